//! Springs: potentials `V` that add `−V_q` to `L_q` and `−V_qq` to `L_qq`.

use crate::elimination::Elimination;
use crate::model::{CoordinateSpring, PathJoint, PointPair, PointSpring};
use crate::plant::kinematics::Poses;
use crate::plant::tree_lu::TreeLu;
use crate::scalar::Scalar;
use crate::spatial::Vec3;
use crate::tree::Tree;

/// `a − b` in world axes, and both points relative to the origins of their trees.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Separation<S = f64> {
    pub(crate) difference: Vec3<S>,
    pub(crate) a: Vec3<S>,
    pub(crate) b: Vec3<S>,
    /// Magnitude of what was subtracted, for round-off estimates.
    pub(crate) magnitude: f64,
}

impl PointPair {
    /// The separation of the points. Origins cancel exactly within one tree.
    #[inline]
    pub(crate) fn separation<S: Scalar>(&self, tree: &Tree, poses: &Poses<S>) -> Separation<S> {
        let (a, origin_a) = poses.point(tree, &self.a);
        let (b, origin_b) = poses.point(tree, &self.b);
        let origins = origin_a - origin_b;
        Separation {
            difference: (a - b) + origins,
            a,
            b,
            magnitude: size(a) + size(b) + size(origins),
        }
    }
}

/// Length of the real part.
fn size<S: Scalar>(v: Vec3<S>) -> f64 {
    Vec3(v.0.map(S::value)).norm()
}

impl PathJoint {
    /// Derivative of the difference `a − b` by the joint's coordinate.
    #[inline]
    pub(crate) fn gradient<S: Scalar>(
        &self,
        tree: &Tree,
        poses: &Poses<S>,
        at: &Separation<S>,
    ) -> Vec3<S> {
        if self.carries_a {
            poses.point_gradient(tree, self.joint, at.a)
        } else {
            -poses.point_gradient(tree, self.joint, at.b)
        }
    }

    /// Derivative of this joint's `gradient` by the coordinate of another: nested axes on one branch,
    /// zero across branches.
    #[inline]
    pub(crate) fn second<S: Scalar>(
        &self,
        gradient: Vec3<S>,
        tree: &Tree,
        poses: &Poses<S>,
        (column, column_gradient): (&PathJoint, Vec3<S>),
    ) -> Vec3<S> {
        if self.carries_a == column.carries_a {
            poses.turned_gradient(tree, (self.joint, gradient), (column.joint, column_gradient))
        } else {
            Vec3::ZERO
        }
    }
}

/// A two-point spring at one configuration.
struct Stretched<S> {
    at: Separation<S>,
    /// Direction from `b` to `a`; zero where the points coincide.
    direction: Vec3<S>,
    /// `dV/dl`.
    tension: S,
    /// `dV/dl / l`, the stiffness across the direction; finite at zero length, where the direction is
    /// undefined and a spring with a rest length pulls nowhere.
    across: S,
}

fn stretched<S: Scalar>(spring: &PointSpring, tree: &Tree, poses: &Poses<S>) -> Stretched<S> {
    let at = spring.ends.separation(tree, poses);
    let stiffness = S::constant(spring.stiffness);
    let square = at.difference.dot(at.difference);
    if square.value() == 0.0 {
        let tension = S::constant(-spring.stiffness * spring.rest_length);
        return Stretched { at, direction: Vec3::ZERO, tension, across: stiffness };
    }
    let length = square.sqrt();
    let inverse = length.recip();
    let direction = at.difference * inverse;
    let tension = (length - spring.rest_length) * spring.stiffness;
    let across = if spring.rest_length == 0.0 { stiffness } else { tension * inverse };
    Stretched { at, direction, tension, across }
}

/// Adds `−V_q` to `l_q` (dynamic coordinates).
#[inline(never)]
pub(crate) fn add_gradient<S: Scalar>(
    coordinate_springs: &[CoordinateSpring],
    point_springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    l_q: &mut [S],
) {
    for spring in coordinate_springs {
        l_q[spring.coordinate] -= (q[spring.coordinate] - spring.rest) * spring.stiffness;
    }
    for spring in point_springs {
        let s = stretched(spring, tree, poses);
        let pull = s.direction * s.tension;
        for joint in &spring.ends.path {
            if let Some(entry) = l_q.get_mut(joint.coordinate) {
                *entry -= pull.dot(joint.gradient(tree, poses, &s.at));
            }
        }
    }
}

/// Potential energy of all springs, J. Springs on prescribed coordinates do not count.
pub(crate) fn potential(
    coordinate_springs: &[CoordinateSpring],
    point_springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses,
    q: &[f64],
) -> f64 {
    let energy = |stiffness: f64, stretch: f64| 0.5 * stiffness * stretch * stretch;
    let coordinate: f64 =
        coordinate_springs.iter().map(|s| energy(s.stiffness, q[s.coordinate] - s.rest)).sum();
    let point: f64 = point_springs
        .iter()
        .map(|s| {
            let length = s.ends.separation(tree, poses).difference.norm();
            energy(s.stiffness, length - s.rest_length)
        })
        .sum();
    coordinate + point
}

/// Calls `entry(i, j, V_ij)` for each ordered pair of coordinates of each two-point spring.
pub(crate) fn for_each_second_derivative<S: Scalar>(
    springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses<S>,
    mut entry: impl FnMut(usize, usize, S),
) {
    for spring in springs {
        let s = stretched(spring, tree, poses);
        let along = S::constant(spring.stiffness) - s.across;
        let path = &spring.ends.path;
        for row in path {
            let row_gradient = row.gradient(tree, poses, &s.at);
            for column in path {
                let gradient = column.gradient(tree, poses, &s.at);
                let second = row.second(row_gradient, tree, poses, (column, gradient));
                let value = along * s.direction.dot(gradient) * s.direction.dot(row_gradient)
                    + s.across * gradient.dot(row_gradient)
                    + s.tension * s.direction.dot(second);
                entry(row.coordinate, column.coordinate, value);
            }
        }
    }
}

/// Adds the springs' part `−¼h V_qq` to the Newton matrix.
#[inline(never)]
pub(crate) fn add_to_newton_matrix(
    coordinate_springs: &[CoordinateSpring],
    point_springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses,
    step: f64,
    elimination: &Elimination,
    matrix: &mut TreeLu,
) {
    for spring in coordinate_springs {
        let slot = elimination.offsets[spring.coordinate + 1] - 1;
        matrix.add_to_diagonal(slot, -0.25 * step * spring.stiffness);
    }
    for_each_second_derivative(point_springs, tree, poses, |i, j, value| {
        let dynamic = elimination.len();
        if i < dynamic && j < dynamic {
            matrix.add(elimination, i, j, -0.25 * step * value);
        }
    });
}
