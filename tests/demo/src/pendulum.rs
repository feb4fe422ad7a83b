//! The paper's pendulum, over gRPC.

use std::f64::consts::PI;
use std::time::Instant;

use anyhow::{Context as _, Result};
use plantd_client::{Client, GainExt as _, MatrixExt as _, diagonal, operating_point, v1};
use serde::{Deserialize, Serialize};

use crate::controller::progress;
use crate::latency::{RoundTrips, Stopwatch};

const MODEL: &str = "pendulum";
/// Time step of the regulator, s.
pub(crate) const TIME_STEP_S: f64 = 0.01;
/// Steps of the regulated run, 6 s.
const STEPS: usize = 600;
/// Initial offset from upright, rad.
pub(crate) const OFFSET_RAD: f64 = 0.4;
/// The push: torque, N·m, and the steps during which it acts.
pub(crate) const PUSH_N_M: f64 = 10.0;
const PUSH_STEPS: std::ops::Range<usize> = 300..320;

/// What the controller found.
#[derive(Serialize, Deserialize)]
pub(crate) struct Report {
    /// Angle and momentum after the paper's step.
    pub(crate) theta: f64,
    pub(crate) p: f64,
    /// Its linearization, row by row.
    pub(crate) a: Vec<f64>,
    pub(crate) b: Vec<f64>,
    pub(crate) controllability_rank: u32,
    /// The regulator about upright.
    pub(crate) gain: Vec<f64>,
    pub(crate) spectral_radius: f64,
    /// Angle from upright after each step, rad, starting with the offset.
    pub(crate) regulated: Vec<f64>,
    /// The same disturbances without feedback.
    pub(crate) unregulated: Vec<f64>,
    pub(crate) round_trips: RoundTrips,
}

pub(crate) async fn control(client: &Client) -> Result<Report> {
    let PaperStep { theta, p, linearized } = paper_step(client).await?;
    let linearization = linearized.linearization.context("no linearization")?;
    let solution = regulator(client).await?;
    let gain = solution.gain.context("no gain")?;
    let mut stopwatch = Stopwatch::default();
    let regulated = disturbed_run(client, Some(&gain), &mut stopwatch).await?;
    let unregulated = disturbed_run(client, None, &mut stopwatch).await?;
    Ok(Report {
        theta,
        p,
        a: linearization.a.context("no A")?.data,
        b: linearization.b.context("no B")?.data,
        controllability_rank: linearized.controllability_rank,
        gain: gain.k.as_ref().context("no gain")?.rows_iter().flatten().copied().collect(),
        spectral_radius: solution.spectral_radius,
        regulated,
        unregulated,
        round_trips: stopwatch.round_trips(),
    })
}

struct PaperStep {
    theta: f64,
    p: f64,
    linearized: v1::LinearizeResponse,
}

/// One step of 0.1 s from θ = 0.2, p = 0.5 with torque 0.8, all of it in F⁻ as in the paper.
async fn paper_step(client: &Client) -> Result<PaperStep> {
    const TORQUE: f64 = 0.8;
    let settings = v1::PlantSettings {
        time_step_s: 0.1,
        force_split: v1::ForceSplit::Paper.into(),
        ..Default::default()
    };
    let momentum = v1::initial_state::Momentum { q: vec![0.2], p: vec![0.5], v: vec![] };
    let plant = client
        .create_plant(v1::CreatePlantRequest {
            model: MODEL.to_owned(),
            settings: Some(settings),
            initial: Some(initial(momentum)),
            ..Default::default()
        })
        .await?;
    let point = v1::StateAndInput { state: plant.state, u: vec![TORQUE] };
    let linearized = client
        .linearize(v1::LinearizeRequest {
            model: MODEL.to_owned(),
            settings: Some(settings),
            point: Some(v1::Point { source: Some(v1::point::Source::StateAndInput(point)) }),
        })
        .await?;
    let mut driver = client.drive(&plant.id).await?;
    let state = driver.step(&[TORQUE]).await?.state.context("no state")?;
    driver.close().await?;
    client.delete_plant(plant.id).await?;
    Ok(PaperStep { theta: state.q[0], p: state.p[0], linearized })
}

/// The server's LQR about the upright equilibrium.
async fn regulator(client: &Client) -> Result<v1::SolveLqrResponse> {
    let weights = v1::LqrWeights {
        q: Some(diagonal([100.0, 1.0])),
        r: Some(diagonal([1.0])),
        ..Default::default()
    };
    let request = v1::SolveLqrRequest {
        model: MODEL.to_owned(),
        settings: Some(v1::PlantSettings { time_step_s: TIME_STEP_S, ..Default::default() }),
        point: Some(operating_point("upright")),
        weights: Some(weights),
        ..Default::default()
    };
    Ok(client.solve_lqr(request).await?)
}

/// Starts beside upright and is pushed on the way; returns the angles from upright.
async fn disturbed_run(
    client: &Client,
    gain: Option<&v1::Gain>,
    stopwatch: &mut Stopwatch,
) -> Result<Vec<f64>> {
    let momentum =
        v1::initial_state::Momentum { q: vec![PI + OFFSET_RAD], p: vec![0.0], v: vec![] };
    let plant = client
        .create_plant(v1::CreatePlantRequest {
            model: MODEL.to_owned(),
            settings: Some(v1::PlantSettings { time_step_s: TIME_STEP_S, ..Default::default() }),
            initial: Some(initial(momentum)),
            ..Default::default()
        })
        .await?;
    let mut state = plant.state.context("no state")?;
    let mut angles = vec![state.q[0] - PI];
    let mut driver = client.drive(&plant.id).await?;
    for k in 0..STEPS {
        let start = Instant::now();
        let mut u = gain.map_or_else(|| Ok(vec![0.0]), |gain| gain.control(&state))?;
        if PUSH_STEPS.contains(&k) {
            u[0] += PUSH_N_M;
        }
        state = driver.step(&u).await?.state.context("no state")?;
        stopwatch.record(start.elapsed());
        angles.push(state.q[0] - PI);
        progress("pendulum over gRPC", k + 1, STEPS);
    }
    driver.close().await?;
    client.delete_plant(plant.id).await?;
    Ok(angles)
}

fn initial(momentum: v1::initial_state::Momentum) -> v1::InitialState {
    v1::InitialState { form: Some(v1::initial_state::Form::Momentum(momentum)) }
}
