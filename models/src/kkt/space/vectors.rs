//! The vectors of joints, of one to three blocks.
//!
//! Without elements that act on bodies from the world or from bodies above, they are those of
//! [`generators`](crate::lagrangian::generators). With such elements the second block has, in the notation of
//! [`fields`](crate::lagrangian::fields), what goes with the axes alone:
//!
//! ```text
//! minus = plus = axis      upper = ¼h pull + ½ drag      lower = ¼h turn      and ½ back more in the first of lower
//! carry = above = 2 axis   below = ½h pull               push = ½h turn       and back more in the first of push
//! ```
//!
//! which ball joints weigh as they do rates and slopes. Of a joint that is moved, `lower` counts `¼h pull − ½ drag`.
//!
//! `back` goes with rates as well as with axes, which stand in the first blocks of `plus` and `above`. What acts from a
//! body ends there, but first blocks go on: where such an element follows velocities, there is a third block
//!
//! ```text
//! plus = above = those of the first      lower = ½ back      push = back      minus = upper = carry = below = 0
//! ```
//!
//! and `back` is in no first one.

use plantd_math::eights::Eight;
use plantd_math::spatial::Mat3;
use plantd_math::unrolled;

use crate::kkt::space::Added;
use crate::kkt::space::lines::{InLine, Line};
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::fields::{Fields, Given};
use crate::lagrangian::generators::{Flanks, Generators, Parts, Step, columns, of_ball, rows};
use crate::lagrangian::turning::{Turning, Weights};

/// What the vectors of a step are made of.
#[derive(Clone, Copy)]
pub(crate) struct Vectors<'a> {
    pub(crate) curvature: &'a Curvature,
    pub(crate) step: Step,
    pub(crate) added: Added<'a>,
}

/// What the columns of a linearization need of an axis beside its generators. Of an axis whose motion is prescribed,
/// and which has no rows, `carry` and `push` are what `above` and `below` are, by its next position.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Margin<V> {
    pub(crate) carry: V,
    /// `push + Aᵀ carry`.
    pub(crate) push: V,
    pub(crate) above: V,
    /// `below + A above`.
    pub(crate) below: V,
}

impl<E: Eight, const B: usize> Margin<InLine<E, B>> {
    /// To memory.
    #[inline(always)]
    pub(crate) fn put<const L: usize>(self, to: &mut Margin<Line<L>>) {
        self.carry.put(&mut to.carry);
        self.push.put(&mut to.push);
        self.above.put(&mut to.above);
        self.below.put(&mut to.below);
    }
}

/// `¼h pull`, `¼h turn`, `½ drag` and `½ back`.
#[derive(Clone, Copy)]
struct Pulls<E> {
    pull: E,
    turn: E,
    drag: E,
    back: E,
}

/// What the axes of a ball joint that is moved give to a column each, of its start or of what is next.
struct MovedBall<E> {
    /// Rates and axes, and these as what acts on bodies counts them.
    above: [[E; 3]; 2],
    below: [[E; 3]; 2],
}

impl<E: Eight> MovedBall<E> {
    /// By what a column makes of position and velocity: rates and slopes are those of half a turn, axes and forces
    /// those of a velocity of `1/h`.
    #[inline(always)]
    fn new(
        [p, q, r]: &[Parts<E>; 3],
        [k, l, m]: &[Pulls<E>; 3],
        (position, velocity): &(Mat3, Mat3),
        h: f64,
    ) -> Self {
        let (position, velocity) = (position.scaled(2.0), velocity.scaled(h));
        let axis = [p.axis, q.axis, r.axis];
        let (rates, slopes) = ([p.rate, q.rate, r.rate], [p.slope, q.slope, r.slope]);
        Self {
            above: [
                sums(columns(&position, &rates), columns(&velocity, &axis)),
                columns(&position, &axis),
            ],
            below: [
                sums(columns(&position, &slopes), columns(&velocity, &[p.force, q.force, r.force])),
                sums(
                    columns(&position, &[k.pull, l.pull, m.pull]),
                    columns(&velocity, &[k.drag, l.drag, m.drag]),
                ),
            ],
        }
    }

    #[inline(always)]
    fn above<const B: usize>(&self, column: usize) -> InLine<E, B> {
        let [own, axes] = &self.above;
        InLine::new(own[column], axes[column], own[column])
    }

    #[inline(always)]
    fn below<const B: usize>(&self, column: usize) -> InLine<E, B> {
        InLine::new(self.below[0][column], self.below[1][column], E::ZERO)
    }
}

#[inline(always)]
fn sums<E: Eight>(a: [E; 3], b: [E; 3]) -> [E; 3] {
    [a[0].plus(b[0]), a[1].plus(b[1]), a[2].plus(b[2])]
}

impl Vectors<'_> {
    #[inline(always)]
    fn pulls<E: Eight>(&self, joint: usize) -> Pulls<E> {
        let zero = Pulls { pull: E::ZERO, turn: E::ZERO, drag: E::ZERO, back: E::ZERO };
        let Some(Fields { given, has_rates, .. }) = self.added.fields else { return zero };
        let Given { pull, turn, drag, back } = &given[joint];
        let Step { motion, half, .. } = self.step;
        let quarter = half * motion;
        let (pull, turn) = (E::of(pull).scaled(quarter), E::of(turn).scaled(quarter));
        if !has_rates {
            return Pulls { pull, turn, ..zero };
        }
        Pulls { pull, turn, drag: E::of(drag).scaled(motion), back: E::of(back).scaled(motion) }
    }

    /// Of a hinge, a slide or a screw.
    #[inline(always)]
    pub(crate) fn single<E: Eight, const B: usize>(
        &self,
        joint: usize,
    ) -> Generators<InLine<E, B>> {
        let parts = self.step.parts::<E>(self.curvature, joint);
        let (own, axis) = (parts.generators(), parts.axis);
        if B == 1 {
            return alone(&own);
        }
        let Pulls { pull, turn, drag, back } = self.pulls::<E>(joint);
        Generators {
            minus: InLine::new(own.minus, axis, E::ZERO),
            plus: InLine::new(own.plus, axis, own.plus),
            upper: InLine::new(own.upper, pull.plus(drag), E::ZERO),
            lower: turned(own.lower, turn, back),
        }
    }

    /// Of the axes of a ball joint, and what these have among themselves.
    #[inline(always)]
    pub(crate) fn ball<E: Eight, const B: usize>(
        &self,
        first: usize,
        weights: &Weights,
    ) -> ([Generators<InLine<E, B>>; 3], [[f64; 3]; 3]) {
        let parts = self.step.parts_of_ball::<E>(self.curvature, first);
        let (own, within) = of_ball(&parts, weights);
        let mut all = [alone(&own[0]), alone(&own[1]), alone(&own[2])];
        if B == 1 {
            return (all, within);
        }
        let [p, q, r] = [self.pulls::<E>(first), self.pulls(first + 1), self.pulls(first + 2)];
        let axes = [parts[0].axis, parts[1].axis, parts[2].axis];
        let minus = rows(&weights.torque, &axes);
        let plus = columns(&weights.column, &axes);
        let pull = columns(&weights.column, &[p.pull, q.pull, r.pull]);
        let turn = rows(&weights.torque, &[p.turn, q.turn, r.turn]);
        let back = rows(&weights.torque, &[p.back, q.back, r.back]);
        let drag = [p.drag, q.drag, r.drag];
        unrolled!(3, a < 3, {
            let own = &own[a];
            all[a] = Generators {
                minus: InLine::new(own.minus, minus[a], E::ZERO),
                plus: InLine::new(own.plus, plus[a], own.plus),
                upper: InLine::new(own.upper, pull[a].plus(drag[a]), E::ZERO),
                lower: turned(own.lower, turn[a], back[a]),
            };
        });
        (all, within)
    }

    /// What a hinge, a slide or a screw gives to a linearization.
    #[inline(always)]
    pub(crate) fn margin<E: Eight, const B: usize>(&self, joint: usize) -> Margin<InLine<E, B>> {
        let parts = self.step.parts::<E>(self.curvature, joint);
        let pulls = if B == 1 { None } else { Some(self.pulls(joint)) };
        let axis = twice(parts.axis);
        margin(&Flanks::of(&parts), pulls, axis, axis)
    }

    /// What the axes of a ball joint give to it.
    #[inline(always)]
    pub(crate) fn margins_of_ball<E: Eight, const B: usize>(
        &self,
        first: usize,
        turning: &Turning,
        weights: &Weights,
    ) -> [Margin<InLine<E, B>>; 3] {
        let parts = self.step.parts_of_ball::<E>(self.curvature, first);
        let [p, q, r] = &Flanks::of_ball(&parts, turning, weights);
        if B == 1 {
            let none = E::ZERO;
            return [
                margin(p, None, none, none),
                margin(q, None, none, none),
                margin(r, None, none, none),
            ];
        }
        let [k, l, m] = [self.pulls::<E>(first), self.pulls(first + 1), self.pulls(first + 2)];
        let twice = [twice(parts[0].axis), twice(parts[1].axis), twice(parts[2].axis)];
        let above = columns(&turning.by_start.0, &twice);
        let pull = columns(&turning.by_start.0, &[k.pull, l.pull, m.pull]);
        [
            margin(p, Some(Pulls { pull: pull[0], ..k }), twice[0], above[0]),
            margin(q, Some(Pulls { pull: pull[1], ..l }), twice[1], above[1]),
            margin(r, Some(Pulls { pull: pull[2], ..m }), twice[2], above[2]),
        ]
    }

    /// What the axes of a ball joint that is moved give to it.
    #[inline(always)]
    pub(crate) fn moved_ball<E: Eight, const B: usize>(
        &self,
        first: usize,
        turning: &Turning,
    ) -> [Margin<InLine<E, B>>; 3] {
        let parts = self.step.parts_of_ball::<E>(self.curvature, first);
        let pulls = [self.pulls::<E>(first), self.pulls(first + 1), self.pulls(first + 2)];
        let h = 1.0 / self.step.inverse;
        let start = MovedBall::new(&parts, &pulls, &turning.by_start, h);
        let next = MovedBall::new(&parts, &pulls, &turning.by_next, h);
        [
            Margin {
                carry: next.above(0),
                push: next.below(0),
                above: start.above(0),
                below: start.below(0),
            },
            Margin {
                carry: next.above(1),
                push: next.below(1),
                above: start.above(1),
                below: start.below(1),
            },
            Margin {
                carry: next.above(2),
                push: next.below(2),
                above: start.above(2),
                below: start.below(2),
            },
        ]
    }

    /// What a joint that is moved gives to it.
    #[inline(always)]
    pub(crate) fn moved<E: Eight, const B: usize>(&self, joint: usize) -> Margin<InLine<E, B>> {
        let parts = self.step.parts::<E>(self.curvature, joint);
        let (own, axis) = (parts.generators(), parts.axis);
        let Pulls { pull, drag, .. } = self.pulls::<E>(joint);
        Margin {
            above: InLine::new(own.minus, axis, own.minus),
            below: InLine::new(own.lower, pull.minus(drag), E::ZERO),
            carry: InLine::new(own.plus, axis, own.plus),
            push: InLine::new(own.upper, pull.plus(drag), E::ZERO),
        }
    }
}

/// Generators of one block.
#[inline(always)]
fn alone<E: Eight, const B: usize>(own: &Generators<E>) -> Generators<InLine<E, B>> {
    Generators {
        minus: InLine::new(own.minus, E::ZERO, E::ZERO),
        plus: InLine::new(own.plus, E::ZERO, E::ZERO),
        upper: InLine::new(own.upper, E::ZERO, E::ZERO),
        lower: InLine::new(own.lower, E::ZERO, E::ZERO),
    }
}

/// What takes the motion of axes above, with `turn` and `back`.
#[inline(always)]
fn turned<E: Eight, const B: usize>(own: E, turn: E, back: E) -> InLine<E, B> {
    InLine::new(if B == 2 { own.plus(back) } else { own }, turn, back)
}

#[inline(always)]
fn twice<E: Eight>(numbers: E) -> E {
    numbers.plus(numbers)
}

/// A margin, with what acts on bodies where that counts.
#[inline(always)]
fn margin<E: Eight, const B: usize>(
    Flanks { carry, push, above, below, .. }: &Flanks<E>,
    pulls: Option<Pulls<E>>,
    axis_of_row: E,
    axis_of_column: E,
) -> Margin<InLine<E, B>> {
    let Some(pulls) = pulls else {
        return Margin {
            carry: InLine::new(*carry, E::ZERO, E::ZERO),
            push: InLine::new(*push, E::ZERO, E::ZERO),
            above: InLine::new(*above, E::ZERO, E::ZERO),
            below: InLine::new(*below, E::ZERO, E::ZERO),
        };
    };
    Margin {
        carry: InLine::new(*carry, axis_of_row, E::ZERO),
        push: turned(*push, twice(pulls.turn), twice(pulls.back)),
        above: InLine::new(*above, axis_of_column, *above),
        below: InLine::new(*below, twice(pulls.pull), E::ZERO),
    }
}
