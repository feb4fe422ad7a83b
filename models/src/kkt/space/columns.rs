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
//! A joint whose motion is prescribed has no row and, for each axis, two columns. Each of its ends takes the midpoint half as far, and
//! the velocity by `∓1/h`, which is what an increment does, and the same with the other sign: `above` and `below` are
//! `minus` and `lower` by its position at the start, `plus` and `upper` by the next one. A ball joint turns its midpoint
//! and changes its velocity by the maps of [`Turning`] in place of a half and `∓1/h`.

use std::ops::Range;

use plantd_math::eights::{Eight, InEights, UNITS, in_eights};
use plantd_math::rows::{Block, LANES};
use plantd_math::spatial::Mat3;
use plantd_math::tree_lu::SmallestPivot;

use crate::kkt::planar::Diagonals;
use crate::kkt::space::lines::{InLine, Line, combined};
use crate::kkt::space::vectors::{Margin, Vectors};
use crate::kkt::space::{
    Added, Factor, Fork, Group, GroupKind, Limb, SpatialRecursion, Sums, WIDEST, Watch,
};
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::generators::{Generators, MatrixKind, Step};
use crate::lagrangian::turning::Turning;
use crate::model::mechanism::Model;

/// A matrix of the axes of a group, by rows.
type Square = [[f64; WIDEST]; WIDEST];

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
pub(crate) struct Columns<const B: usize> {
    margins: Vec<Margin<Line<B>>>,
    among: Vec<Among>,
    /// `F̂` where limbs meet, zero but within a pass, and `T` there.
    flows: Vec<[[Block; 8]; B]>,
    motions: Vec<[[Block; 8]; B]>,
    increment: Vec<Block>,
    momentum: Vec<Block>,
}

/// The unit of a column, where it is one of a block.
#[inline(always)]
fn unit<E: Eight>(column: usize, first: usize) -> Option<E> {
    UNITS.get(column.wrapping_sub(first)).map(|unit| E::of(unit))
}

/// What flows through a joint: for each number of a vector, that of each column.
type Flow<E, const B: usize> = [[E; 8]; B];

/// The product of a vector with each column.
#[inline(always)]
fn product<E: Eight, const B: usize>(line: &Line<B>, flow: &Flow<E, B>) -> E {
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
fn add<E: Eight, const B: usize>(flow: &mut Flow<E, B>, line: &Line<B>, times: E) {
    for (flow, block) in flow.iter_mut().zip(&line.0) {
        for (own, entry) in flow.iter_mut().zip(&block.0) {
            *own = own.plus(times.scaled(*entry));
        }
    }
}

/// Adds what a joint that is moved gives to its two columns.
#[inline(always)]
fn add_moved<E: Eight, const B: usize>(
    flow: &mut Flow<E, B>,
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

#[inline(always)]
fn of_blocks<E: Eight, const B: usize>(blocks: &Flow<Block, B>) -> Flow<E, B> {
    let mut all = [[E::ZERO; 8]; B];
    for (all, blocks) in all.iter_mut().zip(blocks) {
        for (own, block) in all.iter_mut().zip(blocks) {
            *own = E::of(block);
        }
    }
    all
}

impl<const B: usize> Columns<B> {
    /// Room for a linearization by a recursion.
    pub(crate) fn new(recursion: &SpatialRecursion<B>) -> Self {
        let SpatialRecursion { axes, groups, flows, .. } = recursion;
        let (joints, places) = (axes.len(), flows.len());
        Self {
            margins: vec![Margin::default(); joints],
            among: vec![Among::default(); groups.len()],
            flows: vec![[[Block::ZERO; 8]; B]; places],
            motions: vec![[[Block::ZERO; 8]; B]; places],
            increment: vec![Block::ZERO; joints],
            momentum: vec![Block::ZERO; joints],
        }
    }

    /// From the joints of the columns to the root: `F̂`, `x̂`, and what they give to the momentum.
    #[inline(always)]
    fn go_up<E: Eight>(&mut self, recursion: &SpatialRecursion<B>, first: usize) {
        let SpatialRecursion { limbs, groups, axes, within, .. } = recursion;
        let n = axes.len();
        let has = |reach: &Range<usize>, more: usize| {
            reach.start < reach.end
                && reach.start + more < first + LANES
                && first < reach.end + more
        };
        for Limb { groups: own, carries, hangs_from } in limbs {
            let mut flow = [[E::ZERO; 8]; B];
            if let Some(place) = *carries {
                flow = of_blocks(&self.flows[place]);
                self.flows[place] = [[Block::ZERO; 8]; B];
            }
            let mut any = false;
            for at in own.clone() {
                let Group { axes: range, rows, kind, reach } = &groups[at];
                any = any || reach.iter().any(|reach| has(reach, 0) || has(reach, n));
                let (start, margins) = (rows.start, &self.margins[range.clone()]);
                if let GroupKind::Prescribed(_) = kind {
                    for (own, column) in margins.iter().zip(start..) {
                        let vectors = [&own.below, &own.push];
                        add_moved(&mut flow, vectors, [column, n + column], first);
                    }
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
                let all = self.flows[*place].as_flattened_mut().iter_mut();
                for (all, own) in all.zip(flow.as_flattened()) {
                    E::of(all).plus(*own).put(all);
                }
            }
        }
    }

    /// From the root to the leaves: `T`, and the derivatives themselves.
    #[inline(always)]
    fn go_down<E: Eight>(
        &mut self,
        recursion: &SpatialRecursion<B>,
        first: usize,
        rows: &mut Rows<'_>,
    ) {
        let SpatialRecursion { limbs, groups, axes, .. } = recursion;
        let n = axes.len();
        for Limb { groups: own, carries, hangs_from, .. } in limbs.iter().rev() {
            let mut motion = match hangs_from {
                Some(fork) => of_blocks(&self.motions[fork.place]),
                None => [[E::ZERO; 8]; B],
            };
            for at in own.clone().rev() {
                let Group { axes: range, rows: own, kind, .. } = &groups[at];
                let (start, margins) = (own.start, &self.margins[range.clone()]);
                if let GroupKind::Prescribed(_) = kind {
                    for (own, column) in margins.iter().zip(start..) {
                        let vectors = [&own.above, &own.carry];
                        add_moved(&mut motion, vectors, [column, n + column], first);
                    }
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
                let all = self.motions[*place].as_flattened_mut().iter_mut();
                for (to, own) in all.zip(motion.as_flattened()) {
                    own.put(to);
                }
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
    fn lift<E: Eight, const W: usize>(
        self,
        axes: [&Generators<Line<B>>; W],
        flow: &mut Flow<E, B>,
    ) {
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
    fn lower<E: Eight, const W: usize>(
        self,
        axes: [&Generators<Line<B>>; W],
        motion: &mut Flow<E, B>,
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
struct Keep<'a, const B: usize> {
    columns: &'a mut Columns<B>,
    vectors: Vectors<'a>,
    own: Own<'a>,
}

impl<E: Eight, const B: usize> Watch<E, B> for Keep<'_, B> {
    #[inline(always)]
    fn see(
        &mut self,
        at: usize,
        group: &Group,
        axes: &[Generators<Line<B>>],
        sums: Option<&Sums<E, B>>,
    ) {
        let Self { columns, vectors, own } = self;
        let first = group.axes.start;
        let margins = &mut columns.margins[group.axes.clone()];
        let among = &mut columns.among[at];
        match group.kind {
            GroupKind::Single => {}
            GroupKind::Ball(ball) => {
                let (turning, weights) = (&own.turnings[ball], &vectors.added.balls[ball]);
                let all = vectors.margins_of_ball::<E, B>(first, turning, weights);
                for (own, margin) in all.into_iter().zip(&mut *margins) {
                    own.put(margin);
                }
                among.take(&own.balls[ball]);
                if let ([a, b, c], Some(sums)) = (axes, sums) {
                    include([a, b, c], margins, among, sums);
                }
                return;
            }
            GroupKind::Prescribed(ball) => {
                match (ball, &mut *margins) {
                    (Some(ball), [a, b, c]) => {
                        let [k, l, m] = vectors.moved_ball::<E, B>(first, &own.turnings[ball]);
                        k.put(a);
                        l.put(b);
                        m.put(c);
                    }
                    (_, [own, ..]) => vectors.moved::<E, B>(first).put(own),
                    _ => {}
                }
                let Some(sums) = sums else { return };
                for Margin { carry, push, above, below } in margins {
                    for (above, below) in [(above, below), (carry, push)] {
                        InLine::of(below).plus(combined(&sums.columns, above)).put(below);
                    }
                }
                return;
            }
        }
        for (i, margin) in group.axes.clone().zip(&mut *margins) {
            vectors.margin::<E, B>(i).put(margin);
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

impl<E: Eight, const B: usize> Margin<InLine<E, B>> {
    /// To memory.
    #[inline(always)]
    fn put(self, to: &mut Margin<Line<B>>) {
        self.carry.put(&mut to.carry);
        self.push.put(&mut to.push);
        self.above.put(&mut to.above);
        self.below.put(&mut to.below);
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
fn write_among<E: Eight, const B: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    margins: &mut [Margin<Line<B>>],
    [residual, by_start, by_increment]: [&[f64]; 3],
    among: &mut Among,
    sums: Option<&Sums<E, B>>,
) {
    for a in 0..W {
        let [minus, plus] = [InLine::<E, B>::of(&axes[a].minus), InLine::of(&axes[a].plus)];
        let [carry, above] = [InLine::<E, B>::of(&margins[a].carry), InLine::of(&margins[a].above)];
        for b in a..W {
            let below = InLine::of(&margins[b].below);
            among.residual[a][b] = minus.dot(below);
            among.by_start[a][b] = carry.dot(below);
            among.by_increment[a][b] = carry.dot(InLine::of(&axes[b].upper));
        }
        for b in a + 1..W {
            let push = InLine::of(&margins[b].push);
            among.residual[b][a] = above.dot(InLine::of(&axes[b].lower));
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
fn include<E: Eight, const B: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    margins: &mut [Margin<Line<B>>],
    among: &mut Among,
    sums: &Sums<E, B>,
) {
    for b in 0..W {
        let above = combined(&sums.columns, &margins[b].above);
        let plus = combined(&sums.columns, &axes[b].plus);
        for a in 0..W {
            let carry = InLine::<E, B>::of(&margins[a].carry);
            among.residual[a][b] += InLine::of(&axes[a].minus).dot(above);
            among.by_start[a][b] += carry.dot(above);
            among.by_increment[a][b] += carry.dot(plus);
        }
        let Margin { carry, push, below, .. } = &mut margins[b];
        InLine::of(below).plus(above).put(below);
        InLine::of(push).plus(combined(&sums.rows, carry)).put(push);
    }
}

/// A factorization and the columns.
struct Linearize<'a, const B: usize> {
    recursion: &'a mut SpatialRecursion<B>,
    columns: &'a mut Columns<B>,
    vectors: Vectors<'a>,
    own: Own<'a>,
    inertia: &'a [f64],
    rows: Rows<'a>,
}

impl<const B: usize> InEights for Linearize<'_, B> {
    type Output = SmallestPivot;

    #[inline(always)]
    fn run<E: Eight>(self) -> SmallestPivot {
        let Self { recursion, columns, vectors, own, inertia, mut rows } = self;
        let mut keep = Keep { columns, vectors, own };
        let recursion = &mut *recursion;
        let factor = Factor { recursion: &mut *recursion, vectors, inertia };
        let pivot = factor.watched::<E>(&mut keep);
        let recursion = &*recursion;
        for first in (0..2 * recursion.axes.len()).step_by(LANES) {
            columns.go_up::<E>(recursion, first);
            columns.go_down::<E>(recursion, first, &mut rows);
        }
        pivot
    }
}

impl<const B: usize> SpatialRecursion<B> {
    /// Whether a linearization takes less time by columns than with so many entries in each triangle of the Newton
    /// matrix. What forks cost is in the number of limbs. Of the time entry by entry it took:
    ///
    /// ```text
    /// entries over joints and limbs      tree-7 1.2   tree-15 1.6   tree-30 2.1   tree-63 2.5   tree-127 3.1
    /// time                                      1.5           1.5          1.4           1.5            1.45
    /// entries over joints and limbs      arm of 7 hinges 3.5   balls-3 3   walker-2 4.6   walker-4 5.1   chain-8 4
    /// time                                             0.9           0.8            0.7            0.7         0.85
    /// and with vectors of two blocks     chain-8 4   quadruped 4.3   rope of 16 8   rope of 32 16
    /// time                                    1.05             1.2           0.75            0.43
    /// ```
    fn is_faster_by_columns(&self, entries: usize) -> bool {
        let least = if B == 1 { 31 } else { 48 };
        10 * entries > least * (self.axes.len() + self.limbs.len())
    }
}

/// A recursion and its columns.
#[derive(Clone, Debug)]
pub(crate) struct WithColumns<const B: usize> {
    recursion: SpatialRecursion<B>,
    columns: Columns<B>,
}

impl<const B: usize> WithColumns<B> {
    fn new(model: &Model) -> Self {
        let recursion = SpatialRecursion::new(model);
        Self { columns: Columns::new(&recursion), recursion }
    }

    /// Factors as [`SpatialRecursion::factor`] does, and writes the derivatives of the increment and of the momentum by
    /// configuration and momentum, into rows of whole blocks.
    #[inline(never)]
    fn linearize(
        &mut self,
        vectors: Vectors<'_>,
        own: Own<'_>,
        inertia: &[f64],
        rows: Rows<'_>,
    ) -> SmallestPivot {
        let Self { recursion, columns } = self;
        in_eights(Linearize { recursion, columns, vectors, own, inertia, rows })
    }
}

/// A linearization by generators in space, whatever steps are solved by.
#[derive(Clone, Debug)]
pub(crate) enum InSpace {
    OfBodies(WithColumns<1>),
    WithFields(WithColumns<2>),
}

impl InSpace {
    pub(crate) fn new(model: &Model) -> Self {
        match model.has_fields() {
            false => Self::OfBodies(WithColumns::new(model)),
            true => Self::WithFields(WithColumns::new(model)),
        }
    }

    /// Whether it takes less time than with so many entries in each triangle of the Newton matrix.
    pub(crate) fn is_faster(&self, entries: usize) -> bool {
        match self {
            Self::OfBodies(own) => own.recursion.is_faster_by_columns(entries),
            Self::WithFields(own) => own.recursion.is_faster_by_columns(entries),
        }
    }

    /// Factors, and writes the derivatives of the increment and of the momentum by configuration and momentum, into
    /// rows of whole blocks.
    pub(crate) fn linearize(
        &mut self,
        (curvature, added): (&Curvature, Added<'_>),
        own: Own<'_>,
        (inertia, time_step_s): (&[f64], f64),
        rows: Rows<'_>,
    ) -> SmallestPivot {
        let vectors =
            Vectors { curvature, added, step: Step::new(time_step_s, MatrixKind::Newton) };
        match self {
            Self::OfBodies(all) => all.linearize(vectors, own, inertia, rows),
            Self::WithFields(all) => all.linearize(vectors, own, inertia, rows),
        }
    }
}
