//! A spring between two points.
//!
//! ```text
//! V = ½ k (|d| − rest)²    V_i = t d·d_i    V_ij = t (d_i·d_j + d·d_ij) + c (d·d_i)(d·d_j)
//! ```
//!
//! with `d` from point to point, `t = k (|d| − rest)/|d|`, `c = k rest/|d|³`. Where the points coincide, a
//! spring with a rest length pulls nowhere; its stiffness there is taken as `k` in all directions.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Vec3;

use crate::lagrangian::fields::{Field, Take, at_point, change_at_point};
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::lagrangian::ties::{Tie, Ties};
use crate::lagrangian::vectors::{Distance, Separation};
use crate::model::mechanism::{Carries, PointPair, PointSpring, Span};

/// A two-point spring at one configuration.
struct Stretched<S: Scalar> {
    at: Separation<S>,
    /// `t = V_l / l`.
    tension: S,
    /// `c`.
    bend: S,
}

/// Without rest length nothing is divided by the length, so that all derivatives hold at zero too.
fn stretched<S: Scalar>(spring: &PointSpring, place: Place<'_, S>) -> Stretched<S> {
    let at = spring.ends.separation(place.tree, place.poses);
    let square = at.difference.dot(at.difference);
    if spring.rest_length == 0.0 || square.value() == 0.0 {
        return Stretched { at, tension: S::constant(spring.stiffness), bend: S::ZERO };
    }
    let length = square.sqrt();
    let inverse = length.recip();
    let tension = (length - spring.rest_length) * inverse * spring.stiffness;
    let bend = inverse * inverse * inverse * (spring.stiffness * spring.rest_length);
    Stretched { at, tension, bend }
}

impl Field for PointSpring {
    fn span(&self) -> Option<Span> {
        self.ends.span()
    }

    fn exert(&self, at: &Instant<'_>, take: Take<'_>) {
        let Some((_, carries)) = self.ends.moving_end() else { return };
        let Instant { tree, poses, q, .. } = *at;
        let Stretched { at, tension, bend } = stretched(self, Place { tree, poses, q });
        let d = at.difference;
        let (point, sign) = if carries == Carries::A { (at.a, -1.0) } else { (at.b, 1.0) };
        let force = d * (sign * tension);
        take(at_point(point, force), &|axis, _| {
            let moved = axis.at(point);
            let changed = moved * -tension - d * (bend * d.dot(moved));
            change_at_point([point, force], [moved, changed])
        });
    }
}

impl Tie for PointSpring {
    fn segments(&self) -> &[PointPair] {
        std::slice::from_ref(&self.ends)
    }

    fn rows(&self) -> usize {
        3
    }

    fn tie(&self, at: &Instant<'_>, out: &mut Ties) {
        let Instant { tree, poses, q, .. } = *at;
        let Stretched { at: separation, tension, bend } = stretched(self, Place { tree, poses, q });
        let d = separation.difference;
        out.add_separation(&self.ends, at, d * -tension, |by, _| {
            by * -tension - d * (bend * d.dot(by))
        });
    }
}

impl Potential for PointSpring {
    const NEEDS_POSES: bool = true;

    fn couples(&self) -> Vec<usize> {
        self.ends.coordinates().collect()
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let d = self.ends.separation(at.tree, at.poses).difference;
        let square = d.dot(d);
        if self.rest_length == 0.0 {
            return square * (0.5 * self.stiffness);
        }
        let length = if square.value() == 0.0 { S::ZERO } else { square.sqrt() };
        let stretch = length - self.rest_length;
        stretch * stretch * (0.5 * self.stiffness)
    }

    #[inline]
    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        let s = stretched(self, at);
        let pull = s.at.difference * s.tension;
        for joint in &self.ends.path {
            if let Some(entry) = l_q.get_mut(joint.coordinate) {
                *entry -= pull.dot(joint.gradient(at.tree, at.poses, &s.at));
            }
        }
    }

    #[inline]
    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let s = stretched(self, at);
        let value = |[row, column]: [Vec3<S>; 2], seconds: [Vec3<S>; 2]| {
            let along = s.bend * s.at.difference.dot(row) * s.at.difference.dot(column);
            let product = column.dot(row);
            seconds.map(|second| s.tension * (product + s.at.difference.dot(second)) + along)
        };
        self.ends.for_each_pair((at.tree, at.poses, &s.at), value, entry);
    }

    fn third_derivative(&self, at: Place<'_, f64>) -> f64 {
        let Place { tree, poses, .. } = at;
        let distance = Distance::new(&self.ends, tree, poses);
        let (k, length) = (self.stiffness, distance.length);
        let [first, second, third] = distance.steepness();
        if self.rest_length == 0.0 {
            return k * first * (length + 3.0 * first);
        }
        k * (length - self.rest_length).abs() * third + 3.0 * k * first * second
    }
}
