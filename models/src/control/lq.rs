//! One stage of the linear-quadratic problem, backwards: the kernel under regulators and trajectory
//! optimisation.
//!
//! With `M = [B A]` everything comes from `G = MᵀPM`: its blocks are `BᵀPB`, `AᵀPB` and `AᵀPA`. A
//! discrete map has rows that say little (the next prescribed coordinate is the input, its velocity is
//! a difference quotient) and columns that are zero (velocities of prescribed coordinates). A [`Map`]
//! leaves them out: products run over the other rows and columns, a row of a few entries is
//! added entry by entry, and where a zero column leaves `P` as the weight is, its zeros are not
//! multiplied either. Of symmetric results the lower triangle is computed.

use nalgebra::{DMatrix, DVector};

use crate::math::gemm::{Into, LANES, Operand, Scratch, mirror_head, product, transpose};
use crate::math::rows::{Term, add_rows_portable};
use crate::math::simd::wide;
use crate::math::sparse_map::Map;

/// One stage of the cost,
/// `½ xᵀQx + xᵀSu + ½ uᵀRu + x_linearᵀx + u_linearᵀu`. Nothing here need be definite.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stage<'a> {
    /// `Q`, n × n, symmetric.
    pub(crate) q: &'a DMatrix<f64>,
    /// `R`, m × m, symmetric.
    pub(crate) r: &'a DMatrix<f64>,
    /// `S`, n × m; none means zero.
    pub(crate) s: Option<&'a DMatrix<f64>>,
    /// n entries; none means zero.
    pub(crate) x_linear: Option<&'a DVector<f64>>,
    /// m entries; none means zero.
    pub(crate) u_linear: Option<&'a DVector<f64>>,
}

/// `R + BᵀPB` is not positive definite: the stage has no minimum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NotConvex;

/// States and inputs up to which plain loops are fastest.
const SMALL: usize = 8;
/// Where `Q + AᵀPA − KᵀΓK` leaves less than this of a diagonal entry, it is computed again as a sum
/// that cancels less.
const CANCELLED: f64 = 1e-3;

/// The recursion with the cost to go `½ xᵀPx + bᵀx` that it has reached.
#[derive(Debug)]
pub(crate) struct LqRecursion {
    /// n.
    states: usize,
    /// `P` by columns, which begin on cache lines; zeros between them.
    value: Scratch,
    linear: DVector<f64>,
    /// Lower triangular factor of the last `Γ`.
    factor: DMatrix<f64>,
    work: Work,
}

/// Room for the large kernel; nothing here outlives a step.
#[derive(Debug, Default)]
struct Work {
    /// Where the columns of `P` begin that belong to full rows of `M`, and those of the cross term.
    value_columns: Vec<usize>,
    cross_columns: Vec<usize>,
    /// `PM`.
    reached: Scratch,
    /// `G`.
    bracket: Scratch,
    /// `AᵀPB + S`, divided by the factor of `Γ` from the right; zeros above.
    cross: Scratch,
    /// `Kᵀ`.
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

impl LqRecursion {
    /// Room for `n` states and `m` inputs; begins with zero cost.
    pub(crate) fn new(n: usize, m: usize) -> Self {
        let mut recursion = Self {
            states: n,
            value: Scratch::default(),
            linear: DVector::zeros(n),
            factor: DMatrix::identity(m, m),
            work: Work::default(),
        };
        recursion.begin(&DMatrix::zeros(n, n), None);
        recursion
    }

    /// Begins at the end of the horizon, with `P = value` and `b = linear` (none means zero).
    pub(crate) fn begin(&mut self, value: &DMatrix<f64>, linear: Option<&DVector<f64>>) {
        let stride = self.set_states(value.nrows());
        for (target, source) in
            self.value.numbers().chunks_exact_mut(stride.max(1)).zip(value.column_iter())
        {
            target[..value.nrows()].copy_from_slice(source.as_slice());
        }
        match linear {
            Some(linear) => self.linear.copy_from(linear),
            None => self.linear.fill(0.0),
        }
    }

    /// `P`, n × n, symmetric.
    pub(crate) fn value(&self) -> DMatrix<f64> {
        let (n, numbers) = (self.states, self.value.read());
        DMatrix::from_fn(n, n, |i, j| numbers[n.next_multiple_of(LANES) * j + i])
    }

    /// Whether all of `P` is finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.value.read().iter().all(|entry| entry.is_finite())
    }

    /// Makes `P` one of `n` states, zeros at first if that changes anything; from a column to the next.
    fn set_states(&mut self, n: usize) -> usize {
        let stride = n.next_multiple_of(LANES);
        self.value.reserve(stride * n);
        if self.states != n {
            self.states = n;
            self.linear = DVector::zeros(n);
            self.value.numbers().fill(0.0);
        }
        stride
    }

    /// `b`, n entries.
    pub(crate) fn linear(&self) -> &DVector<f64> {
        &self.linear
    }

    /// Reciprocal condition, in the 1-norm, of the last step's `Γ`; 1 before the first. About `2m³`
    /// flops.
    pub(crate) fn reciprocal_condition(&self) -> f64 {
        reciprocal_condition(&self.factor)
    }

    /// One stage back, through the map `x[k+1] = A x + B u`: the law that is best there,
    /// `u = −gain x − offset`, with `Γ = R + BᵀPB`, `gain = Γ⁻¹(BᵀPA + Sᵀ)`,
    /// `offset = Γ⁻¹(Bᵀb + u_linear)`. On failure the cost to go is that of the stage before.
    ///
    /// Allocates nothing after the first step with the same numbers of states and inputs, unless `S`
    /// has entries of states that `A` leaves out. `A` may lead from one number of states to another.
    pub(crate) fn step(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        let Map { next, states: n, inputs: m, .. } = *map;
        assert!(self.states == next, "A and B fit P");
        assert!(stage.q.shape() == (n, n) && stage.r.shape() == (m, m), "Q and R fit A and B");
        assert!(stage.s.is_none_or(|s| s.shape() == (n, m)), "S fits Q and R");
        assert!(gain.shape() == (m, n) && offset.len() == m, "room for the law");
        if self.factor.nrows() != m {
            self.factor = DMatrix::identity(m, m);
        }
        if next > SMALL || n > SMALL || m > SMALL {
            return self.step_large(map, stage, gain, offset);
        }
        match (next, n, m) {
            (2, 2, 1) => self.step_small::<2>((2, 2, 1), map, stage, gain, offset),
            (4, 4, 1) => self.step_small::<4>((4, 4, 1), map, stage, gain, offset),
            sizes => self.step_small::<SMALL>(sizes, map, stage, gain, offset),
        }
    }

    /// At most `N` states and inputs, in plain loops.
    #[inline(always)]
    #[allow(clippy::needless_range_loop, reason = "the indices are those of the formulas")]
    fn step_small<const N: usize>(
        &mut self,
        (next, n, m): (usize, usize, usize),
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        // Columns.
        let (mut a, mut b) = ([[0.0; N]; N], [[0.0; N]; N]);
        for (&row, &start) in map.full.iter().zip(&map.starts) {
            let numbers = &map.numbers()[start..];
            for j in 0..m {
                b[j][row] = numbers[j];
            }
            for (&state, entry) in map.active.iter().zip(&numbers[m..]) {
                a[state][row] = *entry;
            }
        }
        for (row, col, entry) in map.entries() {
            if col < m {
                b[col][row] = entry;
            } else {
                a[map.active[col - m]][row] = entry;
            }
        }
        let value = &self.value.read()[..LANES * next];
        let (q, r) = (&stage.q.as_slice()[..n * n], &stage.r.as_slice()[..m * m]);
        let times_value = |x: &[f64]| {
            let mut y = [0.0; N];
            for k in 0..next {
                for i in 0..next {
                    y[i] += value[LANES * k + i] * x[k];
                }
            }
            y
        };
        let dot = |x: &[f64], y: &[f64]| (0..next).map(|k| x[k] * y[k]).sum::<f64>();
        let mut value_b = [[0.0; N]; N];
        let mut bracket = [[0.0; N]; N];
        let mut cross = [[0.0; N]; N];
        for j in 0..m {
            value_b[j] = times_value(&b[j]);
            for i in 0..=j {
                bracket[j][i] = r[m * j + i] + dot(&b[i], &value_b[j]);
            }
            for i in 0..n {
                cross[j][i] = dot(&a[i], &value_b[j]);
                if let Some(s) = stage.s {
                    cross[j][i] += s.as_slice()[n * j + i];
                }
            }
        }
        // Row j of the factor is bracket[j].
        for j in 0..m {
            for i in 0..=j {
                let known: f64 = (0..i).map(|k| bracket[j][k] * bracket[i][k]).sum();
                let rest = bracket[j][i] - known;
                if i < j {
                    bracket[j][i] = rest / bracket[i][i];
                } else if rest > 0.0 {
                    bracket[j][j] = rest.sqrt();
                } else {
                    return Err(NotConvex);
                }
            }
        }
        let factor = self.factor.as_mut_slice();
        for j in 0..m {
            for i in 0..=j {
                factor[m * i + j] = bracket[j][i];
            }
        }
        // Both as columns of n: first what the factor leaves, then the gain.
        for j in 0..m {
            for i in 0..n {
                let known: f64 = (0..j).map(|k| bracket[j][k] * cross[k][i]).sum();
                cross[j][i] = (cross[j][i] - known) / bracket[j][j];
            }
        }
        let mut law = cross;
        for j in (0..m).rev() {
            for i in 0..n {
                let known: f64 = (j + 1..m).map(|k| bracket[k][j] * law[k][i]).sum();
                law[j][i] = (law[j][i] - known) / bracket[j][j];
            }
        }
        let gain = &mut gain.as_mut_slice()[..m * n];
        for i in 0..n {
            for j in 0..m {
                gain[m * i + j] = law[j][i];
            }
        }
        // The linear part; `input` is what the factor leaves of Bᵀb + u_linear.
        let linear = &self.linear.as_slice()[..next];
        let mut input = [0.0; N];
        for j in 0..m {
            let known: f64 = (0..j).map(|k| bracket[j][k] * input[k]).sum();
            let given = stage.u_linear.map_or(0.0, |u_linear| u_linear[j]);
            input[j] = (dot(&b[j], linear) + given - known) / bracket[j][j];
        }
        let mut new_linear = [0.0; N];
        for i in 0..n {
            let known: f64 = (0..m).map(|k| cross[k][i] * input[k]).sum();
            let given = stage.x_linear.map_or(0.0, |x_linear| x_linear[i]);
            new_linear[i] = dot(&a[i], linear) + given - known;
        }
        for j in (0..m).rev() {
            let known: f64 = (j + 1..m).map(|k| bracket[k][j] * input[k]).sum();
            input[j] = (input[j] - known) / bracket[j][j];
        }
        offset.as_mut_slice()[..m].copy_from_slice(&input[..m]);
        // The value.
        let mut new_value = [[0.0; N]; N];
        let mut has_cancelled = false;
        for j in 0..n {
            let value_a = times_value(&a[j]);
            for i in 0..=j {
                let whole = q[n * j + i] + dot(&a[i], &value_a);
                let gained: f64 = (0..m).map(|k| cross[k][i] * cross[k][j]).sum();
                new_value[j][i] = whole - gained;
                if i == j {
                    has_cancelled |= new_value[j][j].abs() < CANCELLED * whole.abs();
                }
            }
        }
        if has_cancelled {
            let mut closed_loop = [[0.0; N]; N];
            for j in 0..n {
                for i in 0..next {
                    let fed: f64 = (0..m).map(|k| b[k][i] * law[k][j]).sum();
                    closed_loop[j][i] = a[j][i] - fed;
                }
            }
            for j in 0..n {
                let pushed = times_value(&closed_loop[j]);
                for i in 0..=j {
                    let mut sum = q[n * j + i] + dot(&closed_loop[i], &pushed);
                    for k in 0..m {
                        let priced: f64 = (0..m).map(|l| r[m * k + l] * law[l][j]).sum();
                        sum += law[k][i] * priced;
                        if let Some(s) = stage.s {
                            let s = &s.as_slice()[n * k..];
                            sum -= s[i] * law[k][j] + s[j] * law[k][i];
                        }
                    }
                    new_value[j][i] = sum;
                }
            }
        }
        self.set_states(n);
        self.linear.as_mut_slice()[..n].copy_from_slice(&new_linear[..n]);
        let value = &mut self.value.numbers()[..LANES * n];
        for j in 0..n {
            for i in 0..=j {
                value[LANES * j + i] = new_value[j][i];
                value[LANES * i + j] = new_value[j][i];
            }
        }
        Ok(())
    }

    fn step_large(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        if stage.s.is_some_and(|s| reaches_beyond(s, &map.active)) {
            return self.step_large(&map.with_all_states(), stage, gain, offset);
        }
        self.step_wide(map, stage, gain, offset)
    }

    /// The same code for wider registers, with the same bits but for those of products.
    fn step_wide(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx512f") {
            // SAFETY: the processor has AVX-512.
            return unsafe { self.step_avx512(map, stage, gain, offset) };
        }
        self.step_narrow(map, stage, gain, offset)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn step_avx512(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        self.step_portable(map, stage, gain, offset)
    }

    wide! {
        pub(crate) fn step_narrow(
            mut self,
            map: &Map,
            stage: Stage<'_>,
            gain: &mut DMatrix<f64>,
            offset: &mut DVector<f64>,
        ) -> Result<(), NotConvex> = step_portable, step_avx2;
    }

    #[inline(always)]
    fn step_portable(
        &mut self,
        whole_map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        let Map { next, states: n, inputs: m, active, full, starts, .. } = whole_map;
        let (next, n, m) = (*next, *n, *m);
        let (width, stride) = (whole_map.width(), whole_map.stride());
        let panel = (width + 1).next_multiple_of(LANES);
        let Work {
            value_columns,
            cross_columns,
            reached,
            bracket,
            cross,
            gain: law,
            whole,
            linear,
            terms,
            ..
        } = &mut self.work;
        let value_stride = next.next_multiple_of(LANES);
        value_columns.clear();
        value_columns.extend(full.iter().map(|row| value_stride * row));
        cross_columns.clear();
        cross_columns.extend((0..m).map(|j| panel * j));
        let value = self.value.read();
        let last_full = full.last().map_or(0, |row| row + 1);
        let apart = first_apart(value, next, last_full);
        reached.reserve(value_stride * stride);
        bracket.reserve(stride * stride);
        cross.reserve(panel * m);
        law.reserve(panel * m);
        let reached = reached.numbers();
        let (bracket, cross, law) = (bracket.numbers(), cross.numbers(), law.numbers());

        // PM.
        let map = Operand { numbers: whole_map.numbers(), terms: starts, stride: 1 };
        let operand = Operand { numbers: value, terms: value_columns, stride: 1 };
        product(reached, value_stride, operand, map, (apart, width), Into::Set, 0);
        let known = apart.next_multiple_of(LANES);
        if known < value_stride {
            for column in reached.chunks_exact_mut(value_stride).take(width) {
                column[known..].as_chunks_mut().0.fill([0.0; LANES]);
            }
        }
        for (row, col, entry) in whole_map.entries() {
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
        product(bracket, stride, map, operand, (width, width), Into::SetLower, 0);
        let columns =
            bracket.chunks_exact_mut(stride.max(1)).zip(reached.chunks_exact(value_stride.max(1)));
        for (first, (target, source)) in columns.take(width).enumerate() {
            let reach_down =
                |(_, col, entries): &(usize, usize, &[f64])| col + entries.len() > first;
            for (row, col, entries) in whole_map.runs().filter(reach_down) {
                add_products(&mut target[col..], entries, &source[row..]);
            }
        }

        // [R + BᵀPB; AᵀPB + S], and what the factor of Γ leaves of it.
        // From here on there are columns of states.
        let first = m / LANES * LANES;
        for (j, (target, source)) in
            cross.chunks_exact_mut(panel).zip(bracket.chunks_exact(stride)).take(m).enumerate()
        {
            target[..stride].copy_from_slice(source);
            target[stride..].fill(0.0);
            let r = &stage.r.as_slice()[m * j..][..m];
            target.iter_mut().zip(r).for_each(|(target, r)| *target += r);
            if let Some(s) = stage.s {
                let s = s.column(j);
                for (target, &state) in target[m..].iter_mut().zip(active) {
                    *target += s[state];
                }
            }
        }
        // Below them [Bᵀb + u_linear]ᵀ, of which the same is left.
        whole_map.pull_back(self.linear.as_slice(), terms, linear);
        let (input, state) = linear.split_at_mut(m);
        if let Some(u_linear) = stage.u_linear {
            input.iter_mut().zip(u_linear.iter()).for_each(|(input, given)| *input += given);
        }
        for (j, input) in input.iter().enumerate() {
            cross[panel * j + width] = *input;
        }
        factorize(cross, panel, m, terms)?;
        for j in 0..m {
            let source = &cross[panel * j..][j..m];
            self.factor.as_mut_slice()[m * j..][j..m].copy_from_slice(source);
        }
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

        for (j, offset) in offset.iter_mut().enumerate() {
            *offset = law[panel * j + width];
            subtract(state, cross[panel * j + width], &cross[panel * j..][m..width]);
        }

        // The value: Q + AᵀPA less what the inputs gain.
        let diagonal = |bracket: &[f64], i: usize| bracket[(stride + 1) * (m + i)];
        whole.clear();
        whole.extend((0..active.len()).map(|i| diagonal(bracket, i)));
        let operand = Operand { numbers: cross, terms: cross_columns, stride: 1 };
        product(bracket, stride, operand, operand, (width, width), Into::SubtractLower, first);
        let has_cancelled = active.iter().zip(&*whole).enumerate().any(|(i, (&state, whole))| {
            let q = stage.q[(state, state)];
            (q + diagonal(bracket, i)).abs() < CANCELLED * (q + whole).abs()
        });
        if has_cancelled {
            self.value_again(whole_map, stage);
        }
        let value_stride = self.set_states(n);
        let bracket = self.work.bracket.read();
        let value = self.value.numbers();
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
        match stage.x_linear {
            Some(x_linear) => self.linear.copy_from(x_linear),
            None => self.linear.fill(0.0),
        }
        for (&state, entry) in active.iter().zip(&self.work.linear[m..]) {
            self.linear[state] += entry;
        }
        Ok(())
    }

    /// `−SK − KᵀSᵀ + KᵀRK + (A − BK)ᵀP(A − BK)` in the place of `AᵀPA − KᵀΓK`: forgives an error in `K`
    /// to second order.
    fn value_again(&mut self, map: &Map, stage: Stage<'_>) {
        let Map { next, inputs: m, ref active, .. } = *map;
        let (width, stride) = (map.width(), map.stride());
        let value_stride = next.next_multiple_of(LANES);
        let Work {
            value_columns,
            reached,
            bracket,
            gain: law,
            closed_loop,
            closed_loop_rows: rows,
            side_by_side,
            priced,
            ..
        } = &mut self.work;
        let (bracket, law) = (bracket.numbers(), law.numbers());
        let panel = (width + 1).next_multiple_of(LANES);
        let law = |j: usize| &law[panel * j..][..stride];
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
        // What stands in columns of inputs is of no use.
        let value = self.value.read();
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
}

/// Whether `S` has entries of states that are not active.
fn reaches_beyond(s: &DMatrix<f64>, active: &[usize]) -> bool {
    let mut rest = active;
    (0..s.nrows()).any(|state| match rest.split_first() {
        Some((first, others)) if *first == state => {
            rest = others;
            false
        }
        _ => s.row(state).iter().any(|entry| *entry != 0.0),
    })
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

/// `target += a ∘ b`, as far as `a` goes.
#[inline(always)]
fn add_products(target: &mut [f64], a: &[f64], b: &[f64]) {
    in_blocks(target, a, b, |target, a, b| *target += a * b);
}

/// `target = a + b`, as far as `a` goes.
#[inline(always)]
fn set_sums(target: &mut [f64], a: &[f64], b: &[f64]) {
    in_blocks(target, a, b, |target, a, b| *target = a + b);
}

/// Whole blocks first: such loops are short here, and what compilers unroll is longer.
#[inline(always)]
fn in_blocks(target: &mut [f64], a: &[f64], b: &[f64], act: impl Fn(&mut f64, f64, f64)) {
    let (target, target_rest) = target[..a.len()].as_chunks_mut::<LANES>();
    let (b, b_rest) = b[..a.len()].as_chunks::<LANES>();
    let (a, a_rest) = a.as_chunks::<LANES>();
    for ((target, a), b) in target.iter_mut().zip(a).zip(b) {
        (0..LANES).for_each(|i| act(&mut target[i], a[i], b[i]));
    }
    for ((target, a), b) in target_rest.iter_mut().zip(a_rest).zip(b_rest) {
        act(target, *a, *b);
    }
}

#[inline(always)]
fn subtract(target: &mut [f64], factor: f64, source: &[f64]) {
    for (target, source) in target.iter_mut().zip(source) {
        *target -= factor * source;
    }
}

#[inline(always)]
fn scale(target: &mut [f64], factor: f64) {
    for target in target {
        *target *= factor;
    }
}

/// Reciprocal condition, in the 1-norm, of `L Lᵀ`; at most 1.
pub(super) fn reciprocal_condition(factor: &DMatrix<f64>) -> f64 {
    let m = factor.nrows();
    // Columns of the inverse of L.
    let mut inverse = DMatrix::<f64>::zeros(m, m);
    for j in 0..m {
        inverse[(j, j)] = 1.0;
        for k in j..m {
            let known = inverse[(k, j)] / factor[(k, k)];
            let (source, column) = (factor.as_slice(), inverse.as_mut_slice());
            column[m * j + k] = known;
            subtract(&mut column[m * j..][k + 1..m], known, &source[m * k..][k + 1..m]);
        }
    }
    // Columns of L and of the transposed inverse, whose products are symmetric: half of each.
    let (l, inverse) = (factor.transpose(), inverse);
    let largest = norm_of_product(l.as_slice(), m, |i, _| 0..i + 1);
    let largest_inverse = norm_of_product(inverse.as_slice(), m, |_, j| j..m);
    let product = largest * largest_inverse;
    if product.is_nan() {
        0.0
    } else if product > 1.0 {
        product.recip()
    } else {
        1.0
    }
}

/// 1-norm of `XᵀX`, where the terms of entry i ≤ j lie in a range.
fn norm_of_product(
    x: &[f64],
    m: usize,
    terms: impl Fn(usize, usize) -> std::ops::Range<usize>,
) -> f64 {
    let mut sums = vec![0.0; m];
    for j in 0..m {
        for i in 0..=j {
            let terms = terms(i, j);
            let (left, right) = (&x[m * i..][terms.clone()], &x[m * j..][terms]);
            // Four sums, which do not wait for each other.
            let (left, left_rest) = left.as_chunks::<4>();
            let (right, right_rest) = right.as_chunks::<4>();
            let mut four = [0.0; 4];
            for (left, right) in left.iter().zip(right) {
                for ((sum, l), r) in four.iter_mut().zip(left).zip(right) {
                    *sum += l * r;
                }
            }
            let rest: f64 = left_rest.iter().zip(right_rest).map(|(l, r)| l * r).sum();
            let entry = (four.iter().sum::<f64>() + rest).abs();
            sums[i] += entry;
            if i < j {
                sums[j] += entry;
            }
        }
    }
    sums.into_iter().fold(0.0, f64::max)
}

#[cfg(test)]
mod tests;
