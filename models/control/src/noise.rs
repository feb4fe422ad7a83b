//! Covariances of noise.

use nalgebra::DMatrix;

use crate::error::RiccatiError;
use crate::matrix::{is_positive_semidefinite, symmetrize};
use crate::weights::check_symmetric;
use crate::weights::error::WeightsError;

/// Covariances of white noise, per step.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseCovariances {
    process: Option<DMatrix<f64>>,
    input: Option<DMatrix<f64>>,
    measurement: DMatrix<f64>,
}

impl NoiseCovariances {
    /// `process` of the state, n × n, and `input` of the inputs, m × m, are symmetric positive
    /// semidefinite and zero when not given; `measurement`, r × r, is symmetric positive definite.
    pub fn new(
        process: Option<DMatrix<f64>>,
        input: Option<DMatrix<f64>>,
        mut measurement: DMatrix<f64>,
    ) -> Result<Self, NoiseError> {
        let process = process.map(|m| semidefinite("process", m)).transpose()?;
        let input = input.map(|m| semidefinite("input", m)).transpose()?;
        check("measurement", &mut measurement)?;
        if !measurement.is_empty() && measurement.clone().cholesky().is_none() {
            return Err(NoiseError::NotPositiveDefinite);
        }
        Ok(Self { process, input, measurement })
    }

    /// Of the inputs.
    pub fn input(&self) -> Option<&DMatrix<f64>> {
        self.input.as_ref()
    }
    /// Of what is measured.
    pub fn measurement(&self) -> &DMatrix<f64> {
        &self.measurement
    }

    /// Refuses covariances of other numbers of states, inputs and outputs.
    pub(super) fn check(
        &self,
        states: usize,
        inputs: usize,
        outputs: usize,
    ) -> Result<(), KalmanError> {
        let covariances = [
            ("process", self.process.as_ref(), states),
            ("input", self.input.as_ref(), inputs),
            ("measurement", Some(&self.measurement), outputs),
        ];
        for (covariance, given, expected) in covariances {
            if let Some(size) = given.map(DMatrix::nrows).filter(|&size| size != expected) {
                return Err(NoiseError::Dimension { covariance, size, expected }.into());
            }
        }
        Ok(())
    }

    /// `process + B input Bᵀ`.
    pub(super) fn state_noise(&self, b: &DMatrix<f64>) -> DMatrix<f64> {
        let n = b.nrows();
        let mut sum = self.process.clone().unwrap_or_else(|| DMatrix::zeros(n, n));
        if let Some(input) = &self.input {
            sum += b * (input * b.transpose());
        }
        symmetrize(&mut sum);
        sum
    }
}

/// Why covariances were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoiseError {
    /// A covariance is of another size than needed.
    #[error("covariance {covariance} is {size} x {size}; {expected} x {expected} is needed")]
    Dimension {
        /// `process`, `input`, `measurement` or `initial_covariance`.
        covariance: &'static str,
        /// Rows and columns.
        size: usize,
        /// Rows and columns that are needed.
        expected: usize,
    },
    /// A covariance is not square, not finite or not symmetric.
    #[error("covariance {covariance}: {problem}")]
    Malformed {
        /// As above.
        covariance: &'static str,
        /// What is wrong with it, and where.
        problem: String,
    },
    /// A covariance has a negative eigenvalue.
    #[error("covariance {covariance} has a negative eigenvalue")]
    Negative {
        /// As above.
        covariance: &'static str,
    },
    /// `measurement` has an eigenvalue that is not greater than zero.
    #[error(
        "covariance measurement is not positive definite; each output needs some noise, and no two \
         outputs the same"
    )]
    NotPositiveDefinite,
}

impl NoiseError {
    /// The covariance at fault: `process`, `input`, `measurement` or `initial_covariance`.
    pub fn covariance(&self) -> &'static str {
        match self {
            Self::Dimension { covariance, .. }
            | Self::Malformed { covariance, .. }
            | Self::Negative { covariance } => covariance,
            Self::NotPositiveDefinite => "measurement",
        }
    }
}

/// Why there is no filter.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum KalmanError {
    /// A covariance does not fit.
    #[error(transparent)]
    Noise(#[from] NoiseError),
    /// A mode that does not decay by itself does not show in the outputs.
    #[error(
        "not detectable: no output shows the mode with eigenvalue {real:+.6} {imaginary:+.6}i (modulus {modulus:.6}); measure something that moves with it"
    )]
    NotDetectable {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
        /// Modulus, about 1 or greater.
        modulus: f64,
    },
    /// A mode on the unit circle gets no noise, so that the best filter stops listening to it.
    #[error(
        "no process noise reaches the mode with eigenvalue {real:+.6} {imaginary:+.6}i on the unit circle: the filter would stop correcting it; give process or input noise that moves it"
    )]
    NotExcited {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
    },
    /// Lists along a trajectory have other lengths than needed.
    #[error("{list} has {actual} entries for {samples} steps; {expected} are needed")]
    Count {
        /// `outputs`, `noise` or `tangents`.
        list: &'static str,
        /// Steps.
        samples: usize,
        /// Entries.
        actual: usize,
        /// Entries that are needed: `1 or ` the number of states, or the number of states.
        expected: String,
    },
    /// The matrices, or the numerical solution.
    #[error(transparent)]
    Riccati(RiccatiError),
}

impl From<RiccatiError> for KalmanError {
    /// In the words of filters: the dual problem's inputs are the outputs.
    fn from(error: RiccatiError) -> Self {
        match error {
            RiccatiError::NotStabilisable { real, imaginary, modulus } => {
                Self::NotDetectable { real, imaginary, modulus }
            }
            RiccatiError::NotDetectable { real, imaginary } => Self::NotExcited { real, imaginary },
            other => Self::Riccati(other),
        }
    }
}

fn check(covariance: &'static str, m: &mut DMatrix<f64>) -> Result<(), NoiseError> {
    let size = m.nrows();
    check_symmetric(covariance, m, size).map_err(|error| {
        let problem = match error {
            WeightsError::Dimension { rows, cols, .. } => format!("is {rows} x {cols}, not square"),
            WeightsError::NotFinite { row, col, .. } => {
                format!("the number in row {row}, column {col} is not finite")
            }
            WeightsError::NotSymmetric { row, col, .. } => {
                format!("is not symmetric in row {row}, column {col}")
            }
            other => other.to_string(),
        };
        NoiseError::Malformed { covariance, problem }
    })
}

/// Refuses a covariance that is not symmetric positive semidefinite; its symmetric part.
pub(super) fn semidefinite(
    covariance: &'static str,
    mut m: DMatrix<f64>,
) -> Result<DMatrix<f64>, NoiseError> {
    check(covariance, &mut m)?;
    if is_positive_semidefinite(&m) { Ok(m) } else { Err(NoiseError::Negative { covariance }) }
}
