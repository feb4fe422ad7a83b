//! Which entries of the Newton matrix are stored, and in which order they are eliminated.
//!
//! The Newton matrix of a tree couples a joint only with its ancestors, and elimination from the
//! leaves to the root creates no fill-in. A spring between two branches couples these branches: the
//! elimination tree then runs through both. A row stores all its ancestors in the elimination tree,
//! so one factorization serves every scene.

use std::collections::BTreeSet;
use std::ops::Range;

/// Each row takes a multiple of so many slots, for whole registers are computed with. Those beyond the diagonal mean
/// nothing.
pub(crate) const TOGETHER: usize = 4;

/// The elimination tree.
#[derive(Clone, Debug, Default)]
pub struct SymbolicElimination {
    /// Where each row begins, and where the last one ends.
    offsets: Vec<usize>,
    /// The slot of the diagonal of each row, with which it ends.
    diagonals: Vec<usize>,
    /// Ancestors of each row, root first, the row itself last, and again in the slots that mean nothing.
    ancestors: Vec<usize>,
    /// Row `i` owns `descendants[descendant_offsets[i]..descendant_offsets[i + 1]]`.
    descendant_offsets: Vec<usize>,
    /// Proper descendants of each row, and the slots of their entries with it.
    descendants: Vec<(usize, usize)>,
    /// Row `i` owns `coupled[coupled_offsets[i]..coupled_offsets[i + 1]]`.
    coupled_offsets: Vec<usize>,
    /// Ancestors of each row, the row itself, and its descendants.
    coupled: Vec<usize>,
}

impl SymbolicElimination {
    /// Symbolic elimination of the pattern `couplings[j]` (indices below `j`), from the last row to
    /// the first.
    pub fn new(couplings: &[BTreeSet<usize>]) -> Self {
        let n = couplings.len();
        let mut rows = couplings.to_vec();
        let mut parent = vec![None; n];
        for j in (0..n).rev() {
            parent[j] = rows[j].last().copied();
            if let Some(p) = parent[j] {
                let passed_up: Vec<usize> = rows[j].range(..p).copied().collect();
                rows[p].extend(passed_up);
            }
        }
        let mut elimination = Self { offsets: vec![0], ..Self::default() };
        for j in 0..n {
            let mut path = vec![j];
            while let Some(p) = parent[path[path.len() - 1]] {
                path.push(p);
            }
            path.reverse();
            let end = elimination.ancestors.len() + path.len();
            elimination.diagonals.push(end - 1);
            elimination.ancestors.extend(path);
            elimination.ancestors.resize(end.next_multiple_of(TOGETHER), j);
            elimination.offsets.push(elimination.ancestors.len());
        }
        elimination.descendant_offsets = vec![0];
        elimination.coupled_offsets = vec![0];
        for i in 0..n {
            let below = (i + 1..n).filter_map(|j| elimination.slot(j, i).map(|slot| (j, slot)));
            let below: Vec<_> = below.collect();
            elimination.descendants.extend(below);
            elimination.descendant_offsets.push(elimination.descendants.len());
            let above = elimination.row(i);
            elimination.coupled.extend_from_slice(&elimination.ancestors[above]);
            let below = elimination.descendant_offsets[i];
            let below = elimination.descendants[below..].iter().map(|(j, _)| *j);
            elimination.coupled.extend(below);
            elimination.coupled_offsets.push(elimination.coupled.len());
        }
        elimination
    }

    /// Proper descendants of a row, and the slots of their entries with it.
    pub fn below(&self, row: usize) -> &[(usize, usize)] {
        &self.descendants[self.descendant_offsets[row]..self.descendant_offsets[row + 1]]
    }

    /// Ancestors of a row, the row itself, and its descendants, in this order.
    pub fn coupled(&self, row: usize) -> &[usize] {
        &self.coupled[self.coupled_offsets[row]..self.coupled_offsets[row + 1]]
    }

    /// Rows.
    pub fn rows(&self) -> usize {
        self.diagonals.len()
    }

    /// The slots of a row, the last of which is that of the diagonal.
    #[inline(always)]
    pub fn row(&self, row: usize) -> Range<usize> {
        self.offsets[row]..self.diagonals[row] + 1
    }

    /// The slot of a row's diagonal.
    #[inline(always)]
    pub fn diagonal(&self, row: usize) -> usize {
        self.diagonals[row]
    }

    /// Where so many of the first rows begin, and where their diagonals are.
    #[inline(always)]
    pub fn places(&self, rows: usize) -> [&[usize]; 2] {
        [&self.offsets[..rows], &self.diagonals[..rows]]
    }

    /// Where a row begins.
    #[inline(always)]
    pub fn start(&self, row: usize) -> usize {
        self.offsets[row]
    }

    /// Whose entries are in some slots.
    #[inline(always)]
    pub(crate) fn ancestors(&self, slots: Range<usize>) -> &[usize] {
        &self.ancestors[slots]
    }

    /// Proper ancestors of a row, root first.
    #[inline(always)]
    pub fn above(&self, row: usize) -> &[usize] {
        &self.ancestors[self.offsets[row]..self.diagonals[row]]
    }

    /// The slots of a row, and whose entries with it they are.
    pub fn entries_of(&self, row: usize) -> impl Iterator<Item = (usize, usize)> {
        let slots = self.row(row);
        slots.clone().zip(self.ancestors[slots].iter().copied())
    }

    /// Slots of one triangle.
    pub fn slots(&self) -> usize {
        self.ancestors.len()
    }

    /// How many entries each row has, its diagonal included.
    pub fn lengths(&self) -> impl Iterator<Item = usize> {
        (0..self.rows()).map(|row| self.row(row).len())
    }

    /// Entries of one triangle, diagonal included.
    pub fn entries(&self) -> usize {
        self.lengths().sum()
    }

    /// Independent blocks.
    pub fn islands(&self) -> usize {
        self.lengths().filter(|length| *length == 1).count()
    }

    /// Place of the entry of `descendant` with `ancestor`.
    pub fn slot(&self, descendant: usize, ancestor: usize) -> Option<usize> {
        let range = self.row(descendant);
        let start = range.start;
        self.ancestors[range].binary_search(&ancestor).ok().map(|k| start + k)
    }
}
