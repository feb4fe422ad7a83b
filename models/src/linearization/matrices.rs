//! `A` and `B` of a linearization, written into memory of the caller's.
//!
//! Rows of a [`Linearization`] hold the derivatives of increments; `q[k+1] = q[k] + x` adds a one on the
//! diagonal. Ball joints turn at their ends by `dexp₋ξ ξ' + exp(−ξ) η`.

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rows::{Block, LANES};
use plantd_math::simd::wide;
use plantd_math::spatial::{Mat3, Vec3};

use crate::lagrangian::turning::Turning;
use crate::linearization::ends::InputImpulse;
use crate::linearization::linearize::{Kind, Linearization};

/// How the numbers of a matrix follow each other in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Row after row, as C and NumPy have them.
    Rows,
    /// Column after column, as BLAS, Eigen and nalgebra have them.
    Columns,
}

/// Rows and columns that are copied together.
const TILE: usize = LANES;

/// A matrix in memory that somebody else owns.
struct Target<'a> {
    numbers: &'a mut [f64],
    layout: Layout,
    rows: usize,
    columns: usize,
}

impl<'a> Target<'a> {
    fn new(numbers: &'a mut [f64], layout: Layout, [rows, columns]: [usize; 2]) -> Self {
        assert!(
            numbers.len() == rows * columns,
            "the matrix has {rows} rows of {columns} numbers, not {}",
            numbers.len()
        );
        Self { numbers, layout, rows, columns }
    }

    fn clear(&mut self) {
        self.numbers.fill(0.0);
    }

    fn at(&mut self, row: usize, column: usize) -> &mut f64 {
        match self.layout {
            Layout::Rows => &mut self.numbers[row * self.columns + column],
            Layout::Columns => &mut self.numbers[column * self.rows + row],
        }
    }

    /// Copies `[count, width]` numbers, which are in rows `stride` apart, to a place in the matrix.
    fn copy(
        &mut self,
        source: &[f64],
        stride: usize,
        [count, width]: [usize; 2],
        [row, column]: [usize; 2],
    ) {
        if self.layout == Layout::Rows {
            for (i, source) in source.chunks(stride.max(1)).take(count).enumerate() {
                let to = (row + i) * self.columns + column;
                self.numbers[to..][..width].copy_from_slice(&source[..width]);
            }
            return;
        }
        if count >= TILE && width >= TILE {
            let (to, apart) = (&mut self.numbers[column * self.rows + row..], self.rows);
            in_eights(Transpose { to, apart, source, stride, size: [count, width], factors: None });
            return;
        }
        for j in 0..width {
            let to = &mut self.numbers[(column + j) * self.rows + row..][..count];
            to.iter_mut().zip(0..).for_each(|(to, i)| *to = source[i * stride + j]);
        }
    }

    /// Copies three rows, `stride` apart and `width` long, multiplied by a matrix.
    fn copy_turned(
        &mut self,
        by: &Mat3,
        source: &[f64],
        stride: usize,
        width: usize,
        [row, column]: [usize; 2],
    ) {
        wide!({
            let Mat3([x, y, z]) = *by;
            let [from_x, from_y, from_z] = [0, 1, 2].map(|a| &source[a * stride..]);
            for left in (0..width).step_by(TILE) {
                // Rows are padded to whole tiles.
                let [f, g, h] = [from_x, from_y, from_z].map(|row| {
                    let mut block = [0.0; TILE];
                    block.copy_from_slice(&row[left..left + TILE]);
                    Block(block)
                });
                let turned = |a: usize| f.times(x[a]).plus(g.times(y[a])).plus(h.times(z[a]));
                let [f, g, h] = [turned(0).0, turned(1).0, turned(2).0];
                let count = TILE.min(width - left);
                match self.layout {
                    Layout::Rows => {
                        for (a, turned) in [f, g, h].iter().enumerate() {
                            let to = (row + a) * self.columns + column + left;
                            self.numbers[to..][..count].copy_from_slice(&turned[..count]);
                        }
                    }
                    Layout::Columns => {
                        for j in 0..count {
                            let to = (column + left + j) * self.rows + row;
                            self.numbers[to..][..3].copy_from_slice(&[f[j], g[j], h[j]]);
                        }
                    }
                }
            }
        })
    }

    /// Copies `count` rows, `stride` apart, each number times what the input of its column gives to the residual.
    fn copy_times(
        &mut self,
        source: &[f64],
        stride: usize,
        count: usize,
        inputs: &[InputImpulse],
        [row, column]: [usize; 2],
    ) {
        let width = inputs.len();
        if self.layout == Layout::Columns && count >= TILE && width >= TILE {
            let (to, apart) = (&mut self.numbers[column * self.rows + row..], self.rows);
            let (size, factors) = ([count, width], Some(inputs));
            in_eights(Transpose { to, apart, source, stride, size, factors });
            return;
        }
        for (i, line) in source.chunks(stride).take(count).enumerate() {
            for (j, (entry, input)) in line.iter().zip(inputs).enumerate() {
                *self.at(row + i, column + j) = entry * input.residual;
            }
        }
    }

    /// Adds `factor` times `count` numbers, `stride` apart, to a column.
    fn add_column(
        &mut self,
        factor: f64,
        source: &[f64],
        stride: usize,
        count: usize,
        [row, column]: [usize; 2],
    ) {
        let (first, step) = match self.layout {
            Layout::Rows => (row * self.columns + column, self.columns),
            Layout::Columns => (column * self.rows + row, 1),
        };
        let to = self.numbers[first..].iter_mut().step_by(step).take(count);
        to.zip(source.iter().step_by(stride)).for_each(|(to, entry)| *to += factor * entry);
    }

    /// Adds three columns, of `count` numbers `stride` apart, multiplied by the transpose of a matrix.
    fn add_columns(
        &mut self,
        by: &Mat3,
        source: &[f64],
        stride: usize,
        count: usize,
        [row, column]: [usize; 2],
    ) {
        let (first, down, right) = match self.layout {
            Layout::Rows => (row * self.columns + column, self.columns, 1),
            Layout::Columns => (column * self.rows + row, 1, self.rows),
        };
        let whole = if down == 1 { count - count % TILE } else { 0 };
        if whole > 0 {
            let numbers = &mut *self.numbers;
            wide!({
                for top in (0..whole).step_by(TILE) {
                    // Eight rows of what stands in a column.
                    let lines = &source[top * stride..];
                    let column = |k: usize| Block(std::array::from_fn(|i| lines[i * stride + k]));
                    let [x, y, z] = [column(0), column(1), column(2)];
                    for (k, by) in by.0.iter().enumerate() {
                        let sum = x.times(by[0]).plus(y.times(by[1])).plus(z.times(by[2]));
                        let to = &mut numbers[first + top + k * right..][..TILE];
                        to.iter_mut().zip(sum.0).for_each(|(to, sum)| *to += sum);
                    }
                }
            });
        }
        for (i, line) in source.chunks(stride).enumerate().take(count).skip(whole) {
            if let [x, y, z, ..] = *line {
                let product = by.apply_transposed(Vec3([x, y, z]));
                (0..3).for_each(|k| self.numbers[first + i * down + k * right] += product[k]);
            }
        }
    }

    /// Multiplies three rows, beginning at `row`, by a matrix.
    #[inline(always)]
    fn turn_rows(&mut self, by: &Mat3, row: usize) {
        if self.layout == Layout::Columns {
            for column in self.numbers.chunks_exact_mut(self.rows) {
                if let Some(three) = column[row..].first_chunk_mut() {
                    *three = by.apply(Vec3(*three)).0;
                }
            }
            return;
        }
        for column in 0..self.columns {
            let turned = by.apply(Vec3([0, 1, 2].map(|a| *self.at(row + a, column))));
            (0..3).for_each(|a| *self.at(row + a, column) = turned[a]);
        }
    }

    /// Adds a 3 by 3 block.
    fn add_block(&mut self, block: &Mat3, [row, column]: [usize; 2]) {
        for (b, entries) in block.0.iter().enumerate() {
            (0..3).for_each(|a| *self.at(row + a, column + b) += entries[a]);
        }
    }

    /// Puts a 3 by 3 block.
    fn put_block(&mut self, block: &Mat3, [row, column]: [usize; 2]) {
        for (b, entries) in block.0.iter().enumerate() {
            (0..3).for_each(|a| *self.at(row + a, column + b) = entries[a]);
        }
    }
}

/// Copies `[count, width]` numbers, each at least as many as a tile, which are in rows `stride` apart, to columns that
/// are `apart`. Each column counts a factor, if there are some. Tile by tile, so that neither rows nor columns leave
/// the nearest cache; the last ones overlap with those before them.
struct Transpose<'a> {
    to: &'a mut [f64],
    apart: usize,
    source: &'a [f64],
    stride: usize,
    size: [usize; 2],
    factors: Option<&'a [InputImpulse]>,
}

impl InEights for Transpose<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { to, apart, source, stride, size: [count, width], factors } = self;
        for left in tiles(width) {
            let mut of_columns = Block([1.0; TILE]);
            if let Some(impulses) = factors {
                let impulses = of_columns.0.iter_mut().zip(&impulses[left..]);
                impulses.for_each(|(factor, impulse)| *factor = impulse.residual);
            }
            let of_columns = E::of(&of_columns);
            for top in tiles(count) {
                let mut rows = [E::ZERO; TILE];
                for (i, row) in rows.iter_mut().enumerate() {
                    *row = E::of_list(&source[(top + i) * stride + left..]);
                }
                if factors.is_some() {
                    for row in &mut rows {
                        *row = row.times(of_columns);
                    }
                }
                for (j, column) in E::transposed(rows).iter().enumerate() {
                    column.put_list(&mut to[(left + j) * apart + top..]);
                }
            }
        }
    }
}

/// A row of the end of a step, from the rows of increments that begin with `first`.
#[derive(Clone, Copy, Debug)]
struct Turned {
    first: usize,
    weights: Option<[f64; 3]>,
}

impl Turned {
    /// Of each of eight rows from `top` on; the joints are in the order of their coordinates.
    fn tile(turnings: &[Turning], top: usize) -> [Self; TILE] {
        let mut rows = [Self { first: 0, weights: None }; TILE];
        let mut balls = &turnings[turnings.partition_point(|ball| ball.coordinate + 3 <= top)..];
        for (own, row) in rows.iter_mut().zip(top..) {
            own.first = row;
            let Some(Turning { coordinate, to_end: Mat3(columns), .. }) = balls.first() else {
                continue;
            };
            let Some(axis) = row.checked_sub(*coordinate) else { continue };
            let [x, y, z] = columns;
            *own = Self { first: *coordinate, weights: Some([x[axis], y[axis], z[axis]]) };
            if axis == 2 {
                balls = &balls[1..];
            }
        }
        rows
    }

    /// Numbers of eight rows from a column on.
    #[inline(always)]
    fn rows<E: Eight>(
        tile: &[Self; TILE],
        source: &[f64],
        stride: usize,
        left: usize,
    ) -> [E; TILE] {
        let at = |row: usize| E::of_list(&source[row * stride + left..]);
        let mut rows = [E::ZERO; TILE];
        for (row, Self { first, weights }) in rows.iter_mut().zip(tile) {
            *row = at(*first);
            if let Some([x, y, z]) = *weights {
                let sum = row.scaled(x).plus(at(first + 1).scaled(y));
                *row = sum.plus(at(first + 2).scaled(z));
            }
        }
        rows
    }
}

/// [`Transpose`] of rows of which many are of ball joints, which turn at their ends; to do all copies so would make
/// those of other models up to 1.06 times as long.
struct TransposeTurned<'a> {
    to: &'a mut [f64],
    apart: usize,
    source: &'a [f64],
    stride: usize,
    size: [usize; 2],
    turnings: &'a [Turning],
}

impl InEights for TransposeTurned<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { to, apart, source, stride, size: [count, width], turnings } = self;
        for top in tiles(count) {
            let tile = Turned::tile(turnings, top);
            for left in tiles(width) {
                let rows = Turned::rows::<E>(&tile, source, stride, left);
                for (j, column) in E::transposed(rows).iter().enumerate() {
                    column.put_list(&mut to[(left + j) * apart + top..]);
                }
            }
        }
    }
}

/// Writes what inputs of ball joints give to `count` rows, two joints at a time: columns of the momenta, which are in
/// rows `stride` apart, times what the three inputs of a joint give to its residual.
struct TimesBalls<'a> {
    to: &'a mut [f64],
    /// How far numbers of a column are apart, and columns.
    steps: [usize; 2],
    source: &'a [f64],
    stride: usize,
    count: usize,
    impulses: &'a [InputImpulse],
    turnings: &'a [Turning],
}

impl InEights for TimesBalls<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { to, steps: [down, right], source, stride, count, impulses, turnings } = self;
        let width = impulses.len() / 3;
        for top in tiles(count) {
            let tile = Turned::tile(turnings, top);
            for first in (0..width).step_by(6).map(|first| first.min(width - 6)) {
                // Of the last two joints there may be no eight numbers from the first one on.
                let left = first.min(width - TILE);
                let rows = Turned::rows(&tile, source, stride, left);
                let [a, b, c, d, e, f, g, h] = E::transposed(rows);
                let [a, b, c, d, e, f] =
                    if left == first { [a, b, c, d, e, f] } else { [c, d, e, f, g, h] };
                let to = &mut to[top * down + first * right..];
                let (own, next) = impulses[3 * first..].split_at(9);
                put_three([a, b, c], own, to, [down, right]);
                put_three([d, e, f], next, &mut to[3 * right..], [down, right]);
            }
        }
    }
}

/// Writes what three inputs of a ball joint give, from eight numbers of each of its columns.
#[inline(always)]
fn put_three<E: Eight>(
    [x, y, z]: [E; 3],
    impulses: &[InputImpulse],
    to: &mut [f64],
    [down, right]: [usize; 2],
) {
    for (k, by) in impulses.chunks_exact(3).take(3).enumerate() {
        let sum = x.scaled(by[0].residual).plus(y.scaled(by[1].residual));
        let sum = sum.plus(z.scaled(by[2].residual));
        let to = &mut to[k * right..];
        if down == 1 {
            sum.put_list(to);
            continue;
        }
        let mut numbers = Block::ZERO;
        sum.put(&mut numbers);
        to.iter_mut().step_by(down).zip(numbers.0).for_each(|(to, number)| *to = number);
    }
}

/// Where tiles begin that cover so many rows or columns, at least those of one: the last one overlaps with the one
/// before.
#[inline(always)]
fn tiles(count: usize) -> impl Iterator<Item = usize> {
    (0..count).step_by(TILE).map(move |first| first.min(count - TILE))
}

/// What three inputs give to the residual of a ball joint, a column for each, where the list begins with these.
fn of_ball(impulses: &[InputImpulse]) -> Option<Mat3> {
    let nine = impulses.first_chunk::<9>()?;
    let [first, ..] = nine;
    let is_in_place = |(k, impulse): (usize, &InputImpulse)| {
        impulse.input == first.input + k / 3 && impulse.coordinate == first.coordinate + k % 3
    };
    let column = |k: usize| Vec3([0, 1, 2].map(|a| nine[k + a].residual));
    nine.iter().enumerate().all(is_in_place).then(|| Mat3([column(0), column(3), column(6)]))
}

/// Whether each input acts on one coordinate of its own, one after the other: then their columns are those of momenta.
fn is_straight(impulses: &[InputImpulse]) -> bool {
    impulses.windows(2).all(|pair| {
        pair[1].input == pair[0].input + 1 && pair[1].coordinate == pair[0].coordinate + 1
    })
}

/// Whether the inputs are those of ball joints, one joint after the other, and nothing else.
fn are_of_balls(impulses: &[InputImpulse]) -> bool {
    let mut all = impulses.chunks(9).zip(0..);
    let Some(first) = impulses.first() else { return false };
    all.all(|(of_joint, k)| {
        let Some(own) = of_joint.first() else { return false };
        own.input == 3 * k
            && own.coordinate == first.coordinate + 3 * k
            && of_ball(of_joint).is_some()
    })
}

impl Linearization {
    /// Writes [`Linearization::a`] over `out`, without allocation: `4 (nd + nk)²` numbers.
    ///
    /// # Panics
    ///
    /// If `out` has another length.
    pub fn a_into(&self, out: &mut [f64], layout: Layout) {
        let (nd, nk, stride) = (self.nd, self.nk, self.stride);
        let (n, state_columns) = (nd + nk, self.next_columns());
        let mut a = Target::new(out, layout, [2 * n; 2]);
        if nk > 0 {
            a.clear();
        }
        let turned = || self.ends.turnings.iter().filter(|t| t.coordinate < nd);
        let is_tiled = nd >= TILE && nk == 0 && layout == Layout::Columns;
        if is_tiled && 6 * self.ends.turnings.len() > nd {
            let (to, apart) = (&mut a.numbers[..], a.rows);
            let (size, turnings) = ([nd, state_columns], &self.ends.turnings[..]);
            let source = &self.increment[..];
            in_eights(TransposeTurned { to, apart, source, stride, size, turnings });
        } else {
            let mut next = 0;
            for t in turned() {
                let (first, i) = (next, t.coordinate);
                let source = &self.increment[first * stride..];
                a.copy(source, stride, [i - first, state_columns], [first, 0]);
                let source = &self.increment[i * stride..];
                a.copy_turned(&t.to_end, source, stride, state_columns, [i, 0]);
                next = i + 3;
            }
            let rest = &self.increment[next * stride..];
            a.copy(rest, stride, [nd - next, state_columns], [next, 0]);
        }
        a.copy(&self.momentum, stride, [nd, state_columns], [n, 0]);
        for t in turned() {
            let i = t.coordinate;
            a.add_block(&t.carried, [i, i]);
            (i..i + 3).for_each(|i| *a.at(i, i) -= 1.0);
        }
        (0..nd).for_each(|i| *a.at(i, i) += 1.0);
        for k in 0..nk {
            *a.at(n + nd + k, nd + k) = -1.0 / self.ends.time_step_s;
        }
        for t in self.ends.turnings.iter().filter(|t| t.coordinate >= nd) {
            let i = t.coordinate;
            a.put_block(&t.momentum.transpose().scaled(-1.0 / self.ends.time_step_s), [n + i, i]);
        }
    }

    /// Writes `B` of a step where all inputs are those of ball joints, tile by tile: whether it is so.
    fn put_inputs_of_balls(&self, b: &mut Target<'_>) -> bool {
        let (nd, stride, impulses) = (self.nd, self.stride, &self.ends.inputs[..]);
        let is_plain = self.kind == Kind::Step && self.nk == 0 && impulses.len() == 3 * self.ni;
        let is_large = nd >= TILE && self.ni >= TILE;
        if !is_plain || !is_large || !are_of_balls(impulses) {
            return false;
        }
        let steps = match b.layout {
            Layout::Rows => [b.columns, 1],
            Layout::Columns => [1, b.rows],
        };
        let first = nd + impulses[0].coordinate;
        let turned = &self.ends.turnings[..];
        for (rows, top, turnings) in [(&self.increment, 0, turned), (&self.momentum, nd, &[])] {
            let (to, source) = (&mut b.numbers[top * steps[0]..], &rows[first..]);
            in_eights(TimesBalls { to, steps, source, stride, count: nd, impulses, turnings });
        }
        for InputImpulse { input, coordinate, residual, momentum } in impulses {
            *b.at(nd + coordinate, *input) += momentum - residual;
        }
        true
    }

    /// Writes [`Linearization::b`] over `out`, without allocation: `2 (nd + nk) (ni + nk)` numbers.
    ///
    /// # Panics
    ///
    /// If `out` has another length.
    pub fn b_into(&self, out: &mut [f64], layout: Layout) {
        let (nd, nk, ni, stride) = (self.nd, self.nk, self.ni, self.stride);
        let n = nd + nk;
        let mut b = Target::new(out, layout, [2 * n, ni + nk]);
        if self.put_inputs_of_balls(&mut b) {
            return;
        }
        b.clear();
        if self.kind == Kind::Step {
            let mut rest = &self.ends.inputs[..];
            if let Some(first) = rest.first().filter(|_| is_straight(rest)) {
                let place = [first.coordinate, first.input];
                for (rows, top) in [(&self.increment, 0), (&self.momentum, n)] {
                    b.copy_times(&rows[n + place[0]..], stride, nd, rest, [top, place[1]]);
                }
                for InputImpulse { input, coordinate, residual, momentum } in rest {
                    *b.at(n + coordinate, *input) += momentum - residual;
                }
                rest = &[];
            }
            while let Some(impulse) = rest.first() {
                let (column, input) = (n + impulse.coordinate, impulse.input);
                let of_ball = of_ball(rest);
                for (rows, first) in [(&self.increment, 0), (&self.momentum, n)] {
                    let (source, place) = (&rows[column..], [first, input]);
                    match &of_ball {
                        Some(by) => b.add_columns(by, source, stride, nd, place),
                        None => b.add_column(impulse.residual, source, stride, nd, place),
                    }
                }
                let (done, next) = rest.split_at(if of_ball.is_some() { 9 } else { 1 });
                for &InputImpulse { input, coordinate, residual, momentum } in done {
                    *b.at(n + coordinate, input) += momentum - residual;
                }
                rest = next;
            }
        } else if ni > 0 {
            b.copy(&self.driven, ni, [nd, ni], [0, 0]);
            b.copy(&self.driven[(nd + self.constraints()) * ni..], ni, [nd, ni], [n, 0]);
        }
        if nd > 0 {
            let next = self.next_columns();
            b.copy(&self.increment[next..], stride, [nd, nk], [0, ni]);
            b.copy(&self.momentum[next..], stride, [nd, nk], [n, ni]);
        }
        for k in 0..nk {
            *b.at(nd + k, ni + k) = 1.0;
            *b.at(n + nd + k, ni + k) = 1.0 / self.ends.time_step_s;
        }
        for t in &self.ends.turnings {
            let i = t.coordinate;
            if i < nd {
                b.turn_rows(&t.to_end, i);
            } else {
                b.put_block(&t.momentum.scaled(1.0 / self.ends.time_step_s), [n + i, ni + i - nd]);
            }
        }
        for &column in &self.ends.replaced {
            (0..2 * n).for_each(|row| *b.at(row, column) = 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::integrator::settings::Settings;
    use crate::lagrangian::samples;
    use crate::linearization::derivative::StepDerivative;
    use crate::model::mechanism::Model;
    use crate::plant::facade::Plant;
    use plantd_math::sparse_map::Map;
    use plantd_scene::{Input, builtin};

    fn models() -> Vec<Model> {
        let names = ["cart-pole", "chain-8", "marionette", "balls-3", "balls-4", "walker-2"];
        let builtin = names.map(|name| Model::compile(&builtin::scene(name).unwrap()).unwrap());
        samples::models().into_iter().chain(builtin).collect()
    }

    #[test]
    fn both_layouts_hold_the_same_matrices() {
        for model in models().into_iter().map(Arc::new) {
            for order in [2, 4] {
                let settings = Settings { order, ..Settings::new(&model) };
                let Ok(mut plant) = Plant::new(Arc::clone(&model), settings) else { continue };
                let mut u = vec![0.0; model.dimensions.input()];
                plant.hold_input(&mut u);
                let mut out = Linearization::new(&model);
                if plant.linearize(&u, &mut out).is_err() {
                    continue;
                }
                let (a, b) = (out.a(), out.b());
                let mut numbers = vec![f64::NAN; a.len()];
                out.a_into(&mut numbers, Layout::Rows);
                let name = &model.scene.name;
                assert_eq!(a, DMatrix::from_row_slice(a.nrows(), a.ncols(), &numbers), "{name}");
                let mut numbers = vec![f64::NAN; b.len()];
                out.b_into(&mut numbers, Layout::Rows);
                assert_eq!(b, DMatrix::from_row_slice(b.nrows(), b.ncols(), &numbers), "{name}");
                // Linear-quadratic problems get both row by row.
                let mut map = Map::default();
                out.write_map(&mut map);
                let (mut packed, mut next) = (Vec::new(), vec![0.0; a.nrows()]);
                for j in 0..a.ncols() + b.ncols() {
                    let unit = |i: usize| if i == j { 1.0 } else { 0.0 };
                    let x: Vec<f64> = (0..a.ncols()).map(unit).collect();
                    let u: Vec<f64> = (0..b.ncols()).map(|k| unit(a.ncols() + k)).collect();
                    map.apply(&x, &u, &mut packed, &mut next);
                    let column = if j < a.ncols() { a.column(j) } else { b.column(j - a.ncols()) };
                    assert!(next.iter().eq(column.iter()), "{name}");
                }
            }
        }
    }

    /// Of trees of ball joints with three motors each, tile by tile, against products by the elimination.
    #[test]
    fn inputs_of_balls_act_as_products_say() {
        for (count, driven) in [(3, 0..9), (4, 0..12), (5, 3..15), (5, 0..14), (8, 0..24)] {
            let mut scene = builtin::scene(&format!("balls-{count}")).unwrap();
            for i in driven {
                let name = format!("box{}_r{}", i / 3, ["x", "y", "z"][i % 3]);
                let gain = 1.0 + 0.1 * i as f64;
                let input = Input {
                    name: format!("torque{i}"),
                    coordinate: Some(name),
                    gain,
                    ..Input::default()
                };
                scene.inputs.push(input);
            }
            let model = Arc::new(Model::compile(&scene).unwrap());
            let ni = model.dimensions.input();
            let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
            let u: Vec<f64> = (0..ni).map(|i| (i as f64).sin()).collect();
            for _ in 0..20 {
                plant.step(&u).unwrap();
            }
            let (mut out, mut products) = (Linearization::new(&model), StepDerivative::new(&model));
            plant.linearize(&u, &mut out).unwrap();
            plant.differentiate(&u, &mut products).unwrap();
            let b = out.b();
            let mut by_rows = vec![f64::NAN; b.len()];
            out.b_into(&mut by_rows, Layout::Rows);
            assert_eq!(b, DMatrix::from_row_slice(b.nrows(), ni, &by_rows), "{count}");
            for k in 0..ni {
                let unit: Vec<f64> = (0..ni).map(|i| f64::from(u8::from(i == k))).collect();
                let mut next = vec![f64::NAN; b.nrows()];
                products.push_forward(&vec![0.0; b.nrows()], &unit, &mut next);
                let column = DVector::from_vec(next);
                let off = (&column - b.column(k)).amax() / column.amax();
                assert!(off < 1e-13, "{count}, input {k}: {off:e}");
            }
        }
    }

    #[test]
    #[should_panic(expected = "the matrix has 2 rows of 2 numbers, not 3")]
    fn a_matrix_of_another_size_is_refused() {
        let model = Model::compile(&builtin::scene("pendulum").unwrap()).unwrap();
        Linearization::new(&model).a_into(&mut [0.0; 3], Layout::Columns);
    }
}
