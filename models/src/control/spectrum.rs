//! Eigenvalues, with bounded effort.

use nalgebra::linalg::{Schur, balancing};
use nalgebra::{Complex, DMatrix};

use super::RiccatiError;

/// QR sweeps allowed per eigenvalue; LAPACK allows 30.
const SWEEPS_PER_EIGENVALUE: usize = 60;

/// Eigenvalues of a square matrix, about `25n³` flops.
pub(super) fn eigenvalues(m: &DMatrix<f64>) -> Result<Vec<Complex<f64>>, RiccatiError> {
    let size = m.nrows();
    if size == 0 {
        return Ok(Vec::new());
    }
    // Balancing keeps the small eigenvalues of badly scaled states out of the large ones' round-off.
    let mut balanced = m.clone();
    balancing::balance_parlett_reinsch(&mut balanced);
    Schur::try_new(balanced, f64::EPSILON, SWEEPS_PER_EIGENVALUE * size)
        .map(|schur| schur.complex_eigenvalues().iter().copied().collect())
        .ok_or(RiccatiError::Eigenvalues { size })
}

/// Largest modulus of the eigenvalues of a square, finite matrix.
pub fn spectral_radius(m: &DMatrix<f64>) -> Result<f64, RiccatiError> {
    Ok(eigenvalues(m)?.iter().fold(0.0, |radius: f64, z| radius.max(z.norm())))
}
