//! When a search ends, and when the multipliers of bounds are renewed.

use super::Optimizer;
use crate::optimize::bounds::End;
use crate::optimize::{BoundState, Status, Stuck};

/// Growth of the penalty.
const PENALTY_GROWTH: f64 = 4.0;
/// The error of bounds that the penalty need not grow for, in units of the error before.
const PENALTY_WORKS: f64 = 0.5;
/// Beyond this penalty the bounds are taken to be out of reach.
const PENALTY_MAX: f64 = 1e9;
/// From this penalty on bounds are what keeps a search from descending.
const PENALTY_FIRM: f64 = 1e6;
/// Part of the first cost to which the cost is minimised before multipliers are renewed.
const RENEW_BELOW: f64 = 1e-6;
/// The same as part of the penalties' energy.
const RENEW_WITHIN: f64 = 1e-2;
/// Tolerance where none is given, in units of the first cost.
const TOLERANCE: f64 = 1e-9;
/// A promised decrease below this part of the cost drowns in its round-off.
const ROUND_OFF: f64 = 1e-12;
/// Where the cost cannot tell a descent, the directional derivative that a step must leave, in units of
/// the one before.
const BLIND_PROGRESS: f64 = 0.9;

impl Optimizer {
    fn tolerance(&self) -> f64 {
        self.options.tolerance.unwrap_or(TOLERANCE * self.first_cost.abs())
    }

    pub(super) fn end_by_count(&mut self, derivative: f64) {
        if self.status == Status::Running && self.iterations >= self.options.max_iterations {
            self.status = Status::Stuck(Stuck::MaxIterations {
                iterations: self.iterations,
                derivative,
                tolerance: self.tolerance(),
                bounds: self.bound_state(),
            });
        }
    }

    /// How well the bounds are settled; none without any.
    fn bound_state(&self) -> Option<BoundState> {
        self.problem.has_bounds().then(|| BoundState {
            violation: self.bound_violation(),
            error: self.error_of_bounds(),
            tolerance: self.options.bound_tolerance,
            penalty: self.penalty,
        })
    }

    /// Whether nothing is to be gained along the direction: the search has converged, or multipliers
    /// are renewed.
    pub(super) fn has_ended(&mut self, derivative: f64) -> bool {
        let (size, error) = (derivative.abs(), self.error_of_bounds());
        if error <= self.options.bound_tolerance {
            if size <= self.tolerance() {
                self.status = Status::Converged;
            }
            return size <= self.tolerance();
        }
        // Renewed again without a step, multipliers would follow errors that they had no part in, and
        // the penalty would grow without end.
        let renews = self.has_stepped() && size <= self.renew_below();
        if renews {
            self.renew_multipliers(error);
        }
        renews
    }

    /// Whether a step was taken since the multipliers were renewed.
    fn has_stepped(&self) -> bool {
        self.last_derivative != 0.0
    }

    /// A change of the cost that is not to be told from its round-off.
    pub(super) fn round_off(&self) -> f64 {
        ROUND_OFF * self.current.cost.abs().max(self.current.merit.abs())
    }

    /// Whether a search that finds no step has converged: the cost is as low as its round-off lets it be.
    pub(super) fn ends_at(&self, derivative: f64) -> bool {
        derivative.abs() <= self.round_off()
            && self.error_of_bounds() <= self.options.bound_tolerance
    }

    /// Whether multipliers are due where no step is found: kinks of the penalties may stand in the way,
    /// which move with them.
    pub(super) fn renews_at(&self, derivative: f64) -> bool {
        let low = self.round_off().max(RENEW_BELOW * self.first_cost.abs());
        derivative.abs() <= low
            && self.has_stepped()
            && self.error_of_bounds() > self.options.bound_tolerance
    }

    /// No step descends.
    pub(super) fn end_without_step(&mut self, derivative: f64) {
        let is_violated = self.bound_violation() > self.options.bound_tolerance;
        if self.ends_at(derivative) {
            self.status = Status::Converged;
        } else if self.renews_at(derivative) {
            self.renew_multipliers(self.error_of_bounds());
        } else if is_violated && self.penalty >= PENALTY_FIRM {
            self.give_up_bounds();
        } else {
            self.status = Status::Stuck(Stuck::NoDescent {
                derivative,
                cost: self.current.merit,
                backtracks: self.options.max_backtracks,
                tolerance: self.tolerance(),
                bounds: self.bound_state(),
            });
        }
    }

    /// The directional derivative at which multipliers are renewed: so small that the errors of bounds are
    /// those of the penalty, not of a minimum that is not reached yet.
    fn renew_below(&self) -> f64 {
        let energy = self.sum(|end, number, multiplier| {
            let error = end.error(number, multiplier, self.penalty);
            0.5 * end.weight(self.penalty) * error * error
        });
        (RENEW_WITHIN * energy).min(RENEW_BELOW * self.first_cost.abs())
    }

    fn renew_multipliers(&mut self, error: f64) {
        let Self { problem, current, multipliers, penalty, .. } = self;
        for k in 0..=problem.steps {
            for (end, place) in problem.ends.at(false, k) {
                let number = current.x(k)[end.index];
                multipliers[place] = end.renewed(number, multipliers[place], *penalty);
            }
            if k < problem.steps {
                for (end, place) in problem.ends.at(true, k) {
                    let number = current.u(k)[end.index];
                    multipliers[place] = end.renewed(number, multipliers[place], *penalty);
                }
            }
        }
        if !(error <= PENALTY_WORKS * self.bound_error) {
            self.penalty *= PENALTY_GROWTH;
        }
        self.bound_error = error;
        self.last_derivative = 0.0;
        if self.penalty > PENALTY_MAX {
            self.give_up_bounds();
        }
        self.current.merit = self.merit(&self.current);
    }

    fn give_up_bounds(&mut self) {
        if let Some(bounds) = self.bound_state() {
            self.status = Status::Stuck(Stuck::BoundsNotMet(bounds));
        }
    }

    /// Largest violation of a bound, or distance of a multiplier from what it may be.
    pub(super) fn error_of_bounds(&self) -> f64 {
        self.worst(|end, number, multiplier| end.error(number, multiplier, self.penalty))
    }

    pub(super) fn worst(&self, measure: impl Fn(&End, f64, f64) -> f64) -> f64 {
        self.fold_bounds(|worst, end, number, multiplier| {
            worst.max(measure(end, number, multiplier))
        })
    }

    fn sum(&self, measure: impl Fn(&End, f64, f64) -> f64) -> f64 {
        self.fold_bounds(|sum, end, number, multiplier| sum + measure(end, number, multiplier))
    }

    /// Over all ends of bounds at all steps, with the number that is bounded and its multiplier.
    fn fold_bounds(&self, fold: impl Fn(f64, &End, f64, f64) -> f64) -> f64 {
        let (problem, current) = (&self.problem, &self.current);
        let mut value = 0.0;
        for k in 0..=problem.steps {
            for (end, place) in problem.ends.at(false, k) {
                value = fold(value, end, current.x(k)[end.index], self.multipliers[place]);
            }
            for (end, place) in problem.ends.at(true, k).filter(|_| k < problem.steps) {
                value = fold(value, end, current.u(k)[end.index], self.multipliers[place]);
            }
        }
        value
    }

    /// What the cost may rise by along a step: nothing, but where bounds are to be met more closely than
    /// the cost can tell, and steps still lessen the directional derivative, its round-off.
    pub(super) fn slack(&self, derivative: f64) -> f64 {
        let (size, last) = (derivative.abs(), self.last_derivative.abs());
        let advances = !self.has_stepped() || size <= BLIND_PROGRESS * last;
        let is_blind = self.problem.has_bounds() && size <= self.round_off();
        if is_blind && advances { self.round_off() } else { 0.0 }
    }
}
