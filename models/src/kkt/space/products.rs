//! Products with the derivatives of a step of a tree in space, and with their transposes, in O(n).
//!
//! A product is what [`columns`](crate::kkt::space::columns) finds, of one column that is the sum of all: `F̂` goes up
//! and `T` down, with the numbers of the changes in place of units. Its transpose goes the same ways backwards. With
//! `z` what the increments weigh, `w` the momenta, and a bar for what each quantity weighs,
//!
//! ```text
//! up      x̄ = z + plus · T̄ + Iᵀ w             q̄ = above · T̄             T̄ += push w − D⁻¹W x̄
//! down    r̄ = −D⁻ᵀ (x̄ + upper · F̄)            q̄ += below · F̄ + Gᵀ r̄ + Sᵀ w
//!         p̄ = r̄ + w                           F̄ += minus r̄ + carry w
//! ```
//!
//! where `I` and `S` are what the momenta of a group take of its increments and of its start. About 200 flops an axis.

use plantd_math::eights::{Eight, InEights};

use crate::kkt::space::lines::{InLine, Line};
use crate::kkt::space::margins::{Among, Margins};
use crate::kkt::space::vectors::Margin;
use crate::kkt::space::{Group, GroupKind, Limbs, Passage, SpatialRecursion, Square, WIDEST};
use crate::lagrangian::generators::Generators;

/// The product of a line in memory with a flow.
#[inline(always)]
fn along<E: Eight, const B: usize, const U: usize>(line: &Line<B>, flow: InLine<E, U>) -> f64 {
    InLine::of(line).dot(flow)
}

/// A line in memory, times a number.
#[inline(always)]
fn times<E: Eight, const B: usize, const U: usize>(line: &Line<B>, factor: f64) -> InLine<E, U> {
    InLine::of(line).scaled(factor)
}

/// The product of a row of a square with numbers.
#[inline(always)]
fn row(square: &Square, a: usize, numbers: &[f64]) -> f64 {
    square[a].iter().zip(numbers).map(|(entry, number)| entry * number).sum()
}

/// The product of a column of a square with numbers.
#[inline(always)]
fn column(square: &Square, b: usize, numbers: &[f64]) -> f64 {
    square.iter().zip(numbers).map(|(row, number)| row[b] * number).sum()
}

/// What a product reads of an elimination.
#[derive(Clone, Copy)]
struct Read<'a, const B: usize> {
    axes: &'a [Generators<Line<B>>],
    within: &'a [Square],
    margins: &'a Margins<B>,
}

/// The same of a group.
struct OfGroup<'a, const B: usize> {
    axes: &'a [Generators<Line<B>>],
    inverse: &'a Square,
    margins: &'a [Margin<Line<B>>],
    among: &'a Among,
}

impl<'a, const B: usize> Read<'a, B> {
    #[inline(always)]
    fn group(self, at: usize, group: &Group) -> OfGroup<'a, B> {
        OfGroup {
            axes: &self.axes[group.axes.clone()],
            inverse: &self.within[at],
            margins: &self.margins.axes[group.axes.clone()],
            among: &self.margins.among[at],
        }
    }
}

/// Increments and momenta at the end that belong to changes.
pub(super) struct PushForward<'a, const B: usize> {
    pub(super) recursion: &'a mut SpatialRecursion<B>,
    pub(super) margins: &'a Margins<B>,
    /// Of the columns.
    pub(super) by: &'a [f64],
    pub(super) x: &'a mut [f64],
    pub(super) momentum: &'a mut [f64],
}

impl<const B: usize> InEights for PushForward<'_, B> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { recursion, margins, by, x, momentum } = self;
        let SpatialRecursion { coordinates, limbs, groups, axes, within, flows, .. } = recursion;
        let (tree, read) = (Limbs { limbs, groups }, Read { axes, within, margins });
        let (start, next) = by.split_at(*coordinates);
        let (x, momentum) = (&mut *x, &mut *momentum);
        tree.ascend::<E, B>(flows, &mut Forced { read, start, next, x, momentum });
        tree.descend::<E, B>(flows, &mut Moved { read, start, next, x, momentum });
    }
}

/// `F̂` on the way up, with `x̂` and what it gives to the momenta.
struct Forced<'a, const B: usize> {
    read: Read<'a, B>,
    start: &'a [f64],
    next: &'a [f64],
    x: &'a mut [f64],
    momentum: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for Forced<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let OfGroup { axes, inverse, margins, among } = self.read.group(at, group);
        let (start, next) = (&self.start[group.rows.clone()], &self.next[group.rows.clone()]);
        let mut above = flow;
        for (margin, start) in margins.iter().zip(start) {
            above = above.plus(times(&margin.below, *start));
        }
        if let GroupKind::Prescribed(_) = group.kind {
            for (margin, next) in margins.iter().zip(next) {
                above = above.plus(times(&margin.push, *next));
            }
            return above;
        }
        let mut residual = [0.0; WIDEST];
        for (a, (axis, margin)) in axes.iter().zip(margins).enumerate() {
            residual[a] = along(&axis.minus, flow) + row(&among.residual, a, start) + next[a];
            self.momentum[group.rows.start + a] =
                along(&margin.carry, flow) + row(&among.by_start, a, start) + next[a];
        }
        for (a, axis) in axes.iter().enumerate() {
            let x = -row(inverse, a, &residual[..axes.len()]);
            self.x[group.rows.start + a] = x;
            above = above.plus(times(&axis.upper, x));
        }
        above
    }
}

/// `T` on the way down, with the increments and momenta.
struct Moved<'a, const B: usize> {
    read: Read<'a, B>,
    start: &'a [f64],
    next: &'a [f64],
    x: &'a mut [f64],
    momentum: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for Moved<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let OfGroup { axes, margins, among, .. } = self.read.group(at, group);
        let mut below = flow;
        for (margin, start) in margins.iter().zip(&self.start[group.rows.clone()]) {
            below = below.plus(times(&margin.above, *start));
        }
        if let GroupKind::Prescribed(_) = group.kind {
            for (margin, next) in margins.iter().zip(&self.next[group.rows.clone()]) {
                below = below.plus(times(&margin.carry, *next));
            }
            return below;
        }
        let x = &mut self.x[group.rows.clone()];
        for (x, axis) in x.iter_mut().zip(axes) {
            *x -= along(&axis.lower, flow);
            below = below.plus(times(&axis.plus, *x));
        }
        for (a, momentum) in self.momentum[group.rows.clone()].iter_mut().enumerate() {
            *momentum += along(&margins[a].push, flow) + row(&among.by_increment, a, x);
        }
        below
    }
}

/// What the columns give to weighed increments and momenta at the end.
pub(super) struct PullBack<'a, const B: usize> {
    pub(super) recursion: &'a mut SpatialRecursion<B>,
    pub(super) margins: &'a Margins<B>,
    /// What increments weigh; memory of the way.
    pub(super) x: &'a mut [f64],
    pub(super) momentum: &'a [f64],
    pub(super) by: &'a mut [f64],
}

impl<const B: usize> InEights for PullBack<'_, B> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { recursion, margins, x, momentum, by } = self;
        let SpatialRecursion { coordinates, limbs, groups, axes, within, flows, .. } = recursion;
        let (tree, read) = (Limbs { limbs, groups }, Read { axes, within, margins });
        by.fill(0.0);
        let (start, next) = by.split_at_mut(*coordinates);
        let (x, start, next) = (&mut *x, &mut *start, &mut *next);
        tree.ascend::<E, B>(flows, &mut WeighedMotion { read, x, momentum, start, next });
        tree.descend::<E, B>(flows, &mut WeighedForce { read, x, momentum, start, next });
    }
}

/// `T̄` on the way up.
struct WeighedMotion<'a, const B: usize> {
    read: Read<'a, B>,
    x: &'a mut [f64],
    momentum: &'a [f64],
    start: &'a mut [f64],
    next: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for WeighedMotion<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let OfGroup { axes, margins, among, .. } = self.read.group(at, group);
        for (start, margin) in self.start[group.rows.clone()].iter_mut().zip(margins) {
            *start = along(&margin.above, flow);
        }
        if let GroupKind::Prescribed(_) = group.kind {
            for (next, margin) in self.next[group.rows.clone()].iter_mut().zip(margins) {
                *next = along(&margin.carry, flow);
            }
            return flow;
        }
        let momentum = &self.momentum[group.rows.clone()];
        let mut above = flow;
        for (a, x) in self.x[group.rows.clone()].iter_mut().enumerate() {
            *x += along(&axes[a].plus, flow) + column(&among.by_increment, a, momentum);
            above = above.plus(times(&margins[a].push, momentum[a]));
            above = above.minus(times(&axes[a].lower, *x));
        }
        above
    }
}

/// `F̄` on the way down.
struct WeighedForce<'a, const B: usize> {
    read: Read<'a, B>,
    x: &'a mut [f64],
    momentum: &'a [f64],
    start: &'a mut [f64],
    next: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for WeighedForce<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let OfGroup { axes, inverse, margins, among } = self.read.group(at, group);
        let (start, next) =
            (&mut self.start[group.rows.clone()], &mut self.next[group.rows.clone()]);
        for (start, margin) in start.iter_mut().zip(margins) {
            *start += along(&margin.below, flow);
        }
        if let GroupKind::Prescribed(_) = group.kind {
            for (next, margin) in next.iter_mut().zip(margins) {
                *next += along(&margin.push, flow);
            }
            return flow;
        }
        let (x, momentum) = (&mut self.x[group.rows.clone()], &self.momentum[group.rows.clone()]);
        for (x, axis) in x.iter_mut().zip(axes) {
            *x += along(&axis.upper, flow);
        }
        let mut residual = [0.0; WIDEST];
        for (b, residual) in residual.iter_mut().enumerate().take(x.len()) {
            *residual = -column(inverse, b, x);
        }
        let residual = &residual[..x.len()];
        let mut below = flow;
        for a in 0..residual.len() {
            start[a] += column(&among.residual, a, residual) + column(&among.by_start, a, momentum);
            next[a] = residual[a] + momentum[a];
            below = below.plus(times(&axes[a].minus, residual[a]));
            below = below.plus(times(&margins[a].carry, momentum[a]));
        }
        below
    }
}
