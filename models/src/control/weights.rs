//! Weights of the cost.

use nalgebra::{DMatrix, DVector};

use super::{all_finite, is_positive_semidefinite, symmetrize};

/// Asymmetry, relative to the largest entry, that counts as round-off of whoever made the matrix.
const ASYMMETRY: f64 = 1e-9;

/// Weights of `Σ ½ xᵀQx + ½ uᵀRu` with `½ xᵀ Q_f x` at the end of a finite horizon.
///
/// `Q` and `Q_f` are symmetric positive semidefinite, `R` is symmetric positive definite; the
/// constructors see to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    q: DMatrix<f64>,
    r: DMatrix<f64>,
    q_final: DMatrix<f64>,
}

/// Why weights were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WeightsError {
    /// A weight is not square, or of another size than needed.
    #[error("weight {weight} is {rows} x {cols}; {expected} x {expected} is needed")]
    Dimension {
        /// `q`, `r` or `q_final`.
        weight: &'static str,
        /// Rows.
        rows: usize,
        /// Columns.
        cols: usize,
        /// Size that is needed.
        expected: usize,
    },
    /// An entry is NaN or infinite.
    #[error("weight {weight} holds a number that is not finite in row {row}, column {col}")]
    NotFinite {
        /// `q`, `r` or `q_final`.
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
}

impl Weights {
    /// Weights for as many states as `q` has rows and as many inputs as `r` has; `q_final` is `q`
    /// when not given.
    pub fn new(
        mut q: DMatrix<f64>,
        mut r: DMatrix<f64>,
        q_final: Option<DMatrix<f64>>,
    ) -> Result<Self, WeightsError> {
        let (states, inputs) = (q.nrows(), r.nrows());
        check_symmetric("q", &mut q, states)?;
        check_symmetric("r", &mut r, inputs)?;
        if !is_positive_semidefinite(&q) {
            return Err(WeightsError::Negative { weight: "q" });
        }
        if inputs > 0 && r.clone().cholesky().is_none() {
            return Err(WeightsError::NotPositiveDefinite);
        }
        let q_final = match q_final {
            None => q.clone(),
            Some(mut q_final) => {
                check_symmetric("q_final", &mut q_final, states)?;
                if !is_positive_semidefinite(&q_final) {
                    return Err(WeightsError::Negative { weight: "q_final" });
                }
                q_final
            }
        };
        Ok(Self { q, r, q_final })
    }

    /// Diagonal weights, with `q_final = q`.
    pub fn diagonal(q: &[f64], r: &[f64]) -> Result<Self, WeightsError> {
        let matrix = |d: &[f64]| DMatrix::from_diagonal(&DVector::from_column_slice(d));
        Self::new(matrix(q), matrix(r), None)
    }

    /// Weights of a system with `states` and `inputs`, or the dimension that does not fit.
    pub fn for_system(self, states: usize, inputs: usize) -> Result<Self, WeightsError> {
        for (weight, size, expected) in [("q", self.states(), states), ("r", self.inputs(), inputs)]
        {
            if size != expected {
                return Err(WeightsError::Dimension { weight, rows: size, cols: size, expected });
            }
        }
        Ok(self)
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.q.nrows()
    }
    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.r.nrows()
    }
    /// State weight `Q`.
    pub fn q(&self) -> &DMatrix<f64> {
        &self.q
    }
    /// Input weight `R`.
    pub fn r(&self) -> &DMatrix<f64> {
        &self.r
    }
    /// Final weight `Q_f`.
    pub fn q_final(&self) -> &DMatrix<f64> {
        &self.q_final
    }
}

fn check_symmetric(
    weight: &'static str,
    m: &mut DMatrix<f64>,
    expected: usize,
) -> Result<(), WeightsError> {
    let (rows, cols) = m.shape();
    if rows != expected || cols != expected {
        return Err(WeightsError::Dimension { weight, rows, cols, expected });
    }
    if !all_finite(m) {
        let index = m.iter().position(|entry| !entry.is_finite()).unwrap_or(0);
        return Err(WeightsError::NotFinite { weight, row: index % rows, col: index / rows });
    }
    let tolerance = ASYMMETRY * if rows > 0 { m.amax() } else { 0.0 };
    for col in 0..cols {
        for row in 0..col {
            if (m[(row, col)] - m[(col, row)]).abs() > tolerance {
                return Err(WeightsError::NotSymmetric { weight, row, col });
            }
        }
    }
    symmetrize(m);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_named() {
        let identity = DMatrix::<f64>::identity(2, 2);
        let with = |row: usize, col: usize, value: f64| {
            let mut m = identity.clone();
            m[(row, col)] = value;
            m
        };
        let refused = |q: &DMatrix<f64>, r: &DMatrix<f64>, f: Option<&DMatrix<f64>>| {
            Weights::new(q.clone(), r.clone(), f.cloned()).unwrap_err()
        };
        assert_eq!(
            refused(&DMatrix::zeros(2, 3), &identity, None),
            WeightsError::Dimension { weight: "q", rows: 2, cols: 3, expected: 2 }
        );
        assert_eq!(
            refused(&identity, &identity, Some(&DMatrix::zeros(3, 3))),
            WeightsError::Dimension { weight: "q_final", rows: 3, cols: 3, expected: 2 }
        );
        assert_eq!(
            refused(&identity, &with(1, 0, f64::NAN), None),
            WeightsError::NotFinite { weight: "r", row: 1, col: 0 }
        );
        assert_eq!(
            refused(&with(0, 1, 0.5), &identity, None),
            WeightsError::NotSymmetric { weight: "q", row: 0, col: 1 }
        );
        assert_eq!(refused(&identity, &with(1, 1, 0.0), None), WeightsError::NotPositiveDefinite);
        assert_eq!(
            refused(&with(1, 1, -1e-3), &identity, None),
            WeightsError::Negative { weight: "q" }
        );
        assert_eq!(
            refused(&identity, &identity, Some(&(-&identity))),
            WeightsError::Negative { weight: "q_final" }
        );
    }

    #[test]
    fn a_singular_state_weight_is_good() {
        let weights = Weights::diagonal(&[1.0, 0.0], &[2.0]).unwrap();
        assert_eq!((weights.states(), weights.inputs()), (2, 1));
        assert_eq!(weights.q_final(), weights.q());
        assert!(Weights::diagonal(&[0.0, 0.0], &[2.0]).is_ok());
    }

    #[test]
    fn sizes_are_compared_with_the_system() {
        let weights = Weights::diagonal(&[1.0, 0.0], &[2.0]).unwrap();
        assert!(weights.clone().for_system(2, 1).is_ok());
        assert_eq!(
            weights.for_system(2, 3),
            Err(WeightsError::Dimension { weight: "r", rows: 1, cols: 1, expected: 3 })
        );
    }
}
