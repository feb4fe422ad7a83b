//! A spring on the orientation of a ball joint, or of a free joint.
//!
//! ```text
//! V = ½ k |φ|²    V_i = k φ_i    V_ij = k N⁻_ij    φ = log(rest⁻¹ R)
//! ```
//!
//! with the rotation `R` of the joint, derivatives by turns in its own axes, and `N⁻` as in
//! [`plantd_math::rotation`]: `dφ = N⁻ δ`, and `N⁻ᵀ φ = φ`.
//!
//! `φ` is the shorter way round. At half a turn both ways are as long: there the energy has a crest, and the
//! torque changes its sign; value and derivatives are those of the side to which rounding puts it, and all are
//! finite.

use plantd_math::rotation;
use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Mat3, Vec3};

use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::model::mechanism::OrientationSpring;

/// Beyond so many radians nothing is said about third derivatives.
const FAR: f64 = 2.5;

impl OrientationSpring {
    /// `φ`.
    fn turn<S: Scalar>(&self, at: Place<'_, S>) -> Vec3<S> {
        let own = at.poses.of_ball(at.tree, self.joint);
        rotation::log(&Mat3::lift(self.back).times(&own))
    }
}

impl Potential for OrientationSpring {
    const NEEDS_POSES: bool = true;

    fn couples(&self) -> Vec<usize> {
        (0..3).map(|axis| self.coordinate + axis).collect()
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let turn = self.turn(at);
        turn.dot(turn) * (0.5 * self.stiffness)
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        let turn = self.turn(at);
        for (axis, entry) in l_q[self.coordinate..][..3].iter_mut().enumerate() {
            *entry -= turn[axis] * self.stiffness;
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let change = rotation::momentum_at_start(self.turn(at));
        for (row, column) in (0..9).map(|entry| (entry / 3, entry % 3)) {
            let value = change.0[column][row] * self.stiffness;
            entry(self.coordinate + row, self.coordinate + column, value);
        }
    }

    fn third_derivative(&self, at: Place<'_, f64>) -> f64 {
        // `N⁻` and its derivative are bounded away from half a turn.
        if self.turn(at).norm() < FAR { 4.0 * self.stiffness } else { f64::INFINITY }
    }
}
