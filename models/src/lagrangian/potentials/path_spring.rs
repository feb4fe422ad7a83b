//! A spring along a path of points, or the spring of a stop of its length.
//!
//! ```text
//! V = ½ k (L − rest)²    V_i = T L_i    V_ij = k L_i L_j + T L_ij    T = k (L − rest)
//! ```
//!
//! with `L` the sum of the lengths of the path's segments. Of a [stop](crate::lagrangian::stop) `V(L)`,
//! `T = V'(L)` and `k = V''(L)`.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Force;

use crate::lagrangian::fields::{Field, Take, at_point, change_at_point};
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::lagrangian::ties::{Tie, Ties, tied_rows};
use crate::lagrangian::vectors::{Distance, moving_ends, steepness_of};
use crate::model::mechanism::{PathLaw, PathSpring, PointPair, Span, span};

impl PathSpring {
    /// Its segments at a configuration.
    fn segments<'a, S: Scalar>(
        &'a self,
        at: Place<'a, S>,
    ) -> impl Iterator<Item = Distance<'a, S>> {
        self.segments.iter().map(move |ends| Distance::new(ends, at.tree, at.poses))
    }

    /// `L`.
    fn length<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let mut length = S::ZERO;
        for segment in self.segments(at) {
            length += segment.length;
        }
        length
    }
}

impl PathLaw {
    /// `T` at a length.
    fn tension<S: Scalar>(&self, length: S) -> S {
        match self {
            Self::Spring { stiffness, rest_length } => (length - *rest_length) * *stiffness,
            Self::Stop(stop) => stop.slope(length),
        }
    }

    /// Its derivative.
    fn stiffness<S: Scalar>(&self, length: S) -> S {
        match self {
            Self::Spring { stiffness, .. } => S::constant(*stiffness),
            Self::Stop(stop) => stop.curvature(length),
        }
    }
}

impl Field for PathSpring {
    fn span(&self) -> Option<Span> {
        span(&self.segments)
    }

    fn exert(&self, at: &Instant<'_>, take: Take<'_>) {
        let Instant { tree, poses, q, .. } = *at;
        let length = self.length(Place { tree, poses, q });
        let (tension, stiffness) = (self.law.tension(length), self.law.stiffness(length));
        let ends = || moving_ends(&self.segments, tree, poses);
        // `L' = J · unit`.
        let units = ends().map(|end| at_point(end.point, end.along));
        let unit = units.fold(Force::default(), Force::plus);
        for end in ends() {
            let force = end.along * -tension;
            take(at_point(end.point, force), &|axis, _| {
                let moved = axis.at(end.point);
                let longer = axis.dot(unit);
                let changed = end.turned(moved) * -tension - end.along * (stiffness * longer);
                change_at_point([end.point, force], [moved, changed])
            });
        }
    }
}

impl Tie for PathSpring {
    fn segments(&self) -> &[PointPair] {
        &self.segments
    }

    fn rows(&self) -> usize {
        tied_rows(&self.segments)
    }

    fn tie(&self, at: &Instant<'_>, out: &mut Ties) {
        let Instant { tree, poses, q, .. } = *at;
        let length = self.length(Place { tree, poses, q });
        let (tension, stiffness) = (self.law.tension(length), self.law.stiffness(length));
        let row = out.begin_row();
        for ends in &self.segments {
            let change = |longer: f64, _| [-stiffness * longer, 0.0];
            out.add_segment(row, ends, at, -tension, change);
        }
    }
}

impl Potential for PathSpring {
    const NEEDS_POSES: bool = true;

    fn couples(&self) -> Vec<usize> {
        self.segments.iter().flat_map(PointPair::coordinates).collect()
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let length = self.length(at);
        match &self.law {
            PathLaw::Spring { stiffness, rest_length } => {
                let stretch = length - *rest_length;
                stretch * stretch * (0.5 * *stiffness)
            }
            PathLaw::Stop(stop) => stop.energy(length),
        }
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        let tension = self.law.tension(self.length(at));
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
        let length = self.length(at);
        let (tension, stiffness) = (self.law.tension(length), self.law.stiffness(length));
        for segment in self.segments(at) {
            segment.for_each_second_derivative(|i, j, second| entry(i, j, tension * second));
            segment.for_each_derivative(|i, row_slope| {
                for other in self.segments(at) {
                    other.for_each_derivative(|j, slope| {
                        entry(i, j, row_slope * slope * stiffness);
                    });
                }
            });
        }
    }

    fn third_derivative(&self, at: Place<'_, f64>) -> f64 {
        let (length, [first, second, third]) = steepness_of(self.segments(at));
        let tension = self.law.tension(length).abs();
        let [stiffness, stiffening] = match &self.law {
            PathLaw::Spring { stiffness, .. } => [*stiffness, 0.0],
            PathLaw::Stop(stop) => {
                let [share, rising, _] = stop.steepness(length);
                [stop.stiffness * share, stop.stiffness * rising]
            }
        };
        tension * third + 3.0 * stiffness * first * second + stiffening * first.powi(3)
    }
}
