//! Random scenes by the thousand, at random speeds and steps.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Result;
use plantd_models::{Initial, Model, Plant, Scene, Settings, State, StepError};

use crate::case::{Case, Finding, Line};
use crate::geometry::Geometry;
use crate::numbers::Numbers;
use crate::plants::{Method, hold};
use crate::random_scene::{self, Kind};

const TIME_STEPS_S: [f64; 5] = [1e-4, 1e-3, 1e-2, 5e-2, 2e-1];
const SPEEDS: [f64; 3] = [1.0, 10.0, 100.0];
const STEPS: u32 = 30;
/// Halvings of the time step after which a motion that was too fast must be slow enough.
const HALVINGS: i32 = 14;

/// What became of the scenes of one time step and speed.
#[derive(Clone, Copy, Debug, Default)]
struct Count {
    made: u32,
    refused: u32,
}

pub(crate) fn cases() -> Vec<Case> {
    let criterion = "30 steps each of order 2 to 16 in 1 to 7 substeps: an accepted one is finite and violates no constraint by more than 1e-11; \
                     a refused one changes no byte, and either succeeds with steps up to 2¹⁴ times \
                     shorter, or stands where matrices are singular to 1e-6, or has constraints that depend \
                     on each other; linearizations of every \
                     tenth are right";
    vec![Case::new("random scenes", criterion, |setup, finding| {
        let mut counts = BTreeMap::new();
        let mut errors: BTreeMap<&str, u32> = BTreeMap::new();
        let scenes = setup.pick(300, 6_000);
        for seed in (setup.seed << 32..).take(scenes) {
            let mut one = Finding::default();
            let mut random = Numbers::new(seed);
            let (h, s) = (random.below(TIME_STEPS_S.len()), random.below(SPEEDS.len()));
            let count: &mut Count = counts.entry((s, h)).or_default();
            if let Some(error) = run(seed, TIME_STEPS_S[h], SPEEDS[s], count, &mut one)? {
                *errors.entry(error).or_default() += 1;
            }
            finding.absorb(&format!("random-{seed}"), one);
        }
        let made: u32 = counts.values().map(|count| count.made).sum();
        finding.note(format!("{made} scenes of {scenes} seeds; refused: {errors:?}"));
        for (s, speed) in SPEEDS.iter().enumerate() {
            let point = |(h, step): (usize, &f64)| {
                let count = counts.get(&(s, h)).copied().unwrap_or_default();
                (*step, f64::from(count.refused) / f64::from(count.made.max(1)))
            };
            let points = TIME_STEPS_S.iter().enumerate().map(point).collect();
            finding.lines.push(Line { plot: "refused", name: format!("{speed} rad/s"), points });
        }
        Ok(())
    })]
}

/// Steps one scene; the kind of error that ended it.
fn run(
    seed: u64,
    time_step_s: f64,
    speed: f64,
    count: &mut Count,
    finding: &mut Finding,
) -> Result<Option<&'static str>> {
    let scene = Scene::from_toml(&random_scene::scene(seed, Kind::Any))?;
    // A scene may make no sense, or stand at a singular point; that has been refused by name.
    let Ok(model) = Model::compile(&scene) else { return Ok(None) };
    let model = Arc::new(model);
    let (d, mut random) = (model.dimensions(), Numbers::new(!seed));
    let order = [2, 2, 4, 6, 8, 12, 16][random.below(7)];
    let method = Method::new(time_step_s, order, [1, 1, 1, 2, 7][random.below(5)]);
    // Not every scene has every order.
    let mut plants = [method, time_step_s.into()]
        .into_iter()
        .map(|method| Plant::new(model.clone(), method.settings(&model)));
    let Some(Ok(mut plant)) = plants.find(Result::is_ok) else { return Ok(None) };
    let q = plant.q().to_vec();
    let v = (0..d.coordinates())
        .map(|i| if i < d.dynamic { random.between(-speed, speed) } else { 0.0 })
        .collect();
    if plant.initialize(&Initial::Velocity { q, v }).is_err() {
        return Ok(None);
    }
    count.made += 1;
    let geometry = Geometry::new(&model);
    let mut u = vec![0.0; d.input()];
    for _ in 0..STEPS {
        u[..d.inputs].iter_mut().for_each(|u| *u = random.between(-10.0, 10.0) * speed);
        let change: Vec<f64> = (0..d.coordinates())
            .map(|i| if i < d.dynamic { 0.0 } else { random.between(-1.0, 1.0) * time_step_s })
            .collect();
        let next = model.retract(plant.q(), &change);
        u[d.inputs..].copy_from_slice(&next[d.dynamic..]);
        let before = plant.snapshot().to_bytes();
        match plant.step(&u) {
            Ok(_) => {
                let finite = plant.state().x().iter().all(|x| x.is_finite());
                finding.must(finite, || "not finite".to_owned());
                let violation = geometry.violation(plant.q());
                finding.must(violation <= 1e-11, || format!("violation {violation:.1e}"));
            }
            Err(error) => {
                let same = plant.snapshot().to_bytes() == before;
                finding.must(same, || format!("state changed: {error}"));
                count.refused += 1;
                return Ok(Some(judge(&plant, &u, error, finding)));
            }
        }
    }
    if seed.is_multiple_of(10) {
        let still = hold(&plant);
        u[d.inputs..].copy_from_slice(&still[d.inputs..]);
        // The next step may be too violent, or its matrices too close to singular.
        let State { q, p, v, .. } = plant.state();
        plant.initialize(&Initial::Momentum { q, p, v })?;
        match plant.clone().step(&u) {
            Ok(report) if report.constraint_reciprocal_condition > 1e-12 => {}
            _ => return Ok(None),
        }
        finding.linearization(&plant, &u, seed);
    }
    Ok(None)
}

/// Whether a step was refused for the right reason.
fn judge(plant: &Plant, u: &[f64], error: StepError, finding: &mut Finding) -> &'static str {
    let kind = match error {
        StepError::NotConverged { .. } => "not converged",
        StepError::NotFinite { .. } => "not finite",
        StepError::TooFast { .. } => "too fast",
        StepError::Singular { .. } => "singular",
        StepError::SingularConstraints { .. } => "singular constraints",
        StepError::InconsistentConstraints { .. } => "inconsistent",
        StepError::Dimension { .. }
        | StepError::InputNotFinite { .. }
        | StepError::TooManySteps { .. } => "input",
    };
    let found = plant.clone().diagnose();
    let condition =
        found.mass_matrix_reciprocal_condition.min(found.constraint_reciprocal_condition);
    // Equations that depend on each other may well contradict each other when prescribed motion goes on.
    let may_contradict =
        plant.model().dimensions().prescribed > 0 && !found.redundant_constraints.is_empty();
    let right = may_contradict || condition < 1e-6 || shorter_step_succeeds(plant, u);
    finding.must(right && kind != "input", || format!("{error} at condition {condition:.0e}"));
    kind
}

/// Whether a shorter step from the same state succeeds, with the same forces and velocities of
/// prescribed coordinates.
fn shorter_step_succeeds(plant: &Plant, u: &[f64]) -> bool {
    let (model, state) = (plant.model(), plant.state());
    let d = model.dimensions();
    (1..=HALVINGS).any(|m| {
        let part = 2_f64.powi(-m);
        let settings =
            Settings { time_step_s: plant.settings().time_step_s * part, ..*plant.settings() };
        let Ok(mut shorter) = Plant::new(model.clone(), settings) else { return false };
        let (q, p, v) = (state.q.clone(), state.p.clone(), state.v.clone());
        if shorter.initialize(&Initial::Momentum { q, p, v }).is_err() {
            return false;
        }
        let mut end = state.q.clone();
        end[d.dynamic..].copy_from_slice(&u[d.inputs..]);
        let change: Vec<f64> =
            model.difference(&state.q, &end).iter().map(|change| part * change).collect();
        let next = model.retract(&state.q, &change);
        let u = [&u[..d.inputs], &next[d.dynamic..]].concat();
        shorter.step(&u).is_ok()
    })
}
