//! When a search ends, and when the multipliers of bounds are renewed.

use crate::optimize::error::{BoundState, Stuck};
use crate::optimize::progress::Status;
use crate::optimize::search::Optimizer;

/// Beyond this penalty the bounds are taken to be out of reach.
const PENALTY_MAX: f64 = 1e9;
/// From this penalty on bounds are what keeps a search from descending.
const PENALTY_FIRM: f64 = 1e6;
/// Part of the first cost to which the cost is minimised before multipliers are renewed.
const RENEW_BELOW: f64 = 1e-6;
/// Part of the penalties' energy to which it is minimised before.
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
        self.options.tolerance.unwrap_or(TOLERANCE * self.course.first_cost.abs())
    }

    pub(super) fn end_by_count(&mut self, derivative: f64) {
        if self.course.status == Status::Running
            && self.course.iterations >= self.options.max_iterations
        {
            self.course.status = Status::Stuck(Stuck::MaxIterations {
                iterations: self.course.iterations,
                derivative,
                tolerance: self.tolerance(),
                bounds: self.bound_state(),
            });
        }
    }

    fn bound_error(&self) -> f64 {
        self.bounds.error(&self.current.trajectory)
    }

    /// How well the bounds are settled; none without any.
    fn bound_state(&self) -> Option<BoundState> {
        (!self.bounds.is_empty()).then(|| BoundState {
            violation: self.bound_violation(),
            error: self.bound_error(),
            tolerance: self.options.bound_tolerance,
            penalty: self.bounds.penalty,
        })
    }

    /// Whether nothing is to be gained along the direction: the search has converged, or multipliers
    /// are renewed.
    pub(super) fn has_ended(&mut self, derivative: f64) -> bool {
        let (size, error) = (derivative.abs(), self.bound_error());
        if error <= self.options.bound_tolerance {
            if size <= self.tolerance() {
                self.course.status = Status::Converged;
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
        self.course.last_derivative != 0.0
    }

    /// A change of the cost that is not to be told from its round-off.
    pub(super) fn round_off(&self) -> f64 {
        ROUND_OFF * self.current.trajectory.cost.abs().max(self.current.trajectory.merit.abs())
    }

    /// Whether a search that finds no step has converged: the cost is as low as its round-off lets it be.
    pub(super) fn ends_at(&self, derivative: f64) -> bool {
        derivative.abs() <= self.round_off() && self.bound_error() <= self.options.bound_tolerance
    }

    /// Whether multipliers are due where no step is found: kinks of the penalties may stand in the way,
    /// which move with them.
    pub(super) fn renews_at(&self, derivative: f64) -> bool {
        let low = self.round_off().max(RENEW_BELOW * self.course.first_cost.abs());
        derivative.abs() <= low
            && self.has_stepped()
            && self.bound_error() > self.options.bound_tolerance
    }

    /// No step descends.
    pub(super) fn end_without_step(&mut self, derivative: f64) {
        let is_violated = self.bound_violation() > self.options.bound_tolerance;
        if self.ends_at(derivative) {
            self.course.status = Status::Converged;
        } else if self.renews_at(derivative) {
            self.renew_multipliers(self.bound_error());
        } else if is_violated && self.bounds.penalty >= PENALTY_FIRM {
            self.give_up_bounds();
        } else {
            self.course.status = Status::Stuck(Stuck::NoDescent {
                derivative,
                cost: self.current.trajectory.merit,
                backtracks: self.options.max_backtracks,
                tolerance: self.tolerance(),
                bounds: self.bound_state(),
            });
        }
    }

    /// The directional derivative at which multipliers are renewed: so small that the errors of bounds are
    /// those of the penalty, not of a minimum that is not reached yet.
    fn renew_below(&self) -> f64 {
        let energy = self.bounds.energy(&self.current.trajectory);
        (RENEW_WITHIN * energy).min(RENEW_BELOW * self.course.first_cost.abs())
    }

    fn renew_multipliers(&mut self, error: f64) {
        let Self { bounds, current, course, .. } = self;
        bounds.renew(&current.trajectory, error);
        course.last_derivative = 0.0;
        current.trajectory.merit = bounds.merit(&current.trajectory);
        if bounds.penalty > PENALTY_MAX {
            self.give_up_bounds();
        }
    }

    fn give_up_bounds(&mut self) {
        if let Some(bounds) = self.bound_state() {
            self.course.status = Status::Stuck(Stuck::BoundsNotMet(bounds));
        }
    }

    /// What the cost may rise by along a step: nothing, but where bounds are to be met more closely than
    /// the cost can tell, and steps still lessen the directional derivative, its round-off.
    pub(super) fn slack(&self, derivative: f64) -> f64 {
        let (size, last) = (derivative.abs(), self.course.last_derivative.abs());
        let advances = !self.has_stepped() || size <= BLIND_PROGRESS * last;
        let is_blind = !self.bounds.is_empty() && size <= self.round_off();
        if is_blind && advances { self.round_off() } else { 0.0 }
    }
}
