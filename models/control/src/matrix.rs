//! Symmetric matrices, and matrices of finite numbers.

use nalgebra::DMatrix;

use crate::lq::condition::reciprocal_condition;

/// Replaces a matrix that is symmetric but for round-off by its symmetric part.
pub(crate) fn symmetrize(m: &mut DMatrix<f64>) {
    for column in 0..m.ncols() {
        for row in 0..column {
            let mean = 0.5 * (m[(row, column)] + m[(column, row)]);
            m[(row, column)] = mean;
            m[(column, row)] = mean;
        }
    }
}

/// `m ≥ 0` up to round-off: `m` shifted by `1e-12` of its largest diagonal entry has a Cholesky
/// factor.
pub(super) fn is_positive_semidefinite(m: &DMatrix<f64>) -> bool {
    let largest = m.diagonal().amax();
    if largest == 0.0 {
        return m.iter().all(|&entry| entry == 0.0);
    }
    let mut shifted = m / largest;
    for i in 0..m.nrows() {
        shifted[(i, i)] += 1e-12;
    }
    shifted.cholesky().is_some()
}

/// Whether no entry is NaN or infinite.
pub(super) fn all_finite(m: &DMatrix<f64>) -> bool {
    // Without a branch per entry: products with zero are zero, or NaN.
    let (blocks, rest) = m.as_slice().as_chunks::<8>();
    let mut sums = [0.0; 8];
    for block in blocks {
        for (sum, entry) in sums.iter_mut().zip(block) {
            *sum += 0.0 * entry;
        }
    }
    sums.iter().all(|&sum| sum == 0.0) && rest.iter().all(|entry| entry.is_finite())
}

/// Row and column of the first entry that is NaN or infinite, of columns one after the other.
pub(crate) fn not_finite(entries: &[f64], rows: usize) -> Option<(usize, usize)> {
    let index = entries.iter().position(|entry| !entry.is_finite())?;
    Some((index % rows, index / rows))
}

/// `tᵀ q t` of a symmetric `q`.
pub(super) fn congruent(t: &DMatrix<f64>, q: &DMatrix<f64>) -> DMatrix<f64> {
    // Not `tr_mul`, which takes no blocks.
    let mut congruent = t.transpose() * (q * t);
    symmetrize(&mut congruent);
    congruent
}

/// `M⁻¹ rhs` of a symmetric positive definite `M` up to round-off, and the reciprocal condition of `M` in
/// the 1-norm; nothing if `M` is not positive definite, or the solution not finite, in floating point.
pub(super) fn solve_definite(
    mut m: DMatrix<f64>,
    rhs: &DMatrix<f64>,
) -> Option<(DMatrix<f64>, f64)> {
    symmetrize(&mut m);
    let factor = m.cholesky()?;
    let solution = factor.solve(rhs);
    all_finite(&solution).then(|| (solution, reciprocal_condition(&factor.l())))
}
