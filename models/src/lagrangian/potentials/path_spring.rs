//! A spring along a path of points.
//!
//! ```text
//! V = ½ k (L − rest)²    V_i = k (L − rest) L_i    V_ij = k L_i L_j + k (L − rest) L_ij
//! ```
//!
//! with `L` the sum of the lengths of the path's segments.

use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::lagrangian::vectors::Distance;
use crate::math::scalar::Scalar;
use crate::model::mechanism::{PathSpring, PointPair};

impl PathSpring {
    /// Its segments at a configuration.
    fn segments<'a, S: Scalar>(
        &'a self,
        at: Place<'a, S>,
    ) -> impl Iterator<Item = Distance<'a, S>> {
        self.segments.iter().map(move |ends| Distance::new(ends, at.tree, at.poses))
    }

    /// `L − rest`.
    fn stretch<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let mut length = S::ZERO;
        for segment in self.segments(at) {
            length += segment.length;
        }
        length - self.rest_length
    }
}

impl Potential for PathSpring {
    const NEEDS_POSES: bool = true;

    fn couples(&self) -> Vec<usize> {
        self.segments.iter().flat_map(PointPair::coordinates).collect()
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let stretch = self.stretch(at);
        stretch * stretch * (0.5 * self.stiffness)
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        let tension = self.stretch(at) * self.stiffness;
        for segment in self.segments(at) {
            segment.for_each_derivative(|i, slope| {
                if let Some(entry) = l_q.get_mut(i) {
                    *entry -= tension * slope;
                }
            });
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let tension = self.stretch(at) * self.stiffness;
        for segment in self.segments(at) {
            segment.for_each_second_derivative(|i, j, second| entry(i, j, tension * second));
            segment.for_each_derivative(|i, row_slope| {
                for other in self.segments(at) {
                    other.for_each_derivative(|j, slope| {
                        entry(i, j, row_slope * slope * self.stiffness);
                    });
                }
            });
        }
    }
}
