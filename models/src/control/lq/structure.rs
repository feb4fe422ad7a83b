//! Where the map of a step has entries: products run over these alone.

use nalgebra::DMatrix;

use super::{FEW, LANES};

/// Where `M = [B A]` has entries.
#[derive(Clone, Debug, Default)]
pub(super) struct Structure {
    /// Entries in each row of `M`.
    pub(super) counts: Vec<f64>,
    /// States whose column of `A` or row of `S` is not zero, ascending.
    pub(super) active: Vec<usize>,
    /// Rows of `M` that are not of few entries, ascending.
    pub(super) full: Vec<usize>,
    /// Rows of `P` up to here have entries in the columns of full rows of `M`.
    pub(super) reach: usize,
    /// Of rows of few entries: row of `M`, column of `M` (inputs first, then active states), entry.
    pub(super) entries: Vec<(usize, usize, f64)>,
    /// Inputs and rows of the map that they come from.
    pub(super) inputs: usize,
    pub(super) rows: usize,
    /// Where the columns of `P` and of `Mᵀ` begin that belong to full rows of `M`, and of the cross
    /// term.
    pub(super) value_columns: Vec<usize>,
    pub(super) map_columns: Vec<usize>,
    pub(super) cross_columns: Vec<usize>,
}

impl Structure {
    #[inline(always)]
    pub(super) fn find(
        &mut self,
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        s: Option<&DMatrix<f64>>,
        value: &DMatrix<f64>,
        value_stride: usize,
    ) {
        let ((next, n), m) = (a.shape(), b.ncols());
        let column = |col: usize| next * col..next * (col + 1);
        self.counts.clear();
        self.counts.resize(next, 0.0);
        count(&mut self.counts, b.as_slice());
        count(&mut self.counts, a.as_slice());
        let is_active = |state: &usize| {
            !is_zero(&a.as_slice()[column(*state)])
                || s.is_some_and(|s| (0..m).any(|j| s[(*state, j)] != 0.0))
        };
        let is_same = (0..n).filter(is_active).eq(self.active.iter().copied());
        if !is_same {
            self.active.clear();
            self.active.extend((0..n).filter(is_active));
        }
        // Where there is little to spare, all rows are as good as full.
        let few = if n + m > 4 * FEW { FEW as f64 } else { -1.0 };
        self.full.clear();
        self.full.extend((0..next).filter(|&row| self.counts[row] > few));
        let full = &self.full;
        let reaches = |row: usize| {
            let column = &value.as_slice()[column(row)];
            full.iter().any(|&full| column[full] != 0.0)
        };
        let last_full = full.last().map_or(0, |row| row + 1);
        self.reach =
            (last_full..next).rev().find(|&row| reaches(row)).map_or(last_full, |row| row + 1);
        if !(is_same && self.renew_entries(a, b, few)) {
            self.find_entries(a, b, few);
        }
        let stride = (m + self.active.len()).next_multiple_of(LANES);
        for (starts, count, stride) in
            [(&mut self.map_columns, self.full.len(), stride), (&mut self.cross_columns, m, stride)]
        {
            starts.clear();
            starts.extend((0..count).map(|k| stride * k));
        }
        self.value_columns.clear();
        self.value_columns.extend(self.full.iter().map(|row| value_stride * row));
    }

    /// The entry of `M` in a column of the active ones.
    #[inline(always)]
    fn entry(&self, a: &DMatrix<f64>, b: &DMatrix<f64>, row: usize, col: usize) -> f64 {
        let (next, m) = b.shape();
        if col < m {
            b.as_slice()[next * col + row]
        } else {
            a.as_slice()[next * self.active[col - m] + row]
        }
    }

    /// Reads entries where the last map had them; whether these are all.
    #[inline(always)]
    fn renew_entries(&mut self, a: &DMatrix<f64>, b: &DMatrix<f64>, few: f64) -> bool {
        let (next, m) = b.shape();
        if self.inputs != m || self.rows != next {
            return false;
        }
        let mut entries = std::mem::take(&mut self.entries);
        for (row, col, entry) in &mut entries {
            *entry = self.entry(a, b, *row, *col);
        }
        // As many entries as the rows have, none of them zero, are all of them.
        let present =
            entries.iter().filter(|&&(row, _, entry)| entry != 0.0 && self.counts[row] <= few);
        let present = present.count();
        let expected: f64 = self.counts.iter().filter(|&&count| count <= few).sum();
        let is_whole = present == entries.len() && present as f64 == expected;
        self.entries = entries;
        is_whole
    }

    fn find_entries(&mut self, a: &DMatrix<f64>, b: &DMatrix<f64>, few: f64) {
        let (next, m) = b.shape();
        (self.inputs, self.rows) = (m, next);
        let mut entries = std::mem::take(&mut self.entries);
        entries.clear();
        for row in (0..next).filter(|&row| self.counts[row] <= few) {
            let present = (0..m + self.active.len())
                .map(|col| (row, col, self.entry(a, b, row, col)))
                .filter(|&(_, _, entry)| entry != 0.0);
            entries.extend(present.take(self.counts[row] as usize));
        }
        self.entries = entries;
    }
}

/// Adds the numbers of entries in the rows of a matrix of columns.
#[inline(always)]
fn count(counts: &mut [f64], columns: &[f64]) {
    const ROWS: usize = 16;
    let rows = counts.len();
    let (blocks, rest) = counts.as_chunks_mut::<ROWS>();
    let start_of_rest = ROWS * blocks.len();
    for (k, block) in blocks.iter_mut().enumerate() {
        let mut sums = *block;
        for column in columns.chunks_exact(rows) {
            let entries: &[f64] = &column[ROWS * k..][..ROWS];
            for (sum, &entry) in sums.iter_mut().zip(entries) {
                *sum += if entry == 0.0 { 0.0 } else { 1.0 };
            }
        }
        *block = sums;
    }
    if !rest.is_empty() {
        for column in columns.chunks_exact(rows) {
            for (sum, &entry) in rest.iter_mut().zip(&column[start_of_rest..]) {
                *sum += if entry == 0.0 { 0.0 } else { 1.0 };
            }
        }
    }
}

#[inline(always)]
fn is_zero(column: &[f64]) -> bool {
    let (blocks, rest) = column.as_chunks::<LANES>();
    let is_zero = |entries: &[f64]| entries.iter().fold(true, |zero, &entry| zero & (entry == 0.0));
    blocks.iter().all(|block| is_zero(block)) && is_zero(rest)
}
