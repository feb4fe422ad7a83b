//! What a linearization keeps of an elimination: of each axis and of each group.

use plantd_math::eights::Eight;
use plantd_math::spatial::Mat3;
use plantd_math::unrolled;

use crate::kkt::planar::Diagonals;
use crate::kkt::space::lines::{InLine, Line, combined};
use crate::kkt::space::vectors::{Margin, Vectors};
use crate::kkt::space::{Both, Group, GroupKind, SpatialRecursion, Square, Watch};
use crate::lagrangian::generators::Generators;
use crate::lagrangian::turning::Turning;

/// What the axes of a group have among themselves, with what is below them.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Among {
    /// `G`.
    pub(super) residual: Square,
    /// Of the momentum, by the start and by the increment.
    pub(super) by_start: Square,
    pub(super) by_increment: Square,
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

/// What is kept of an elimination.
#[derive(Clone, Debug)]
pub(super) struct Margins<const B: usize> {
    /// Of axes.
    pub(super) axes: Vec<Margin<Line<B>>>,
    /// Of groups.
    pub(super) among: Vec<Among>,
}

impl<const B: usize> Margins<B> {
    pub(super) fn new(recursion: &SpatialRecursion<B>) -> Self {
        Self {
            axes: vec![Margin::default(); recursion.axes.len()],
            among: vec![Among::default(); recursion.groups.len()],
        }
    }
}

/// What joints have of themselves: springs, dampers and forces of coordinates, and balls.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Own<'a> {
    pub(crate) diagonals: &'a Diagonals,
    pub(crate) turnings: &'a [Turning],
    pub(crate) balls: &'a [OfBall],
}

/// Takes them from an elimination.
pub(super) struct Keep<'a, const B: usize> {
    pub(super) kept: &'a mut Margins<B>,
    pub(super) vectors: Vectors<'a>,
    pub(super) own: Own<'a>,
}

impl<E: Eight, const B: usize> Watch<E, B> for Keep<'_, B> {
    #[inline(always)]
    fn see<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        axes: &[Generators<Line<B>>],
        sums: Option<Both<'_, E, U>>,
    ) {
        let Self { kept, vectors, own } = self;
        let first = group.axes.start;
        let margins = &mut kept.axes[group.axes.clone()];
        let among = &mut kept.among[at];
        match group.kind {
            GroupKind::Single => {}
            GroupKind::Ball(ball) => {
                let (turning, weights) = (&own.turnings[ball], &vectors.added.balls[ball]);
                let all = vectors.margins_of_ball::<E, U>(first, turning, weights);
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
                        let [k, l, m] = vectors.moved_ball::<E, U>(first, &own.turnings[ball]);
                        k.put(a);
                        l.put(b);
                        m.put(c);
                    }
                    (_, [own, ..]) => vectors.moved::<E, U>(first).put(own),
                    _ => {}
                }
                let Some(sums) = sums else { return };
                for Margin { carry, push, above, below } in margins {
                    for (above, below) in [(above, below), (carry, push)] {
                        InLine::of(below).plus(combined(sums.columns, above)).put(below);
                    }
                }
                return;
            }
        }
        for (i, margin) in group.axes.clone().zip(&mut *margins) {
            vectors.margin::<E, U>(i).put(margin);
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
fn write_among<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    margins: &mut [Margin<Line<B>>],
    [residual, by_start, by_increment]: [&[f64]; 3],
    among: &mut Among,
    sums: Option<Both<'_, E, U>>,
) {
    unrolled!(3, a < W, {
        let [minus, plus] = [InLine::<E, U>::of(&axes[a].minus), InLine::of(&axes[a].plus)];
        let [carry, above] = [InLine::<E, U>::of(&margins[a].carry), InLine::of(&margins[a].above)];
        unrolled!(3, b < W, {
            if b >= a {
                let below = InLine::of(&margins[b].below);
                among.residual[a][b] = minus.dot(below);
                among.by_start[a][b] = carry.dot(below);
                among.by_increment[a][b] = carry.dot(InLine::of(&axes[b].upper));
            }
            if b > a {
                let push = InLine::of(&margins[b].push);
                among.residual[b][a] = above.dot(InLine::of(&axes[b].lower));
                among.by_start[b][a] = above.dot(push);
                among.by_increment[b][a] = plus.dot(push);
            }
        });
        among.residual[a][a] += residual[a];
        among.by_start[a][a] += by_start[a];
        among.by_increment[a][a] += by_increment[a];
    });
    if let Some(sums) = sums {
        include(axes, margins, among, sums);
    }
}

/// Adds what is below.
#[inline(always)]
fn include<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    margins: &mut [Margin<Line<B>>],
    among: &mut Among,
    sums: Both<'_, E, U>,
) {
    unrolled!(3, b < W, {
        let above = combined(sums.columns, &margins[b].above);
        let plus = combined(sums.columns, &axes[b].plus);
        unrolled!(3, a < W, {
            let carry = InLine::<E, U>::of(&margins[a].carry);
            among.residual[a][b] += InLine::of(&axes[a].minus).dot(above);
            among.by_start[a][b] += carry.dot(above);
            among.by_increment[a][b] += carry.dot(plus);
        });
        let Margin { carry, push, below, .. } = &mut margins[b];
        InLine::of(below).plus(above).put(below);
        InLine::of(push).plus(combined(sums.rows, carry)).put(push);
    });
}
