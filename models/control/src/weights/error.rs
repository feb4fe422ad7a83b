//! Why weights are refused.

/// Why weights were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WeightsError {
    /// A weight is of another shape than needed.
    #[error("weight {weight} is {rows} x {cols}; {expected_rows} x {expected_cols} is needed")]
    Dimension {
        /// `q`, `r`, `s`, `q_final`, `x_linear` or `u_linear`; those two count as columns.
        weight: &'static str,
        /// Rows.
        rows: usize,
        /// Columns.
        cols: usize,
        /// Rows that are needed.
        expected_rows: usize,
        /// Columns that are needed.
        expected_cols: usize,
    },
    /// An entry is NaN or infinite.
    #[error("weight {weight} holds a number that is not finite in row {row}, column {col}")]
    NotFinite {
        /// As in [`WeightsError::Dimension`].
        weight: &'static str,
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        col: usize,
    },
    /// Entries that mirror each other differ.
    #[error("weight {weight} is not symmetric in row {row}, column {col}")]
    NotSymmetric {
        /// `q`, `r` or `q_final`.
        weight: &'static str,
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        col: usize,
    },
    /// `r` has an eigenvalue that is not greater than zero.
    #[error("weight r is not positive definite")]
    NotPositiveDefinite,
    /// `q` or `q_final` has a negative eigenvalue.
    #[error("weight {weight} has a negative eigenvalue")]
    Negative {
        /// `q` or `q_final`.
        weight: &'static str,
    },
    /// The cross term outweighs `q` and `r`: some state and input together cost less than nothing.
    #[error(
        "weight s is too large beside q and r: q - s inverse(r) s' has a negative eigenvalue; give \
         less of s or more of q or r"
    )]
    CrossTooLarge,
    /// The weights of one step were refused.
    #[error("step {step}: {error}")]
    Step {
        /// The step, from 0.
        step: usize,
        /// What is wrong with them; never another `Step`.
        error: Box<WeightsError>,
    },
    /// Weights per step without a step.
    #[error("weights per step need at least one step")]
    NoSteps,
    /// Weights of another number of steps than they are pulled back along.
    #[error("there are weights for {weights} steps; they are pulled back along {steps}")]
    Steps {
        /// Steps that have weights.
        weights: usize,
        /// Steps that have a `T`.
        steps: usize,
    },
}

impl WeightsError {
    /// The weight at fault: `q`, `r`, `s`, `q_final`, `x_linear` or `u_linear`; of weights per step,
    /// within that step. Empty when none was given at all.
    pub fn weight(&self) -> &'static str {
        match self {
            Self::Dimension { weight, .. }
            | Self::NotFinite { weight, .. }
            | Self::NotSymmetric { weight, .. }
            | Self::Negative { weight } => weight,
            Self::NotPositiveDefinite => "r",
            Self::CrossTooLarge => "s",
            Self::Step { error, .. } => error.weight(),
            Self::NoSteps | Self::Steps { .. } => "",
        }
    }

    /// The step whose weights are at fault; none when the weights are not of one step.
    pub fn step(&self) -> Option<usize> {
        match self {
            Self::Step { step, .. } => Some(*step),
            _ => None,
        }
    }
}
