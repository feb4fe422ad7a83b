//! LU factorization without pivoting along the elimination tree: the non-symmetric twin of
//! Featherstone's LTL, without fill-in. O(n·depth²) to factor, O(n·depth) to solve.

use crate::elimination::Elimination;
use crate::plant::rows::add_rows;

/// A matrix that couples each row only with its ancestors, and its factorization in place.
#[derive(Clone, Debug)]
pub(crate) struct TreeLu {
    /// `upper[slot] = K[ancestor, row]`.
    pub(crate) upper: Vec<f64>,
    /// `lower[slot] = K[row, ancestor]`.
    pub(crate) lower: Vec<f64>,
    inverse_pivot: Vec<f64>,
}

/// The smallest pivot of a factorization.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SmallestPivot {
    pub(crate) row: usize,
    /// Relative to the largest entry of the matrix.
    pub(crate) relative: f64,
}

impl TreeLu {
    pub(crate) fn new(elimination: &Elimination) -> Self {
        Self {
            upper: vec![0.0; elimination.entries()],
            lower: vec![0.0; elimination.entries()],
            inverse_pivot: vec![0.0; elimination.len()],
        }
    }

    /// Sets all entries to zero; needed before filling where not every slot is written.
    pub(crate) fn clear(&mut self) {
        self.upper.fill(0.0);
        self.lower.fill(0.0);
    }

    /// Adds to a diagonal entry, which only the upper triangle holds for the factorization.
    pub(crate) fn add_to_diagonal(&mut self, slot: usize, value: f64) {
        self.upper[slot] += value;
    }

    /// Adds to both entries of a pair.
    pub(crate) fn add_symmetric(&mut self, slot: usize, value: f64) {
        self.upper[slot] += value;
        self.lower[slot] += value;
    }

    /// Factors in place, from the last row to the first.
    #[inline(never)]
    pub(crate) fn factor(&mut self, elimination: &Elimination) -> SmallestPivot {
        let largest = self
            .upper
            .iter()
            .chain(&self.lower)
            .fold(f64::MIN_POSITIVE, |largest, entry| largest.max(entry.abs()));
        let mut smallest = SmallestPivot { row: 0, relative: f64::INFINITY };
        for k in (0..elimination.len()).rev() {
            let start = elimination.offsets[k];
            let ancestors = &elimination.ancestors[start..elimination.offsets[k + 1] - 1];
            let depth = ancestors.len();
            let (upper_above, upper_row) = self.upper.split_at_mut(start);
            let (lower_above, lower_row) = self.lower.split_at_mut(start);
            let pivot = upper_row[depth];
            let relative = pivot.abs() / largest;
            // Written so that a NaN counts as the smallest.
            if !(relative >= smallest.relative) {
                smallest = SmallestPivot { row: k, relative };
            }
            let inverse = 1.0 / pivot;
            self.inverse_pivot[k] = inverse;
            for entry in &mut upper_row[..depth] {
                *entry *= inverse;
            }
            for (d, &ancestor) in ancestors.iter().enumerate().rev() {
                let target = elimination.offsets[ancestor];
                let (l, u) = (lower_row[d], upper_row[d]);
                let upper_target = &mut upper_above[target..=target + d];
                for (t, s) in upper_target.iter_mut().zip(&upper_row[..=d]) {
                    *t -= l * s;
                }
                let lower_target = &mut lower_above[target..target + d];
                for (t, s) in lower_target.iter_mut().zip(&lower_row[..d]) {
                    *t -= u * s;
                }
            }
        }
        smallest
    }

    /// Solves `K x = b` in place.
    #[inline(never)]
    pub(crate) fn solve(&self, elimination: &Elimination, x: &mut [f64]) {
        for k in (0..elimination.len()).rev() {
            let range = elimination.offsets[k]..elimination.offsets[k + 1] - 1;
            let value = x[k];
            for (&ancestor, u) in
                elimination.ancestors[range.clone()].iter().zip(&self.upper[range])
            {
                x[ancestor] -= u * value;
            }
        }
        for k in 0..elimination.len() {
            let range = elimination.offsets[k]..elimination.offsets[k + 1] - 1;
            let mut value = x[k];
            for (&ancestor, l) in
                elimination.ancestors[range.clone()].iter().zip(&self.lower[range])
            {
                value -= l * x[ancestor];
            }
            x[k] = value * self.inverse_pivot[k];
        }
    }

    /// Solves `K X = B` in place for the first columns of a row-major matrix; `columns` and `stride`
    /// are whole blocks.
    #[inline(never)]
    pub(crate) fn solve_rows(
        &self,
        elimination: &Elimination,
        x: &mut [f64],
        stride: usize,
        columns: usize,
    ) {
        for i in (0..elimination.len()).rev() {
            let (row, below) = x[i * stride..].split_at_mut(stride);
            let terms = elimination.below(i).iter();
            let terms = terms.map(|&(j, slot)| (-self.upper[slot], j - i - 1));
            add_rows(&mut row[..columns], below, stride, terms);
        }
        for i in 0..elimination.len() {
            let range = elimination.offsets[i]..elimination.offsets[i + 1] - 1;
            let (above, row) = x.split_at_mut(i * stride);
            let row = &mut row[..columns];
            let ancestors = elimination.ancestors[range.clone()].iter();
            let terms = ancestors.zip(&self.lower[range]).map(|(&j, l)| (-l, j));
            add_rows(row, above, stride, terms);
            for entry in row {
                *entry *= self.inverse_pivot[i];
            }
        }
    }
}
