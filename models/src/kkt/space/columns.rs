//! The derivatives of a step of a tree in space, eight columns at a time, in whole registers.
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
//! A joint whose motion is prescribed has no row and two columns. Each of its ends takes the midpoint half as far, and
//! the velocity by `∓1/h`, which is what an increment does, and the same with the other sign: `above` and `below` are
//! `minus` and `lower` by its position at the start, `plus` and `upper` by the next one.

use std::ops::Range;

use plantd_math::eights::{Eight, InEights, UNITS, in_eights};
use plantd_math::rows::{Block, LANES};
use plantd_math::spatial::Mat3;
use plantd_math::tree_lu::SmallestPivot;

use crate::kkt::planar::Diagonals;
use crate::kkt::space::{
    Added, Factor, Fork, Group, GroupKind, Limb, SpatialRecursion, Sums, WIDEST, Watch, combined,
};
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::generators::{Flanks, Generators, Step};
use crate::lagrangian::turning::Turning;

/// A matrix of the axes of a group, by rows.
type Square = [[f64; WIDEST]; WIDEST];

/// What an axis gives to the derivatives of a step beside its generators. Of an axis whose motion is prescribed, and
/// which has no rows, `carry` and `push` are what `above` and `below` are, by its next position.
#[derive(Clone, Copy, Debug, Default)]
struct Margin {
    carry: Block,
    /// `push + Aᵀ carry`.
    push: Block,
    above: Block,
    /// `below + A above`.
    below: Block,
}

/// What the axes of a group have among themselves, with what is below them.
#[derive(Clone, Copy, Debug, Default)]
struct Among {
    /// `G`.
    residual: Square,
    /// Of the momentum, by the start and by the increment.
    by_start: Square,
    by_increment: Square,
}

/// The same of the axes of one ball joint alone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OfBall {
    pub(crate) residual: Mat3,
    pub(crate) by_start: Mat3,
    pub(crate) by_increment: Mat3,
}

impl OfBall {
    /// Nothing.
    pub(crate) const ZERO: Self =
        Self { residual: Mat3::ZERO, by_start: Mat3::ZERO, by_increment: Mat3::ZERO };
}

/// What joints have of themselves: springs, dampers and forces of coordinates, and balls.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Own<'a> {
    pub(crate) diagonals: &'a Diagonals,
    pub(crate) turnings: &'a [Turning],
    pub(crate) balls: &'a [OfBall],
}

/// Where the derivatives of the increment and of the momentum go: rows of coordinates, `stride` apart.
pub(crate) struct Rows<'a> {
    pub(crate) increment: &'a mut [f64],
    pub(crate) momentum: &'a mut [f64],
    pub(crate) stride: usize,
}

/// Eight columns of the derivatives, and what finds them.
#[derive(Clone, Debug)]
pub(crate) struct Columns {
    margins: Vec<Margin>,
    among: Vec<Among>,
    /// `F̂` where limbs meet, zero but within a pass, and `T` there.
    flows: Vec<[Block; 8]>,
    motions: Vec<[Block; 8]>,
    increment: Vec<Block>,
    momentum: Vec<Block>,
}

/// The unit of a column, where it is one of a block.
#[inline(always)]
fn unit<E: Eight>(column: usize, first: usize) -> Option<E> {
    UNITS.get(column.wrapping_sub(first)).map(|unit| E::of(unit))
}

/// The product of a vector with each column.
#[inline(always)]
fn product<E: Eight>(Block([a, b, c, d, e, f, g, h]): &Block, flow: &[E; 8]) -> E {
    let [p, q, r, s, t, u, v, w] = flow;
    let one = p.scaled(*a).plus(q.scaled(*b)).plus(r.scaled(*c).plus(s.scaled(*d)));
    one.plus(t.scaled(*e).plus(u.scaled(*f)).plus(v.scaled(*g).plus(w.scaled(*h))))
}

/// Adds a vector, times a number for each column.
#[inline(always)]
fn add<E: Eight>(flow: &mut [E; 8], vector: &Block, times: E) {
    for (own, entry) in flow.iter_mut().zip(&vector.0) {
        *own = own.plus(times.scaled(*entry));
    }
}

/// Adds what a joint that is moved gives to its two columns.
#[inline(always)]
fn add_moved<E: Eight>(flow: &mut [E; 8], vectors: [&Block; 2], columns: [usize; 2], first: usize) {
    for (vector, column) in vectors.into_iter().zip(columns) {
        if let Some(unit) = unit::<E>(column, first) {
            add(flow, vector, unit);
        }
    }
}

#[inline(always)]
fn of_blocks<E: Eight>(blocks: &[Block; 8]) -> [E; 8] {
    let mut all = [E::ZERO; 8];
    for (own, block) in all.iter_mut().zip(blocks) {
        *own = E::of(block);
    }
    all
}

impl Columns {
    /// Room for a linearization by a recursion.
    pub(crate) fn new(recursion: &SpatialRecursion) -> Self {
        let SpatialRecursion { axes, groups, flows, .. } = recursion;
        let (joints, places) = (axes.len(), flows.len());
        Self {
            margins: vec![Margin::default(); joints],
            among: vec![Among::default(); groups.len()],
            flows: vec![[Block::ZERO; 8]; places],
            motions: vec![[Block::ZERO; 8]; places],
            increment: vec![Block::ZERO; joints],
            momentum: vec![Block::ZERO; joints],
        }
    }

    /// From the joints of the columns to the root: `F̂`, `x̂`, and what they give to the momentum.
    #[inline(always)]
    fn go_up<E: Eight>(&mut self, recursion: &SpatialRecursion, first: usize) {
        let SpatialRecursion { limbs, groups, axes, within, .. } = recursion;
        let n = axes.len();
        let has = |reach: &Range<usize>, more: usize| {
            reach.start < reach.end
                && reach.start + more < first + LANES
                && first < reach.end + more
        };
        for Limb { groups: own, carries, hangs_from } in limbs {
            let mut flow = [E::ZERO; 8];
            if let Some(place) = *carries {
                flow = of_blocks(&self.flows[place]);
                self.flows[place] = [Block::ZERO; 8];
            }
            let mut any = false;
            for at in own.clone() {
                let Group { axes: range, rows, kind, reach } = &groups[at];
                any = any || reach.iter().any(|reach| has(reach, 0) || has(reach, n));
                let (start, margins) = (rows.start, &self.margins[range.clone()]);
                if let (GroupKind::Prescribed, [own]) = (kind, margins) {
                    let vectors = [&own.below, &own.push];
                    add_moved(&mut flow, vectors, [start, n + start], first);
                    continue;
                }
                let increment = &mut self.increment[range.clone()];
                let momentum = &mut self.momentum[range.clone()];
                if !any {
                    increment.fill(Block::ZERO);
                    momentum.fill(Block::ZERO);
                    continue;
                }
                let group = Lifted {
                    margins,
                    among: &self.among[at],
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
            if let (true, Some(Fork { place, .. })) = (any, hangs_from) {
                for (all, own) in self.flows[*place].iter_mut().zip(flow) {
                    E::of(all).plus(own).put(all);
                }
            }
        }
    }

    /// From the root to the leaves: `T`, and the derivatives themselves.
    #[inline(always)]
    fn go_down<E: Eight>(
        &mut self,
        recursion: &SpatialRecursion,
        first: usize,
        rows: &mut Rows<'_>,
    ) {
        let SpatialRecursion { limbs, groups, axes, .. } = recursion;
        let n = axes.len();
        for Limb { groups: own, carries, hangs_from, .. } in limbs.iter().rev() {
            let mut motion = match hangs_from {
                Some(fork) => of_blocks(&self.motions[fork.place]),
                None => [E::ZERO; 8],
            };
            for at in own.clone().rev() {
                let Group { axes: range, rows: own, kind, .. } = &groups[at];
                let (start, margins) = (own.start, &self.margins[range.clone()]);
                if let (GroupKind::Prescribed, [own]) = (kind, margins) {
                    let vectors = [&own.above, &own.carry];
                    add_moved(&mut motion, vectors, [start, n + start], first);
                    continue;
                }
                let group = Lowered {
                    margins,
                    among: &self.among[at],
                    increment: &self.increment[range.clone()],
                    momentum: &self.momentum[range.clone()],
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
                for (to, own) in self.motions[*place].iter_mut().zip(motion) {
                    own.put(to);
                }
            }
        }
    }
}

/// A group on the way up.
struct Lifted<'a> {
    margins: &'a [Margin],
    among: &'a Among,
    inverse: &'a Square,
    increment: &'a mut [Block],
    momentum: &'a mut [Block],
    /// Of its first axis, by the configuration and by the momentum.
    columns: [usize; 2],
    first: usize,
}

impl Lifted<'_> {
    #[inline(always)]
    fn lift<E: Eight, const W: usize>(self, axes: [&Generators; W], flow: &mut [E; 8]) {
        let Self { margins, among, inverse, increment, momentum, columns, first } = self;
        let [mut residual, mut carried] = [[E::ZERO; W]; 2];
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
struct Lowered<'a> {
    margins: &'a [Margin],
    among: &'a Among,
    increment: &'a [Block],
    momentum: &'a [Block],
    /// Its first row.
    start: usize,
    first: usize,
}

impl Lowered<'_> {
    #[inline(always)]
    fn lower<E: Eight, const W: usize>(
        self,
        axes: [&Generators; W],
        motion: &mut [E; 8],
        rows: &mut Rows<'_>,
    ) {
        let Self { margins, among, increment, momentum, start, first } = self;
        let [mut x, mut p] = [[E::ZERO; W]; 2];
        for a in 0..W {
            x[a] = E::of(&increment[a]).minus(product(&axes[a].lower, motion));
            p[a] = E::of(&momentum[a]).plus(product(&margins[a].push, motion));
        }
        for a in 0..W {
            let at = (start + a) * rows.stride + first;
            for (x, slope) in x.iter().zip(&among.by_increment[a]) {
                p[a] = p[a].plus(x.scaled(*slope));
            }
            x[a].put_list(&mut rows.increment[at..][..LANES]);
            p[a].put_list(&mut rows.momentum[at..][..LANES]);
            add(motion, &axes[a].plus, x[a]);
            if let Some(unit) = unit(start + a, first) {
                add(motion, &margins[a].above, unit);
            }
        }
    }
}

/// Takes from an elimination what the columns need.
struct Keep<'a> {
    columns: &'a mut Columns,
    curvature: &'a Curvature,
    step: Step,
    added: Added<'a>,
    own: Own<'a>,
}

impl<E: Eight> Watch<E> for Keep<'_> {
    #[inline(always)]
    fn see(&mut self, at: usize, group: &Group, axes: &[Generators], sums: Option<&Sums<E>>) {
        let Self { columns, curvature, step, added, own } = self;
        let first = group.axes.start;
        let margins = &mut columns.margins[group.axes.clone()];
        let among = &mut columns.among[at];
        match group.kind {
            GroupKind::Single => {}
            GroupKind::Ball(ball) => {
                let parts = step.parts_of_ball::<E>(curvature, first);
                let flanks = Flanks::of_ball(&parts, &own.turnings[ball], &added.balls[ball]);
                for (flanks, margin) in flanks.iter().zip(&mut *margins) {
                    margin.take(flanks);
                }
                among.take(&own.balls[ball]);
                if let ([a, b, c], Some(sums)) = (axes, sums) {
                    include([a, b, c], margins, among, sums);
                }
                return;
            }
            GroupKind::Prescribed => {
                margins[0].take_prescribed(&step.parts::<E>(curvature, first).generators(), sums);
                return;
            }
        }
        for (i, margin) in group.axes.clone().zip(&mut *margins) {
            margin.take(&Flanks::of(&step.parts::<E>(curvature, i)));
        }
        let Diagonals { residual, by_start, by_increment } = own.diagonals;
        let diagonals =
            [residual, by_start, by_increment].map(|diagonal| &diagonal[group.rows.clone()]);
        match axes {
            [a] => write_among([a], margins, diagonals, among, sums),
            [a, b] => write_among([a, b], margins, diagonals, among, sums),
            [a, b, c] => write_among([a, b, c], margins, diagonals, among, sums),
            _ => {}
        }
    }
}

impl Margin {
    #[inline(always)]
    fn take<E: Eight>(&mut self, flanks: &Flanks<E>) {
        flanks.carry.put(&mut self.carry);
        flanks.push.put(&mut self.push);
        flanks.above.put(&mut self.above);
        flanks.below.put(&mut self.below);
    }

    #[inline(always)]
    fn take_prescribed<E: Eight>(&mut self, own: &Generators<E>, sums: Option<&Sums<E>>) {
        let Self { carry, push, above, below } = self;
        own.minus.put(above);
        own.lower.put(below);
        own.plus.put(carry);
        own.upper.put(push);
        if let Some(sums) = sums {
            for (above, below) in [(above, below), (carry, push)] {
                E::of(below).plus(combined(&sums.columns, above)).put(below);
            }
        }
    }
}

impl Among {
    fn take(&mut self, ball: &OfBall) {
        for (to, from) in [
            (&mut self.residual, &ball.residual),
            (&mut self.by_start, &ball.by_start),
            (&mut self.by_increment, &ball.by_increment),
        ] {
            *to = from.transpose().0.map(|row| row.0);
        }
    }
}

/// What hinges, slides and screws one below the other have among themselves.
#[inline(always)]
fn write_among<E: Eight, const W: usize>(
    axes: [&Generators; W],
    margins: &mut [Margin],
    [residual, by_start, by_increment]: [&[f64]; 3],
    among: &mut Among,
    sums: Option<&Sums<E>>,
) {
    for a in 0..W {
        let [minus, plus] = [E::of(&axes[a].minus), E::of(&axes[a].plus)];
        let [carry, above] = [E::of(&margins[a].carry), E::of(&margins[a].above)];
        for b in a..W {
            let below = E::of(&margins[b].below);
            among.residual[a][b] = minus.dot(below);
            among.by_start[a][b] = carry.dot(below);
            among.by_increment[a][b] = carry.dot(E::of(&axes[b].upper));
        }
        for b in a + 1..W {
            let push = E::of(&margins[b].push);
            among.residual[b][a] = above.dot(E::of(&axes[b].lower));
            among.by_start[b][a] = above.dot(push);
            among.by_increment[b][a] = plus.dot(push);
        }
        among.residual[a][a] += residual[a];
        among.by_start[a][a] += by_start[a];
        among.by_increment[a][a] += by_increment[a];
    }
    if let Some(sums) = sums {
        include(axes, margins, among, sums);
    }
}

/// Adds what is below.
#[inline(always)]
fn include<E: Eight, const W: usize>(
    axes: [&Generators; W],
    margins: &mut [Margin],
    among: &mut Among,
    sums: &Sums<E>,
) {
    for b in 0..W {
        let above = combined(&sums.columns, &margins[b].above);
        let plus = combined(&sums.columns, &axes[b].plus);
        for a in 0..W {
            let carry = E::of(&margins[a].carry);
            among.residual[a][b] += E::of(&axes[a].minus).dot(above);
            among.by_start[a][b] += carry.dot(above);
            among.by_increment[a][b] += carry.dot(plus);
        }
        let Margin { carry, push, below, .. } = &mut margins[b];
        E::of(below).plus(above).put(below);
        E::of(push).plus(combined(&sums.rows, carry)).put(push);
    }
}

/// A factorization and the columns.
pub(super) struct Linearize<'a> {
    pub(super) recursion: &'a mut SpatialRecursion,
    pub(super) columns: &'a mut Columns,
    pub(super) curvature: &'a Curvature,
    pub(super) added: Added<'a>,
    pub(super) own: Own<'a>,
    pub(super) inertia: &'a [f64],
    pub(super) step: Step,
    pub(super) rows: Rows<'a>,
}

impl InEights for Linearize<'_> {
    type Output = SmallestPivot;

    #[inline(always)]
    fn run<E: Eight>(self) -> SmallestPivot {
        let Self { recursion, columns, curvature, added, own, inertia, step, mut rows } = self;
        let mut keep = Keep { columns, curvature, step, added, own };
        let recursion = &mut *recursion;
        let factor = Factor { recursion: &mut *recursion, curvature, added, inertia, step };
        let pivot = factor.watched::<E>(&mut keep);
        let recursion = &*recursion;
        for first in (0..2 * recursion.axes.len()).step_by(LANES) {
            columns.go_up::<E>(recursion, first);
            columns.go_down::<E>(recursion, first, &mut rows);
        }
        pivot
    }
}

impl SpatialRecursion {
    /// Whether a linearization takes less time by columns than with so many entries in each triangle of the Newton
    /// matrix. What forks cost is in the number of limbs. Of the time entry by entry it took:
    ///
    /// ```text
    /// entries over joints and limbs      tree-7 1.2   tree-15 1.6   tree-30 2.1   tree-63 2.5   tree-127 3.1
    /// time                                      1.5           1.5          1.4           1.5            1.45
    /// entries over joints and limbs      arm of 7 hinges 3.5   balls-3 3   walker-2 4.6   walker-4 5.1   chain-8 4
    /// time                                             0.9           0.8            0.7            0.7         0.85
    /// ```
    pub(crate) fn is_faster_by_columns(&self, entries: usize) -> bool {
        10 * entries > 31 * (self.axes.len() + self.limbs.len())
    }

    /// Factors as [`Self::factor`] does, and writes the derivatives of the increment and of the momentum by
    /// configuration and momentum, into rows of whole blocks.
    #[inline(never)]
    pub(crate) fn linearize(
        &mut self,
        columns: &mut Columns,
        curvature: &Curvature,
        (added, own): (Added<'_>, Own<'_>),
        (inertia, step): (&[f64], Step),
        rows: Rows<'_>,
    ) -> SmallestPivot {
        let recursion = self;
        in_eights(Linearize { recursion, columns, curvature, added, own, inertia, step, rows })
    }
}
