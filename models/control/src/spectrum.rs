//! Eigenvalues, with bounded effort.

use nalgebra::linalg::{Schur, balancing};
use nalgebra::{Complex, DMatrix, DVector};

use crate::error::RiccatiError;

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

/// Largest modulus first, conjugate ones side by side.
pub(super) fn sorted(mut modes: Vec<Complex<f64>>) -> Vec<Complex<f64>> {
    modes.sort_by(|a, b| {
        let larger = b.norm().total_cmp(&a.norm());
        larger.then(a.re.total_cmp(&b.re)).then(b.im.total_cmp(&a.im))
    });
    modes
}

/// Balances a map `A` and takes `B` along; the units of the new states.
pub(super) fn balance(a: &mut DMatrix<f64>, b: &mut DMatrix<f64>) -> DVector<f64> {
    if a.is_empty() {
        return DVector::zeros(0);
    }
    let scales = balancing::balance_parlett_reinsch(a);
    for (mut row, scale) in b.row_iter_mut().zip(scales.iter()) {
        row /= *scale;
    }
    scales
}
