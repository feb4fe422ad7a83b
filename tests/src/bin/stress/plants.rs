//! Plants, and what moves them.

use std::sync::Arc;

use anyhow::{Context as _, Result, anyhow};
use plantd_models::{Initial, Model, Plant, Scene, Settings, StepError, StepReport, builtin};

use crate::case::Finding;

/// A built-in scene.
pub(crate) fn scene(name: &str) -> Scene {
    builtin::scene(name).unwrap_or_else(|| panic!("no scene {name}"))
}

/// A built-in scene that keeps its energy.
pub(crate) fn undamped(name: &str) -> Scene {
    let mut scene = Scene { damping: 0.0, ..scene(name) };
    scene.coordinates.iter_mut().for_each(|coordinate| coordinate.damping = None);
    scene
}

/// A scene from TOML without its head.
pub(crate) fn parse(text: &str) -> Result<Scene> {
    Ok(Scene::from_toml(&format!("format = 1\nname = \"stress\"\n{text}"))?)
}

/// How plants are stepped, unless a case says otherwise.
pub(crate) fn settings(model: &Model, time_step_s: f64) -> Settings {
    Settings { time_step_s, ..Settings::new(model) }
}

/// A plant at the initial configuration of its scene.
pub(crate) fn plant(scene: &Scene, time_step_s: f64) -> Result<Plant> {
    let model = Arc::new(Model::compile(scene)?);
    let settings = settings(&model, time_step_s);
    Ok(Plant::new(model, settings)?)
}

/// A plant with a velocity.
pub(crate) fn moving(scene: &Scene, time_step_s: f64, q: &[f64], v: &[f64]) -> Result<Plant> {
    let mut plant = plant(scene, time_step_s)?;
    plant.initialize(&Initial::Velocity { q: q.to_vec(), v: v.to_vec() })?;
    Ok(plant)
}

/// A plant in its initial configuration with unlike velocities.
pub(crate) fn pushed(scene: &Scene, time_step_s: f64, size: f64) -> Result<Plant> {
    let mut plant = plant(scene, time_step_s)?;
    let d = plant.model().dimensions();
    let q = plant.q().to_vec();
    let speed = |i: usize| if i < d.dynamic { size * (1.0 + i as f64).sin() } else { 0.0 };
    let v = (0..d.coordinates()).map(speed).collect();
    plant.initialize(&Initial::Velocity { q, v })?;
    Ok(plant)
}

/// The input that holds prescribed coordinates and exerts no force.
pub(crate) fn hold(plant: &Plant) -> Vec<f64> {
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    u
}

/// A step that must succeed.
pub(crate) fn step(plant: &mut Plant, u: &[f64]) -> Result<StepReport> {
    plant.step(u).map_err(|error| anyhow!("step {}: {error}", plant.step_index()))
}

/// Steps with [`hold`].
pub(crate) fn coast(plant: &mut Plant, steps: u64) -> Result<()> {
    let u = hold(plant);
    (0..steps).try_for_each(|_| step(plant, &u).map(drop))
}

/// Total energy, J.
pub(crate) fn energy(plant: &mut Plant) -> f64 {
    let energy = plant.energy();
    energy.kinetic_j + energy.potential_j
}

/// The greatest distance of the energy from its start over a number of steps.
pub(crate) fn energy_error(plant: &mut Plant, steps: u64) -> Result<f64> {
    let (u, start) = (hold(plant), energy(plant));
    let mut worst = 0.0_f64;
    for _ in 0..steps {
        step(plant, &u)?;
        let error = (energy(plant) - start).abs();
        // A NaN stays.
        worst = if error <= worst { worst } else { error };
    }
    Ok(worst)
}

/// Energy between the highest and the lowest place of hanging bodies, all weights once up and down: the
/// sum of `2 m g l` for a chain of hinges, J.
pub(crate) fn well_depth(scene: &Scene) -> Result<f64> {
    let mut plant = plant(scene, 1.0)?;
    let n = plant.model().dimensions().coordinates();
    let at_rest = |plant: &mut Plant, first: f64| -> Result<f64> {
        let mut q = vec![0.0; n];
        q[0] = first;
        Ok(plant.energy_at(&q, &vec![0.0; n])?.potential_j)
    };
    let up = at_rest(&mut plant, std::f64::consts::PI).context("upright")?;
    Ok(up - at_rest(&mut plant, 0.0)?)
}

/// Largest entry, in size.
pub(crate) fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |a, x| if x.abs() <= a { a } else { x.abs() })
}

/// Largest difference of two vectors.
pub(crate) fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, |a, x| if x <= a { a } else { x })
}

/// Steps; how many succeeded before one was refused, which must leave every byte of the state.
pub(crate) fn until_refused(
    plant: &mut Plant,
    steps: u64,
    mut seen: impl FnMut(&mut Plant),
) -> Result<(u64, Option<StepError>)> {
    let u = hold(plant);
    for k in 0..steps {
        let before = plant.snapshot().to_bytes();
        if let Err(error) = plant.step(&u) {
            return match plant.snapshot().to_bytes() == before {
                true => Ok((k, Some(error))),
                false => Err(anyhow!("a refused step changed the state: {error}")),
            };
        }
        seen(plant);
    }
    Ok((steps, None))
}

/// Notes why a step was refused.
pub(crate) fn refused(finding: &mut Finding, what: &str, (steps, error): (u64, Option<StepError>)) {
    if let Some(error) = error {
        finding.note(format!("{what} refused after {steps} steps: {error}"));
    }
}
