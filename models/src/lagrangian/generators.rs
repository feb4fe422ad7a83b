//! The second derivatives of the Lagrangian in a step, as products of vectors of eight numbers.
//!
//! For joint `i` on the path from `j` to the root (or `i = j`) the Newton matrix is, with the rows of
//! [`curvature`](crate::lagrangian::curvature),
//!
//! ```text
//! K_ij = minus_i · upper_j      minus = ½h rate − axis      upper = ½ slope + force/h
//! K_ji = plus_i · lower_j       plus  = ½h rate + axis      lower = ½ slope − force/h
//! ```
//!
//! In what follows `rate`, `slope` and `force` are these multiples.
//!
//! A ball joint has three of each, of its axes. With the maps of [`turning`](crate::lagrangian::turning)
//! and `C = dexp₋ξ/2`, by which its midpoint turns twice as far as `ξ` changes,
//!
//! ```text
//! minus = T⁻ rate − N⁻ axis      upper = Cᵀ slope + force
//! plus  = Cᵀ rate + axis         lower = T⁻ slope − N⁻ force
//! ```
//!
//! where a map takes three vectors to three sums of them. Its axes turn with it: what it has of itself is
//! no such product but
//!
//! ```text
//! K = T⁻ (¼h τ_ζ C + ½ τ_v) − N⁻ (½ m_ζ C + m_v/h) + (T⁻)' (½h τ + a h f) − (N⁻)' m
//! K_ab = lower_a · (Cᵀ rate)_b + (T⁻ rate)_a · force_b − (N⁻ force)_a · axis_b + ...
//! ```
//!
//! with the derivatives of torque `τ` and momentum `m` by a turn `ζ` of the midpoint and the velocity `v`,
//! and of the maps by `ξ`.
//!
//! The linearization of a step has other rows and columns of the same parts. The start turns the midpoint by
//! `E = exp(−ξ/2)` at the same `ξ`, and the momentum changes by `h τ + m × ξ`:
//!
//! ```text
//!                                 of joints with others below      below others
//! rows of the momentum            2 rate − ξ× axis                 2 slope − ξ× force
//! columns of the start            2 Eᵀ rate                        2 Eᵀ slope
//! ```
//!
//! with products that are, like those of `K`, those of the residual itself.

use plantd_math::eights::Eight;
use plantd_math::rows::Block;
use plantd_math::spatial::Mat3;
use plantd_math::unrolled;

use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::turning::{Turning, Weights};

/// Which matrix of the second derivatives of the Lagrangian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MatrixKind {
    /// The Newton matrix `K`.
    Newton,
    /// The mass matrix, as `−M/h`.
    Mass,
}

/// What the generators of all joints of a step have in common.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    /// ½, or 0 for masses alone.
    pub(crate) motion: f64,
    /// `½h`, or 0.
    pub(crate) half: f64,
    /// `1/h`.
    pub(crate) inverse: f64,
}

/// What the generators of a joint are made of.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Parts<E = Block> {
    pub(crate) axis: E,
    pub(crate) rate: E,
    pub(crate) force: E,
    pub(crate) slope: E,
}

/// What a joint gives to the matrix.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Generators<E = Block> {
    pub(crate) minus: E,
    pub(crate) plus: E,
    pub(crate) upper: E,
    pub(crate) lower: E,
}

#[inline(always)]
fn sum<E: Eight>([a, b, c]: &[E; 3], weights: [f64; 3]) -> E {
    a.scaled(weights[0]).plus(b.scaled(weights[1])).plus(c.scaled(weights[2]))
}

/// `m` times three vectors, one below the other.
#[inline(always)]
pub(crate) fn rows<E: Eight>(m: &Mat3, vectors: &[E; 3]) -> [E; 3] {
    let Mat3([x, y, z]) = m;
    let mut out = *vectors;
    unrolled!(3, a < 3, { out[a] = sum(vectors, [x[a], y[a], z[a]]) });
    out
}

/// `mᵀ` times three vectors, one below the other.
#[inline(always)]
pub(crate) fn columns<E: Eight>(m: &Mat3, vectors: &[E; 3]) -> [E; 3] {
    let mut out = *vectors;
    unrolled!(3, a < 3, { out[a] = sum(vectors, m.0[a].0) });
    out
}

impl Step {
    /// Of the length `h`.
    #[inline(always)]
    pub(crate) fn new(h: f64, kind: MatrixKind) -> Self {
        let motion = if kind == MatrixKind::Mass { 0.0 } else { 0.5 };
        Self { motion, half: h * motion, inverse: 1.0 / h }
    }

    /// The parts of a joint, at the last second derivatives.
    #[inline(always)]
    pub(crate) fn parts<E: Eight>(&self, curvature: &Curvature, joint: usize) -> Parts<E> {
        let Self { motion, half, inverse } = *self;
        let Curvature { axis, rate, force, slope, .. } = curvature;
        Parts {
            axis: E::of(&axis[joint]),
            rate: E::of(&rate[joint]).scaled(half),
            force: E::of(&force[joint]).scaled(inverse),
            slope: E::of(&slope[joint]).scaled(motion),
        }
    }

    /// The parts of the axes of a ball joint.
    #[inline(always)]
    pub(crate) fn parts_of_ball<E: Eight>(
        &self,
        curvature: &Curvature,
        first: usize,
    ) -> [Parts<E>; 3] {
        [
            self.parts(curvature, first),
            self.parts(curvature, first + 1),
            self.parts(curvature, first + 2),
        ]
    }
}

impl<E: Eight> Parts<E> {
    /// Of a hinge, a slide or a screw.
    #[inline(always)]
    pub(crate) fn generators(&self) -> Generators<E> {
        let Self { axis, rate, force, slope } = *self;
        Generators {
            minus: rate.minus(axis),
            plus: rate.plus(axis),
            upper: slope.plus(force),
            lower: slope.minus(force),
        }
    }
}

impl<E: Eight> Generators<E> {
    /// To memory.
    #[inline(always)]
    pub(crate) fn put(&self, to: &mut Generators) {
        self.minus.put(&mut to.minus);
        self.plus.put(&mut to.plus);
        self.upper.put(&mut to.upper);
        self.lower.put(&mut to.lower);
    }
}

/// Of the three axes of a ball joint, and `K` of these among themselves.
#[inline(always)]
pub(crate) fn of_ball<E: Eight>(
    parts: &[Parts<E>; 3],
    weights: &Weights,
) -> ([Generators<E>; 3], [[f64; 3]; 3]) {
    let Weights { momentum, torque, column, own } = weights;
    let [p, q, r] = parts;
    let (axis, rate) = ([p.axis, q.axis, r.axis], [p.rate, q.rate, r.rate]);
    let (force, slope) = ([p.force, q.force, r.force], [p.slope, q.slope, r.slope]);
    let [rates, slopes] = [rows(torque, &rate), rows(torque, &slope)];
    let [axes, forces] = [rows(momentum, &axis), rows(momentum, &force)];
    let [rate, slope] = [columns(column, &rate), columns(column, &slope)];
    let mut generators = [p.generators(), q.generators(), r.generators()];
    let mut within = [[0.0; 3]; 3];
    unrolled!(3, a < 3, {
        generators[a] = Generators {
            minus: rates[a].minus(axes[a]),
            plus: rate[a].plus(axis[a]),
            upper: slope[a].plus(force[a]),
            lower: slopes[a].minus(forces[a]),
        };
        unrolled!(3, b < 3, {
            let turned = generators[a].lower.times(rate[b]);
            let moved = rates[a].times(force[b]).minus(forces[a].times(axis[b]));
            within[a][b] = turned.plus(moved).sum() + own.0[b].0[a];
        });
    });
    (generators, within)
}

/// What a joint gives to the linearization of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Flanks<E = Block> {
    pub(crate) parts: Parts<E>,
    /// Of a ball joint: its rows and columns are weighed.
    pub(crate) is_turned: bool,
    pub(crate) newton: Generators<E>,
    /// Rows of the momentum, of a joint with others below it, and below others.
    pub(crate) carry: E,
    pub(crate) push: E,
    /// Columns of the start.
    pub(crate) above: E,
    pub(crate) below: E,
}

impl<E: Eight> Flanks<E> {
    #[inline(always)]
    pub(crate) fn of(parts: &Parts<E>) -> Self {
        let Parts { rate, slope, .. } = parts;
        let [rate, slope] = [rate.scaled(2.0), slope.scaled(2.0)];
        let newton = parts.generators();
        let (parts, is_turned) = (*parts, false);
        Self { parts, is_turned, newton, carry: rate, push: slope, above: rate, below: slope }
    }

    #[inline(always)]
    pub(crate) fn of_ball(
        parts: &[Parts<E>; 3],
        turning: &Turning,
        weights: &Weights,
    ) -> [Self; 3] {
        let (newton, _) = of_ball(parts, weights);
        let [p, q, r] = parts;
        let mut flanks = [Self::of(p), Self::of(q), Self::of(r)];
        let [a, b, c] = &flanks;
        let (rate, slope) = ([a.carry, b.carry, c.carry], [a.push, b.push, c.push]);
        let (spin, start) = (turning.spin(), &turning.by_start.0);
        let axes = rows(&spin, &[p.axis, q.axis, r.axis]);
        let forces = rows(&spin, &[p.force, q.force, r.force]);
        let (above, below) = (columns(start, &rate), columns(start, &slope));
        unrolled!(3, a < 3, {
            let own = &mut flanks[a];
            (own.is_turned, own.newton) = (true, newton[a]);
            (own.carry, own.push) = (rate[a].plus(axes[a]), slope[a].plus(forces[a]));
            (own.above, own.below) = (above[a], below[a]);
        });
        flanks
    }

    /// To memory.
    #[inline(always)]
    pub(crate) fn put(&self, to: &mut Flanks) {
        to.is_turned = self.is_turned;
        self.newton.put(&mut to.newton);
        let Parts { axis, rate, force, slope } = &mut to.parts;
        self.parts.axis.put(axis);
        self.parts.rate.put(rate);
        self.parts.force.put(force);
        self.parts.slope.put(slope);
        self.carry.put(&mut to.carry);
        self.push.put(&mut to.push);
        self.above.put(&mut to.above);
        self.below.put(&mut to.below);
    }
}
