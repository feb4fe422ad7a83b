//! Why a regulator or an analysis is not to be had.

use nalgebra::DMatrix;

use crate::matrix::all_finite;

/// Why there is no regulator.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RiccatiError {
    /// A matrix has the wrong shape.
    #[error(
        "{matrix} of sample {sample} is {rows} x {cols}; {expected_rows} x {expected_cols} is needed"
    )]
    Dimension {
        /// `A`, `B`, or `T` for a tangent space.
        matrix: &'static str,
        /// Index of the sample; 0 for an infinite horizon.
        sample: usize,
        /// Rows it has.
        rows: usize,
        /// Columns it has.
        cols: usize,
        /// Rows it should have.
        expected_rows: usize,
        /// Columns it should have.
        expected_cols: usize,
    },
    /// The number of tangent spaces is not one more than the number of samples.
    #[error("{actual} tangent spaces for {samples} samples; one more than samples is needed")]
    TangentCount {
        /// Samples.
        samples: usize,
        /// Tangent spaces.
        actual: usize,
    },
    /// Weights per step for another number of steps than there are samples.
    #[error("weights of {stages} steps for {samples} samples; one per sample is needed")]
    StageCount {
        /// Samples.
        samples: usize,
        /// Weights.
        stages: usize,
    },
    /// Weights that are not convex step by step are not so as a whole either.
    #[error(
        "the problem is not convex at sample {sample}: R + BᵀPB is not positive definite there; give \
         the inputs more weight r, or take weights that are convex step by step"
    )]
    NotConvex {
        /// Index of the sample, counted from the start.
        sample: usize,
    },
    /// A matrix holds NaN or infinity.
    #[error("{matrix} of sample {sample} is not finite")]
    NotFinite {
        /// `A` or `B`.
        matrix: &'static str,
        /// Index of the sample; 0 for an infinite horizon.
        sample: usize,
    },
    /// The cost to go left the finite numbers, or `R + BᵀPB` lost its definiteness.
    #[error(
        "the cost to go cannot be represented at sample {sample}: the motion grows too fast there, or the weights span too many orders of magnitude"
    )]
    Overflow {
        /// Index of the sample, counted from the start.
        sample: usize,
    },
    /// A mode that does not decay by itself is out of reach of the inputs.
    #[error(
        "not stabilisable: no input reaches the mode with eigenvalue {real:+.6} {imaginary:+.6}i (modulus {modulus:.6})"
    )]
    NotStabilisable {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
        /// Modulus, about 1 or greater.
        modulus: f64,
    },
    /// A mode on the unit circle costs nothing, so that no regulator is best.
    #[error(
        "not detectable: the weights do not see the mode with eigenvalue {real:+.6} {imaginary:+.6}i on the unit circle; give it a state weight"
    )]
    NotDetectable {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
    },
    /// Doubling ended without a solution that passes the checks.
    #[error(
        "no solution after {iterations} doublings: relative residual {residual:e}, spectral radius {spectral_radius}; the problem is too ill-conditioned"
    )]
    NotConverged {
        /// Doublings.
        iterations: u32,
        /// Relative residual of the Riccati equation; infinite when the iteration overflowed.
        residual: f64,
        /// Largest modulus of the eigenvalues of `A − BK`; infinite when the iteration overflowed.
        spectral_radius: f64,
    },
    /// The eigenvalues of a matrix were not found.
    #[error("the eigenvalues of the {size} x {size} closed loop were not found")]
    Eigenvalues {
        /// Size of the matrix.
        size: usize,
    },
}

/// Why a linear map could not be analysed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AnalysisError {
    /// A matrix has the wrong shape.
    #[error("{matrix} is {rows} x {cols}; {expected_rows} x {expected_cols} is needed")]
    Dimension {
        /// `A`, `B`, `C` or `D`.
        matrix: &'static str,
        /// Rows it has.
        rows: usize,
        /// Columns it has.
        cols: usize,
        /// Rows it should have.
        expected_rows: usize,
        /// Columns it should have.
        expected_cols: usize,
    },
    /// A matrix holds NaN or infinity.
    #[error("{matrix} is not finite")]
    NotFinite {
        /// `A`, `B`, `C` or `D`.
        matrix: &'static str,
    },
    /// A frequency is NaN or infinite.
    #[error("a frequency is {frequency_hz}")]
    Frequency {
        /// The frequency.
        frequency_hz: f64,
    },
    /// The response is infinite: `e^{iωh}` is an eigenvalue of `A`.
    #[error(
        "the response is infinite at {frequency_hz} Hz: {real} {imaginary:+}i is a pole on the unit \
         circle"
    )]
    Pole {
        /// The frequency.
        frequency_hz: f64,
        /// Real part of the pole.
        real: f64,
        /// Imaginary part of the pole.
        imaginary: f64,
    },
    /// The eigenvalues of `A` were not found.
    #[error("the eigenvalues of the {size} x {size} matrix were not found")]
    Eigenvalues {
        /// Size of the matrix.
        size: usize,
    },
}

impl RiccatiError {
    /// Refuses a matrix that is not of the shape (rows, columns).
    pub(super) fn check_shape(
        matrix: &'static str,
        sample: usize,
        m: &DMatrix<f64>,
        (expected_rows, expected_cols): (usize, usize),
    ) -> Result<(), Self> {
        let (rows, cols) = m.shape();
        if (rows, cols) == (expected_rows, expected_cols) {
            return Ok(());
        }
        Err(Self::Dimension { matrix, sample, rows, cols, expected_rows, expected_cols })
    }

    /// Refuses a matrix that is not of the shape (rows, columns), or not finite.
    pub(super) fn check(
        matrix: &'static str,
        sample: usize,
        m: &DMatrix<f64>,
        shape: (usize, usize),
    ) -> Result<(), Self> {
        Self::check_shape(matrix, sample, m, shape)?;
        if all_finite(m) { Ok(()) } else { Err(Self::NotFinite { matrix, sample }) }
    }

    /// Refuses a map that is not of `n` states and `m` inputs, or not finite.
    pub(super) fn check_map(
        sample: usize,
        (a, b): (&DMatrix<f64>, &DMatrix<f64>),
        (n, m): (usize, usize),
    ) -> Result<(), Self> {
        Self::check("A", sample, a, (n, n))?;
        Self::check("B", sample, b, (n, m))
    }
}

impl AnalysisError {
    /// Refuses a matrix that is not of the shape (rows, columns), or not finite.
    pub(super) fn check(
        matrix: &'static str,
        m: &DMatrix<f64>,
        (expected_rows, expected_cols): (usize, usize),
    ) -> Result<(), Self> {
        let (rows, cols) = m.shape();
        if (rows, cols) != (expected_rows, expected_cols) {
            return Err(Self::Dimension { matrix, rows, cols, expected_rows, expected_cols });
        }
        if all_finite(m) { Ok(()) } else { Err(Self::NotFinite { matrix }) }
    }
}
