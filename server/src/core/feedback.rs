//! Feedback laws `u = u_ref + feedforward − K (x ⊖ x_ref)` in a plant's own loop.
//!
//! A law is computed on a worker and then only read: a step with feedback allocates nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use plantd_models::{Model, Plant, StepError};

use crate::core::limits::LimitExceeded;
use crate::core::regulator::{RegulatorError, Spec};

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

/// The law of one step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Stage {
    /// Gain, rows of as many entries as `x` has, one after the other.
    pub k: Vec<f64>,
    /// Reference state.
    pub x: Vec<f64>,
    /// Reference input.
    pub u: Vec<f64>,
    /// Added to it; empty means zero.
    pub feedforward: Vec<f64>,
}

impl Stage {
    /// `u_ref + feedforward − k error`, the terms of each sum from first to last.
    fn write_input(&self, error: &[f64], out: &mut [f64]) {
        // A plant without coordinates has no rows to cut.
        for (i, out) in out.iter_mut().enumerate() {
            let row = &self.k[i * error.len()..][..error.len()];
            let correction: f64 = row.iter().zip(error).map(|(k, error)| k * error).sum();
            *out = self.u[i] + self.feedforward.get(i).copied().unwrap_or(0.0) - correction;
        }
    }
}

/// A law about a point, or along a trajectory.
#[derive(Debug)]
pub struct Law {
    /// About a point one, along a trajectory one per step.
    pub stages: Vec<Stage>,
    /// Final state of a trajectory.
    pub end: Option<Vec<f64>>,
    /// Room in memory.
    pub room: Reservation,
}

impl Law {
    /// Steps of the trajectory; 0 about a point.
    pub fn horizon(&self) -> usize {
        if self.end.is_some() { self.stages.len() } else { 0 }
    }

    /// Stage and reference state at so many steps after the beginning. After the end, the last stage
    /// with the final state.
    fn at(&self, step: u64) -> (&Stage, &[f64]) {
        let last = self.stages.len() - 1;
        let k = usize::try_from(step).unwrap_or(usize::MAX);
        match &self.end {
            Some(end) if k > last => (&self.stages[last], end),
            _ => (&self.stages[k.min(last)], &self.stages[k.min(last)].x),
        }
    }
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
    /// [`crate::core::session::Session`].
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

/// Room in memory for what all plants or watchers together hold.
#[derive(Debug)]
pub struct Room {
    name: &'static str,
    what: &'static str,
    used: AtomicU64,
    limit: u64,
}

impl Room {
    /// Room for so many numbers: the limit of that name, for what it is.
    pub fn new(name: &'static str, what: &'static str, limit: u64) -> Arc<Self> {
        Arc::new(Self { name, what, used: AtomicU64::new(0), limit })
    }

    /// Takes room for so many numbers.
    pub fn reserve(self: &Arc<Self>, numbers: usize) -> Result<Reservation, LimitExceeded> {
        let numbers = u64::try_from(numbers).unwrap_or(u64::MAX);
        let take = |used: u64| used.checked_add(numbers).filter(|sum| *sum <= self.limit);
        match self.used.fetch_update(Ordering::AcqRel, Ordering::Acquire, take) {
            Ok(_) => Ok(Reservation { room: Arc::clone(self), numbers }),
            Err(used) => Err(LimitExceeded {
                name: self.name,
                limit: self.limit,
                what: self.what,
                actual: used.saturating_add(numbers),
            }),
        }
    }
}

/// Room that is taken until this is dropped.
#[derive(Debug)]
pub struct Reservation {
    room: Arc<Room>,
    numbers: u64,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.room.used.fetch_sub(self.numbers, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_is_given_back() {
        let room = Room::new("feedback_numbers", "numbers", 10);
        let first = room.reserve(6).unwrap();
        let refused = room.reserve(5).unwrap_err();
        assert_eq!((refused.name, refused.actual), ("feedback_numbers", 11));
        assert!(room.reserve(usize::MAX).is_err());
        drop(first);
        room.reserve(10).unwrap();
    }

    #[test]
    fn a_trajectory_holds_before_its_beginning_and_after_its_end() {
        let room = Room::new("feedback_numbers", "numbers", 10).reserve(1).unwrap();
        let stage = |x: f64| Stage { x: vec![x], u: vec![0.0], k: vec![1.0], ..Stage::default() };
        let law = Law { stages: vec![stage(0.0), stage(1.0)], end: Some(vec![2.0]), room };
        let reference = |step| law.at(step).1[0];
        assert_eq!([0, 1, 2, 3, u64::MAX].map(reference), [0.0, 1.0, 2.0, 2.0, 2.0]);
        assert_eq!(law.at(7).0, &stage(1.0));
    }

    #[test]
    fn the_law_adds_feedforward_and_subtracts_the_correction() {
        let stage = Stage {
            k: vec![1.0, 2.0, 3.0, 4.0],
            x: vec![0.0; 2],
            u: vec![10.0, 20.0],
            feedforward: vec![0.5, -0.5],
        };
        let mut out = [0.0; 2];
        stage.write_input(&[1.0, -1.0], &mut out);
        assert_eq!(out, [11.5, 20.5]);
        let rigid = Stage { u: vec![10.0, 20.0], ..Stage::default() };
        rigid.write_input(&[], &mut out);
        assert_eq!(out, [10.0, 20.0]);
    }
}
