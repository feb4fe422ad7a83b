//! Two points that are one along a world axis `e`.
//!
//! ```text
//! h = d·e    h_i = d_i·e    h_ij = d_ij·e
//! ```

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::Place;
use crate::math::scalar::Scalar;
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
            let gradient = joint.gradient_in_world(tree, poses, &at);
            row[joint.coordinate] += gradient[self.axis];
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let at = self.points.separation(tree, poses);
        for (k, row) in self.points.path.iter().enumerate() {
            let row_gradient = row.gradient_in_world(tree, poses, &at);
            for column in &self.points.path[..=k] {
                let gradient = column.gradient_in_world(tree, poses, &at);
                let (row_at, column_at) = ((row, row_gradient), (column, gradient));
                let second = row.second_in_world(row_gradient, tree, poses, column_at);
                entry(row.coordinate, column.coordinate, second[self.axis]);
                if row.joint == column.joint {
                    continue;
                }
                // Only within a ball joint does the order matter.
                let mirrored = if tree.one_ball(row.joint, column.joint) {
                    column.second_in_world(gradient, tree, poses, row_at)
                } else {
                    second
                };
                entry(column.coordinate, row.coordinate, mirrored[self.axis]);
            }
        }
    }
}
