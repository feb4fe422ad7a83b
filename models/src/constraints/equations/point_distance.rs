//! Two points at a distance, fixed or prescribed.
//!
//! ```text
//! h = |d|² − l²    h_i = 2 d·d_i    h_ij = 2 (d_i·d_j + d·d_ij)
//! ```

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Vec3;

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::Place;
use crate::model::mechanism::{Length, PointDistance};

impl Equation for PointDistance {
    fn coordinates(&self) -> Vec<usize> {
        self.points.coordinates().collect()
    }

    #[inline(always)]
    fn value<S: Scalar>(
        &self,
        Place { tree, poses, q }: Place<'_, S>,
        values: &mut [S],
    ) -> S::Magnitude {
        let at = self.points.separation(tree, poses);
        let length = self.length.at(q);
        let square = at.difference.dot(at.difference);
        let squared_length = length * length;
        values[0] = square - squared_length;
        square.magnitude().sqrt() * at.magnitude * 2.0 + squared_length.magnitude()
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { tree, poses, q }: Place<'_, S>, row: &mut [S]) {
        if let Length::Driven(length) = self.length {
            row[length] = q[length] * -2.0;
        }
        let at = self.points.separation(tree, poses);
        let weight = at.difference.scaled(2.0);
        for joint in &self.points.path {
            row[joint.coordinate] += weight.dot(joint.gradient(tree, poses, &at));
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let at = self.points.separation(tree, poses);
        let value = |[row, column]: [Vec3<S>; 2], seconds: [Vec3<S>; 2]| {
            let product = column.dot(row);
            seconds.map(|second| (product + at.difference.dot(second)) * 2.0)
        };
        self.points.for_each_pair((tree, poses, &at), value, &mut *entry);
        if let Length::Driven(length) = self.length {
            entry(length, length, S::constant(-2.0));
        }
    }
}
