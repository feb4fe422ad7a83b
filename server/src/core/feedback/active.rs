//! A plant's feedback at work.

use std::sync::Arc;

use plantd_models::{Model, Plant, StepError};

use crate::core::feedback::law::Law;
use crate::core::feedback::regulator::{RegulatorError, Spec};

/// What a feedback does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Nothing; its gains are for watchers.
    WatchOnly,
    /// The law instead of the driver's input.
    Replace,
    /// The law plus the driver's input forces.
    Add,
    /// The driver's input until a bound is passed, from then on the law.
    Guard,
}

/// A bound of an entry of `x ⊖ x_ref`.
#[derive(Clone, Debug, PartialEq)]
pub struct GuardBound {
    /// Index of the entry.
    pub index: usize,
    /// Its name.
    pub name: String,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
}

/// When and why a watchdog took over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trip {
    /// Step of the plant.
    pub step: u64,
    /// Index among the bounds.
    pub bound: usize,
}

/// What there is to say of a feedback.
#[derive(Clone, Debug)]
pub struct FeedbackInfo {
    /// What it does.
    pub mode: Mode,
    /// Which of the plant's computations of laws it comes from.
    pub revision: u64,
    /// Step at which a trajectory begins.
    pub first_step: u64,
    /// Steps of the trajectory; 0 about a point.
    pub horizon: usize,
    /// Step at which the watchdog took over, and the entry of x that left its bound.
    pub tripped: Option<(u64, String)>,
    /// Why the last computation of its law failed.
    pub failure: Option<Arc<RegulatorError>>,
}

/// A plant's feedback.
#[derive(Debug)]
pub struct Feedback {
    /// What the law is computed from.
    pub spec: Arc<Spec>,
    /// The law in force.
    pub law: Arc<Law>,
    /// What it does.
    pub mode: Mode,
    /// Bounds of the watchdog.
    pub guard: Vec<GuardBound>,
    /// The watchdog took over.
    pub tripped: Option<Trip>,
    /// Step at which a trajectory begins.
    pub first_step: u64,
    /// Step from which the law holds.
    pub since_step: u64,
    /// Which of the plant's computations of laws it comes from.
    pub revision: u64,
    /// Parameters and time step to which the last computation belongs; see
    /// `Changed::generation` of the core.
    pub generation: u64,
    /// Why that computation failed.
    pub failure: Option<Arc<RegulatorError>>,
    error: Vec<f64>,
}

impl Feedback {
    /// A feedback with a law that was computed for the `generation`.
    pub fn new(spec: Arc<Spec>, law: Law, mode: Mode, guard: Vec<GuardBound>) -> Self {
        let states = law.stages.first().map_or(0, |stage| stage.x.len());
        Self {
            spec,
            law: Arc::new(law),
            mode,
            guard,
            tripped: None,
            first_step: 0,
            since_step: 0,
            revision: 0,
            generation: 0,
            failure: None,
            error: vec![0.0; states],
        }
    }

    /// Writes the input of the next step into `applied`, if the feedback has a say in it; `driver` is
    /// what the driver sends.
    pub fn input(
        &mut self,
        plant: &Plant,
        driver: &[f64],
        applied: &mut [f64],
    ) -> Result<bool, StepError> {
        let expected = applied.len();
        if self.mode == Mode::WatchOnly {
            return Ok(false);
        }
        let is_needed = self.mode != Mode::Replace || !driver.is_empty();
        if is_needed && driver.len() != expected {
            return Err(StepError::Dimension { expected, actual: driver.len() });
        }
        let (law, error) = (&self.law, &mut self.error);
        let (stage, reference) = law.at(plant.step_index().saturating_sub(self.first_step));
        write_error(plant.model(), reference, plant, error);
        if self.mode == Mode::Guard && self.tripped.is_none() {
            let left = |bound: &GuardBound| {
                !(error[bound.index] >= bound.min && error[bound.index] <= bound.max)
            };
            let Some(bound) = self.guard.iter().position(left) else { return Ok(false) };
            self.tripped = Some(Trip { step: plant.step_index(), bound });
        }
        stage.write_input(error, applied);
        if self.mode == Mode::Add {
            let inputs = plant.model().dimensions().inputs;
            for (applied, driver) in applied.iter_mut().zip(driver).take(inputs) {
                *applied += driver;
            }
        }
        Ok(true)
    }

    /// What there is to say of it.
    pub fn info(&self) -> FeedbackInfo {
        let entry = |trip: Trip| self.guard.get(trip.bound).map(|bound| bound.name.clone());
        FeedbackInfo {
            mode: self.mode,
            revision: self.revision,
            first_step: self.first_step,
            horizon: self.law.horizon(),
            tripped: self.tripped.map(|trip| (trip.step, entry(trip).unwrap_or_default())),
            failure: self.failure.clone(),
        }
    }

    /// What watchers of gains get.
    pub fn in_force(&self) -> InForce {
        InForce {
            law: Arc::clone(&self.law),
            first_step: self.first_step,
            since_step: self.since_step,
            revision: self.revision,
            failure: self.failure.clone().map(|failure| (self.generation, failure)),
        }
    }
}

/// `x ⊖ x_ref`.
fn write_error(model: &Model, reference: &[f64], plant: &Plant, error: &mut [f64]) {
    let n = model.dimensions().coordinates();
    let (error_q, error_rest) = error.split_at_mut(n);
    model.write_difference(&reference[..n], plant.q(), error_q);
    let rest = plant.p().iter().chain(plant.v());
    for (error, (x, reference)) in error_rest.iter_mut().zip(rest.zip(&reference[n..])) {
        *error = x - reference;
    }
}

/// A law with what watchers of gains need to know of it.
#[derive(Clone, Debug)]
pub struct InForce {
    /// The law.
    pub law: Arc<Law>,
    /// Step at which a trajectory begins.
    pub first_step: u64,
    /// Step from which the law holds.
    pub since_step: u64,
    /// Which computation it comes from.
    pub revision: u64,
    /// Why the last computation failed, and for which parameters and time step.
    pub failure: Option<(u64, Arc<RegulatorError>)>,
}

impl InForce {
    /// The gain at a step of the plant: rows of as many entries as `x` has, one after the other.
    pub fn gain_at(&self, step: u64) -> &[f64] {
        &self.law.at(step.saturating_sub(self.first_step)).0.k
    }

    /// Number of messages: one about a point; one per step and the final state along a trajectory.
    pub fn count(&self) -> usize {
        if self.law.end.is_some() { self.law.stages.len() + 1 } else { 1 }
    }

    /// Index of the first message that matters at a step of the plant.
    pub fn first(&self, step: u64) -> usize {
        let k = usize::try_from(step.saturating_sub(self.first_step)).unwrap_or(usize::MAX);
        k.min(self.law.stages.len() - 1)
    }
}
