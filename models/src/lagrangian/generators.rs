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
use plantd_math::spatial::{Mat3, Vec3};

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
fn lanes(a: Vec3, b: Vec3, [c, d]: [f64; 2]) -> Block {
    Block([a[0], a[1], a[2], b[0], b[1], b[2], c, d])
}

#[inline(always)]
fn sum<E: Eight>([a, b, c]: &[E; 3], weights: [f64; 3]) -> E {
    a.scaled(weights[0]).plus(b.scaled(weights[1])).plus(c.scaled(weights[2]))
}

/// `m` times three vectors, one below the other.
#[inline(always)]
fn rows<E: Eight>(m: &Mat3, vectors: &[E; 3]) -> [E; 3] {
    let Mat3([x, y, z]) = m;
    let mut out = *vectors;
    for (a, out) in out.iter_mut().enumerate() {
        *out = sum(vectors, [x[a], y[a], z[a]]);
    }
    out
}

/// `mᵀ` times three vectors, one below the other.
#[inline(always)]
pub(crate) fn columns<E: Eight>(m: &Mat3, vectors: &[E; 3]) -> [E; 3] {
    let mut out = *vectors;
    for (column, out) in m.0.iter().zip(&mut out) {
        *out = sum(vectors, column.0);
    }
    out
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
}

impl<E: Eight> Parts<E> {
    #[inline(always)]
    pub(crate) fn of(parts: &Parts) -> Self {
        let Parts { axis, rate, force, slope } = parts;
        let [axis, rate] = [E::of(axis), E::of(rate)];
        let [force, slope] = [E::of(force), E::of(slope)];
        Self { axis, rate, force, slope }
    }

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
    for (a, generators) in generators.iter_mut().enumerate() {
        *generators = Generators {
            minus: rates[a].minus(axes[a]),
            plus: rate[a].plus(axis[a]),
            upper: slope[a].plus(force[a]),
            lower: slopes[a].minus(forces[a]),
        };
    }
    let mut within = [[0.0; 3]; 3];
    for (a, row) in within.iter_mut().enumerate() {
        for (b, entry) in row.iter_mut().enumerate() {
            let turned = generators[a].lower.times(rate[b]);
            let moved = rates[a].times(force[b]).minus(forces[a].times(axis[b]));
            *entry = turned.plus(moved).sum() + own.0[b].0[a];
        }
    }
    (generators, within)
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
        let [rate, slope] = [rate.scaled(2.0), slope.scaled(2.0)];
        let newton = parts.generators();
        let (parts, is_turned) = (*parts, false);
        Self { parts, is_turned, newton, carry: rate, push: slope, above: rate, below: slope }
    }

    #[inline(always)]
    pub(crate) fn of_ball(parts: &[Parts; 3], turning: &Turning, weights: &Weights) -> [Self; 3] {
        let (newton, _) = of_ball(parts, weights);
        let [p, q, r] = parts;
        let twice = |of: fn(&Parts) -> Block| [of(p), of(q), of(r)].map(|part| part.scaled(2.0));
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
