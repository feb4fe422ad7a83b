//! A spring on a coordinate whose force is a spline.
//!
//! ```text
//! V = −∫ f dq    V_i = −f    V_ii = −f'
//! ```

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::model::mechanism::SplineSpring;

impl Potential for SplineSpring {
    const NEEDS_POSES: bool = false;

    fn couples(&self) -> Vec<usize> {
        vec![self.coordinate]
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        -self.force.integral(at.q[self.coordinate])
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        l_q[self.coordinate] += self.force.value(at.q[self.coordinate]);
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let stiffness = -self.force.slope(at.q[self.coordinate]);
        entry(self.coordinate, self.coordinate, stiffness);
    }

    fn third_derivative(&self, _: Place<'_, f64>) -> f64 {
        self.force.steepest()
    }
}
