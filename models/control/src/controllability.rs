//! What the inputs reach, and what the outputs show.

use nalgebra::DMatrix;
use nalgebra::linalg::SVD;

use crate::matrix::all_finite;
use crate::spectrum::balance;

/// Singular value, relative to the block's own scale, below which a direction is not reached.
const REACHED: f64 = 1e-10;

/// Rank of the controllability matrix `[B, AB, A²B, …]`.
///
/// The powers are not formed: their columns line up with the fastest mode and lose the others to
/// round-off. Instead an orthonormal basis of what is reached grows by what one more step adds
/// (the staircase algorithm); new directions are told by singular values, after balancing, so that
/// the units of states and inputs do not matter. Gives 0 for matrices that are not finite or do
/// not fit together. About `4n²r` flops for rank `r`, plus small singular value decompositions.
pub fn controllability_rank(a: &DMatrix<f64>, b: &DMatrix<f64>) -> usize {
    let n = a.nrows();
    if a.ncols() != n || b.nrows() != n || !all_finite(a) || !all_finite(b) {
        return 0;
    }
    let (mut a, mut fresh) = (a.clone(), b.clone());
    balance(&mut a, &mut fresh);
    normalize_columns(&mut fresh);
    let a_norm = a.norm();
    if a_norm > 0.0 {
        a /= a_norm;
    }
    let mut reached = DMatrix::<f64>::zeros(n, 0);
    while reached.ncols() < n && fresh.ncols() > 0 {
        let Some(directions) = new_directions(&reached, &fresh) else { break };
        let known = reached.ncols();
        reached = reached.resize_horizontally(known + directions.ncols(), 0.0);
        reached.columns_mut(known, directions.ncols()).copy_from(&directions);
        fresh = &a * directions;
    }
    reached.ncols()
}

/// Rank of the observability matrix `[C; CA; CA²; …]`: how many directions of the state the outputs
/// `y = C x` tell apart. By duality the controllability rank of `(Aᵀ, Cᵀ)`; same costs, same cautions.
pub fn observability_rank(a: &DMatrix<f64>, c: &DMatrix<f64>) -> usize {
    controllability_rank(&a.transpose(), &c.transpose())
}

fn normalize_columns(m: &mut DMatrix<f64>) {
    for mut column in m.column_iter_mut() {
        let norm = column.norm();
        if norm > 0.0 {
            column /= norm;
        }
    }
}

/// Orthonormal basis of what `fresh` adds to the orthonormal `reached`.
fn new_directions(reached: &DMatrix<f64>, fresh: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let mut rest = fresh.clone();
    // Twice is enough (Kahan, Parlett): the first pass leaves round-off of the removed part.
    for _ in 0..2 {
        let removed = reached * (reached.transpose() * &rest);
        rest -= removed;
    }
    let limit = 60 * (rest.nrows() + rest.ncols());
    let svd = SVD::try_new(rest, true, false, f64::EPSILON, limit)?;
    let rank = svd.singular_values.iter().filter(|&&s| s > REACHED).count();
    // nalgebra sorts singular values, largest first.
    svd.u.map(|u| u.columns(0, rank).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain(n: usize, coupling: f64) -> (DMatrix<f64>, DMatrix<f64>) {
        let a = DMatrix::from_fn(n, n, |i, j| if i == j + 1 { coupling } else { 0.0 });
        (a, DMatrix::from_fn(n, 1, |i, _| if i == 0 { 1.0 } else { 0.0 }))
    }

    #[test]
    fn the_papers_pendulum_is_controllable() {
        let a = DMatrix::from_row_slice(2, 2, &[0.95333434, 0.09766672, -0.93331323, 0.95333434]);
        let b = DMatrix::from_column_slice(2, 1, &[0.00976667, 0.09533343]);
        assert_eq!(controllability_rank(&a, &b), 2);
    }

    #[test]
    fn long_chains_are_reached_to_the_end() {
        let (a, b) = chain(60, 0.5);
        assert_eq!(controllability_rank(&a, &b), 60);
        let (mut a, b) = chain(60, 0.5);
        a[(40, 39)] = 0.0;
        assert_eq!(controllability_rank(&a, &b), 40);
    }

    #[test]
    fn units_do_not_matter() {
        let a = DMatrix::from_row_slice(3, 3, &[0.9, 0.1, 0.0, -0.2, 0.8, 0.3, 0.0, 0.1, 1.1]);
        let b = DMatrix::from_column_slice(3, 1, &[0.0, 1.0, 0.0]);
        assert_eq!(controllability_rank(&a, &b), 3);
        let units = DMatrix::from_diagonal(&nalgebra::dvector![1e-6, 1.0, 1e7]);
        let inverse = DMatrix::from_diagonal(&nalgebra::dvector![1e6, 1.0, 1e-7]);
        assert_eq!(controllability_rank(&(&units * a * inverse), &(units * b * 1e-12)), 3);
    }

    #[test]
    fn a_position_shows_the_velocity_and_not_the_other_way_round() {
        // x = (position, velocity) without a spring.
        let a = DMatrix::from_row_slice(2, 2, &[1.0, 0.1, 0.0, 1.0]);
        assert_eq!(observability_rank(&a, &DMatrix::from_row_slice(1, 2, &[1.0, 0.0])), 2);
        assert_eq!(observability_rank(&a, &DMatrix::from_row_slice(1, 2, &[0.0, 1.0])), 1);
        assert_eq!(observability_rank(&a, &DMatrix::zeros(0, 2)), 0);
        assert_eq!(observability_rank(&a, &DMatrix::zeros(1, 3)), 0);
    }

    #[test]
    fn what_no_input_reaches_does_not_count() {
        let a = DMatrix::from_diagonal(&nalgebra::dvector![1.2, 0.9, 0.5]);
        let b = DMatrix::from_column_slice(3, 1, &[0.0, 1.0, 1.0]);
        assert_eq!(controllability_rank(&a, &b), 2);
        assert_eq!(controllability_rank(&a, &DMatrix::zeros(3, 2)), 0);
        assert_eq!(controllability_rank(&a, &DMatrix::zeros(3, 0)), 0);
        assert_eq!(controllability_rank(&a, &DMatrix::from_element(3, 1, f64::NAN)), 0);
    }
}
