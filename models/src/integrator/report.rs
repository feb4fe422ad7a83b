//! What the solver of a step did, and why it failed.

use plantd_math::tree_lu::SmallestPivot;

use crate::kkt::system::Estimates;
use crate::model::mechanism::Model;

/// What the solver did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Residual evaluations, each followed by one correction; those of all steps of the period. Of
    /// collocation, rounds over the stages.
    pub iterations: u32,
    /// Factorizations of the Newton matrix.
    pub factorizations: u32,
    /// Final residual in units of its own round-off; where it is foreseen to be no more than that and not
    /// evaluated again, as it is foreseen.
    pub residual: f64,
    /// Final constraint violation in units of its own round-off.
    pub constraint_residual: f64,
    /// Estimate of the reciprocal condition of the Newton matrix `M[k+1]`, at most 1: its smallest
    /// pivot, each relative to the larger of its diagonal entry and the inertia that its coordinate
    /// has at most, over `h`. Of the last factorization of the step.
    pub reciprocal_condition: f64,
    /// Estimate of the reciprocal condition of `Dh(q[k+1]) M[k+1]⁻¹ Dh(q[k])ᵀ`, at most 1: its
    /// smallest pivot that does not belong to a redundant equation, relative to the largest, each
    /// equation scaled by the steepest that it gets; where loops are eliminated one after the other, that
    /// of their own pivots. Of the last factorization of the step; 1 without constraints.
    pub constraint_reciprocal_condition: f64,
    /// Equations of constraints that depend on others.
    pub redundant_constraints: u32,
    /// Steps of the method in the period.
    pub steps: u32,
    /// How often the period was halved: 0 unless it could not be solved in longer steps.
    pub halvings: u32,
}

/// Why a step failed. The plant is as it was.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// The input has the wrong length.
    #[error("the input has {actual} entries; {expected} are needed")]
    Dimension {
        /// Entries it must have.
        expected: usize,
        /// Entries it has.
        actual: usize,
    },
    /// An entry of the input is NaN or infinite.
    #[error("input {index} (`{name}`) is {value}")]
    InputNotFinite {
        /// Index of the entry.
        index: usize,
        /// Name of the input or prescribed coordinate.
        name: String,
        /// The entry.
        value: f64,
    },
    /// Newton's method did not reach the round-off level.
    #[error(
        "no convergence after {iterations} iterations: residual is {residual:e} times round-off; the step may be too large for the motion"
    )]
    NotConverged {
        /// Iterations done.
        iterations: u32,
        /// Residual in units of its round-off.
        residual: f64,
    },
    /// The iteration left the finite numbers.
    #[error("the motion left the finite numbers after {iterations} iterations")]
    NotFinite {
        /// Iterations done.
        iterations: u32,
    },
    /// A joint turned by more than half a turn: the solution is not the continuation of the motion.
    #[error(
        "`{coordinate}` turned by {increment:.3} rad in one step; the step is too large for the motion"
    )]
    TooFast {
        /// Coordinate of the joint.
        coordinate: String,
        /// Its increment, rad.
        increment: f64,
    },
    /// The Newton matrix is singular.
    #[error(
        "singular Newton matrix at coordinate `{coordinate}` (pivot {pivot:e} of what it can be)"
    )]
    Singular {
        /// Coordinate of the vanishing pivot.
        coordinate: String,
        /// The pivot, as in [`StepReport::reciprocal_condition`].
        pivot: f64,
    },
    /// Constraints lost their independence: `Dh(q[k+1]) M⁻¹ Dh(q[k])ᵀ` is singular, beyond equations
    /// that are redundant everywhere.
    #[error(
        "singular configuration of the constraints {} (reciprocal condition {reciprocal_condition:e})",
        quoted(constraints)
    )]
    SingularConstraints {
        /// Names of the equations concerned.
        constraints: Vec<String>,
        /// The estimate.
        reciprocal_condition: f64,
    },
    /// Second derivatives of a period of that many steps take too much memory.
    #[error(
        "second derivatives of a period of {steps} steps of this model take more than 1 GiB; take fewer substeps"
    )]
    TooManySteps {
        /// Steps of the period.
        steps: usize,
    },
    /// Constraints that depend on each other contradict each other.
    #[error(
        "the constraints {} contradict each other: the best configuration violates them by {violation:e}",
        quoted(constraints)
    )]
    InconsistentConstraints {
        /// Names of the equations that stay violated.
        constraints: Vec<String>,
        /// Largest value `h(q)` at the best configuration found.
        violation: f64,
    },
}

/// Names in a sentence; the first few of many.
pub(crate) fn quoted(names: &[String]) -> String {
    const SHOWN: usize = 8;
    let mut text =
        names.iter().take(SHOWN).map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN {
        text.push_str(&format!(" and {} more", names.len() - SHOWN));
    }
    text
}

impl StepError {
    /// Whether shorter steps may succeed.
    pub(crate) fn may_be_too_long(&self) -> bool {
        match self {
            Self::NotConverged { .. }
            | Self::NotFinite { .. }
            | Self::TooFast { .. }
            | Self::Singular { .. }
            | Self::SingularConstraints { .. } => true,
            Self::Dimension { .. }
            | Self::InputNotFinite { .. }
            | Self::TooManySteps { .. }
            | Self::InconsistentConstraints { .. } => false,
        }
    }
}

impl Estimates {
    pub(crate) fn write(&self, report: &mut StepReport) {
        report.reciprocal_condition = self.matrix;
        report.constraint_reciprocal_condition = self.constraints;
        report.redundant_constraints = self.redundant;
    }
}

impl StepReport {
    /// Of one step, of a model without constraints.
    pub(crate) const UNCONSTRAINED: Self = Self {
        iterations: 0,
        factorizations: 0,
        residual: 0.0,
        constraint_residual: 0.0,
        reciprocal_condition: 1.0,
        constraint_reciprocal_condition: 1.0,
        redundant_constraints: 0,
        steps: 1,
        halvings: 0,
    };

    /// Adds a step of a period.
    pub(crate) fn add(&mut self, step: &Self) {
        self.iterations += step.iterations;
        self.factorizations += step.factorizations;
        self.residual = self.residual.max(step.residual);
        self.constraint_residual = self.constraint_residual.max(step.constraint_residual);
        self.reciprocal_condition = self.reciprocal_condition.min(step.reciprocal_condition);
        self.constraint_reciprocal_condition =
            self.constraint_reciprocal_condition.min(step.constraint_reciprocal_condition);
        self.redundant_constraints = self.redundant_constraints.max(step.redundant_constraints);
        self.steps += 1;
    }
}

impl Model {
    /// The error of a Newton matrix with a pivot that is too small.
    pub(crate) fn singular_matrix(&self, pivot: SmallestPivot) -> StepError {
        let coordinate = self.coordinates[pivot.row].name.clone();
        StepError::Singular { coordinate, pivot: pivot.relative }
    }

    /// Refuses an input of the wrong length, or with a number that is not finite.
    pub fn check_input(&self, u: &[f64]) -> Result<(), StepError> {
        let d = self.dimensions;
        if u.len() != d.input() {
            return Err(StepError::Dimension { expected: d.input(), actual: u.len() });
        }
        self.check_finite(u)
    }

    /// Refuses an input, or its first entries, with a number that is not finite.
    pub(crate) fn check_finite(&self, u: &[f64]) -> Result<(), StepError> {
        let d = self.dimensions;
        match u.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(index) => {
                let name = match self.scene.inputs.get(index) {
                    Some(input) => input.name.clone(),
                    None => self.coordinates[d.dynamic + index - d.inputs].name.clone(),
                };
                Err(StepError::InputNotFinite { index, name, value: u[index] })
            }
        }
    }
}
