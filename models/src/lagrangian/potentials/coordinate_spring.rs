//! A spring on a coordinate.
//!
//! ```text
//! V = ½ k (q − rest)²    V_i = k (q − rest)    V_ii = k
//! ```

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::model::mechanism::CoordinateSpring;

impl Potential for CoordinateSpring {
    const NEEDS_POSES: bool = false;

    fn couples(&self) -> Vec<usize> {
        vec![self.coordinate]
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let stretch = at.q[self.coordinate] - self.rest;
        stretch * stretch * (0.5 * self.stiffness)
    }

    #[inline(always)]
    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        l_q[self.coordinate] -= (at.q[self.coordinate] - self.rest) * self.stiffness;
    }

    #[inline(always)]
    fn for_each_second_derivative<S: Scalar>(
        &self,
        _: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        entry(self.coordinate, self.coordinate, S::constant(self.stiffness));
    }

    fn third_derivative(&self, _: Place<'_, f64>) -> f64 {
        0.0
    }
}
