//! The spring of a stop of a coordinate: `V_i = V'(q)`, `V_ii = V''(q)` of the [stop](crate::lagrangian::stop).

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::model::mechanism::CoordinateStop;

impl Potential for CoordinateStop {
    const NEEDS_POSES: bool = false;

    fn couples(&self) -> Vec<usize> {
        vec![self.coordinate]
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        self.stop.energy(at.q[self.coordinate])
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        l_q[self.coordinate] -= self.stop.slope(at.q[self.coordinate]);
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        entry(self.coordinate, self.coordinate, self.stop.curvature(at.q[self.coordinate]));
    }

    fn third_derivative(&self, at: Place<'_, f64>) -> f64 {
        self.stop.stiffness * self.stop.steepness(at.q[self.coordinate])[1]
    }
}
