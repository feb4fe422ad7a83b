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

impl AlongAxis {
    /// The force of the multipliers of its own equation and of those that follow.
    pub(crate) fn force<S: Scalar>(&self, multipliers: &[S]) -> Vec3<S> {
        let mut force = Vec3::ZERO;
        for (axis, multiplier) in self.axes().zip(multipliers) {
            force.0[axis] = *multiplier;
        }
        force
    }

    /// Its own axis, and those of the equations that follow.
    #[inline(always)]
    fn axes(&self) -> impl Iterator<Item = usize> {
        [self.axis].into_iter().chain(self.others.iter().copied())
    }
}

impl Equation for AlongAxis {
    fn count(&self) -> usize {
        1 + self.others.len()
    }

    fn coordinates(&self) -> Vec<usize> {
        self.points.coordinates().collect()
    }

    #[inline(always)]
    fn value<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        values: &mut [S],
    ) -> S::Magnitude {
        let at = self.points.separation(tree, poses);
        for (axis, value) in self.axes().zip(values) {
            *value = at.difference[axis];
        }
        at.magnitude
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { tree, poses, q }: Place<'_, S>, rows: &mut [S]) {
        let at = self.points.separation(tree, poses);
        for joint in &self.points.path {
            let gradient = joint.gradient(tree, poses, &at);
            let mut at = joint.coordinate;
            for axis in self.axes() {
                rows[at] = gradient[axis];
                at += q.len();
            }
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
