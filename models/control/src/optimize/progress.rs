//! Where a search stands.

use nalgebra::DMatrix;
use plantd_models::State;

use crate::optimize::error::Stuck;
use crate::optimize::options::Method;

/// Where a search stands: what it goes on from, bit for bit, given the same problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Initial state of the trajectory.
    pub initial: State,
    /// Row k is `u[k]`.
    pub inputs: DMatrix<f64>,
    /// Iterations so far.
    pub iterations: u32,
    /// Cost of the trajectory with which the search began.
    pub first_cost: f64,
    /// Multipliers of the bounds: those of `states`, `inputs` and `final_state` in this order, for each
    /// bound the lower before the upper end, for each end its steps. Equal ends have one.
    pub bound_multipliers: Vec<f64>,
    /// Penalty of the bounds.
    pub penalty: f64,
    /// Error of the bounds when the multipliers were last renewed.
    pub bound_violation: f64,
    /// Initial state that [`FreeInitialState::weight`](crate::optimize::specification::FreeInitialState::weight) refers to.
    pub initial_reference: State,
    /// Shortenings of the last step that was taken.
    pub backtracks: u32,
    /// Directional derivative of the last step since the multipliers were renewed; 0 before the first.
    pub last_derivative: f64,
}

/// What an iteration did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Number of the iteration, from 0.
    pub iteration: u32,
    /// Cost before it, with the penalties of bounds.
    pub cost_before: f64,
    /// Cost after it, with the penalties of bounds.
    pub cost: f64,
    /// Directional derivative of the cost along the direction.
    pub directional_derivative: f64,
    /// Method that gave the direction.
    pub method: Method,
    /// Why it was not the one asked for, when it was not.
    pub fallback: Option<Fallback>,
    /// Length of the step; 0 when none was taken: the search has ended, or multipliers were renewed.
    pub step_length: f64,
    /// Shortenings before it was accepted.
    pub backtracks: u32,
    /// Largest violation of a bound.
    pub bound_violation: f64,
}

/// Why an iteration did not use the method that it was asked to.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Fallback {
    /// The quadratic model has no minimum.
    #[error("the quadratic model has no minimum at step {step}")]
    NotConvex {
        /// The step.
        step: usize,
    },
    /// The direction does not descend.
    #[error("the direction does not descend: its derivative is {derivative:e}")]
    Ascent {
        /// Directional derivative.
        derivative: f64,
    },
    /// No step along the direction lowers the cost enough.
    #[error("no step along a direction with derivative {derivative:e} lowers the cost")]
    NoStep {
        /// Directional derivative.
        derivative: f64,
    },
}

/// Whether a search goes on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Status {
    /// It does.
    #[default]
    Running,
    /// The directional derivative and the bounds are within their tolerances.
    Converged,
    /// It ended without; the trajectory is the best that was found.
    Stuck(Stuck),
}
