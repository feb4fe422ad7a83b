//! All derivatives of a step of a tree in space, as many columns at a time as are in one register: eight numbers of each
//! stay there from joint to joint, which in two would be more than there are with AVX2.
//!
//! The derivatives of the residual and of the momentum at the end of a step have rows and columns of the same
//! vectors as the Newton matrix ([`generators`](crate::lagrangian::generators)). With what is below a joint and
//! what is above it, of a start `q'` and an increment `x'`,
//!
//! ```text
//! F = Σ below q' + upper x' (below it)          T = Σ above q' + plus x' (above it)
//! r'_i = minus_i · F + lower_i · T + own        p'_i = carry_i · F + push_i · T + own
//! ```
//!
//! Once what is below is eliminated, `F = F̂ + A T` with the `A` of the elimination, where `F̂` is what the columns
//! give that are below, alone. So each block of columns takes two passes: `F̂` goes up from the joints of the
//! columns, and `T` down to all others,
//!
//! ```text
//! x̂ = −D⁻¹ (minus · F̂ + G q' + p')              x' = x̂ − D⁻¹ Wᵀ T
//! p'_i = carry · F̂ + (push + Aᵀ carry) · T + (own + carry · A plus) x' + (own + carry · A above) q'
//! ```
//!
//! with `G = own + minus · A above`. A row costs 24 products and sums for a column, and 24 more if it is above the
//! joint of the column.
//!
//! A joint whose motion is prescribed has no row and, for each axis, two columns. Each of its ends takes the midpoint half as far, and
//! the velocity by `∓1/h`, which is what an increment does, and the same with the other sign: `above` and `below` are
//! `minus` and `lower` by its position at the start, `plus` and `upper` by the next one. A ball joint turns its midpoint
//! and changes its velocity by the maps of [`Turning`] in place of a half and `∓1/h`.

use std::ops::Range;

use plantd_math::eights::{Eight, InEights, UNITS};
use plantd_math::rows::Block;

use crate::kkt::space::lines::Line;
use crate::kkt::space::margins::{Among, Margins};
use crate::kkt::space::vectors::Margin;
use crate::kkt::space::{Fork, Group, GroupKind, Limb, SpatialRecursion, Square, WIDEST};
use crate::lagrangian::generators::Generators;

/// Where the derivatives of the increment and of the momentum go: rows of coordinates, `stride` apart.
pub(crate) struct Rows<'a> {
    pub(crate) increment: &'a mut [f64],
    pub(crate) momentum: &'a mut [f64],
    pub(crate) stride: usize,
}

/// Columns of the derivatives that are found at once; without room until there is need for them.
#[derive(Clone, Debug, Default)]
pub(super) struct Columns<const B: usize> {
    /// `F̂` where limbs meet, zero but within a pass, and `T` there.
    flows: Vec<[[Block; 8]; B]>,
    motions: Vec<[[Block; 8]; B]>,
    increment: Vec<Block>,
    momentum: Vec<Block>,
    /// Of each limb, its first group with some of the columns at it or below it.
    reached: Vec<usize>,
}

/// The coordinates of some columns: those of the configuration and those of the momentum.
struct Window([Range<usize>; 2]);

impl Window {
    /// Of columns that begin with `first`.
    fn new(first: usize, count: usize, coordinates: usize) -> Self {
        let of = |before: usize| {
            let at = |column: usize| column.saturating_sub(before).min(coordinates);
            at(first)..at(first + count)
        };
        Self([of(0), of(coordinates)])
    }

    /// Whether one of them is among the coordinates of a group, or of what is below it.
    #[inline(always)]
    fn is_below(&self, group: &Group) -> bool {
        let Self(windows) = self;
        let meet = |a: &Range<usize>, b: &Range<usize>| a.start.max(b.start) < a.end.min(b.end);
        group.reach.iter().any(|reach| windows.iter().any(|window| meet(reach, window)))
    }
}

/// Of groups with none of the columns at or below them.
const NOTHING: [Block; WIDEST] = [Block::ZERO; WIDEST];

/// The unit of a column, where it is one of a block.
#[inline(always)]
fn unit<E: Eight>(column: usize, first: usize) -> Option<E> {
    UNITS[..E::COUNT].get(column.wrapping_sub(first)).map(|unit| E::of(unit))
}

/// What flows through a joint: for each number of a vector, that of each column.
type Flow<E, const B: usize> = [[E; 8]; B];

/// The product of a vector with each column.
#[inline(always)]
fn product<E: Eight, const B: usize, const U: usize>(line: &Line<B>, flow: &Flow<E, U>) -> E {
    let mut sum = E::ZERO;
    for (at, (block, flow)) in line.0.iter().zip(flow).enumerate() {
        let Block([a, b, c, d, e, f, g, h]) = block;
        let [p, q, r, s, t, u, v, w] = flow;
        let one = p.scaled(*a).plus(q.scaled(*b)).plus(r.scaled(*c).plus(s.scaled(*d)));
        let own = one.plus(t.scaled(*e).plus(u.scaled(*f)).plus(v.scaled(*g).plus(w.scaled(*h))));
        sum = if at == 0 { own } else { sum.plus(own) };
    }
    sum
}

/// Adds a vector, times a number for each column.
#[inline(always)]
fn add<E: Eight, const B: usize, const U: usize>(flow: &mut Flow<E, U>, line: &Line<B>, times: E) {
    for (flow, block) in flow.iter_mut().zip(&line.0) {
        for (own, entry) in flow.iter_mut().zip(&block.0) {
            *own = own.plus(times.scaled(*entry));
        }
    }
}

/// Adds what a joint that is moved gives to its two columns.
#[inline(always)]
fn add_moved<E: Eight, const B: usize, const U: usize>(
    flow: &mut Flow<E, U>,
    vectors: [&Line<B>; 2],
    columns: [usize; 2],
    first: usize,
) {
    for (vector, column) in vectors.into_iter().zip(columns) {
        if let Some(unit) = unit::<E>(column, first) {
            add(flow, vector, unit);
        }
    }
}

/// Leaves the first block of each column alone.
#[inline(always)]
fn end<E: Eight, const B: usize>(flow: &mut Flow<E, B>) {
    for own in &mut flow[1..] {
        *own = const { [E::ZERO; 8] };
    }
}

#[inline(always)]
fn of_blocks<E: Eight, const B: usize, const U: usize>(blocks: &Flow<Block, B>) -> Flow<E, U> {
    let mut all = const { [[E::ZERO; 8]; U] };
    for (all, blocks) in all.iter_mut().zip(blocks) {
        for (own, block) in all.iter_mut().zip(blocks) {
            *own = E::of(block);
        }
    }
    all
}

impl<const B: usize> Columns<B> {
    pub(super) fn make_room(&mut self, recursion: &SpatialRecursion<B>) {
        let SpatialRecursion { axes, flows, limbs, .. } = recursion;
        let Self { flows: up, motions: down, increment, momentum, reached } = self;
        reached.resize(limbs.len(), 0);
        for flows_of_eight in [up, down] {
            flows_of_eight.resize(flows.len(), [[Block::ZERO; 8]; B]);
        }
        for numbers in [increment, momentum] {
            numbers.resize(axes.len(), Block::ZERO);
        }
    }

    /// From the joints of the columns to the root: `F̂`, `x̂`, and what they give to the momentum.
    #[inline(always)]
    fn go_up<E: Eight>(
        &mut self,
        recursion: &SpatialRecursion<B>,
        margins: &Margins<B>,
        first: usize,
    ) {
        let window = Window::new(first, E::COUNT, recursion.coordinates);
        for (at, limb) in recursion.limbs.iter().enumerate() {
            let mut groups = limb.groups.clone();
            let is_reached = |at: &usize| window.is_below(&recursion.groups[*at]);
            if !groups.end.checked_sub(1).is_some_and(|top| is_reached(&top)) {
                self.reached[at] = groups.end;
                continue;
            }
            groups.start = groups.clone().find(is_reached).unwrap_or(groups.end);
            self.reached[at] = groups.start;
            if B > 1 && limb.is_acted_on {
                self.climb::<E, B>((limb, groups), recursion, margins, first);
            } else {
                self.climb::<E, 1>((limb, groups), recursion, margins, first);
            }
        }
    }

    /// Up a limb whose vectors have `U` blocks of use, from the first group that is reached.
    #[inline(always)]
    fn climb<E: Eight, const U: usize>(
        &mut self,
        (limb, reached): (&Limb, Range<usize>),
        recursion: &SpatialRecursion<B>,
        margins: &Margins<B>,
        first: usize,
    ) {
        let SpatialRecursion { coordinates: n, groups, axes, within, .. } = recursion;
        let Limb { carries, hangs_from, .. } = limb;
        let mut flow = const { [[E::ZERO; 8]; U] };
        if let Some(place) = *carries {
            flow = of_blocks(&self.flows[place]);
            self.flows[place] = [[Block::ZERO; 8]; B];
        }
        for at in reached {
            let Group { axes: range, rows, kind, is_end, .. } = &groups[at];
            let (start, own_margins) = (rows.start, &margins.axes[range.clone()]);
            let increment = &mut self.increment[range.clone()];
            let momentum = &mut self.momentum[range.clone()];
            match kind {
                GroupKind::Prescribed(_) => {
                    for (own, column) in own_margins.iter().zip(start..) {
                        let vectors = [&own.below, &own.push];
                        add_moved(&mut flow, vectors, [column, n + column], first);
                    }
                }
                _ => {
                    let group = Lifted {
                        margins: own_margins,
                        among: &margins.among[at],
                        inverse: &within[at],
                        increment,
                        momentum,
                        columns: [start, n + start],
                        first,
                    };
                    match &axes[range.clone()] {
                        [a] => group.lift([a], &mut flow),
                        [a, b] => group.lift([a, b], &mut flow),
                        [a, b, c] => group.lift([a, b, c], &mut flow),
                        _ => {}
                    }
                }
            }
            if U > 1 && *is_end {
                end(&mut flow);
            }
        }
        if let Some(Fork { place, .. }) = hangs_from {
            let all = self.flows[*place].as_flattened_mut().iter_mut();
            for (all, own) in all.zip(flow.as_flattened()) {
                E::of(all).plus(*own).put(all);
            }
        }
    }

    /// From the root to the leaves: `T`, and the derivatives themselves.
    #[inline(always)]
    fn go_down<E: Eight>(
        &mut self,
        recursion: &SpatialRecursion<B>,
        margins: &Margins<B>,
        first: usize,
        rows: &mut Rows<'_>,
    ) {
        for (at, limb) in recursion.limbs.iter().enumerate().rev() {
            let limb = (limb, self.reached[at]);
            if B > 1 && limb.0.is_acted_on {
                self.climb_down::<E, B>(limb, recursion, margins, first, rows);
            } else {
                self.climb_down::<E, 1>(limb, recursion, margins, first, rows);
            }
        }
    }

    /// Down a limb, with the first group that is reached.
    #[inline(always)]
    fn climb_down<E: Eight, const U: usize>(
        &mut self,
        (limb, reached): (&Limb, usize),
        recursion: &SpatialRecursion<B>,
        margins: &Margins<B>,
        first: usize,
        rows: &mut Rows<'_>,
    ) {
        let SpatialRecursion { coordinates: n, groups, axes, .. } = recursion;
        let Limb { groups: own, carries, hangs_from, .. } = limb;
        let mut motion = match hangs_from {
            Some(fork) => of_blocks::<E, B, U>(&self.motions[fork.place]),
            None => const { [[E::ZERO; 8]; U] },
        };
        for at in own.clone().rev() {
            let Group { axes: range, rows: own, kind, is_end, .. } = &groups[at];
            if U > 1 && *is_end {
                end(&mut motion);
            }
            let (start, own_margins) = (own.start, &margins.axes[range.clone()]);
            if let GroupKind::Prescribed(_) = kind {
                for (own, column) in own_margins.iter().zip(start..) {
                    let vectors = [&own.above, &own.carry];
                    add_moved(&mut motion, vectors, [column, n + column], first);
                }
                continue;
            }
            let (mut increment, mut momentum) = (&NOTHING[..], &NOTHING[..]);
            if at >= reached {
                increment = &self.increment[range.clone()];
                momentum = &self.momentum[range.clone()];
            }
            let group = Lowered {
                margins: own_margins,
                among: &margins.among[at],
                increment,
                momentum,
                start,
                first,
            };
            match &axes[range.clone()] {
                [a] => group.lower([a], &mut motion, rows),
                [a, b] => group.lower([a, b], &mut motion, rows),
                [a, b, c] => group.lower([a, b, c], &mut motion, rows),
                _ => {}
            }
        }
        if let Some(place) = carries {
            let all = self.motions[*place].as_flattened_mut().iter_mut();
            for (to, own) in all.zip(motion.as_flattened()) {
                own.put(to);
            }
        }
    }
}

/// A group on the way up.
struct Lifted<'a, const B: usize> {
    margins: &'a [Margin<Line<B>>],
    among: &'a Among,
    inverse: &'a Square,
    increment: &'a mut [Block],
    momentum: &'a mut [Block],
    /// Of its first axis, by the configuration and by the momentum.
    columns: [usize; 2],
    first: usize,
}

impl<const B: usize> Lifted<'_, B> {
    #[inline(always)]
    fn lift<E: Eight, const U: usize, const W: usize>(
        self,
        axes: [&Generators<Line<B>>; W],
        flow: &mut Flow<E, U>,
    ) {
        let Self { margins, among, inverse, increment, momentum, columns, first } = self;
        let [mut residual, mut carried] = const { [[E::ZERO; W]; 2] };
        for a in 0..W {
            residual[a] = product(&axes[a].minus, flow);
            carried[a] = product(&margins[a].carry, flow);
        }
        let [by_start, by_momentum] = columns;
        for b in 0..W {
            if let Some(unit) = unit::<E>(by_start + b, first) {
                for a in 0..W {
                    residual[a] = residual[a].plus(unit.scaled(among.residual[a][b]));
                    carried[a] = carried[a].plus(unit.scaled(among.by_start[a][b]));
                }
                add(flow, &margins[b].below, unit);
            }
            if let Some(unit) = unit::<E>(by_momentum + b, first) {
                residual[b] = residual[b].plus(unit);
                carried[b] = carried[b].plus(unit);
            }
        }
        for a in 0..W {
            let mut x = residual[0].scaled(-inverse[a][0]);
            for b in 1..W {
                x = x.plus(residual[b].scaled(-inverse[a][b]));
            }
            add(flow, &axes[a].upper, x);
            x.put(&mut increment[a]);
            carried[a].put(&mut momentum[a]);
        }
    }
}

/// A group on the way down.
struct Lowered<'a, const B: usize> {
    margins: &'a [Margin<Line<B>>],
    among: &'a Among,
    increment: &'a [Block],
    momentum: &'a [Block],
    /// Its first row.
    start: usize,
    first: usize,
}

impl<const B: usize> Lowered<'_, B> {
    #[inline(always)]
    fn lower<E: Eight, const U: usize, const W: usize>(
        self,
        axes: [&Generators<Line<B>>; W],
        motion: &mut Flow<E, U>,
        rows: &mut Rows<'_>,
    ) {
        let Self { margins, among, increment, momentum, start, first } = self;
        let [mut x, mut p] = const { [[E::ZERO; W]; 2] };
        for a in 0..W {
            x[a] = E::of(&increment[a]).minus(product(&axes[a].lower, motion));
            p[a] = E::of(&momentum[a]).plus(product(&margins[a].push, motion));
        }
        for a in 0..W {
            let at = (start + a) * rows.stride + first;
            for (x, slope) in x.iter().zip(&among.by_increment[a]) {
                p[a] = p[a].plus(x.scaled(*slope));
            }
            x[a].put_list(&mut rows.increment[at..][..E::COUNT]);
            p[a].put_list(&mut rows.momentum[at..][..E::COUNT]);
            add(motion, &axes[a].plus, x[a]);
            if let Some(unit) = unit(start + a, first) {
                add(motion, &margins[a].above, unit);
            }
        }
    }
}

/// All columns of a step that is eliminated.
pub(super) struct AllColumns<'a, const B: usize> {
    pub(super) recursion: &'a SpatialRecursion<B>,
    pub(super) margins: &'a Margins<B>,
    pub(super) columns: &'a mut Columns<B>,
    pub(super) rows: Rows<'a>,
}

impl<const B: usize> InEights for AllColumns<'_, B> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { recursion, margins, columns, mut rows } = self;
        for first in (0..2 * recursion.coordinates).step_by(E::One::COUNT) {
            columns.go_up::<E::One>(recursion, margins, first);
            columns.go_down::<E::One>(recursion, margins, first, &mut rows);
        }
    }
}
