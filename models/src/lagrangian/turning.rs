//! The maps by which a ball joint weighs the derivatives of a step; see [`plantd_math::rotation`].

use plantd_math::rotation::{self, Chart, Turn};
use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Mat3, Vec3};

use crate::model::mechanism::Model;

/// How one ball joint weighs the derivatives of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Turning<S = f64> {
    /// First of its three coordinates.
    pub(crate) coordinate: usize,
    pub(crate) turn: Turn<S>,
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
    /// How they change with what is next: `ξ` of a dynamic joint, the end of a prescribed one.
    pub(crate) by_next: (Mat3<S>, Mat3<S>),
}

impl<S: Scalar> Turning<S> {
    pub(crate) fn new(model: &Model, coordinate: usize, turn: Turn<S>, time_step_s: f64) -> Self {
        let rate = S::constant(1.0 / time_step_s);
        let whole = Chart::new(turn.xi);
        let middle = turn.dexp_of_half().scaled(S::constant(0.5));
        let start = turn.half().transpose();
        let momentum = turn.momentum_at_start();
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
            torque: turn.torque_at_start(),
            to_end: whole.dexp(),
            carried: whole.exp().transpose(),
            by_start,
            by_next,
        }
    }

    /// `m ↦ m × ξ`.
    pub(crate) fn spin(&self) -> Mat3<S> {
        rotation::crossed(self.turn.xi)
    }

    /// Change of `T⁻ impulse − N⁻ momentum` with `ξ`, and of `T⁻ force`.
    pub(crate) fn by_turn(
        &self,
        impulse: Vec3<S>,
        momentum: Vec3<S>,
        force: Vec3<S>,
    ) -> [Mat3<S>; 2] {
        let changes = self.turn.changes();
        let residual = changes.of_torque(impulse).minus(&changes.of_momentum(momentum));
        [residual, changes.of_torque(force)]
    }
}

/// How one ball joint weighs its rows and columns of the Newton matrix.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Weights {
    /// `N⁻` and `T⁻`.
    pub(crate) momentum: Mat3,
    pub(crate) torque: Mat3,
    /// `dexp₋ξ/2`.
    pub(crate) column: Mat3,
    /// What its rows have in its columns beside the Lagrangian's second derivatives.
    pub(crate) own: Mat3,
}

impl Weights {
    /// Of a joint that does not turn.
    pub(crate) const REST: Self = Self {
        momentum: Mat3::IDENTITY,
        torque: Mat3::IDENTITY,
        column: Mat3::IDENTITY,
        own: Mat3::ZERO,
    };
}
