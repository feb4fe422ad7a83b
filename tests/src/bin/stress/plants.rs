//! Plants, and what moves them.

use std::sync::Arc;

use anyhow::{Context as _, Result, anyhow};
use plantd_models::{
    HALVINGS_MAX, Initial, Model, Plant, Scene, Settings, StepError, StepReport, builtin,
};

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

/// A scene from TOML without its head; without gravity, unless the text has one.
pub(crate) fn parse(text: &str) -> Result<Scene> {
    let mut scene = Scene::from_toml(&format!("format = 1\nname = \"stress\"\n{text}"))?;
    scene.gravity.get_or_insert_default();
    Ok(scene)
}

/// How plants are stepped; a time step alone means order 2 in one step, halved where it must be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Method {
    pub(crate) time_step_s: f64,
    pub(crate) order: u32,
    pub(crate) substeps: u32,
    pub(crate) halvings: u32,
}

impl From<f64> for Method {
    fn from(time_step_s: f64) -> Self {
        Self { time_step_s, order: 2, substeps: 1, halvings: HALVINGS_MAX }
    }
}

impl Method {
    pub(crate) fn new(time_step_s: f64, order: u32, substeps: u32) -> Self {
        Self { order, substeps, ..time_step_s.into() }
    }

    /// Order and substeps in a name; nothing for 2 and 1.
    pub(crate) fn name(self) -> String {
        match (self.order, self.substeps) {
            (2, 1) => String::new(),
            (order, 1) => format!(", order {order}"),
            (order, substeps) => format!(", order {order} in {substeps} substeps"),
        }
    }

    /// Refuses what it cannot do in one go.
    pub(crate) fn unhalved(self) -> Self {
        Self { halvings: 0, ..self }
    }

    pub(crate) fn settings(self, model: &Model) -> Settings {
        let Self { time_step_s, order, substeps, halvings } = self;
        Settings { time_step_s, order, substeps, halvings, ..Settings::new(model) }
    }
}

/// A plant at the initial configuration of its scene.
pub(crate) fn plant(scene: &Scene, method: impl Into<Method>) -> Result<Plant> {
    let model = Arc::new(Model::compile(scene)?);
    let settings = method.into().settings(&model);
    Ok(Plant::new(model, settings)?)
}

/// A plant with a velocity.
pub(crate) fn moving(
    scene: &Scene,
    method: impl Into<Method>,
    q: &[f64],
    v: &[f64],
) -> Result<Plant> {
    let mut plant = plant(scene, method)?;
    plant.initialize(&Initial::Velocity { q: q.to_vec(), v: v.to_vec() })?;
    Ok(plant)
}

/// A plant in its initial configuration with unlike velocities.
pub(crate) fn pushed(scene: &Scene, method: impl Into<Method>, size: f64) -> Result<Plant> {
    let mut plant = plant(scene, method)?;
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
