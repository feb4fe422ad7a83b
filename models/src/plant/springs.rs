//! Springs: potentials `V` that add `−V_q` to `L_q` and `−V_qq` to `L_qq`.

use crate::elimination::Elimination;
use crate::model::{CoordinateSpring, PathJoint, PointPair, PointSpring};
use crate::plant::kinematics::Poses;
use crate::plant::tree_lu::TreeLu;
use crate::spatial::Vec3;
use crate::tree::{JointKind, Tree};

/// `a − b` in world axes, and both points relative to the origins of their trees.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Separation {
    pub(crate) difference: Vec3,
    pub(crate) a: Vec3,
    pub(crate) b: Vec3,
    /// Magnitude of what was subtracted, for round-off estimates.
    pub(crate) magnitude: f64,
}

impl PointPair {
    /// The separation of the points. Origins cancel exactly within one tree.
    #[inline]
    pub(crate) fn separation(&self, tree: &Tree, poses: &Poses) -> Separation {
        let (a, origin_a) = poses.point(tree, &self.a);
        let (b, origin_b) = poses.point(tree, &self.b);
        let origins = origin_a - origin_b;
        Separation {
            difference: (a - b) + origins,
            a,
            b,
            magnitude: a.norm() + b.norm() + origins.norm(),
        }
    }
}

impl PathJoint {
    /// Derivative of the difference `a − b` by the joint's coordinate.
    #[inline]
    pub(crate) fn gradient(&self, tree: &Tree, poses: &Poses, at: &Separation) -> Vec3 {
        if self.carries_a {
            poses.point_gradient(tree, self.joint, at.a)
        } else {
            -poses.point_gradient(tree, self.joint, at.b)
        }
    }

    /// Second derivative of the difference by this joint's coordinate and that of `below`, which
    /// comes later on the path: nested axes, `w × ∂`, on one branch, zero across branches.
    #[inline]
    pub(crate) fn second(
        &self,
        tree: &Tree,
        poses: &Poses,
        below: &PathJoint,
        gradient_below: Vec3,
    ) -> Vec3 {
        if self.carries_a != below.carries_a || tree.joints[self.joint].kind == JointKind::Prismatic
        {
            Vec3::ZERO
        } else {
            poses.axis(self.joint).cross(gradient_below)
        }
    }
}

/// A two-point spring at one configuration.
struct Stretched {
    at: Separation,
    /// Direction from `b` to `a`; zero where the points coincide.
    direction: Vec3,
    /// `dV/dl`.
    tension: f64,
    /// `dV/dl / l`, the stiffness across the direction; finite at zero length, where the direction is
    /// undefined and a spring with a rest length pulls nowhere.
    across: f64,
}

fn stretched(spring: &PointSpring, tree: &Tree, poses: &Poses) -> Stretched {
    let at = spring.ends.separation(tree, poses);
    let length = at.difference.norm();
    let direction = if length > 0.0 { at.difference * (1.0 / length) } else { Vec3::ZERO };
    let tension = spring.stiffness * (length - spring.rest_length);
    let across = if spring.rest_length == 0.0 || length == 0.0 {
        spring.stiffness
    } else {
        tension / length
    };
    Stretched { at, direction, tension, across }
}

/// Adds `−V_q` to `l_q` (dynamic coordinates).
#[inline(never)]
pub(crate) fn add_gradient(
    coordinate_springs: &[CoordinateSpring],
    point_springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses,
    q: &[f64],
    l_q: &mut [f64],
) {
    for spring in coordinate_springs {
        l_q[spring.coordinate] -= spring.stiffness * (q[spring.coordinate] - spring.rest);
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

/// Calls `entry(i, j, V_ij)` once for each pair of coordinates of each two-point spring, `i` not
/// below `j` on the path.
pub(crate) fn for_each_second_derivative(
    springs: &[PointSpring],
    tree: &Tree,
    poses: &Poses,
    mut entry: impl FnMut(usize, usize, f64),
) {
    for spring in springs {
        let s = stretched(spring, tree, poses);
        let along = spring.stiffness - s.across;
        for (k, below) in spring.ends.path.iter().enumerate() {
            let gradient = below.gradient(tree, poses, &s.at);
            for above in &spring.ends.path[..=k] {
                let other = above.gradient(tree, poses, &s.at);
                let second = above.second(tree, poses, below, gradient);
                let value = along * s.direction.dot(gradient) * s.direction.dot(other)
                    + s.across * gradient.dot(other)
                    + s.tension * s.direction.dot(second);
                entry(above.coordinate, below.coordinate, value);
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
            let slot = elimination.slot(i.max(j), i.min(j));
            let value = -0.25 * step * value;
            match slot {
                Some(slot) if i == j => matrix.add_to_diagonal(slot, value),
                Some(slot) => matrix.add_symmetric(slot, value),
                None => debug_assert!(false, "a spring couples coordinates {i} and {j}"),
            }
        }
    });
}
