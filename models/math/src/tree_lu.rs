//! LU factorization without pivoting along the elimination tree: the non-symmetric twin of
//! Featherstone's LTL, without fill-in. O(n·depth²) to factor, O(n·depth) to solve.

use crate::elimination::{SymbolicElimination, TOGETHER};
use crate::rows::{LANES, Term, add_rows_portable, padded};
use crate::scalar::{Beside, Compared, LanesOf, Scalar, Wide};
use crate::simd::widest;

/// A matrix that couples each row only with its ancestors, and its factorization in place.
#[derive(Clone, Debug, Default)]
pub struct TreeLu<S = f64> {
    /// `upper[slot] = K[ancestor, row]`.
    pub upper: Vec<S>,
    /// `lower[slot] = K[row, ancestor]`.
    pub lower: Vec<S>,
    inverse_pivot: Vec<S>,
    /// What each pivot is compared with.
    reference: Vec<S>,
    terms: Vec<Term>,
}

/// The smallest pivot of a factorization.
#[derive(Clone, Copy, Debug)]
pub struct SmallestPivot<S = f64> {
    /// Where it stands; of matrices side by side, where that of one of them does.
    pub row: usize,
    /// Relative to its reference, at most 1.
    pub relative: S,
}

impl<S: Compared> SmallestPivot<S> {
    /// Before any.
    pub const NONE: Self = Self { row: 0, relative: S::ONE };

    /// Compares a pivot with its reference. A NaN counts as zero.
    #[inline(always)]
    pub fn see(&mut self, row: usize, pivot: S, reference: S) {
        let relative = (pivot.abs() / reference).max(S::ZERO);
        let is_smaller = relative.less(self.relative);
        if S::any(is_smaller) {
            self.row = row;
            self.relative = S::choose(is_smaller, relative, self.relative);
        }
    }
}

/// What [`TreeLu::factor`] does.
struct Factor<'a, S: Scalar> {
    matrix: &'a mut TreeLu<S>,
    elimination: &'a SymbolicElimination,
    /// One of each row.
    scale: &'a [f64],
    factor: f64,
}

impl<S: Compared> Beside<S> for Factor<'_, S> {
    type Output = SmallestPivot<S>;

    #[inline(always)]
    fn run<W: Wide<S>>(self) -> SmallestPivot<S> {
        let Self { matrix, elimination, scale, factor } = self;
        let rows = scale.len();
        let TreeLu { upper, lower, inverse_pivot, reference, .. } = matrix;
        let [starts, diagonals] = elimination.places(rows);
        let (inverse_pivot, reference) = (&mut inverse_pivot[..rows], &mut reference[..rows]);
        for ((reference, diagonal), scale) in reference.iter_mut().zip(diagonals).zip(scale) {
            *reference = upper[*diagonal].abs().max(S::constant(scale * factor));
        }
        // What is beyond the diagonal of a row is subtracted from with it, where that is one operation.
        let width = |entries: usize| match W::TAKES_FOURS {
            true => entries.next_multiple_of(TOGETHER),
            false => entries,
        };
        let mut smallest = SmallestPivot::NONE;
        for k in (0..rows).rev() {
            let start = starts[k];
            let ancestors = elimination.ancestors(start..diagonals[k]);
            let depth = ancestors.len();
            let (upper_above, upper_row) = upper.split_at_mut(start);
            let (lower_above, lower_row) = lower.split_at_mut(start);
            let pivot = upper_row[depth];
            smallest.see(k, pivot, reference[k]);
            let inverse = pivot.recip();
            inverse_pivot[k] = inverse;
            for entry in &mut upper_row[..depth] {
                *entry = *entry * inverse;
            }
            for (d, &ancestor) in ancestors.iter().enumerate().rev() {
                let (l, u) = (lower_row[d], upper_row[d]);
                let start = starts[ancestor];
                let (upper_above, lower_above) =
                    (&mut upper_above[start..], &mut lower_above[start..]);
                let own = width(d + 1);
                let above = if W::TAKES_FOURS { own } else { d };
                W::subtract(
                    [l, u],
                    [&upper_row[..own], &lower_row[..above]],
                    [&mut upper_above[..own], &mut lower_above[..above]],
                );
            }
        }
        smallest
    }
}

impl<S: Compared> TreeLu<S> {
    /// Of a matrix with that elimination tree; all entries are zero.
    pub fn new(elimination: &SymbolicElimination) -> Self {
        Self {
            upper: vec![S::ZERO; elimination.slots()],
            lower: vec![S::ZERO; elimination.slots()],
            inverse_pivot: vec![S::ZERO; elimination.rows()],
            reference: vec![S::ZERO; elimination.rows()],
            terms: Vec::with_capacity(elimination.rows()),
        }
    }

    /// Makes room for a matrix that had none.
    pub fn make_room(&mut self, elimination: &SymbolicElimination) {
        if self.upper.len() != elimination.slots() {
            *self = Self::new(elimination);
        }
    }

    /// Sets all entries to zero; needed before filling where not every slot is written.
    pub fn clear(&mut self) {
        self.upper.fill(S::ZERO);
        self.lower.fill(S::ZERO);
    }

    /// Adds to a diagonal entry, which only the upper triangle holds for the factorization.
    pub fn add_to_diagonal(&mut self, slot: usize, value: S) {
        self.upper[slot] += value;
    }

    /// Adds to the entry of two coupled rows, which may be one.
    #[inline]
    pub fn add(&mut self, elimination: &SymbolicElimination, row: usize, column: usize, value: S) {
        let slot = elimination.slot(row.max(column), row.min(column));
        let slot = slot.expect("what a model adds to its matrix is coupled");
        let triangle = if row <= column { &mut self.upper } else { &mut self.lower };
        triangle[slot] += value;
    }

    /// Factors in place, from the last row to the first. Each pivot is compared with the larger of
    /// its diagonal entry and `scale · factor` of its row.
    #[inline(never)]
    pub fn factor(
        &mut self,
        elimination: &SymbolicElimination,
        scale: &[f64],
        factor: f64,
    ) -> SmallestPivot<S> {
        S::beside(scale.len(), Factor { matrix: self, elimination, scale, factor })
    }

    /// [`Self::factor`] number by number, in the code of the caller, which may know how many rows there are.
    #[inline(always)]
    pub fn factor_few(
        &mut self,
        elimination: &SymbolicElimination,
        scale: &[f64],
        factor: f64,
    ) -> SmallestPivot<S> {
        S::alone(Factor { matrix: self, elimination, scale, factor })
    }

    /// Solves `K x = b` in place.
    #[inline(never)]
    pub fn solve(&self, elimination: &SymbolicElimination, x: &mut [S]) {
        self.substitute(elimination, x);
    }

    /// [`Self::solve`] in the registers of the caller.
    #[inline(always)]
    pub fn substitute(&self, elimination: &SymbolicElimination, x: &mut [S]) {
        let rows = x.len();
        let ([starts, diagonals], inverse_pivot) =
            (elimination.places(rows), &self.inverse_pivot[..rows]);
        let rows = starts.iter().zip(diagonals).map(|(start, end)| *start..*end).enumerate();
        for (k, row) in rows.clone().rev() {
            let value = x[k];
            for (&ancestor, u) in elimination.ancestors(row.clone()).iter().zip(&self.upper[row]) {
                x[ancestor] -= *u * value;
            }
        }
        for (k, row) in rows {
            let mut value = x[k];
            for (&ancestor, l) in elimination.ancestors(row.clone()).iter().zip(&self.lower[row]) {
                value -= *l * x[ancestor];
            }
            x[k] = value * inverse_pivot[k];
        }
    }
}

impl<S: Compared> TreeLu<S> {
    /// Takes the factors of others where that is said.
    #[inline(always)]
    pub fn take_where(&mut self, truth: S::Truth, others: &Self) {
        let lists = [
            (&mut self.upper, &others.upper),
            (&mut self.lower, &others.lower),
            (&mut self.inverse_pivot, &others.inverse_pivot),
        ];
        for (own, others) in lists {
            for (own, other) in own.iter_mut().zip(others) {
                *own = S::choose(truth, *other, *own);
            }
        }
    }
}

impl<const N: usize> TreeLu<LanesOf<N>> {
    /// Takes the factors of one matrix into a lane.
    pub fn take_lane(&mut self, lane: usize, other: &TreeLu) {
        let lists = [
            (&mut self.upper, &other.upper),
            (&mut self.lower, &other.lower),
            (&mut self.inverse_pivot, &other.inverse_pivot),
        ];
        for (own, other) in lists {
            own.iter_mut().zip(other).for_each(|(own, other)| own.0[lane] = *other);
        }
    }
}

impl TreeLu {
    /// Solves `K X = B` in place for the first columns of a row-major matrix; `columns` and `stride`
    /// are whole blocks.
    pub fn solve_rows(
        &mut self,
        elimination: &SymbolicElimination,
        x: &mut [f64],
        stride: usize,
        columns: usize,
    ) {
        self.solve_units(elimination, x, stride, columns, columns);
    }

    /// [`Self::solve_rows`] where the columns from `units` on begin with the identity, of which rows below
    /// another have nothing but in their own columns; without them, `units` is at least `columns`.
    #[inline(never)]
    pub fn solve_units(
        &mut self,
        elimination: &SymbolicElimination,
        x: &mut [f64],
        stride: usize,
        columns: usize,
        units: usize,
    ) {
        widest!({
            let first = padded(units).min(columns);
            let rest = ((units + elimination.rows()) / LANES * LANES).clamp(first, columns);
            for i in (0..elimination.rows()).rev() {
                let (row, below) = x[i * stride..].split_at_mut(stride);
                let terms = elimination.below(i);
                let Some(&(last, _)) = terms.last() else { continue };
                self.terms.clear();
                self.terms.extend(terms.iter().map(|&(j, slot)| (-self.upper[slot], j - i - 1)));
                add_rows_portable(&mut row[..first], below, stride, &self.terms);
                let own = (units + i) / LANES * LANES;
                let own = own.clamp(first, rest)..padded(units + last + 1).clamp(first, rest);
                let source = &below[own.start..];
                add_rows_portable(&mut row[own], source, stride, &self.terms);
                add_rows_portable(&mut row[rest..columns], &below[rest..], stride, &self.terms);
            }
            for i in 0..elimination.rows() {
                let (above, row) = x.split_at_mut(i * stride);
                let row = &mut row[..columns];
                let ancestors = elimination.above(i).iter();
                let lower = &self.lower[elimination.row(i)];
                self.terms.clear();
                self.terms.extend(ancestors.zip(lower).map(|(&j, l)| (-l, j)));
                add_rows_portable(row, above, stride, &self.terms);
                let inverse = self.inverse_pivot[i];
                row.iter_mut().for_each(|entry| *entry *= inverse);
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// A forest with a coupling between two branches: rows 3 and 5 share no path without it.
    fn elimination() -> SymbolicElimination {
        let couplings = [&[][..], &[0], &[0, 1], &[0, 1, 2], &[0], &[0, 3, 4], &[], &[6]];
        SymbolicElimination::new(&couplings.map(|c| c.iter().copied().collect::<BTreeSet<_>>()))
    }

    /// A diagonally dominant matrix on the pattern, with the dense one that it stands for.
    fn matrix(elimination: &SymbolicElimination) -> (TreeLu, DMatrix<f64>) {
        let n = elimination.rows();
        let (mut lu, mut dense) = (TreeLu::new(elimination), DMatrix::zeros(n, n));
        for row in 0..n {
            for (slot, ancestor) in elimination.entries_of(row) {
                let (u, l) = ((slot as f64 * 0.7).sin(), (slot as f64 * 1.3).cos());
                let (u, l) = if ancestor == row { (6.0 + u, 6.0 + u) } else { (u, l) };
                (lu.upper[slot], lu.lower[slot]) = (u, l);
                (dense[(ancestor, row)], dense[(row, ancestor)]) = (u, l);
            }
        }
        (lu, dense)
    }

    #[test]
    fn a_solution_satisfies_the_dense_system() {
        let elimination = elimination();
        let (mut lu, dense) = matrix(&elimination);
        let b = DVector::from_fn(elimination.rows(), |i, _| (i as f64).cos());
        let mut x = b.as_slice().to_vec();
        assert!(lu.factor(&elimination, &[0.0; 8], 1.0).relative > 0.1);
        lu.solve(&elimination, &mut x);
        assert!((dense * DVector::from_vec(x) - b).amax() < 1e-14);
    }

    #[test]
    fn rows_are_solved_like_single_columns() {
        let elimination = elimination();
        let (mut lu, _) = matrix(&elimination);
        lu.factor(&elimination, &[0.0; 8], 1.0);
        let (n, stride) = (elimination.rows(), 24);
        let mut rows: Vec<f64> = (0..n * stride).map(|i| (i as f64).sin()).collect();
        for column in 0..stride {
            let mut single: Vec<f64> =
                (0..n).map(|i| ((i * stride + column) as f64).sin()).collect();
            lu.solve(&elimination, &mut single);
            let mut copy = rows.clone();
            lu.solve_rows(&elimination, &mut copy, stride, stride);
            for (i, value) in single.iter().enumerate() {
                assert!((copy[i * stride + column] - value).abs() < 1e-14);
            }
        }
        let untouched = rows[stride - 1];
        lu.solve_rows(&elimination, &mut rows, stride, 16);
        assert_eq!(rows[stride - 1], untouched, "columns beyond the given ones stay");
    }

    #[test]
    fn a_vanishing_pivot_is_named() {
        let elimination = elimination();
        let (mut lu, _) = matrix(&elimination);
        // Row 7 hangs from row 6 alone: make their block singular.
        let (diagonal, coupling) = (elimination.diagonal(7), elimination.row(7).start);
        let root = elimination.diagonal(6);
        (lu.upper[diagonal], lu.upper[coupling], lu.lower[coupling], lu.upper[root]) =
            (2.0, 2.0, 2.0, 2.0);
        let smallest = lu.factor(&elimination, &[0.0; 8], 1.0);
        assert_eq!((smallest.row, smallest.relative), (6, 0.0));
    }

    #[test]
    fn nan_is_the_smallest_pivot() {
        let elimination = elimination();
        let (mut lu, _) = matrix(&elimination);
        lu.upper[elimination.diagonal(4)] = f64::NAN;
        assert_eq!(lu.factor(&elimination, &[0.0; 8], 1.0).relative, 0.0);
    }
}
