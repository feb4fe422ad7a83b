//! The marionette of the paper, over shared memory: 22 dynamic coordinates, 18 prescribed ones (the
//! ends and lengths of six strings), 6 constraints.

use std::f64::consts::PI;
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use plantd_client::link::LinkDriver;
use plantd_client::{Client, GainExt as _, MatrixExt as _, diagonal, v1};
use serde::{Deserialize, Serialize};

use crate::controller::progress;
use crate::latency::{RoundTrips, Stopwatch, connect_link};

const MODEL: &str = "marionette";
/// Time step, s.
pub(crate) const TIME_STEP_S: f64 = 0.01;
/// Steps of the experiment, 10 s.
const STEPS: usize = 1001;
/// Amplitude of the strings' lengths, m, and their angular frequency, rad/s.
const AMPLITUDE_M: f64 = 0.1;
const FREQUENCY_RAD_S: f64 = 0.6 * PI;
/// The strings that move, and where each starts: opposite limbs go opposite ways.
const MOVING_STRINGS: [(&str, f64); 4] = [
    ("left_leg_string_length", -1.0),
    ("right_leg_string_length", 1.0),
    ("left_arm_string_length", 1.0),
    ("right_arm_string_length", -1.0),
];
/// The angle that is plotted.
const TORSO_ANGLE: &str = "torso_rx";

/// What the controller found.
#[derive(Serialize, Deserialize)]
pub(crate) struct Report {
    pub(crate) dynamic: usize,
    pub(crate) prescribed: usize,
    pub(crate) constraints: usize,
    /// ‖K₀‖, Frobenius.
    pub(crate) first_gain_norm: f64,
    /// Time for reference, linearization and gains, as the controller waits for them, s.
    pub(crate) solve_s: f64,
    pub(crate) open_loop: Run,
    pub(crate) closed_loop: Run,
    pub(crate) reference_angle: Vec<f64>,
    pub(crate) round_trips: RoundTrips,
}

/// One run from the perturbed state.
#[derive(Serialize, Deserialize)]
pub(crate) struct Run {
    /// ‖q − q_ref‖ of the dynamic coordinates at each step.
    pub(crate) error_norms: Vec<f64>,
    /// Angle of the torso, rad.
    pub(crate) angles: Vec<f64>,
}

pub(crate) async fn control(client: &Client) -> Result<Report> {
    let model = client.get_model(MODEL).await?;
    let strings = Strings::of(&model)?;
    let rows = strings.rows();
    let plant = create(client, at_rest(&model)).await?;
    let start = plant.state.clone().context("no state")?;

    let since = Instant::now();
    let gains = gains(client, start, &rows).await?;
    let solve_s = since.elapsed().as_secs_f64();

    let mut stopwatch = Stopwatch::default();
    let mut driver = connect_link(client, &plant.id).await?;
    let perturbed = perturb(&mut driver, &rows[0])?;
    drop(driver);
    client.delete_plant(plant.id).await?;

    let run = async |with_feedback: bool, stopwatch: &mut Stopwatch| {
        let plant = create(client, perturbed.clone()).await?;
        let mut driver = connect_link(client, &plant.id).await?;
        let run = drive(&mut driver, &gains, &model, with_feedback, stopwatch)?;
        drop(driver);
        client.delete_plant(plant.id).await?;
        Ok::<_, anyhow::Error>(run)
    };
    let open_loop = run(false, &mut stopwatch).await?;
    let closed_loop = run(true, &mut stopwatch).await?;
    let angle = index_of(&model, TORSO_ANGLE)?;
    let first_gain = gains[0].k.as_ref().context("no gain")?;
    Ok(Report {
        dynamic: strings.dynamic,
        prescribed: model.coordinates.len() - strings.dynamic,
        constraints: model.constraints.len(),
        first_gain_norm: first_gain.data.iter().map(|k| k * k).sum::<f64>().sqrt(),
        solve_s,
        open_loop,
        closed_loop,
        reference_angle: gains.iter().map(|gain| gain.x_reference[angle]).collect(),
        round_trips: stopwatch.round_trips(),
    })
}

/// The strings: all held but four, which lengthen and shorten.
pub(crate) struct Strings {
    dynamic: usize,
    held: Vec<f64>,
    /// Entries of those that move, and where each starts.
    moving: Vec<(usize, f64)>,
}

impl Strings {
    pub(crate) fn of(model: &v1::Model) -> Result<Self> {
        let dynamic = model.coordinates.iter().filter(|c| !c.prescribed).count();
        ensure!(model.inputs.is_empty(), "the marionette moves by its strings alone");
        let held = model.coordinates[dynamic..].iter().map(|c| c.initial).collect();
        let moving =
            MOVING_STRINGS.iter().map(|(name, sign)| Ok((index_of(model, name)? - dynamic, *sign)));
        Ok(Self { dynamic, held, moving: moving.collect::<Result<_>>()? })
    }

    /// The input at a time.
    pub(crate) fn at(&self, time_s: f64) -> Vec<f64> {
        let mut u = self.held.clone();
        for &(entry, sign) in &self.moving {
            u[entry] += sign * AMPLITUDE_M * (FREQUENCY_RAD_S * time_s).sin();
        }
        u
    }

    /// Those of the reference motion.
    fn rows(&self) -> Vec<Vec<f64>> {
        (0..STEPS).map(|k| self.at(k as f64 * TIME_STEP_S)).collect()
    }
}

fn index_of(model: &v1::Model, coordinate: &str) -> Result<usize> {
    let position = model.coordinates.iter().position(|c| c.name == coordinate);
    position.with_context(|| format!("the marionette has no coordinate `{coordinate}`"))
}

fn settings() -> v1::PlantSettings {
    v1::PlantSettings {
        time_step_s: TIME_STEP_S,
        force_split: v1::ForceSplit::Paper.into(),
        ..Default::default()
    }
}

/// The scene's configuration twice, one time step apart: the start of the reference.
fn at_rest(model: &v1::Model) -> v1::initial_state::Form {
    let q: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
    let pair = v1::initial_state::TwoConfigurations { q0: q.clone(), q1: q };
    v1::initial_state::Form::TwoConfigurations(pair)
}

async fn create(client: &Client, initial: v1::initial_state::Form) -> Result<v1::PlantInfo> {
    let request = v1::CreatePlantRequest {
        model: MODEL.to_owned(),
        settings: Some(settings()),
        initial: Some(v1::InitialState { form: Some(initial) }),
        open_link: true,
        ..Default::default()
    };
    Ok(client.create_plant(request).await?)
}

/// The server simulates the reference, linearizes along it and solves for the gains. One for each
/// step, and a last one that holds the final reference state only.
async fn gains(client: &Client, start: v1::State, rows: &[Vec<f64>]) -> Result<Vec<v1::Gain>> {
    let (coordinates, inputs) = (start.q.len(), rows[0].len());
    let states = 2 * coordinates;
    let mut q = vec![100.0; coordinates];
    q.resize(states, 1.0);
    let weights = v1::LqrWeights {
        q: Some(diagonal(q)),
        r: Some(diagonal(vec![1.0; inputs])),
        ..Default::default()
    };
    let trajectory = v1::Trajectory { initial: Some(start), u: Some(v1::Matrix::from_rows(rows)) };
    let request = v1::SolveTrajectoryLqrRequest {
        model: MODEL.to_owned(),
        settings: Some(settings()),
        trajectory: Some(trajectory),
        weights: Some(weights),
        // As the paper does; the manifold is the better choice for a new design.
        constraints: v1::ConstraintHandling::Full.into(),
        ..Default::default()
    };
    let mut answers = client.solve_trajectory_lqr(request).await?;
    let mut gains = Vec::with_capacity(STEPS + 1);
    while let Some(answer) = answers.next().await? {
        gains.push(answer.gain.context("no gain")?);
        progress("gains along the motion", gains.len(), STEPS + 1);
    }
    ensure!(gains.len() == STEPS + 1, "{} gains for {STEPS} steps", gains.len());
    Ok(gains)
}

/// Lets the marionette sag under held strings for as long as the experiment lasts, and takes that
/// for a perturbed initial state.
fn perturb(driver: &mut LinkDriver, held: &[f64]) -> Result<v1::initial_state::Form> {
    for k in 0..STEPS {
        driver.step(held)?;
        progress("perturbed initial state", k + 1, STEPS);
    }
    let state = driver.state();
    let momentum = v1::initial_state::Momentum {
        q: state.q.to_vec(),
        p: state.p.to_vec(),
        v: state.v.to_vec(),
    };
    Ok(v1::initial_state::Form::Momentum(momentum))
}

fn drive(
    driver: &mut LinkDriver,
    gains: &[v1::Gain],
    model: &v1::Model,
    with_feedback: bool,
    stopwatch: &mut Stopwatch,
) -> Result<Run> {
    let dynamic = driver.dimensions().dynamic;
    let angle = index_of(model, TORSO_ANGLE)?;
    let task = if with_feedback { "closed loop" } else { "open loop" };
    let mut run = Run { error_norms: Vec::new(), angles: Vec::new() };
    for (k, gain) in gains.iter().enumerate() {
        let q = driver.state().q;
        let squares = q[..dynamic].iter().zip(&gain.x_reference).map(|(q, r)| (q - r).powi(2));
        run.error_norms.push(squares.sum::<f64>().sqrt());
        run.angles.push(q[angle]);
        if k == STEPS {
            break;
        }
        let u =
            if with_feedback { gain.control(&driver.state())? } else { gain.u_reference.clone() };
        let start = Instant::now();
        driver.step(&u)?;
        stopwatch.record(start.elapsed());
        progress(task, k + 1, STEPS);
    }
    Ok(run)
}
