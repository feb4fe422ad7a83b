//! Dense LU with complete pivoting, for the small Schur complement of the constraints.
//!
//! Rows that depend on others (redundant constraints) show as vanishing pivots and are left out. Of
//! all solutions the one of least norm is taken: what a solution has along the null space of the
//! matrix is removed. A matrix of full rank pays nothing for that.
//!
//! **Near a singular configuration** the pivot of an equation that is not redundant vanishes as the square
//! of the distance from there. It says the same as it did further away: left out, the equation would be
//! violated and its multiplier lost. So the first `r` pivots, of `r` equations that are independent in
//! general, are in use as long as more than noise is left of them; redundant equations come after them.

use crate::rows::{Term, add_rows};
use crate::simd::wide;

/// Relative to the first, pivots below this are noise. Steps with such pivots are refused unless
/// [`Settings::singular_below`](crate::Settings::singular_below) allows them.
const NOISE: f64 = 1e-14;

/// A square matrix, row-major, and its factorization in place.
#[derive(Clone, Debug)]
pub struct PivotedLu {
    /// The matrix by rows before, its factors after the factorization.
    pub matrix: Vec<f64>,
    order: usize,
    rank: usize,
    /// Equations that are independent in general.
    independent: usize,
    rows: Vec<usize>,
    columns: Vec<usize>,
    scale: Vec<f64>,
    inverse_pivot: Vec<f64>,
    /// Largest entry of what was left out.
    rest: f64,
    /// Orthonormal basis of the null space, one row per vector.
    null: Vec<f64>,
    null_vectors: usize,
    /// A permuted right-hand side.
    scratch: Vec<f64>,
    terms: Vec<Term>,
}

/// The largest entry so far.
#[derive(Clone, Copy, Debug, Default)]
struct Largest {
    row: usize,
    column: usize,
    size: f64,
}

impl Largest {
    /// Looks at the entries of a row, which begin at `column`.
    #[inline(always)]
    fn find(&mut self, row: usize, column: usize, entries: &[f64]) {
        let size = entries.iter().fold(0.0, |m, x| if x.abs() > m { x.abs() } else { m });
        if size > self.size {
            let at = entries.iter().position(|x| x.abs() == size);
            *self = Self { row, column: column + at.unwrap_or_default(), size };
        }
    }
}

impl PivotedLu {
    /// Room for a matrix and for right-hand sides of up to `stride` columns (whole blocks).
    ///
    /// Rows and columns are multiplied by `scale` before they are factored; those of which it is zero
    /// are left out.
    pub fn new(scale: &[f64], stride: usize) -> Self {
        let order = scale.len();
        Self {
            matrix: vec![0.0; order * order],
            order,
            rank: 0,
            independent: 0,
            rows: vec![0; order],
            columns: vec![0; order],
            scale: scale.to_vec(),
            inverse_pivot: vec![0.0; order],
            rest: 0.0,
            null: vec![0.0; order * order],
            null_vectors: 0,
            scratch: vec![0.0; order * stride.max(1)],
            terms: Vec::with_capacity(order),
        }
    }

    /// With the number of rows that are independent in general.
    pub fn with_independent(self, independent: usize) -> Self {
        Self { independent, ..self }
    }

    /// Factors what stands in `matrix`.
    #[inline(never)]
    pub fn factor(&mut self) {
        wide!({
            let n = self.order;
            for (i, row) in self.matrix.chunks_exact_mut(n.max(1)).enumerate() {
                (self.rows[i], self.columns[i]) = (i, i);
                for (entry, scale) in row.iter_mut().zip(&self.scale) {
                    *entry *= self.scale[i] * scale;
                }
            }
            self.rank = n;
            self.null_vectors = 0;
            self.rest = 0.0;
            let mut largest = Largest::default();
            for (i, row) in self.matrix.chunks_exact(n.max(1)).enumerate() {
                largest.find(i, 0, row);
            }
            let first = largest.size;
            for k in 0..n {
                let smallest = if k < self.independent { NOISE } else { DEPENDENT };
                // Written so that a NaN ends the factorization too.
                if !(largest.size > smallest * first) {
                    self.rank = k;
                    self.rest = largest.size;
                    self.find_null();
                    return;
                }
                self.swap(k, largest.row, largest.column);
                let inverse = 1.0 / self.matrix[k * n + k];
                self.inverse_pivot[k] = inverse;
                let (above, below) = self.matrix.split_at_mut((k + 1) * n);
                let pivot_row = &above[k * n + k + 1..];
                largest = Largest { row: k + 1, column: k + 1, size: 0.0 };
                for (i, row) in below.chunks_exact_mut(n).enumerate() {
                    let factor = row[k] * inverse;
                    row[k] = factor;
                    let row = &mut row[k + 1..];
                    for (entry, pivot) in row.iter_mut().zip(pivot_row) {
                        *entry -= factor * pivot;
                    }
                    largest.find(k + 1 + i, k + 1, row);
                }
            }
        })
    }

    /// Takes over the factorization of another matrix of the same order and scale.
    pub fn take_factors_of(&mut self, other: &Self) {
        let known = other.null_vectors * other.order;
        self.matrix.copy_from_slice(&other.matrix);
        self.rows.copy_from_slice(&other.rows);
        self.columns.copy_from_slice(&other.columns);
        self.inverse_pivot.copy_from_slice(&other.inverse_pivot);
        self.null[..known].copy_from_slice(&other.null[..known]);
        self.null_vectors = other.null_vectors;
        (self.rank, self.rest) = (other.rank, other.rest);
    }

    /// Rows that were left out.
    pub fn deficiency(&self) -> usize {
        self.order - self.rank
    }

    /// The smallest of the first `expected` pivots (of all that are not zero, if these are more)
    /// relative to the largest pivot or to `unit`; 1 without any.
    pub fn reciprocal_condition(&self, expected: usize, unit: f64) -> f64 {
        let pivot =
            |k: usize| if k < self.rank { self.inverse_pivot[k].abs().recip() } else { self.rest };
        match expected.max(self.rank).checked_sub(1) {
            Some(last) => (pivot(last) / pivot(0).max(unit)).clamp(0.0, 1.0),
            None => 1.0,
        }
    }

    /// Finds the null space: with `P` the order of the columns and `U = [U1 U2]`, the vectors
    /// `P [−U1⁻¹ U2; 1]`, scaled back and made orthonormal.
    #[cold]
    fn find_null(&mut self) {
        let (n, rank) = (self.order, self.rank);
        for free in rank..n {
            if self.scale[self.columns[free]] == 0.0 {
                continue;
            }
            let z = &mut self.scratch[..n];
            z.fill(0.0);
            z[free] = 1.0;
            for k in (0..rank).rev() {
                let row = &self.matrix[k * n..][..n];
                let sum: f64 = (k + 1..rank).map(|j| row[j] * z[j]).sum();
                z[k] = -(sum + row[free]) * self.inverse_pivot[k];
            }
            let (found, vector) = self.null.split_at_mut(self.null_vectors * n);
            let vector = &mut vector[..n];
            for (z, column) in z.iter().zip(&self.columns) {
                vector[*column] = z * self.scale[*column];
            }
            // Twice is enough.
            for _ in 0..2 {
                for other in found.chunks_exact(n) {
                    subtract_part(vector, other);
                }
            }
            let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
            vector.iter_mut().for_each(|x| *x /= length);
            self.null_vectors += 1;
        }
    }

    /// Takes from `x` what it has along the null space, which leaves the solution of least norm.
    pub fn remove_null(&self, x: &mut [f64]) {
        for vector in self.null.chunks_exact(self.order.max(1)).take(self.null_vectors) {
            subtract_part(x, vector);
        }
    }

    fn swap(&mut self, k: usize, row: usize, column: usize) {
        let n = self.order;
        self.rows.swap(k, row);
        self.columns.swap(k, column);
        for j in 0..n {
            self.matrix.swap(k * n + j, row * n + j);
        }
        for i in 0..n {
            self.matrix.swap(i * n + k, i * n + column);
        }
    }

    /// Solves in place, with least norm.
    pub fn solve(&mut self, x: &mut [f64]) {
        let (n, rank) = (self.order, self.rank);
        for k in 0..rank {
            let row = self.rows[k];
            let mut value = x[row] * self.scale[row];
            for j in 0..k {
                value -= self.matrix[k * n + j] * self.scratch[j];
            }
            self.scratch[k] = value;
        }
        for k in (0..rank).rev() {
            let mut value = self.scratch[k];
            for j in k + 1..rank {
                value -= self.matrix[k * n + j] * self.scratch[j];
            }
            self.scratch[k] = value * self.inverse_pivot[k];
        }
        self.scratch[rank..n].fill(0.0);
        for k in 0..n {
            let target = self.columns[k];
            x[target] = self.scratch[k] * self.scale[target];
        }
        self.remove_null(x);
    }

    /// Solves with the transposed matrix in place, by the transpose of what [`Self::solve`] does.
    pub fn solve_transposed(&mut self, x: &mut [f64]) {
        let (n, rank) = (self.order, self.rank);
        self.remove_null(x);
        for k in 0..rank {
            let column = self.columns[k];
            let mut value = x[column] * self.scale[column];
            for j in 0..k {
                value -= self.matrix[j * n + k] * self.scratch[j];
            }
            self.scratch[k] = value * self.inverse_pivot[k];
        }
        for k in (0..rank).rev() {
            let mut value = self.scratch[k];
            for j in k + 1..rank {
                value -= self.matrix[j * n + k] * self.scratch[j];
            }
            self.scratch[k] = value;
        }
        self.scratch[rank..n].fill(0.0);
        for k in 0..n {
            let target = self.rows[k];
            x[target] = self.scratch[k] * self.scale[target];
        }
    }

    /// Makes room for right-hand sides of more columns (whole blocks).
    pub fn reserve(&mut self, stride: usize) {
        let needed = self.order * stride;
        if self.scratch.len() < needed {
            self.scratch.resize(needed, 0.0);
        }
    }

    /// Solves for right-hand sides side by side, row-major; `stride` is whole blocks.
    pub fn solve_rows(&mut self, x: &mut [f64], stride: usize) {
        let (n, rank) = (self.order, self.rank);
        for k in 0..rank {
            let (above, target) = self.scratch.split_at_mut(k * stride);
            let target = &mut target[..stride];
            let row = self.rows[k];
            for (t, entry) in target.iter_mut().zip(&x[row * stride..]) {
                *t = entry * self.scale[row];
            }
            let factors = self.matrix[k * n..][..k].iter().enumerate();
            self.terms.clear();
            self.terms.extend(factors.map(|(j, l)| (-l, j)));
            add_rows(target, above, stride, &self.terms);
        }
        for k in (0..rank).rev() {
            let (target, below) = self.scratch[k * stride..].split_at_mut(stride);
            let factors = self.matrix[k * n..][k + 1..rank].iter().enumerate();
            self.terms.clear();
            self.terms.extend(factors.map(|(j, u)| (-u, j)));
            add_rows(target, below, stride, &self.terms);
            for t in target {
                *t *= self.inverse_pivot[k];
            }
        }
        self.scratch[rank * stride..n * stride].fill(0.0);
        for k in 0..n {
            let target = self.columns[k];
            let source = &self.scratch[k * stride..];
            for (t, entry) in x[target * stride..][..stride].iter_mut().zip(source) {
                *t = entry * self.scale[target];
            }
        }
        self.remove_null_rows(x, stride);
    }

    fn remove_null_rows(&mut self, x: &mut [f64], stride: usize) {
        for vector in self.null.chunks_exact(self.order.max(1)).take(self.null_vectors) {
            let along = &mut self.scratch[..stride];
            along.fill(0.0);
            self.terms.clear();
            self.terms.extend(vector.iter().enumerate().map(|(c, part)| (*part, c)));
            add_rows(along, x, stride, &self.terms);
            for (row, part) in x.chunks_exact_mut(stride).zip(vector) {
                add_rows(row, along, stride, &[(-part, 0)]);
            }
        }
    }
}

/// `x −= n (nᵀ x)` for a vector `n` of length one.
fn subtract_part(x: &mut [f64], n: &[f64]) {
    let part: f64 = x.iter().zip(n).map(|(x, n)| x * n).sum();
    x.iter_mut().zip(n).for_each(|(x, n)| *x -= part * n);
}

/// Square of the distance from the others, relative to a row of full steepness, below which a row
/// depends on them.
pub const DEPENDENT: f64 = 1e-11;

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    fn filled(dense: &DMatrix<f64>, scale: &[f64]) -> PivotedLu {
        let mut lu = PivotedLu::new(scale, 8);
        lu.matrix.copy_from_slice(dense.transpose().as_slice());
        lu.factor();
        lu
    }

    #[test]
    fn badly_scaled_rows_do_not_count_as_redundant() {
        let lengths = [1e6, 1.0, 1e-7];
        let scale = DMatrix::from_diagonal(&DVector::from_row_slice(&lengths));
        let core = DMatrix::from_row_slice(3, 3, &[2.0, 0.3, -0.4, 0.1, 3.0, 0.2, 0.5, -0.6, 4.0]);
        let dense = &scale * core * &scale;
        let x = DVector::from_vec(vec![1e-6, -2.0, 3e7]);
        let mut solution = (&dense * &x).as_slice().to_vec();
        let mut lu = filled(&dense, &lengths.map(f64::recip));
        lu.solve(&mut solution);
        assert_eq!(lu.deficiency(), 0);
        assert!((DVector::from_vec(solution).component_div(&x).add_scalar(-1.0)).amax() < 1e-12);
        let smallest = lu.reciprocal_condition(3, 1.0);
        assert!((0.3..1.0).contains(&smallest), "{smallest}");
    }

    /// Rows of rank 2 among five: the third is the sum of the first two, the fourth is noise, the
    /// fifth twice the second.
    fn redundant() -> DMatrix<f64> {
        let rows = [
            [1.0, 0.2, 0.0, 0.4],
            [0.0, 1.0, 0.5, 0.0],
            [1.0, 1.2, 0.5, 0.4],
            [1e-17, -1e-17, 0.0, 1e-17],
            [0.0, 2.0, 1.0, 0.0],
        ];
        DMatrix::from_fn(5, 4, |i, j| rows[i][j])
    }

    #[test]
    fn transposed_solutions_are_adjoint() {
        let regular = DMatrix::from_fn(5, 5, |i, j| {
            (if i == j { 3.0 } else { 0.0 }) + ((3 * i + 5 * j) as f64).sin()
        });
        let a = redundant();
        let turned = DMatrix::from_fn(5, 4, |i, j| a[(i, j)] * (1.0 + 0.1 * j as f64));
        let dense = turned * a.transpose();
        for (dense, scale) in [(&regular, [1.0; 5]), (&dense, [1.0, 1.0, 1.0, 0.0, 1.0])] {
            let mut lu = filled(dense, &scale);
            let (mut x, mut y) = ([1.0, -2.0, 0.5, 0.7, 0.2], [0.3, 0.7, -1.1, 0.9, -0.4]);
            let (b, c) = (x, y);
            lu.solve(&mut x);
            lu.solve_transposed(&mut y);
            let dot = |a: [f64; 5], b: [f64; 5]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            assert!((dot(x, c) - dot(b, y)).abs() < 1e-13);
        }
    }

    #[test]
    fn a_consistent_redundant_system_is_solved_with_least_norm() {
        let a = redundant();
        // Not symmetric, as in a step, with the null space of the rows of `a` on the right.
        let turned = DMatrix::from_fn(5, 4, |i, j| a[(i, j)] * (1.0 + 0.1 * j as f64));
        let dense = turned * a.transpose();
        let b = &dense * DVector::from_vec(vec![1.0, 2.0, -1.0, 0.0, 0.5]);
        let mut lu = filled(&dense, &[1.0, 1.0, 1.0, 0.0, 1.0]);
        let mut single = b.as_slice().to_vec();
        lu.solve(&mut single);
        assert_eq!(lu.deficiency(), 3);
        assert!((&dense * DVector::from_vec(single.clone()) - &b).amax() < 1e-12);
        let least = dense.svd(true, true).solve(&b, 1e-10).unwrap();
        assert!((DVector::from_vec(single.clone()) - least).amax() < 1e-12);
        let mut rows = vec![0.0; 5 * 8];
        (0..5).for_each(|i| rows[i * 8 + 5] = b[i]);
        lu.solve_rows(&mut rows, 8);
        (0..5).for_each(|i| assert!((rows[i * 8 + 5] - single[i]).abs() < 1e-14));
    }

    #[test]
    fn only_pivots_that_should_be_there_count() {
        let a = redundant();
        let lu = filled(&(&a * a.transpose()), &[1.0, 1.0, 1.0, 0.0, 1.0]);
        assert!(lu.reciprocal_condition(2, 1.0) > 0.05);
        assert!(lu.reciprocal_condition(3, 1.0) < 1e-14);
        assert!(lu.reciprocal_condition(2, 1e6) < 1e-5);
        assert_eq!(filled(&DMatrix::zeros(0, 0), &[]).reciprocal_condition(0, 1.0), 1.0);
        assert_eq!(filled(&DMatrix::zeros(1, 1), &[1.0]).reciprocal_condition(1, 1.0), 0.0);
    }
}
