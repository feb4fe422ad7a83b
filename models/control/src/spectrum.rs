//! Eigenvalues, with bounded effort.

use nalgebra::linalg::{Schur, balancing};
use nalgebra::{Complex, DMatrix, DVector};

use crate::error::RiccatiError;

/// QR sweeps allowed per eigenvalue; LAPACK allows 30.
const SWEEPS_PER_EIGENVALUE: usize = 60;

/// Eigenvalues of a square matrix, about `25n³` flops.
///
/// The sweeps have no exceptional shifts, and of few matrices, such as maps with several eigenvalues 1, they go round in
/// circles by their round-off. Others with the same eigenvalues do not: the transpose, and what a reflection makes of both.
pub(super) fn eigenvalues(m: &DMatrix<f64>) -> Result<Vec<Complex<f64>>, RiccatiError> {
    let size = m.nrows();
    if size == 0 {
        return Ok(Vec::new());
    }
    // Balancing keeps the small eigenvalues of badly scaled states out of the large ones' round-off.
    let mut balanced = m.clone();
    balancing::balance_parlett_reinsch(&mut balanced);
    let found = |m: DMatrix<f64>| {
        let schur = Schur::try_new(m, f64::EPSILON, SWEEPS_PER_EIGENVALUE * size)?;
        Some(schur.complex_eigenvalues().iter().copied().collect())
    };
    found(balanced.clone())
        .or_else(|| found(balanced.transpose()))
        .or_else(|| found(reflected(balanced.clone())))
        .or_else(|| found(reflected(balanced.transpose())))
        .ok_or(RiccatiError::Eigenvalues { size })
}

/// `Q M Q` with a reflection `Q` along a vector that has nothing to do with `M`.
fn reflected(mut m: DMatrix<f64>) -> DMatrix<f64> {
    let along = DVector::from_fn(m.nrows(), |i, _| 1.0 / (i as f64 + 1.5)).normalize();
    let rows = m.transpose() * &along;
    m.ger(-2.0, &along, &rows, 1.0);
    let columns = &m * &along;
    m.ger(-2.0, &columns, &along, 1.0);
    m
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Of cyclic permutations sweeps without exceptional shifts get nowhere; of free bodies all eigenvalues are 1.
    #[test]
    fn sweeps_that_go_round_in_circles_are_begun_elsewhere() {
        for n in 1..12 {
            let cycle = DMatrix::from_fn(n, n, |i, j| if (j + 1) % n == i { 1.0 } else { 0.0 });
            let mut found = eigenvalues(&cycle).unwrap();
            found.sort_by(|a, b| a.arg().total_cmp(&b.arg()));
            assert_eq!(found.len(), n);
            for z in found {
                assert!((z.powu(n as u32) - 1.0).norm() < 1e-12, "{n}: {z}");
            }
            let free =
                DMatrix::from_fn(2 * n, 2 * n, |i, j| if i == j || j == i + n { 1.0 } else { 0.0 });
            assert!(eigenvalues(&free).unwrap().iter().all(|z| (z - 1.0).norm() < 1e-6), "{n}");
        }
    }

    #[test]
    fn reflections_keep_eigenvalues() {
        let m = DMatrix::from_fn(6, 6, |i, j| (1.3 * i as f64 + 0.7 * (j * j) as f64).sin());
        let [a, b] = [m.clone(), reflected(m)].map(|m| sorted(eigenvalues(&m).unwrap()));
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).norm() < 1e-13), "{a:?} {b:?}");
    }
}
