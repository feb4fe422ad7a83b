//! A path of a length, fixed or prescribed, over points. The derivatives of a segment's length are those of
//! [`Distance`].
//!
//! ```text
//! h = Σ |d_s| − l
//! ```

use plantd_math::scalar::Scalar;

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::vectors::Distance;
use crate::model::mechanism::{Length, PathLength, PointPair};

impl Equation for PathLength {
    fn coordinates(&self) -> Vec<usize> {
        self.segments.iter().flat_map(PointPair::coordinates).collect()
    }

    #[inline(never)]
    fn value<S: Scalar>(
        &self,
        Place { tree, poses, q }: Place<'_, S>,
        values: &mut [S],
    ) -> S::Magnitude {
        let length = self.length.at(q);
        let (mut value, mut magnitude) = (-length, length.magnitude());
        for segment in &self.segments {
            let segment = Distance::new(segment, tree, poses);
            value += segment.length;
            magnitude += segment.magnitude();
        }
        values[0] = value;
        magnitude
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { tree, poses, .. }: Place<'_, S>, row: &mut [S]) {
        if let Length::Driven(length) = self.length {
            row[length] = -S::ONE;
        }
        for segment in &self.segments {
            let segment = Distance::new(segment, tree, poses);
            segment.for_each_derivative(|i, slope| row[i] += slope);
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        for segment in &self.segments {
            Distance::new(segment, tree, poses).for_each_second_derivative(&mut *entry);
        }
    }
}
