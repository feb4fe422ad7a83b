//! Dense LU with complete pivoting, for the small Schur complement of the constraints.
//!
//! Rows that depend on others (redundant constraints) show as vanishing pivots: they are left out,
//! and their multipliers are zero.

use crate::plant::rows::{Term, add_rows};

/// Pivots below this fraction of the largest count as zero.
const RANK_TOLERANCE: f64 = 1e-11;

/// A square matrix, row-major, and its factorization in place.
#[derive(Clone, Debug)]
pub(crate) struct PivotedLu {
    pub(crate) matrix: Vec<f64>,
    order: usize,
    rank: usize,
    rows: Vec<usize>,
    columns: Vec<usize>,
    scale: Vec<f64>,
    inverse_pivot: Vec<f64>,
    /// A permuted right-hand side.
    scratch: Vec<f64>,
    terms: Vec<Term>,
}

impl PivotedLu {
    /// Room for a matrix and for right-hand sides of up to `stride` columns (whole blocks).
    pub(crate) fn new(order: usize, stride: usize) -> Self {
        Self {
            matrix: vec![0.0; order * order],
            order,
            rank: 0,
            rows: vec![0; order],
            columns: vec![0; order],
            scale: vec![1.0; order],
            inverse_pivot: vec![0.0; order],
            scratch: vec![0.0; order * stride.max(1)],
            terms: Vec::with_capacity(order),
        }
    }

    /// Factors what stands in `matrix`, scaled to a unit diagonal first.
    pub(crate) fn factor(&mut self) {
        let n = self.order;
        for i in 0..n {
            let diagonal = self.matrix[i * n + i].abs();
            self.scale[i] = if diagonal > 0.0 { diagonal.sqrt().recip() } else { 1.0 };
            self.rows[i] = i;
            self.columns[i] = i;
        }
        for i in 0..n {
            for j in 0..n {
                self.matrix[i * n + j] *= self.scale[i] * self.scale[j];
            }
        }
        self.rank = n;
        let mut first = 0.0;
        for k in 0..n {
            let (row, column, pivot) = self.largest_from(k);
            if k == 0 {
                first = pivot;
            }
            // Written so that a NaN ends the factorization too.
            if !(pivot > RANK_TOLERANCE * first) {
                self.rank = k;
                return;
            }
            self.swap(k, row, column);
            let inverse = 1.0 / self.matrix[k * n + k];
            self.inverse_pivot[k] = inverse;
            for i in k + 1..n {
                let factor = self.matrix[i * n + k] * inverse;
                self.matrix[i * n + k] = factor;
                for j in k + 1..n {
                    self.matrix[i * n + j] -= factor * self.matrix[k * n + j];
                }
            }
        }
    }

    fn largest_from(&self, k: usize) -> (usize, usize, f64) {
        let n = self.order;
        let mut largest = (k, k, 0.0);
        for i in k..n {
            for j in k..n {
                let entry = self.matrix[i * n + j].abs();
                if entry > largest.2 {
                    largest = (i, j, entry);
                }
            }
        }
        largest
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

    /// Solves in place; multipliers of redundant rows are zero.
    pub(crate) fn solve(&mut self, x: &mut [f64]) {
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
    }

    /// The same for a row-major right-hand side; `stride` is whole blocks.
    pub(crate) fn solve_rows(&mut self, x: &mut [f64], stride: usize) {
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
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    fn filled(dense: &DMatrix<f64>) -> PivotedLu {
        let mut lu = PivotedLu::new(dense.nrows(), 8);
        lu.matrix.copy_from_slice(dense.transpose().as_slice());
        lu.factor();
        lu
    }

    #[test]
    fn badly_scaled_rows_do_not_count_as_redundant() {
        let scale = DMatrix::from_diagonal(&DVector::from_vec(vec![1e6, 1.0, 1e-7]));
        let core = DMatrix::from_row_slice(3, 3, &[2.0, 0.3, -0.4, 0.1, 3.0, 0.2, 0.5, -0.6, 4.0]);
        let dense = &scale * core * &scale;
        let x = DVector::from_vec(vec![1e-6, -2.0, 3e7]);
        let mut solution = (&dense * &x).as_slice().to_vec();
        let mut lu = filled(&dense);
        lu.solve(&mut solution);
        assert_eq!(lu.rank, 3);
        assert!((DVector::from_vec(solution).component_div(&x).add_scalar(-1.0)).amax() < 1e-12);
    }

    #[test]
    fn a_consistent_redundant_system_is_solved() {
        // The third row is the sum of the others.
        let a = DMatrix::from_row_slice(
            3,
            4,
            &[1.0, 0.2, 0.0, 0.4, 0.0, 1.0, 0.5, 0.0, 1.0, 1.2, 0.5, 0.4],
        );
        let dense = &a * a.transpose();
        let b = &dense * DVector::from_vec(vec![1.0, 2.0, -1.0]);
        let mut lu = filled(&dense);
        let mut single = b.as_slice().to_vec();
        lu.solve(&mut single);
        assert_eq!(lu.rank, 2);
        assert!((&dense * DVector::from_vec(single.clone()) - &b).amax() < 1e-12);
        let mut rows = vec![0.0; 3 * 8];
        (0..3).for_each(|i| rows[i * 8 + 5] = b[i]);
        lu.solve_rows(&mut rows, 8);
        (0..3).for_each(|i| assert!((rows[i * 8 + 5] - single[i]).abs() < 1e-14));
    }
}
