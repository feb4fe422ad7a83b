//! Why a problem is refused, and why a search ends without having converged.

use nalgebra::DMatrix;
use plantd_models::{InitialError, StepError};

use crate::matrix::not_finite;
use crate::weights::error::WeightsError;

/// Why a problem was refused, or an iteration failed. An optimizer is as it was before.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OptimizeError {
    /// There is no step to optimise.
    #[error("the guess has no inputs; at least one row is needed")]
    NoSteps,
    /// A matrix or a list has the wrong shape.
    #[error("{what} is {rows} x {cols}; {expected_rows} x {expected_cols} is needed")]
    Dimension {
        /// Which one.
        what: &'static str,
        /// Rows it has.
        rows: usize,
        /// Columns it has.
        cols: usize,
        /// Rows that are needed.
        expected_rows: usize,
        /// Columns that are needed.
        expected_cols: usize,
    },
    /// A number is NaN or infinite.
    #[error("{what} holds a number that is not finite in row {row}, column {col}")]
    NotFinite {
        /// Where.
        what: &'static str,
        /// Row, from 0; the step, for trajectories.
        row: usize,
        /// Column, from 0.
        col: usize,
    },
    /// A weight was refused.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// There are weights for another number of steps.
    #[error("there are weights for {actual} steps; the guess has {expected}")]
    Stages {
        /// Stages given.
        actual: usize,
        /// Stages needed.
        expected: usize,
    },
    /// An option is out of its range.
    #[error("option {name} is {value}; it must be {range}")]
    Option {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// A bound cannot be used.
    #[error("bound {position} of {list}: {fault}")]
    Bound {
        /// `states`, `inputs` or `final_state`.
        list: &'static str,
        /// Position in the list, from 0.
        position: usize,
        /// What is wrong with it.
        fault: BoundFault,
    },
    /// A free entry of the initial state does not exist.
    #[error("entry {entry} of the initial state cannot be free: there are {states}")]
    FreeEntry {
        /// Index in `x`.
        entry: usize,
        /// Entries of `x`.
        states: usize,
    },
    /// The plant cannot run the guess.
    #[error(
        "the guess does not simulate: step {step}: {error}; give inputs that the plant can follow"
    )]
    Guess {
        /// Step that failed.
        step: usize,
        /// Why.
        error: StepError,
    },
    /// The initial state is refused.
    #[error("the initial state: {0}")]
    Initial(#[from] InitialError),
    /// The cost of the guess is not finite.
    #[error("the cost of the guess is {cost}; give a guess nearer to what is desired")]
    Cost {
        /// The cost.
        cost: f64,
    },
    /// The map has no derivatives at a step of the trajectory.
    #[error("step {step} cannot be linearized: {error}")]
    Linearization {
        /// The step.
        step: usize,
        /// Why.
        error: StepError,
    },
    /// The regulator that projects onto motions of the plant cannot be represented.
    #[error(
        "the projection regulator has no gain at step {step}: the motion grows too fast there, or its weights span too many orders of magnitude"
    )]
    Projection {
        /// The step, counted from the start.
        step: usize,
    },
    /// A checkpoint belongs to another problem.
    #[error("the checkpoint does not fit the problem: {what}")]
    Checkpoint {
        /// What differs.
        what: &'static str,
    },
    /// The callback said to stop; nothing was changed by the iteration.
    #[error("cancelled")]
    Cancelled,
    /// The search has ended; see [`crate::optimize::Optimizer::status`].
    #[error("the search has ended")]
    Finished,
}

impl OptimizeError {
    /// Refuses a matrix of another shape, or with numbers that are not finite.
    pub(super) fn check(
        what: &'static str,
        matrix: &DMatrix<f64>,
        (expected_rows, expected_cols): (usize, usize),
    ) -> Result<(), Self> {
        let (rows, cols) = matrix.shape();
        if (rows, cols) != (expected_rows, expected_cols) {
            return Err(Self::Dimension { what, rows, cols, expected_rows, expected_cols });
        }
        match not_finite(matrix.as_slice(), rows) {
            None => Ok(()),
            Some((row, col)) => Err(Self::NotFinite { what, row, col }),
        }
    }
}

/// What is wrong with a bound.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum BoundFault {
    /// There is no entry of that index.
    #[error("there is no entry {index}; there are {entries}")]
    Index {
        /// The index.
        index: usize,
        /// Entries there are.
        entries: usize,
    },
    /// It bounds nothing.
    #[error("neither min nor max is given")]
    Empty,
    /// An end is NaN or infinite.
    #[error("an end is {value}")]
    NotFinite {
        /// The end.
        value: f64,
    },
    /// Its ends are in the wrong order.
    #[error("min {min} is greater than max {max}")]
    Crossed {
        /// Smallest value.
        min: f64,
        /// Largest value.
        max: f64,
    },
}

/// Why a search ended without having converged.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Stuck {
    /// As many iterations as allowed.
    #[error(
        "no convergence within {iterations} iterations: the directional derivative is {derivative:e}, the tolerance {tolerance:e}{}; allow more iterations, or go on from the checkpoint",
        so_far(*bounds)
    )]
    MaxIterations {
        /// Iterations done.
        iterations: u32,
        /// Directional derivative of the last one.
        derivative: f64,
        /// Tolerance.
        tolerance: f64,
        /// How well the bounds are settled; none without any.
        bounds: Option<BoundState>,
    },
    /// No step along the direction lowers the cost enough.
    #[error(
        "no step along a direction with derivative {derivative:e} lowers the cost {cost} after {backtracks} shortenings; the tolerance is {tolerance:e}{}. Allow more shortenings, or give a regulator of the projection that holds the motion more firmly; {}",
        so_far(*bounds),
        good_enough(derivative.abs(), *bounds)
    )]
    NoDescent {
        /// Directional derivative.
        derivative: f64,
        /// Cost, with penalties.
        cost: f64,
        /// Shortenings tried.
        backtracks: u32,
        /// Tolerance.
        tolerance: f64,
        /// How well the bounds are settled; none without any.
        bounds: Option<BoundState>,
    },
    /// Not even steepest descent has a direction.
    #[error(
        "the quadratic model has no minimum at step {step}, not even with identity weights: the motion grows too fast there; shorten the horizon or begin nearer to the goal"
    )]
    NotConvex {
        /// The step.
        step: usize,
    },
    /// The last input's cost has no minimum, whatever the motion: `R + BᵀQ_f B` is not positive
    /// definite at the last step.
    #[error(
        "the weights leave the cost of the input at the last step ({step}) without a minimum; make r positive definite, or q_final larger"
    )]
    WeightsNotConvex {
        /// The step.
        step: usize,
    },
    /// The bounds cannot be met, or their multipliers do not settle.
    #[error("{}", not_met(.0))]
    BoundsNotMet(BoundState),
}

/// How well the bounds of a problem are settled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundState {
    /// Largest violation, in the unit of the entry.
    pub violation: f64,
    /// Largest violation, or where a bound holds, distance from it, or, if that is less, of its multiplier
    /// from zero, in units of the penalty.
    pub error: f64,
    /// Error that counts as none.
    pub tolerance: f64,
    /// Penalty reached.
    pub penalty: f64,
}

fn so_far(bounds: Option<BoundState>) -> String {
    let Some(BoundState { error, tolerance, .. }) = bounds else { return String::new() };
    format!(", and the error of the bounds {error:e}, bound_tolerance {tolerance:e}")
}

/// With which options, or with which guess, the search would not have ended so.
fn good_enough(derivative: f64, bounds: Option<BoundState>) -> String {
    let larger = match bounds {
        Some(BoundState { violation, tolerance, .. }) if violation > tolerance => {
            return format!(
                "a bound is violated by {violation:e}: begin with a guess that meets it, or with the optimum of wider bounds"
            );
        }
        Some(BoundState { error, tolerance, .. }) if error > tolerance => {
            format!("a tolerance above {derivative:e} and a bound_tolerance above {error:e}")
        }
        _ => format!("a tolerance above {derivative:e}"),
    };
    format!("with {larger} the motion that was found counts as the optimum")
}

fn not_met(bounds: &BoundState) -> String {
    let BoundState { violation, error, tolerance, penalty } = bounds;
    if violation > tolerance {
        format!(
            "a bound stays violated by {violation:e} at penalty {penalty:e}; bound_tolerance is {tolerance:e}: widen the bounds, lengthen the horizon, begin with a guess that meets them, or raise bound_tolerance above {violation:e} if that is near enough"
        )
    } else {
        format!(
            "the bounds are met, but their multipliers do not settle: an error of {error:e} is left at penalty {penalty:e}; raise bound_tolerance from {tolerance:e} above that"
        )
    }
}
