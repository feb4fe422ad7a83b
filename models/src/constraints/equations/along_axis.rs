//! Two points that are one along a world axis `e`.
//!
//! ```text
//! h = d·e    h_i = d_i·e    h_ij = d_ij·e
//! ```

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Vec3;

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::Place;
use crate::model::mechanism::AlongAxis;

impl Equation for AlongAxis {
    fn coordinates(&self) -> Vec<usize> {
        self.points.coordinates().collect()
    }

    #[inline(always)]
    fn value<S: Scalar>(&self, Place { tree, poses, .. }: Place<'_, S>) -> (S, f64) {
        let at = self.points.separation(tree, poses);
        (at.difference[self.axis], at.magnitude)
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { tree, poses, .. }: Place<'_, S>, row: &mut [S]) {
        let at = self.points.separation(tree, poses);
        for joint in &self.points.path {
            row[joint.coordinate] += joint.gradient(tree, poses, &at)[self.axis];
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let at = self.points.separation(tree, poses);
        let value = |_: [Vec3<S>; 2], seconds: [Vec3<S>; 2]| seconds.map(|s| s[self.axis]);
        self.points.for_each_pair((tree, poses, &at), value, entry);
    }
}
