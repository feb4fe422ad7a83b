//! The kernel for many states and inputs: products in blocks, of the map without its zeros.

use nalgebra::{DMatrix, DVector};
use plantd_math::gemm::{Into, LANES, Operand, Scratch, mirror_head, product, transpose};
use plantd_math::rows::{Term, add_rows_portable};
use plantd_math::simd::widest;
use plantd_math::sparse_map::Map;

use crate::lq::cost_to_go::{CANCELLED, CostToGo};
use crate::lq::kernels::{add_products, scale, set_sums, subtract};
use crate::lq::stage::{NotConvex, Stage};

/// Room for the kernel; nothing here outlives a step.
#[derive(Debug, Default)]
pub(super) struct LargeKernel {
    /// Where the columns of `P` begin that belong to full rows of `M`, and those of the cross term.
    value_columns: Vec<usize>,
    cross_columns: Vec<usize>,
    /// `PM`.
    reached: Scratch,
    /// `G`.
    bracket: Scratch,
    /// `[L; Y; yᵀ]`; zeros above.
    cross: Scratch,
    /// `Kᵀ`, with the offset below it.
    gain: Scratch,
    /// Diagonal of `AᵀPA`.
    whole: Vec<f64>,
    /// `Mᵀb`, then what the offset takes from it.
    linear: Vec<f64>,
    /// Rows of a triangular system that are solved.
    terms: Vec<Term>,
    /// For the sum that cancels less: rows of `A − BK`, where they begin, and a row of `½RK − Sᵀ`.
    closed_loop: Scratch,
    closed_loop_rows: Vec<usize>,
    side_by_side: Vec<usize>,
    priced: Vec<f64>,
}

/// Numbers of a column of the cross term: inputs, active states, the linear term, padding.
fn panel(map: &Map) -> usize {
    (map.width() + 1).next_multiple_of(LANES)
}

impl LargeKernel {
    // For wider registers with the same bits, but for those of products.
    /// One stage back. `S` has no entries of states that are not active.
    pub(super) fn step(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        cost: &mut CostToGo,
        factor: &mut DMatrix<f64>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        widest!({
            self.find_bracket(map, cost);
            self.set_cross(map, stage, &cost.linear);
            factorize(self.cross.numbers(), panel(map), map.inputs, &mut self.terms)?;
            self.find_law(map, factor);
            self.write_law(map, gain, offset);
            self.subtract_gained(map, stage, cost);
            self.write_value(map, stage, cost);
            self.write_linear(map, stage, cost);
            Ok(())
        })
    }

    /// `PM`, and the lower triangle of `G = MᵀPM`.
    #[inline(always)]
    fn find_bracket(&mut self, map: &Map, cost: &CostToGo) {
        let Map { next, full, starts, .. } = map;
        let (next, width, stride) = (*next, map.width(), map.stride());
        let Self { value_columns, reached, bracket, .. } = self;
        let value_stride = next.next_multiple_of(LANES);
        value_columns.clear();
        value_columns.extend(full.iter().map(|row| value_stride * row));
        let value = cost.numbers();
        let last_full = full.last().map_or(0, |row| row + 1);
        let apart = first_apart(value, next, last_full);
        reached.reserve(value_stride * stride);
        bracket.reserve(stride * stride);
        let (reached, bracket) = (reached.numbers(), bracket.numbers());

        // PM.
        let rows = Operand { numbers: map.numbers(), terms: starts, stride: 1 };
        let operand = Operand { numbers: value, terms: value_columns, stride: 1 };
        product(reached, value_stride, operand, rows, (apart, width), Into::Set, 0);
        let known = apart.next_multiple_of(LANES);
        if known < value_stride {
            for column in reached.chunks_exact_mut(value_stride).take(width) {
                column[known..].as_chunks_mut().0.fill([0.0; LANES]);
            }
        }
        for (row, col, entry) in map.entries() {
            // What is apart in P has zeros towards the others.
            let rows = match row {
                _ if apart > last_full => 0..value_stride,
                _ if row < last_full => 0..known,
                _ => last_full / LANES * LANES..value_stride,
            };
            let target = &mut reached[value_stride * col..][rows.clone()];
            add_rows_portable(target, &value[value_stride * row..][rows], 0, &[(entry, 0)]);
        }

        // G = MᵀPM, lower triangle.
        let operand = Operand { numbers: reached, terms: full, stride: value_stride };
        product(bracket, stride, rows, operand, (width, width), Into::SetLower, 0);
        let columns =
            bracket.chunks_exact_mut(stride.max(1)).zip(reached.chunks_exact(value_stride.max(1)));
        for (first, (target, source)) in columns.take(width).enumerate() {
            let reach_down =
                |(_, col, entries): &(usize, usize, &[f64])| col + entries.len() > first;
            for (row, col, entries) in map.runs().filter(reach_down) {
                add_products(&mut target[col..], entries, &source[row..]);
            }
        }
    }

    /// Columns `[Γ; X]`, with `Γ = R + BᵀPB` and `X = AᵀPB + S`, and below them `[Bᵀb + u_linear]ᵀ`.
    #[inline(always)]
    fn set_cross(&mut self, map: &Map, stage: Stage<'_>, value_linear: &DVector<f64>) {
        let (m, width, stride, panel) = (map.inputs, map.width(), map.stride(), panel(map));
        let Self { cross_columns, bracket, cross, linear, terms, .. } = self;
        cross_columns.clear();
        cross_columns.extend((0..m).map(|j| panel * j));
        cross.reserve(panel * m);
        let (bracket, cross) = (bracket.read(), cross.numbers());
        for (j, (target, source)) in
            cross.chunks_exact_mut(panel).zip(bracket.chunks_exact(stride)).take(m).enumerate()
        {
            target[..stride].copy_from_slice(source);
            target[stride..].fill(0.0);
            let r = &stage.r.as_slice()[m * j..][..m];
            target.iter_mut().zip(r).for_each(|(target, r)| *target += r);
            if let Some(s) = stage.s {
                let s = s.column(j);
                for (target, &state) in target[m..].iter_mut().zip(&map.active) {
                    *target += s[state];
                }
            }
        }
        map.pull_back(value_linear.as_slice(), terms, linear);
        let input = &mut linear[..m];
        if let Some(u_linear) = stage.u_linear {
            input.iter_mut().zip(u_linear.iter()).for_each(|(input, given)| *input += given);
        }
        for (j, input) in input.iter().enumerate() {
            cross[panel * j + width] = *input;
        }
    }

    /// `Kᵀ = Y L⁻¹` and `offset = L⁻ᵀ y` of the columns `[L; Y; yᵀ]`; copies `L`.
    #[inline(always)]
    fn find_law(&mut self, map: &Map, factor: &mut DMatrix<f64>) {
        let (m, panel) = (map.inputs, panel(map));
        let Self { cross, gain: law, terms, .. } = self;
        law.reserve(panel * m);
        let (cross, law) = (cross.read(), law.numbers());
        for j in 0..m {
            let source = &cross[panel * j..][j..m];
            factor.as_mut_slice()[m * j..][j..m].copy_from_slice(source);
        }
        // From here on there are columns of states.
        let first = m / LANES * LANES;
        for j in (0..m).rev() {
            let (before, done) = law.split_at_mut(panel * (j + 1));
            let target = &mut before[panel * j..];
            target.copy_from_slice(&cross[panel * j..][..panel]);
            let column = &cross[panel * j..][..m];
            terms.clear();
            terms.extend(column[j + 1..].iter().enumerate().map(|(k, factor)| (-factor, k)));
            let (target, done) = (&mut target[first..], &done[first.min(done.len())..]);
            add_rows_portable(target, done, panel, terms);
            scale(target, column[j].recip());
        }
    }

    /// Writes `K` and the offset, and takes `Y y` from `Aᵀb`.
    #[inline(always)]
    fn write_law(&mut self, map: &Map, gain: &mut DMatrix<f64>, offset: &mut DVector<f64>) {
        let (m, active, width, panel) = (map.inputs, &map.active, map.width(), panel(map));
        let Self { cross, gain: law, linear, .. } = self;
        let (cross, law) = (cross.read(), law.read());
        if is_head(active) {
            gain.as_mut_slice()[m * active.len()..].fill(0.0);
            let target = (gain.as_mut_slice(), m);
            transpose(target, (&law[m.min(law.len())..], panel), (m, active.len()));
        } else {
            gain.as_mut_slice().fill(0.0);
            for (i, &state) in active.iter().enumerate() {
                let column = &mut gain.as_mut_slice()[m * state..][..m];
                for (target, source) in column.iter_mut().zip(law[m + i..].iter().step_by(panel)) {
                    *target = *source;
                }
            }
        }
        let state = &mut linear[m..];
        for (j, offset) in offset.iter_mut().enumerate() {
            *offset = law[panel * j + width];
            subtract(state, cross[panel * j + width], &cross[panel * j..][m..width]);
        }
    }

    /// `AᵀPA − Y Yᵀ` in the place of `AᵀPA`, or where that cancels, the sum of [`Self::find_again`].
    #[inline(always)]
    fn subtract_gained(&mut self, map: &Map, stage: Stage<'_>, cost: &CostToGo) {
        let (m, active, width, stride) = (map.inputs, &map.active, map.width(), map.stride());
        let Self { cross_columns, bracket, cross, whole, .. } = self;
        let bracket = bracket.numbers();
        let diagonal = |bracket: &[f64], i: usize| bracket[(stride + 1) * (m + i)];
        whole.clear();
        whole.extend((0..active.len()).map(|i| diagonal(bracket, i)));
        let operand = Operand { numbers: cross.read(), terms: cross_columns, stride: 1 };
        let first = m / LANES * LANES;
        product(bracket, stride, operand, operand, (width, width), Into::SubtractLower, first);
        let has_cancelled = active.iter().zip(&*whole).enumerate().any(|(i, (&state, whole))| {
            let q = stage.q[(state, state)];
            (q + diagonal(bracket, i)).abs() < CANCELLED * (q + whole).abs()
        });
        if has_cancelled {
            self.find_again(map, stage, cost);
        }
    }

    /// `−SK − KᵀSᵀ + KᵀRK + (A − BK)ᵀP(A − BK)` in the place of `AᵀPA − KᵀΓK`: forgives an error in `K`
    /// to second order.
    fn find_again(&mut self, map: &Map, stage: Stage<'_>, cost: &CostToGo) {
        let Map { next, inputs: m, ref active, .. } = *map;
        let (width, stride) = (map.width(), map.stride());
        let value_stride = next.next_multiple_of(LANES);
        let Self {
            value_columns,
            reached,
            bracket,
            gain: law,
            closed_loop,
            closed_loop_rows: rows,
            side_by_side,
            priced,
            ..
        } = self;
        let (bracket, law) = (bracket.numbers(), law.numbers());
        let panel = panel(map);
        let law = |j: usize| &law[panel * j..][..stride];

        // Rows of A − BK; what stands in columns of inputs is of no use.
        closed_loop.reserve(stride * next);
        let closed_loop = closed_loop.numbers();
        closed_loop[..stride * next].fill(0.0);
        rows.clear();
        rows.extend((0..next).map(|row| stride * row));
        for (&row, &start) in map.full.iter().zip(&map.starts) {
            let (inputs, states) = map.numbers()[start..][..width].split_at(m);
            let target = &mut closed_loop[stride * row..][..stride];
            target[m..width].copy_from_slice(states);
            inputs.iter().enumerate().for_each(|(j, b)| subtract(target, *b, law(j)));
        }
        for (row, col, entry) in map.entries() {
            let target = &mut closed_loop[stride * row..][..stride];
            if col < m {
                subtract(target, entry, law(col));
            } else {
                target[col] += entry;
            }
        }

        // (A − BK)ᵀP(A − BK).
        let value = cost.numbers();
        value_columns.clear();
        value_columns.extend((0..next).map(|row| value_stride * row));
        let right = Operand { numbers: closed_loop, terms: rows, stride: 1 };
        let left = Operand { numbers: value, terms: value_columns, stride: 1 };
        let reached = reached.numbers();
        product(reached, value_stride, left, right, (next, width), Into::Set, 0);
        side_by_side.clear();
        side_by_side.extend(0..next);
        let pushed = Operand { numbers: reached, terms: side_by_side, stride: value_stride };
        product(bracket, stride, right, pushed, (width, width), Into::SetLower, m / LANES * LANES);

        // KᵀRK − KᵀSᵀ − SK = Kᵀ(½RK − Sᵀ) + its transpose.
        for j in 0..m {
            priced.clear();
            priced.resize(stride, 0.0);
            (0..m).for_each(|k| subtract(priced, -0.5 * stage.r[(j, k)], law(k)));
            if let Some(s) = stage.s {
                let states = priced[m..width].iter_mut().zip(active);
                states.for_each(|(target, state)| *target -= s[(*state, j)]);
            }
            for i in m..width {
                let target = &mut bracket[stride * i..][i..width];
                subtract(target, -priced[i], &law(j)[i..width]);
                subtract(target, -law(j)[i], &priced[i..width]);
            }
        }
    }

    /// `P ← Q +` what stands in the place of `AᵀPA`.
    #[inline(always)]
    fn write_value(&self, map: &Map, stage: Stage<'_>, cost: &mut CostToGo) {
        let Map { states: n, inputs: m, ref active, .. } = *map;
        let (width, stride) = (map.width(), map.stride());
        let value_stride = cost.set_states(n);
        let bracket = self.bracket.read();
        let value = cost.numbers_mut();
        let count = active.len();
        if is_head(active) {
            let columns =
                value.chunks_exact_mut(value_stride).zip(stage.q.as_slice().chunks_exact(n));
            for (j, (column, q)) in columns.enumerate() {
                let copied = if j < count { count } else { 0 };
                column[copied..n].copy_from_slice(&q[copied..]);
                if j < count {
                    // What stands above the diagonal is replaced.
                    let first = j / LANES * LANES;
                    let source = &bracket[stride * (m + j)..][m + first..width];
                    set_sums(&mut column[first..count], &q[first..count], source);
                }
            }
            mirror_head(value, value_stride, count);
        } else {
            for (column, q) in value.chunks_exact_mut(value_stride).zip(stage.q.column_iter()) {
                column[..n].copy_from_slice(q.as_slice());
            }
            for (j, &col) in active.iter().enumerate() {
                let source = &bracket[stride * (m + j)..][m + j..width];
                for (&row, source) in active[j..].iter().zip(source) {
                    value[value_stride * col + row] += source;
                }
            }
            mirror(value, value_stride, active);
        }
    }

    /// `b ← x_linear +` what is left of `Aᵀb`.
    #[inline(always)]
    fn write_linear(&self, map: &Map, stage: Stage<'_>, cost: &mut CostToGo) {
        match stage.x_linear {
            Some(x_linear) => cost.linear.copy_from(x_linear),
            None => cost.linear.fill(0.0),
        }
        for (&state, entry) in map.active.iter().zip(&self.linear[map.inputs..]) {
            cost.linear[state] += entry;
        }
    }
}

/// The first of the rows at the end of `P` that have no entry in the first `columns` columns.
fn first_apart(value: &[f64], n: usize, columns: usize) -> usize {
    let stride = n.next_multiple_of(LANES);
    let is_apart = |row: usize| {
        let entries = &value[stride * row..][..columns];
        !entries.iter().fold(false, |any, entry| any | (*entry != 0.0))
    };
    (columns..n).rev().find(|&row| !is_apart(row)).map_or(columns, |row| row + 1)
}

/// Whether these are the first indices.
fn is_head(indices: &[usize]) -> bool {
    indices.last().is_none_or(|&last| last + 1 == indices.len())
}

/// Of `m` columns `[Γ; X]` makes `[L; X L⁻ᵀ]` with `Γ = L Lᵀ`; above the diagonal anything.
#[inline(always)]
fn factorize(
    c: &mut [f64],
    stride: usize,
    m: usize,
    terms: &mut Vec<Term>,
) -> Result<(), NotConvex> {
    for j in 0..m {
        let (done, rest) = c.split_at_mut(stride * j);
        let first = j / LANES * LANES;
        terms.clear();
        terms.extend((0..j).map(|k| (-done[stride * k + j], k)));
        let column = &mut rest[first..stride];
        add_rows_portable(column, &done[first.min(done.len())..], stride, terms);
        let pivot = column[j - first];
        if !(pivot > 0.0) {
            return Err(NotConvex);
        }
        let root = pivot.sqrt();
        scale(column, root.recip());
        column[j - first] = root;
    }
    Ok(())
}

/// Copies the lower triangle of the given rows and columns to the upper one.
fn mirror(value: &mut [f64], n: usize, indices: &[usize]) {
    for (i, &row) in indices.iter().enumerate() {
        for &col in &indices[..i] {
            value[n * row + col] = value[n * col + row];
        }
    }
}
