//! The accuracy mode: which order and how many substeps reach a tolerance, found by a probe.
//!
//! The probe is the motion over fifty control periods from a state with the input that holds still.
//! Its reference is the highest order there is, in as many substeps as it takes until twice as many change
//! it by no more than a tenth of the tolerance. For each order, the number of substeps is raised by what
//! its error asks for, `(error / tolerance)^(1/order)`, until the error is below the tolerance; of those
//! that get there the one with the fewest evaluations is taken. No clock is read: the choice is the same
//! everywhere.

use std::sync::Arc;

use plantd_math::norms::larger;

use crate::integrator::report::StepError;
use crate::integrator::scheme::Scheme;
use crate::integrator::settings::{SUBSTEPS_MAX, Settings};
use crate::integrator::state::State;
use crate::plant::facade::Plant;
use crate::plant::initial::{Initial, InitialError};

/// Control periods of the probe.
const PERIODS: u32 = 50;
/// All orders.
const ORDERS: [u32; 6] = [2, 4, 6, 8, 12, 16];
/// Tolerances below are not told from round-off.
const LEAST: f64 = 1e-13;
/// Evaluations of coordinates after which the probe is given up.
const MOST_EVALUATIONS: u64 = 100_000_000;

/// What was chosen, and why.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Order of the method.
    pub order: u32,
    /// Substeps in a control period.
    pub substeps: u32,
    /// Largest error of a coordinate during the probe, rad or m.
    pub error: f64,
    /// Control periods of the probe.
    pub periods: u32,
}

/// Why there is no choice.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChoiceError {
    /// The tolerance is not a number, or too small.
    #[error("a tolerance of {0:e} is out of reach; it must be finite and at least 1e-13")]
    Tolerance(f64),
    /// The settings or the state were refused.
    #[error(transparent)]
    Initial(#[from] InitialError),
    /// The motion ends within the probe.
    #[error("the probe ends in period {period}: {error}")]
    Step {
        /// The period.
        period: u32,
        /// Why.
        error: StepError,
    },
    /// The probe takes too long.
    #[error("the probe takes more evaluations than are worth it; take a shorter time step")]
    TooLong,
    /// It was told not to go on.
    #[error("nobody waits for the choice")]
    Cancelled,
    /// No order reaches the tolerance, or no reference does.
    #[error(
        "no order with up to {SUBSTEPS_MAX} substeps reaches {tolerance:e} over the probe; take a shorter time step"
    )]
    OutOfReach {
        /// The tolerance.
        tolerance: f64,
    },
}

/// The probe.
struct Probe<'a> {
    plant: &'a Plant,
    state: State,
    evaluations: u64,
    go_on: &'a mut dyn FnMut() -> bool,
}

impl Plant {
    /// Finds the order and the substeps that keep the error of every coordinate below a tolerance, rad or m,
    /// over 50 control periods from the present state. The plant's own order and substeps do not count.
    ///
    /// Simulates the probe some tens of times; asks `go_on` in every period whether to.
    pub fn choose_method(
        &self,
        tolerance: f64,
        go_on: &mut dyn FnMut() -> bool,
    ) -> Result<Choice, ChoiceError> {
        if !(tolerance.is_finite() && tolerance >= LEAST) {
            return Err(ChoiceError::Tolerance(tolerance));
        }
        let mut probe = Probe { plant: self, state: self.state(), evaluations: 0, go_on };
        let out_of_reach = ChoiceError::OutOfReach { tolerance };
        let reference = probe.reference(tolerance)?.ok_or(out_of_reach.clone())?;
        let mut best: Option<(u64, Choice)> = None;
        for order in ORDERS {
            let cheapest = best.as_ref().map_or(u64::MAX, |(cost, _)| *cost);
            let reached = probe.reach(order, tolerance, &reference, cheapest)?;
            best = reached.filter(|(cost, _)| *cost < cheapest).or(best);
        }
        best.map(|(_, choice)| choice).ok_or(out_of_reach)
    }
}

impl Probe<'_> {
    /// Configurations at the ends of the periods, and the evaluations that they took.
    fn run(&mut self, order: u32, substeps: u32) -> Result<(Vec<f64>, u64), ChoiceError> {
        let model = Arc::clone(self.plant.model());
        let settings = Settings { order, substeps, ..*self.plant.settings() };
        let stages = match settings.check(&model)? {
            Scheme::Gauss(stages) => stages as u64,
            Scheme::Midpoint => 1,
        };
        let State { q, p, v, step, .. } = self.state.clone();
        let mut plant = Plant::at(model, settings, &Initial::Momentum { q, p, v })?;
        plant.set_step_index(step);
        let start = plant.q().to_vec();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        let (mut path, mut cost) = (Vec::new(), 0);
        let coordinates = start.len() as u64;
        for period in 0..PERIODS {
            if !(self.go_on)() {
                return Err(ChoiceError::Cancelled);
            }
            if self.evaluations > MOST_EVALUATIONS {
                return Err(ChoiceError::TooLong);
            }
            plant.hold_input(&mut u);
            let report = plant.step(&u).map_err(|error| ChoiceError::Step { period, error })?;
            // A factorization costs about as much as three evaluations.
            let evaluations =
                stages * u64::from(report.iterations + 3) + 3 * u64::from(report.factorizations);
            cost += evaluations;
            self.evaluations += coordinates * evaluations;
            path.extend(plant.model().difference(&start, plant.q()));
        }
        Ok((path, cost))
    }

    /// The motion itself, to a tenth of the tolerance.
    fn reference(&mut self, tolerance: f64) -> Result<Option<Vec<f64>>, ChoiceError> {
        let exists = |order: &&u32| {
            let settings = Settings { order: **order, substeps: 1, ..*self.plant.settings() };
            settings.check(self.plant.model()).is_ok()
        };
        let order = ORDERS.iter().rev().find(exists).copied().unwrap_or(2);
        let mut substeps = 2;
        let mut before = self.run(order, substeps).map(|(path, _)| path);
        while 2 * substeps <= SUBSTEPS_MAX {
            substeps *= 2;
            let path = self.run(order, substeps)?.0;
            if before.is_ok_and(|before| distance(&before, &path) <= 0.1 * tolerance) {
                return Ok(Some(path));
            }
            before = Ok(path);
        }
        Ok(None)
    }

    /// The fewest substeps with which an order reaches the tolerance, if they cost less than others.
    fn reach(
        &mut self,
        order: u32,
        tolerance: f64,
        reference: &[f64],
        cheapest: u64,
    ) -> Result<Option<(u64, Choice)>, ChoiceError> {
        let mut substeps = 1;
        while substeps <= SUBSTEPS_MAX {
            let raise = match self.run(order, substeps) {
                Ok((path, cost)) => {
                    let error = distance(&path, reference);
                    if error <= tolerance {
                        let choice = Choice { order, substeps, error, periods: PERIODS };
                        return Ok(Some((cost, choice)));
                    }
                    if cost > cheapest {
                        return Ok(None);
                    }
                    // No more than fourfold at once: far from the limit an order is not what it will be.
                    (error / tolerance).powf(1.0 / f64::from(order)).min(4.0)
                }
                Err(ChoiceError::Initial(_)) => return Ok(None),
                Err(ChoiceError::Step { .. }) => 2.0,
                Err(error) => return Err(error),
            };
            substeps = ((f64::from(substeps) * raise) as u32).max(substeps + 1);
        }
        Ok(None)
    }
}

/// Largest difference.
fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a - b).fold(0.0, larger)
}

/// What a control period is off by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorEstimate {
    /// Largest error of a coordinate, rad or m.
    pub configuration: f64,
    /// Largest error of a momentum relative to the largest momentum or its change in the period.
    pub momentum: f64,
}

impl Plant {
    /// Estimates the error of the period from here, by taking it in twice as many substeps: with the order
    /// `r`, `|x_h − x_{h/2}| / (1 − 2⁻ʳ)` (Richardson). Stays in place; allocates, and costs about four
    /// steps.
    pub fn estimate_error(&self, u: &[f64]) -> Result<ErrorEstimate, StepError> {
        let mut whole = self.clone();
        whole.step(u)?;
        let mut halves = self.clone();
        halves.settings.substeps *= 2;
        halves.state.past.forget();
        halves.step(u)?;
        let scale = 1.0 / (1.0 - (-f64::from(self.settings.order)).exp2());
        let configuration = self.model.difference(whole.q(), halves.q());
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        let size = largest(whole.p()).max(distance(whole.p(), self.p())).max(f64::MIN_POSITIVE);
        Ok(ErrorEstimate {
            configuration: scale * largest(&configuration),
            momentum: scale * distance(whole.p(), halves.p()) / size,
        })
    }
}
