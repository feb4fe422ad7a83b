//! The maps by which a ball joint weighs the derivatives of a step.

use crate::math::rotation;
use crate::math::scalar::{Dual, Scalar};
use crate::math::spatial::{Mat3, Vec3};
use crate::model::mechanism::Model;

/// How one ball joint weighs the derivatives of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Turning<S = f64> {
    /// First of its three coordinates.
    pub(crate) coordinate: usize,
    /// `ξ`.
    pub(crate) turn: Vec3<S>,
    /// `N⁻`.
    pub(crate) momentum: Mat3<S>,
    /// `T⁻`.
    pub(crate) torque: Mat3<S>,
    /// `dexp₋ξ`: how the end turns, in its own axes, as `ξ` changes.
    pub(crate) to_end: Mat3<S>,
    /// `exp(−ξ)`: how it turns with the start.
    pub(crate) carried: Mat3<S>,
    /// How the midpoint turns, and the velocity changes, with the start: of a dynamic joint at fixed
    /// `ξ`, of a prescribed one at a fixed end.
    pub(crate) by_start: (Mat3<S>, Mat3<S>),
    /// These maps with what is next: `ξ` of a dynamic joint, the end of a prescribed one.
    pub(crate) by_next: (Mat3<S>, Mat3<S>),
}

impl<S: Scalar> Turning<S> {
    pub(crate) fn new(model: &Model, coordinate: usize, turn: Vec3<S>, time_step_s: f64) -> Self {
        let rate = S::constant(1.0 / time_step_s);
        let half = turn.scaled(0.5);
        let middle = rotation::dexp(half).scaled(S::constant(0.5));
        let start = rotation::exp(-half);
        let momentum = rotation::momentum_at_start(turn);
        let (by_start, by_next) = if coordinate < model.dimensions.dynamic {
            ((start, Mat3::ZERO), (middle, Mat3::IDENTITY.scaled(rate)))
        } else {
            // ξ' = N⁻ η₁ − N⁺ η₀, with η what turns the ends.
            let back = momentum.transpose();
            let turned = middle.times(&back);
            (
                (start.minus(&turned), back.scaled(-rate)),
                (middle.times(&momentum), momentum.scaled(rate)),
            )
        };
        Self {
            coordinate,
            turn,
            momentum,
            torque: rotation::torque_at_start(turn),
            to_end: rotation::dexp(turn),
            carried: rotation::exp(-turn),
            by_start,
            by_next,
        }
    }

    /// Change of `T⁻ torque − N⁻ momentum` along each axis of `ξ`, and of `(T⁻ − 1) force`.
    pub(crate) fn by_turn(
        &self,
        torque: Vec3<S>,
        momentum: Vec3<S>,
        force: Vec3<S>,
    ) -> [[Vec3<S>; 3]; 2] {
        let lift = |v: Vec3<S>| Vec3(v.0.map(|x| Dual::new(x, S::ZERO)));
        let change = |v: Vec3<Dual<S>>| Vec3(v.0.map(|x| x.eps));
        let along = |axis: usize| {
            let mut turn = lift(self.turn);
            turn.0[axis].eps = S::ONE;
            let weight = rotation::torque_at_start(turn);
            let carried = rotation::momentum_at_start(turn).apply(lift(momentum));
            let residual = weight.apply(lift(torque)) - carried;
            (change(residual), change(weight.apply(lift(force))))
        };
        let axes = [along(0), along(1), along(2)];
        [axes.map(|(residual, _)| residual), axes.map(|(_, force)| force)]
    }
}
