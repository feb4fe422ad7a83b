//! Dense LU with partial pivoting, for the stages of collocation.

use crate::plant::rows::{LANES, Term, add_rows};
use crate::scalar::{Lanes, Scalar};
use crate::wide::wide;

/// A square matrix, row-major, and its factors. Whole blocks of columns are eliminated, so that what is left
/// of the diagonal is of no meaning afterwards: the multipliers have a place of their own.
#[derive(Clone, Debug)]
pub(crate) struct DenseLu {
    /// Rows are `stride` long; what is beyond the order must be finite.
    pub(crate) matrix: Vec<f64>,
    pub(crate) stride: usize,
    /// `L`, row after row, zero from the diagonal on.
    multipliers: Vec<f64>,
    order: usize,
    /// With which row each was exchanged.
    exchanged: Vec<usize>,
    inverse_pivot: Vec<f64>,
    /// A right-hand side and its solution, padded.
    work: Vec<f64>,
    terms: Vec<Term>,
}

impl DenseLu {
    /// A matrix whose rows have room for some more columns, which do not count.
    pub(crate) fn new(order: usize, room: usize) -> Self {
        let stride = (order + room).max(1).next_multiple_of(LANES);
        Self {
            matrix: vec![0.0; order * stride],
            stride,
            multipliers: vec![0.0; order * stride],
            order,
            exchanged: vec![0; order],
            inverse_pivot: vec![0.0; order],
            work: vec![0.0; 2 * stride],
            terms: Vec::with_capacity(order),
        }
    }

    wide! {
        /// Factors what stands in `matrix`; false if it is singular.
        #[inline(never)]
        pub(crate) fn factor(mut self) -> bool = factor_portable, factor_avx2;

        /// Solves `A x = b` in place.
        #[inline(never)]
        pub(crate) fn solve(mut self, x: &mut [f64]) = solve_portable, solve_avx2;
    }

    #[inline(always)]
    fn factor_portable(&mut self) -> bool {
        let (n, stride) = (self.order, self.stride);
        self.multipliers.fill(0.0);
        for k in 0..n {
            let mut pivot = k;
            let mut size = 0.0;
            for (i, row) in self.matrix.chunks_exact(stride).enumerate().skip(k) {
                if row[k].abs() > size {
                    (pivot, size) = (i, row[k].abs());
                }
            }
            let inverse = 1.0 / self.matrix[pivot * stride + k];
            if !inverse.is_finite() {
                return false;
            }
            (self.exchanged[k], self.inverse_pivot[k]) = (pivot, inverse);
            if pivot > k {
                for rows in [&mut self.matrix, &mut self.multipliers] {
                    let (above, below) = rows.split_at_mut(pivot * stride);
                    above[k * stride..][..stride].swap_with_slice(&mut below[..stride]);
                }
            }
            let (above, below) = self.matrix.split_at_mut((k + 1) * stride);
            let row = &above[k * stride..].as_chunks::<LANES>().0[k / LANES..];
            let multipliers = self.multipliers[(k + 1) * stride..].chunks_exact_mut(stride);
            for (target, multipliers) in below.chunks_exact_mut(stride).zip(multipliers) {
                let factor = target[k] * inverse;
                multipliers[k] = factor;
                let targets = &mut target.as_chunks_mut::<LANES>().0[k / LANES..];
                for (target, entries) in targets.iter_mut().zip(row) {
                    let mut rest = *target;
                    for (rest, entry) in rest.iter_mut().zip(entries) {
                        *rest -= factor * entry;
                    }
                    *target = rest;
                }
            }
        }
        true
    }

    #[inline(always)]
    fn solve_portable(&mut self, x: &mut [f64]) {
        let (n, stride) = (self.order, self.stride);
        let (right, solution) = self.work.split_at_mut(stride);
        right[..n].copy_from_slice(x);
        for (k, &other) in self.exchanged.iter().enumerate() {
            right.swap(k, other);
        }
        for (i, row) in self.multipliers.chunks_exact(stride).enumerate().skip(1) {
            right[i] -= dot(row, right, 0, i);
        }
        // Where a row has nothing of meaning, before its diagonal, the solution is zero as yet.
        solution.fill(0.0);
        for (i, row) in self.matrix.chunks_exact(stride).enumerate().rev() {
            solution[i] = (right[i] - dot(row, solution, i, n)) * self.inverse_pivot[i];
        }
        x.copy_from_slice(&solution[..n]);
    }

    /// Solves `A X = B` in place; rows are `stride` long, whole blocks.
    pub(crate) fn solve_rows(&mut self, x: &mut [f64], stride: usize) {
        let (n, width) = (self.order, self.stride);
        for (k, &other) in self.exchanged.iter().enumerate().filter(|(k, other)| *k != **other) {
            let (above, below) = x.split_at_mut(other * stride);
            above[k * stride..][..stride].swap_with_slice(&mut below[..stride]);
        }
        for i in 1..n {
            let (above, target) = x.split_at_mut(i * stride);
            self.terms.clear();
            self.terms.extend(self.multipliers[i * width..][..i].iter().map(|l| -l).zip(0..));
            add_rows(&mut target[..stride], above, stride, &self.terms);
        }
        for i in (0..n).rev() {
            let (target, below) = x[i * stride..].split_at_mut(stride);
            self.terms.clear();
            self.terms.extend(self.matrix[i * width..][..n][i + 1..].iter().map(|u| -u).zip(0..));
            add_rows(target, below, stride, &self.terms);
            target.iter_mut().for_each(|entry| *entry *= self.inverse_pivot[i]);
        }
    }

    /// Solves `Aᵀ x = b` in place.
    pub(crate) fn solve_transposed(&self, x: &mut [f64]) {
        let (n, stride) = (self.order, self.stride);
        for i in 0..n {
            x[i] *= self.inverse_pivot[i];
            let (solved, rest) = x.split_at_mut(i + 1);
            let row = &self.matrix[i * stride..][..n][i + 1..];
            rest.iter_mut().zip(row).for_each(|(x, u)| *x -= u * solved[i]);
        }
        for i in (1..n).rev() {
            let (rest, solved) = x.split_at_mut(i);
            let row = &self.multipliers[i * stride..][..i];
            rest.iter_mut().zip(row).for_each(|(x, l)| *x -= l * solved[0]);
        }
        for (k, &other) in self.exchanged.iter().enumerate().rev() {
            x.swap(k, other);
        }
    }

    /// Takes over the factorization of another matrix of the same order.
    pub(crate) fn take_factors_of(&mut self, other: &Self) {
        self.matrix.copy_from_slice(&other.matrix);
        self.multipliers.copy_from_slice(&other.multipliers);
        self.exchanged.copy_from_slice(&other.exchanged);
        self.inverse_pivot.copy_from_slice(&other.inverse_pivot);
    }
}

/// The dot product of the blocks that hold the entries from one on, to the one before another.
#[inline(always)]
fn dot(row: &[f64], x: &[f64], first: usize, end: usize) -> f64 {
    let blocks = first / Lanes::COUNT..end.div_ceil(Lanes::COUNT);
    let (row, x) = (&row.as_chunks().0[blocks.clone()], &x.as_chunks().0[blocks]);
    let mut sums = Lanes::ZERO;
    for (entries, x) in row.iter().zip(x) {
        sums += Lanes(*entries) * Lanes(*x);
    }
    let [a, b, c, d] = sums.0;
    (a + c) + (b + d)
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
            let mut lu = DenseLu::new(order, order % 3);
            for (i, row) in lu.matrix.chunks_exact_mut(lu.stride).enumerate() {
                row[..order].iter_mut().zip(&matrix.row(i)).for_each(|(to, from)| *to = *from);
            }
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
        let mut singular = DenseLu::new(2, 2);
        let stride = singular.stride;
        (singular.matrix[0], singular.matrix[1]) = (1.0, 2.0);
        (singular.matrix[stride], singular.matrix[stride + 1]) = (2.0, 4.0);
        assert!(!singular.factor());
    }
}
