//! The map of a step without its zeros.

use nalgebra::DMatrix;

use crate::gemm::{LANES, Scratch};
use crate::rows::{Term, add_rows_portable};

/// Entries up to which a row of the map is added entry by entry.
const FEW: usize = 4;

/// `M = [B A]`: its full rows, in the columns of inputs and of active states, and the entries of the
/// others.
#[derive(Debug, Default)]
pub struct Map {
    /// Rows.
    pub next: usize,
    /// Columns of `A`.
    pub states: usize,
    /// Columns of `B`.
    pub inputs: usize,
    /// States whose column of `A` is not zero, ascending.
    pub active: Vec<usize>,
    /// Rows of `M` that are not of few entries, ascending.
    pub full: Vec<usize>,
    /// Where they begin in the numbers.
    pub starts: Vec<usize>,
    /// Of the other rows: the entries, run after run.
    pub entries: Vec<f64>,
    /// Of the other rows: runs along diagonals.
    pub runs: Vec<Run>,
    /// Memory of products.
    pub numbers: Scratch,
}

/// Entries along a diagonal.
#[derive(Debug)]
pub struct Run {
    /// Where the first entry is: its row, its column among inputs and active states.
    row: usize,
    col: usize,
    length: usize,
}

impl Map {
    /// Takes `A` and `B`, and looks for their zeros.
    pub fn set(&mut self, a: &DMatrix<f64>, b: &DMatrix<f64>) {
        let ((next, n), m) = (a.shape(), b.ncols());
        let column = |state: usize| &a.as_slice()[next * state..][..next];
        // Where there is little to spare, everything is as good as full.
        let is_small = n + m <= 4 * FEW;
        let is_active = |state: &usize| is_small || column(*state).iter().any(|x| *x != 0.0);
        let mut counts = vec![0_usize; if is_small { 0 } else { next }];
        if !is_small {
            for column in [a, b].into_iter().flat_map(|m| m.as_slice().chunks_exact(next.max(1))) {
                for (count, entry) in counts.iter_mut().zip(column) {
                    *count += usize::from(*entry != 0.0);
                }
            }
        }
        let is_full = |row: usize| is_small || counts[row] > FEW;
        self.begin((next, n, m), (0..n).filter(is_active), (0..next).filter(|row| is_full(*row)));
        let Self { active, full, starts, numbers, .. } = self;
        let (numbers, width) = (numbers.numbers(), m + active.len());
        for (row, start) in full.iter().zip(starts) {
            let (inputs, states) = numbers[*start..][..width].split_at_mut(m);
            for (j, to) in inputs.iter_mut().enumerate() {
                *to = b.as_slice()[next * j + row];
            }
            for (to, state) in states.iter_mut().zip(&*active) {
                *to = a.as_slice()[next * state + row];
            }
        }
        let mut entries = Vec::new();
        for row in (0..next).filter(|row| !is_full(*row)) {
            let by_input = (0..m).map(|j| b[(row, j)]);
            let by_state = active.iter().map(|state| a[(row, *state)]);
            let all = by_input.chain(by_state).enumerate().map(|(col, x)| (row, col, x));
            entries.extend(all.filter(|(.., x)| *x != 0.0));
        }
        // Diagonal by diagonal.
        entries.sort_unstable_by_key(|&(row, col, _)| (next + col - row, row));
        entries.into_iter().for_each(|(row, col, entry)| self.push(row, col, entry));
    }

    /// Begins: rows, states and inputs; active states; full rows, of which all numbers are to be written.
    pub fn begin(
        &mut self,
        (next, states, inputs): (usize, usize, usize),
        active: impl Iterator<Item = usize>,
        full: impl Iterator<Item = usize>,
    ) {
        (self.next, self.states, self.inputs) = (next, states, inputs);
        self.entries.clear();
        self.runs.clear();
        self.active.clear();
        self.active.extend(active);
        self.full.clear();
        self.full.extend(full);
        let stride = self.stride();
        self.starts.clear();
        self.starts.extend((0..self.full.len()).map(|i| stride * i));
        self.numbers.reserve(stride * self.full.len());
        let width = self.width();
        for row in self.numbers.numbers().chunks_exact_mut(stride.max(1)).take(self.full.len()) {
            row[width..].fill(0.0);
        }
    }

    /// The full row at a place among the full ones: inputs, active states, padding.
    pub fn row_mut(&mut self, place: usize) -> &mut [f64] {
        let stride = self.stride();
        &mut self.numbers.numbers()[stride * place..][..stride]
    }

    /// Adds an entry of a row of few: row, column among inputs and active states. What lies along a
    /// diagonal is best added in its order.
    pub fn push(&mut self, row: usize, col: usize, entry: f64) {
        self.entries.push(entry);
        match self.runs.last_mut() {
            Some(run) if (run.row + run.length, run.col + run.length) == (row, col) => {
                run.length += 1;
            }
            _ => self.runs.push(Run { row, col, length: 1 }),
        }
    }

    /// The entries of rows of few, along diagonals: first row, first column, entries.
    pub fn runs(&self) -> impl Iterator<Item = (usize, usize, &[f64])> {
        let mut rest = &self.entries[..];
        self.runs.iter().map(move |run| {
            let (entries, others) = rest.split_at(run.length);
            rest = others;
            (run.row, run.col, entries)
        })
    }

    /// The entries of rows of few, one by one: row, column, entry.
    pub fn entries(&self) -> impl Iterator<Item = (usize, usize, f64)> {
        self.runs().flat_map(|(row, col, entries)| {
            entries.iter().enumerate().map(move |(i, entry)| (row + i, col + i, *entry))
        })
    }

    /// This map with every state active.
    pub fn with_all_states(&self) -> Self {
        let mut all = Self::default();
        let sizes = (self.next, self.states, self.inputs);
        all.begin(sizes, 0..self.states, self.full.iter().copied());
        let m = self.inputs;
        for (place, start) in self.starts.iter().enumerate() {
            let row = &self.numbers()[*start..][..self.width()];
            let target = all.row_mut(place);
            target.fill(0.0);
            target[..m].copy_from_slice(&row[..m]);
            self.active.iter().zip(&row[m..]).for_each(|(state, x)| target[m + state] = *x);
        }
        for (row, col, entry) in self.entries() {
            all.push(row, if col < m { col } else { m + self.active[col - m] }, entry);
        }
        all
    }

    /// Inputs and active states.
    pub fn width(&self) -> usize {
        self.inputs + self.active.len()
    }

    /// From a full row to the next.
    pub fn stride(&self) -> usize {
        self.width().next_multiple_of(LANES)
    }

    /// The full rows, one after the other.
    pub fn numbers(&self) -> &[f64] {
        self.numbers.read()
    }

    /// Begins to bring the map into caches, for soon.
    pub fn prefetch(&self) {
        #[cfg(target_arch = "x86_64")]
        for line in self.numbers()[..self.stride() * self.full.len()].chunks(LANES) {
            use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
            // SAFETY: a hint, whatever the address.
            unsafe { _mm_prefetch::<_MM_HINT_T1>(line.as_ptr().cast()) };
        }
    }

    /// `next = A x + B u`. `packed` is room.
    pub fn apply(&self, x: &[f64], u: &[f64], packed: &mut Vec<f64>, next: &mut [f64]) {
        packed.clear();
        packed.extend_from_slice(u);
        packed.extend(self.active.iter().map(|state| x[*state]));
        packed.resize(self.stride(), 0.0);
        next.fill(0.0);
        for (row, start) in self.full.iter().zip(&self.starts) {
            let numbers = &self.numbers()[*start..][..packed.len()];
            let mut sums = [0.0; LANES];
            for (a, b) in numbers.as_chunks().0.iter().zip(packed.as_chunks().0) {
                let (a, b): (&[f64; LANES], &[f64; LANES]) = (a, b);
                sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
            }
            next[*row] = sums.iter().sum();
        }
        for (row, col, entry) in self.entries() {
            next[row] += entry * packed[col];
        }
    }

    /// `Mᵀ z` into room for the inputs and the active states.
    #[inline(always)]
    pub fn pull_back(&self, z: &[f64], terms: &mut Vec<Term>, out: &mut Vec<f64>) {
        out.clear();
        out.resize(self.stride(), 0.0);
        terms.clear();
        terms.extend(self.full.iter().enumerate().map(|(place, row)| (z[*row], place)));
        add_rows_portable(out, self.numbers(), self.stride(), terms);
        for (row, col, entry) in self.entries() {
            out[col] += z[row] * entry;
        }
        out.truncate(self.width());
    }

    /// `by_x += Aᵀ z` and `by_u += Bᵀ z`. `packed` is room.
    pub fn add_pulled_back(
        &self,
        z: &[f64],
        packed: &mut Vec<f64>,
        by_x: &mut [f64],
        by_u: &mut [f64],
    ) {
        self.pull_back(z, &mut Vec::new(), packed);
        let (inputs, states) = packed.split_at(self.inputs);
        by_u.iter_mut().zip(inputs).for_each(|(to, x)| *to += x);
        self.active.iter().zip(states).for_each(|(state, x)| by_x[*state] += x);
    }
}
