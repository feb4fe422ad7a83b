//! Inverses of dense matrices by Gauss and Jordan, with partial pivoting, for the stages of collocation.
//!
//! A factorization takes a third of the operations; but in its solves each unknown waits for the one before,
//! while products with the inverse wait for nothing, and there are several for each matrix.

use crate::rows::{LANES, Term, add_rows};
use crate::scalar::{Lanes, LanesOf, Scalar};
use crate::simd::{wide, widest};

/// A square matrix, row-major, then the inverse of it with its rows exchanged.
#[derive(Clone, Debug)]
pub struct DenseInverse {
    /// Rows are `stride` long; what is beyond the order must be finite, and counts for nothing.
    pub matrix: Vec<f64>,
    /// Numbers from one row to the next.
    pub stride: usize,
    order: usize,
    /// With which row each was exchanged.
    exchanged: Vec<usize>,
    /// A right-hand side, padded with zeros, and several.
    work: Vec<f64>,
    right: Vec<f64>,
    terms: Vec<Term>,
}

impl DenseInverse {
    /// A matrix whose rows have room for some more columns, which do not count.
    pub fn new(order: usize, room: usize) -> Self {
        let stride = (order + room).max(1).next_multiple_of(LANES);
        Self {
            matrix: vec![0.0; order * stride],
            stride,
            order,
            exchanged: vec![0; order],
            work: vec![0.0; stride],
            right: Vec::new(),
            terms: Vec::with_capacity(order),
        }
    }

    /// Makes room for right-hand sides of so many columns.
    pub fn reserve(&mut self, columns: usize) {
        self.right.reserve(self.order * columns);
    }

    /// Inverts what stands in `matrix`, in its place, about `2n³` flops; false if it is singular.
    #[inline(never)]
    pub fn invert(&mut self) -> bool {
        widest!({
            let (n, stride) = (self.order, self.stride);
            for k in 0..n {
                let (mut pivot, mut size) = (k, 0.0);
                for (i, row) in self.matrix.chunks_exact(stride).enumerate().skip(k) {
                    let entry = row[k].abs();
                    let is_larger = entry > size;
                    pivot = if is_larger { i } else { pivot };
                    size = if is_larger { entry } else { size };
                }
                let inverse = 1.0 / self.matrix[pivot * stride + k];
                if !inverse.is_finite() {
                    return false;
                }
                self.exchanged[k] = pivot;
                if pivot > k {
                    let (above, below) = self.matrix.split_at_mut(pivot * stride);
                    above[k * stride..][..stride].swap_with_slice(&mut below[..stride]);
                }
                let (above, rest) = self.matrix.split_at_mut(k * stride);
                let (row, below) = rest.split_at_mut(stride);
                row.iter_mut().for_each(|entry| *entry *= inverse);
                let others = above.chunks_exact_mut(stride).chain(below.chunks_exact_mut(stride));
                for target in others {
                    let factor = target[k];
                    for (target, entries) in
                        target.as_chunks_mut::<LANES>().0.iter_mut().zip(row.as_chunks::<LANES>().0)
                    {
                        let mut left = *target;
                        for (left, entry) in left.iter_mut().zip(entries) {
                            *left -= factor * entry;
                        }
                        *target = left;
                    }
                    target[k] = -factor * inverse;
                }
                row[k] = inverse;
            }
            true
        })
    }

    /// Solves `A x = b` in place.
    #[inline(never)]
    pub fn solve(&mut self, x: &mut [f64]) {
        wide!({
            let n = self.order;
            self.work[..n].copy_from_slice(x);
            for (k, &other) in self.exchanged.iter().enumerate() {
                self.work.swap(k, other);
            }
            for (x, row) in x.iter_mut().zip(self.matrix.chunks_exact(self.stride)) {
                let mut sums = Lanes::ZERO;
                for (entries, b) in row.as_chunks().0.iter().zip(self.work.as_chunks().0) {
                    sums += LanesOf(*entries) * LanesOf(*b);
                }
                let [a, b, c, d] = sums.0;
                *x = (a + c) + (b + d);
            }
        })
    }

    /// Solves `A X = B` in place; rows are `stride` long, whole blocks. Allocates when there are more
    /// columns than ever before.
    pub fn solve_rows(&mut self, x: &mut [f64], stride: usize) {
        let (n, width) = (self.order, self.stride);
        for (k, &other) in self.exchanged.iter().enumerate().filter(|(k, other)| *k != **other) {
            let (above, below) = x.split_at_mut(other * stride);
            above[k * stride..][..stride].swap_with_slice(&mut below[..stride]);
        }
        self.right.clear();
        self.right.extend_from_slice(&x[..n * stride]);
        for (target, row) in x.chunks_exact_mut(stride).zip(self.matrix.chunks_exact(width)) {
            self.terms.clear();
            self.terms.extend(row[..n].iter().copied().zip(0..));
            target.fill(0.0);
            add_rows(target, &self.right, stride, &self.terms);
        }
    }

    /// Solves `Aᵀ x = b` in place (allocates).
    pub fn solve_transposed(&self, x: &mut [f64]) {
        let terms: Vec<Term> = x.iter().copied().zip(0..).collect();
        let mut sums = vec![0.0; self.stride];
        add_rows(&mut sums, &self.matrix, self.stride, &terms);
        x.copy_from_slice(&sums[..self.order]);
        for (k, &other) in self.exchanged.iter().enumerate().rev() {
            x.swap(k, other);
        }
    }

    /// Takes over the inverse of another matrix of the same order.
    pub fn take_inverse_of(&mut self, other: &Self) {
        self.matrix.copy_from_slice(&other.matrix);
        self.exchanged.copy_from_slice(&other.exchanged);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::simd::narrowly;

    #[test]
    fn solutions_are_those_of_a_known_library() {
        for order in [1, 2, 5, 24] {
            let entry = |i: usize, j: usize| ((1 + 3 * i + 7 * j * j + i * j) as f64 * 0.7).sin();
            let matrix = DMatrix::from_fn(order, order, entry);
            let mut inverse = DenseInverse::new(order, order % 3);
            for (i, row) in inverse.matrix.chunks_exact_mut(inverse.stride).enumerate() {
                row[..order].iter_mut().zip(&matrix.row(i)).for_each(|(to, from)| *to = *from);
            }
            let mut narrow = inverse.clone();
            assert!(inverse.invert() && narrowly(|| narrow.invert()));
            assert_eq!(inverse.matrix, narrow.matrix, "the same bits in any register");
            let right = DVector::from_fn(order, |i, _| 1.0 + i as f64);
            let expected = matrix.clone().lu().solve(&right).unwrap();
            let mut x = right.as_slice().to_vec();
            inverse.solve(&mut x);
            let mut rows: Vec<f64> = right.iter().flat_map(|b| [*b; 8]).collect();
            inverse.solve_rows(&mut rows, 8);
            let size = expected.amax();
            for (i, expected) in expected.iter().enumerate() {
                assert!((x[i] - expected).abs() < 1e-11 * size, "{order}");
                assert!((rows[8 * i + 7] - expected).abs() < 1e-11 * size, "{order}");
            }
            let expected = matrix.transpose().lu().solve(&right).unwrap();
            let mut x = right.as_slice().to_vec();
            inverse.solve_transposed(&mut x);
            let errors = x.iter().zip(expected.iter()).map(|(x, e)| (x - e).abs());
            assert!(errors.fold(0.0, f64::max) < 1e-11 * expected.amax(), "{order}");
        }
        let mut singular = DenseInverse::new(2, 2);
        let stride = singular.stride;
        (singular.matrix[0], singular.matrix[1]) = (1.0, 2.0);
        (singular.matrix[stride], singular.matrix[stride + 1]) = (2.0, 4.0);
        assert!(!singular.invert());
    }
}
