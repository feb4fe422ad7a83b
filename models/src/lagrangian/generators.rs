//! The second derivatives of the Lagrangian in a step, as products of vectors of eight numbers.
//!
//! With `e1`, `e2` and gravity `g = |g| e3` along three right-handed axes, and for joint `i` on the path from
//! `j` to the root (or `i = j`), all about the origin of the tree, the Newton matrix is
//!
//! ```text
//! K_ij = minus_i · upper_j      minus = rate − axis      upper = slope + force
//! K_ji = plus_i · lower_j       plus  = rate + axis      lower = slope − force
//!
//! axis = [J  0  0]      rate  = [½h J̇  w·e1  w·e2]      force = [F/h  0  0]
//!                       slope = [½P  ¼h |g| f·e2  −¼h |g| f·e1]
//! ```
//!
//! with the angular part `w` of `J` and the force part `f` of `F`: eight numbers, as what turns about the
//! vertical changes nothing of a weight.
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

use plantd_math::rows::Block;
use plantd_math::spatial::{Mat3, Vec3};

use crate::lagrangian::curvature::Within;
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::turning::{Turning, Weights};
use crate::model::mechanism::Model;

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
    /// `e1` and `e2`.
    horizontal: [Vec3; 2],
    /// ½, or 0 for masses alone.
    motion: f64,
    /// `½h`, or 0.
    half: f64,
    /// `1/h`.
    pub(crate) inverse: f64,
    /// `¼h |g|`, or 0.
    weight: f64,
}

/// What the generators of a joint are made of.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Parts {
    pub(crate) axis: Block,
    pub(crate) rate: Block,
    pub(crate) force: Block,
    pub(crate) slope: Block,
}

/// What a joint gives to the matrix.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Generators {
    pub(crate) minus: Block,
    pub(crate) plus: Block,
    pub(crate) upper: Block,
    pub(crate) lower: Block,
}

#[inline(always)]
pub(crate) fn dot(a: &Block, b: &Block) -> f64 {
    let (a, b) = (&a.0, &b.0);
    let pair = |k: usize| a[k] * b[k] + a[k + 4] * b[k + 4];
    (pair(0) + pair(1)) + (pair(2) + pair(3))
}

#[inline(always)]
fn lanes(a: Vec3, b: Vec3, [c, d]: [f64; 2]) -> Block {
    Block([a[0], a[1], a[2], b[0], b[1], b[2], c, d])
}

#[inline(always)]
fn sum([a, b, c]: &[Block; 3], weights: Vec3) -> Block {
    a.times(weights[0]).plus(b.times(weights[1])).plus(c.times(weights[2]))
}

/// `m` times three vectors, one below the other.
#[inline(always)]
pub(crate) fn rows(m: &Mat3, vectors: &[Block; 3]) -> [Block; 3] {
    let Mat3([x, y, z]) = m;
    let row = |a: usize| sum(vectors, Vec3([x[a], y[a], z[a]]));
    [row(0), row(1), row(2)]
}

/// `mᵀ` times three vectors, one below the other.
#[inline(always)]
pub(crate) fn columns(m: &Mat3, vectors: &[Block; 3]) -> [Block; 3] {
    let Mat3([x, y, z]) = *m;
    [sum(vectors, x), sum(vectors, y), sum(vectors, z)]
}

impl Step {
    /// Of the length `h`.
    #[inline(always)]
    pub(crate) fn new(vertical: &Vertical, h: f64, kind: MatrixKind) -> Self {
        let motion = if kind == MatrixKind::Mass { 0.0 } else { 0.5 };
        let half = h * motion;
        let weight = 0.5 * half * vertical.gravity;
        Self { horizontal: vertical.horizontal, motion, half, inverse: 1.0 / h, weight }
    }

    /// The parts of the axes of a ball joint.
    #[inline(always)]
    pub(crate) fn parts_of_ball(&self, mechanics: &Mechanics, first: usize) -> [Parts; 3] {
        let of = |a: usize| self.parts(mechanics, first + a);
        [of(0), of(1), of(2)]
    }

    /// The parts of a joint, at the second derivatives of `mechanics`.
    #[inline(always)]
    pub(crate) fn parts(&self, mechanics: &Mechanics, joint: usize) -> Parts {
        let Self { horizontal: [e1, e2], motion, half, inverse, weight } = *self;
        let Mechanics { momenta, curvature, .. } = mechanics;
        let (axis, rate) = (momenta.axis[joint], momenta.axis_rate[joint]);
        let (force, slope) = (curvature.force[joint], curvature.rate[joint]);
        let tilt = [axis.w.dot(e1), axis.w.dot(e2)];
        let weight = [weight * force.f.dot(e2), -weight * force.f.dot(e1)];
        Parts {
            axis: lanes(axis.w, axis.v, [0.0; 2]),
            rate: lanes(rate.w * half, rate.v * half, tilt),
            force: lanes(force.n * inverse, force.f * inverse, [0.0; 2]),
            slope: lanes(slope.n * motion, slope.f * motion, weight),
        }
    }

    /// `K` of the axes of a ball joint, the first of which is `first`, among themselves.
    #[inline(always)]
    pub(crate) fn within_ball(
        &self,
        mechanics: &Mechanics,
        gravity: Option<Vec3>,
        first: usize,
        weights: &Weights,
    ) -> Mat3 {
        let Self { motion, half, inverse, .. } = *self;
        let Weights { momentum, torque, column, own } = weights;
        let Mechanics { momenta, curvature, .. } = mechanics;
        let Within { tau_z, tau_v, m_v } = curvature.within_ball(momenta, gravity, first);
        let turned = tau_z.times(column).scaled(0.5 * half).plus(&tau_v.scaled(motion));
        let moved = tau_v.transpose().times(column).scaled(motion).plus(&m_v.scaled(inverse));
        torque.times(&turned).minus(&momentum.times(&moved)).plus(own)
    }
}

impl Parts {
    /// Of a hinge, a slide or a screw.
    #[inline(always)]
    pub(crate) fn generators(&self) -> Generators {
        let Self { axis, rate, force, slope } = self;
        Generators {
            minus: rate.plus(axis.times(-1.0)),
            plus: rate.plus(*axis),
            upper: slope.plus(*force),
            lower: slope.plus(force.times(-1.0)),
        }
    }
}

/// Of the three axes of a ball joint.
#[inline(always)]
pub(crate) fn of_ball(parts: &[Parts; 3], weights: &Weights) -> [Generators; 3] {
    let Weights { momentum, torque, column, .. } = weights;
    let [p, q, r] = parts;
    let (axis, rate) = ([p.axis, q.axis, r.axis], [p.rate, q.rate, r.rate]);
    let (force, slope) = ([p.force, q.force, r.force], [p.slope, q.slope, r.slope]);
    let (rates, axes) = (rows(torque, &rate), rows(momentum, &axis));
    let (slopes, forces) = (rows(torque, &slope), rows(momentum, &force));
    let (rate, slope) = (columns(column, &rate), columns(column, &slope));
    let of = |a: usize| Generators {
        minus: rates[a].plus(axes[a].times(-1.0)),
        plus: rate[a].plus(axis[a]),
        upper: slope[a].plus(force[a]),
        lower: slopes[a].plus(forces[a].times(-1.0)),
    };
    [of(0), of(1), of(2)]
}

/// What a joint gives to the linearization of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Flanks {
    pub(crate) parts: Parts,
    /// Of a ball joint: its rows and columns are weighed.
    pub(crate) is_turned: bool,
    pub(crate) newton: Generators,
    /// Rows of the momentum, of a joint with others below it, and below others.
    pub(crate) carry: Block,
    pub(crate) push: Block,
    /// Columns of the start.
    pub(crate) above: Block,
    pub(crate) below: Block,
}

impl Flanks {
    #[inline(always)]
    pub(crate) fn of(parts: &Parts) -> Self {
        let Parts { rate, slope, .. } = parts;
        let [rate, slope] = [rate.times(2.0), slope.times(2.0)];
        let newton = parts.generators();
        let (parts, is_turned) = (*parts, false);
        Self { parts, is_turned, newton, carry: rate, push: slope, above: rate, below: slope }
    }

    #[inline(always)]
    pub(crate) fn of_ball(parts: &[Parts; 3], turning: &Turning, weights: &Weights) -> [Self; 3] {
        let newton = of_ball(parts, weights);
        let [p, q, r] = parts;
        let twice = |of: fn(&Parts) -> Block| [of(p), of(q), of(r)].map(|part| part.times(2.0));
        let [rate, slope] = [twice(|part| part.rate), twice(|part| part.slope)];
        let spin = turning.spin();
        let axes = rows(&spin, &[p.axis, q.axis, r.axis]);
        let forces = rows(&spin, &[p.force, q.force, r.force]);
        let start = &turning.by_start.0;
        let (above, below) = (columns(start, &rate), columns(start, &slope));
        let of = |a: usize| Self {
            parts: parts[a],
            is_turned: true,
            newton: newton[a],
            carry: rate[a].plus(axes[a]),
            push: slope[a].plus(forces[a]),
            above: above[a],
            below: below[a],
        };
        [of(0), of(1), of(2)]
    }
}

/// Where gravity points.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Vertical {
    /// `e1` and `e2`.
    horizontal: [Vec3; 2],
    /// `|g|`.
    gravity: f64,
}

impl Vertical {
    pub(crate) fn new(model: &Model) -> Self {
        let size = model.gravity.map_or(0.0, Vec3::norm);
        let [e1, e2, _] = match model.gravity {
            Some(g) => Mat3::with_z_along(g * (1.0 / size)).0,
            None => Mat3::ZERO.0,
        };
        Self { horizontal: [e1, e2], gravity: size }
    }
}
