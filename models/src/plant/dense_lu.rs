//! Dense LU with partial pivoting, for the stages of collocation.

use crate::plant::rows::{Term, add_rows};
use crate::wide::wide;

/// A square matrix, row-major, and its factorization in place.
#[derive(Clone, Debug)]
pub(crate) struct DenseLu {
    pub(crate) matrix: Vec<f64>,
    order: usize,
    /// With which row each was exchanged.
    exchanged: Vec<usize>,
    inverse_pivot: Vec<f64>,
    terms: Vec<Term>,
}

impl DenseLu {
    pub(crate) fn new(order: usize) -> Self {
        Self {
            matrix: vec![0.0; order * order],
            order,
            exchanged: vec![0; order],
            inverse_pivot: vec![0.0; order],
            terms: Vec::with_capacity(order),
        }
    }

    wide! {
        /// Factors what stands in `matrix`; false if it is singular.
        #[inline(never)]
        pub(crate) fn factor(mut self) -> bool = factor_portable, factor_avx2;

        /// Solves `A x = b` in place.
        #[inline(never)]
        pub(crate) fn solve(self, x: &mut [f64]) = solve_portable, solve_avx2;
    }

    #[inline(always)]
    fn factor_portable(&mut self) -> bool {
        let n = self.order;
        for k in 0..n {
            let size = |i: usize| self.matrix[i * n + k].abs();
            let pivot = (k..n).fold(k, |best, i| if size(i) > size(best) { i } else { best });
            let inverse = 1.0 / self.matrix[pivot * n + k];
            if !inverse.is_finite() {
                return false;
            }
            (self.exchanged[k], self.inverse_pivot[k]) = (pivot, inverse);
            let (above, below) = self.matrix.split_at_mut((k + 1) * n);
            let row = &mut above[k * n..];
            if pivot > k {
                row.swap_with_slice(&mut below[(pivot - k - 1) * n..][..n]);
            }
            for target in below.chunks_exact_mut(n) {
                let factor = target[k] * inverse;
                target[k] = factor;
                for (t, entry) in target[k + 1..].iter_mut().zip(&row[k + 1..]) {
                    *t -= factor * entry;
                }
            }
        }
        true
    }

    #[inline(always)]
    fn solve_portable(&self, x: &mut [f64]) {
        let n = self.order;
        for (k, &other) in self.exchanged.iter().enumerate() {
            x.swap(k, other);
        }
        let dot = |row: &[f64], x: &[f64]| row.iter().zip(x).map(|(a, b)| a * b).sum::<f64>();
        for i in 1..n {
            x[i] -= dot(&self.matrix[i * n..][..i], x);
        }
        for i in (0..n).rev() {
            let known = dot(&self.matrix[i * n..][..n][i + 1..], &x[i + 1..]);
            x[i] = (x[i] - known) * self.inverse_pivot[i];
        }
    }

    /// Solves `A X = B` in place; rows are `stride` long, whole blocks.
    pub(crate) fn solve_rows(&mut self, x: &mut [f64], stride: usize) {
        let n = self.order;
        for (k, &other) in self.exchanged.iter().enumerate().filter(|(k, other)| *k != **other) {
            let (above, below) = x.split_at_mut(other * stride);
            above[k * stride..][..stride].swap_with_slice(&mut below[..stride]);
        }
        for i in 1..n {
            let (above, target) = x.split_at_mut(i * stride);
            self.terms.clear();
            self.terms.extend(self.matrix[i * n..][..i].iter().map(|l| -l).zip(0..));
            add_rows(&mut target[..stride], above, stride, &self.terms);
        }
        for i in (0..n).rev() {
            let (target, below) = x[i * stride..].split_at_mut(stride);
            self.terms.clear();
            self.terms.extend(self.matrix[i * n..][..n][i + 1..].iter().map(|u| -u).zip(0..));
            add_rows(target, below, stride, &self.terms);
            target.iter_mut().for_each(|entry| *entry *= self.inverse_pivot[i]);
        }
    }

    /// Solves `Aᵀ x = b` in place.
    pub(crate) fn solve_transposed(&self, x: &mut [f64]) {
        let n = self.order;
        for i in 0..n {
            x[i] *= self.inverse_pivot[i];
            let (solved, rest) = x.split_at_mut(i + 1);
            let row = &self.matrix[i * n..][..n][i + 1..];
            rest.iter_mut().zip(row).for_each(|(x, u)| *x -= u * solved[i]);
        }
        for i in (1..n).rev() {
            let (rest, solved) = x.split_at_mut(i);
            let row = &self.matrix[i * n..][..i];
            rest.iter_mut().zip(row).for_each(|(x, l)| *x -= l * solved[0]);
        }
        for (k, &other) in self.exchanged.iter().enumerate().rev() {
            x.swap(k, other);
        }
    }

    /// Takes over the factorization of another matrix of the same order.
    pub(crate) fn take_factors_of(&mut self, other: &Self) {
        self.matrix.copy_from_slice(&other.matrix);
        self.exchanged.copy_from_slice(&other.exchanged);
        self.inverse_pivot.copy_from_slice(&other.inverse_pivot);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    #[test]
    fn solutions_are_those_of_a_known_library() {
        for order in [1, 2, 5, 24] {
            let entry = |i: usize, j: usize| ((1 + 3 * i + 7 * j * j + i * j) as f64 * 0.7).sin();
            let matrix = DMatrix::from_fn(order, order, entry);
            let mut lu = DenseLu::new(order);
            lu.matrix.copy_from_slice(matrix.transpose().as_slice());
            assert!(lu.factor());
            let right = DVector::from_fn(order, |i, _| 1.0 + i as f64);
            let expected = matrix.clone().lu().solve(&right).unwrap();
            let mut x = right.as_slice().to_vec();
            lu.solve(&mut x);
            let mut rows: Vec<f64> = right.iter().flat_map(|b| [*b; 8]).collect();
            lu.solve_rows(&mut rows, 8);
            let size = expected.amax();
            for (i, expected) in expected.iter().enumerate() {
                assert!((x[i] - expected).abs() < 1e-11 * size, "{order}");
                assert!((rows[8 * i + 7] - expected).abs() < 1e-11 * size, "{order}");
            }
            let expected = matrix.transpose().lu().solve(&right).unwrap();
            let mut x = right.as_slice().to_vec();
            lu.solve_transposed(&mut x);
            let errors = x.iter().zip(expected.iter()).map(|(x, e)| (x - e).abs());
            assert!(errors.fold(0.0, f64::max) < 1e-11 * expected.amax(), "{order}");
        }
        let mut singular = DenseLu::new(2);
        singular.matrix.copy_from_slice(&[1.0, 2.0, 2.0, 4.0]);
        assert!(!singular.factor());
    }
}
