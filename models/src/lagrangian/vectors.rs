//! Vectors that bodies carry, and their derivatives by the coordinates of the joints: nested axes.
//!
//! A joint with axis `w` turns every vector that it carries: `∂u/∂q = w × u`. With joint `i` above
//! joint `j`, both carrying `u`, `∂²u/∂q_i ∂q_j = w_i × ∂u/∂q_j`; across branches it is zero.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Vec3;

use crate::lagrangian::kinematics::Poses;
use crate::model::mechanism::{Carries, PathJoint, PointPair, Product, Vector};
use crate::model::tree::{Attachment, Tree, WORLD};

/// `a − b` in world axes, and both points relative to the origins of their trees.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Separation<S: Scalar = f64> {
    pub(crate) difference: Vec3<S>,
    pub(crate) a: Vec3<S>,
    pub(crate) b: Vec3<S>,
    /// Magnitude of what was subtracted, for round-off estimates.
    pub(crate) magnitude: S::Magnitude,
}

impl PointPair {
    /// Whether no joint carries both.
    #[inline]
    pub(crate) fn are_apart(&self, tree: &Tree) -> bool {
        let root = |joint: usize| tree.joints.get(joint).map(|joint| joint.root);
        root(self.a.joint) != root(self.b.joint)
    }

    /// The separation of the points. Origins cancel exactly within one tree.
    #[inline(always)]
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
#[inline(always)]
fn size<S: Scalar>(v: Vec3<S>) -> S::Magnitude {
    Vec3(v.0.map(S::magnitude)).norm()
}

impl PathJoint {
    /// Derivative of the difference `a − b` by the joint's coordinate.
    #[inline(always)]
    pub(crate) fn gradient<S: Scalar>(
        &self,
        tree: &Tree,
        poses: &Poses<S>,
        at: &Separation<S>,
    ) -> Vec3<S> {
        match self.carries {
            Carries::A => poses.point_gradient(tree, self.joint, at.a),
            Carries::B => -poses.point_gradient(tree, self.joint, at.b),
            Carries::Both => poses.turned(tree, self.joint, at.difference),
        }
    }

    /// Derivative of this joint's `gradient` by the coordinate of another: nested axes on one branch,
    /// zero across branches. Joints that carry both points are above all others.
    #[inline]
    pub(crate) fn second<S: Scalar>(
        &self,
        gradient: Vec3<S>,
        tree: &Tree,
        poses: &Poses<S>,
        (column, column_gradient): (&PathJoint, Vec3<S>),
    ) -> Vec3<S> {
        let above = |joint: &PathJoint| joint.carries == Carries::Both;
        if self.carries == column.carries || above(self) || above(column) {
            poses.turned_gradient(tree, (self.joint, gradient), (column.joint, column_gradient))
        } else {
            Vec3::ZERO
        }
    }
}

impl PointPair {
    /// Calls `entry(i, j, value)` for each ordered pair of joints on the path: `value` makes those of a pair
    /// and of the pair mirrored from `d_i`, `d_j` and from `d_ij`, `d_ji`.
    #[inline(always)]
    pub(crate) fn for_each_pair<S: Scalar>(
        &self,
        (tree, poses, at): (&Tree, &Poses<S>, &Separation<S>),
        value: impl Fn([Vec3<S>; 2], [Vec3<S>; 2]) -> [S; 2],
        mut entry: impl FnMut(usize, usize, S),
    ) {
        for (k, row) in self.path.iter().enumerate() {
            let row_gradient = row.gradient(tree, poses, at);
            for column in &self.path[..=k] {
                let gradient = column.gradient(tree, poses, at);
                let second = row.second(row_gradient, tree, poses, (column, gradient));
                // Only within a ball joint does the order matter.
                let mirrored = if tree.one_ball(row.joint, column.joint) {
                    column.second(gradient, tree, poses, (row, row_gradient))
                } else {
                    second
                };
                let [own, other] = value([row_gradient, gradient], [second, mirrored]);
                entry(row.coordinate, column.coordinate, own);
                if row.joint != column.joint {
                    entry(column.coordinate, row.coordinate, other);
                }
            }
        }
    }
}

/// The distance of two points at one configuration.
///
/// ```text
/// l = |d|,  l_i = e·d_i,  l_ij = [d_i·d_j − (e·d_i)(e·d_j)] / l + e·d_ij,  e = d / l
/// ```
///
/// Where the points coincide it has no direction; then the derivatives are zero.
pub(crate) struct Distance<'a, S: Scalar> {
    pair: &'a PointPair,
    tree: &'a Tree,
    poses: &'a Poses<S>,
    at: Separation<S>,
    direction: Vec3<S>,
    inverse: S,
    pub(crate) length: S,
}

impl<'a, S: Scalar> Distance<'a, S> {
    pub(crate) fn new(pair: &'a PointPair, tree: &'a Tree, poses: &'a Poses<S>) -> Self {
        let at = pair.separation(tree, poses);
        let square = at.difference.dot(at.difference);
        let [length, inverse] = square.roots();
        Self { pair, tree, poses, direction: at.difference * inverse, at, inverse, length }
    }

    /// Magnitude of what was subtracted, for round-off estimates.
    pub(crate) fn magnitude(&self) -> S::Magnitude {
        self.at.magnitude
    }

    /// Calls `entry(i, l_i)` for each joint between the points.
    pub(crate) fn for_each_derivative(&self, mut entry: impl FnMut(usize, S)) {
        for joint in &self.pair.path {
            let gradient = joint.gradient(self.tree, self.poses, &self.at);
            entry(joint.coordinate, self.direction.dot(gradient));
        }
    }

    /// Calls `entry(i, j, l_ij)` for each ordered pair of joints between the points.
    pub(crate) fn for_each_second_derivative(&self, entry: impl FnMut(usize, usize, S)) {
        let value = |[row, column]: [Vec3<S>; 2], seconds: [Vec3<S>; 2]| {
            let across = row.dot(column) - self.direction.dot(row) * self.direction.dot(column);
            seconds.map(|second| across * self.inverse + self.direction.dot(second))
        };
        self.pair.for_each_pair((self.tree, self.poses, &self.at), value, entry);
    }
}

impl Distance<'_, f64> {
    /// Its direction `e` and `1/l`; both zero where the points coincide.
    pub(crate) fn line(&self) -> (Vec3, f64) {
        (self.direction, self.inverse)
    }

    /// Bounds of `|l_i|`, `|l_ij|` and `|l_ijk|`: with `r` the longest lever of a joint, `r`, `r (r/l + 1)` and
    /// `r (3 r²/l² + 3 r/l + 1)`. Not finite where the points coincide.
    pub(crate) fn steepness(&self) -> [f64; 3] {
        let lever = self.pair.lever(self.tree, self.poses, &self.at);
        let ratio = lever / self.length;
        [lever, lever * (ratio + 1.0), lever * (3.0 * ratio * (ratio + 1.0) + 1.0)]
    }
}

/// Two directions across one, of length 1 each.
pub(crate) fn across(along: Vec3) -> [Vec3; 2] {
    let Vec3([x, y, z]) = along;
    let least = if x.abs() <= y.abs().min(z.abs()) {
        Vec3([1.0, 0.0, 0.0])
    } else if y.abs() <= z.abs() {
        Vec3([0.0, 1.0, 0.0])
    } else {
        Vec3([0.0, 0.0, 1.0])
    };
    let unit = |vector: Vec3| {
        let length = vector.norm();
        if length > 0.0 { vector * (1.0 / length) } else { Vec3::ZERO }
    };
    let first = unit(along.cross(least));
    [first, unit(along.cross(first))]
}

impl PointPair {
    /// The farthest that one joint moves the points against each other, by a unit of its coordinate.
    pub(crate) fn lever(&self, tree: &Tree, poses: &Poses, at: &Separation) -> f64 {
        let levers = self.path.iter().map(|joint| joint.gradient(tree, poses, at).norm());
        levers.fold(0.0, f64::max)
    }
}

/// The length of a path, and the sums of the bounds that its segments have.
pub(crate) fn steepness_of<'a>(
    segments: impl Iterator<Item = Distance<'a, f64>>,
) -> (f64, [f64; 3]) {
    let (mut length, mut sums) = (0.0, [0.0; 3]);
    for segment in segments {
        length += segment.length;
        sums.iter_mut().zip(segment.steepness()).for_each(|(sum, own)| *sum += own);
    }
    (length, sums)
}

/// The end of a segment that all joints between its points carry.
pub(crate) struct MovingEnd<'a> {
    pub(crate) of: &'a Attachment,
    pub(crate) point: Vec3,
    /// The other end.
    pub(crate) base: &'a Attachment,
    pub(crate) base_point: Vec3,
    /// From the other end to this one, of length 1, or zero where they coincide.
    pub(crate) along: Vec3,
    inverse: f64,
}

/// Those of the segments of a path whose lengths change.
pub(crate) fn moving_ends<'a>(
    segments: &'a [PointPair],
    tree: &'a Tree,
    poses: &'a Poses,
) -> impl Iterator<Item = MovingEnd<'a>> {
    segments.iter().filter_map(|pair| {
        let (of, carries) = pair.moving_end()?;
        let Distance { at: Separation { a, b, .. }, direction, inverse, .. } =
            Distance::new(pair, tree, poses);
        Some(match carries {
            Carries::A => {
                let (base, along) = (&pair.b, direction);
                MovingEnd { of, point: a, base, base_point: b, along, inverse }
            }
            _ => {
                let (base, along) = (&pair.a, -direction);
                MovingEnd { of, point: b, base, base_point: a, along, inverse }
            }
        })
    })
}

impl MovingEnd<'_> {
    /// How `along` turns as the end moves.
    pub(crate) fn turned(&self, moved: Vec3) -> Vec3 {
        (moved - self.along * self.along.dot(moved)) * self.inverse
    }
}

/// A product `u·w` at one configuration.
///
/// ```text
/// h = u·w,  h_i = u_i·w + u·w_i,  h_ij = u_ij·w + u_i·w_j + u_j·w_i + u·w_ij
/// ```
///
/// Joints that carry both bodies turn both vectors alike, and change nothing.
pub(crate) struct ProductAt<'a, S: Scalar> {
    pub(crate) product: &'a Product,
    pub(crate) tree: &'a Tree,
    pub(crate) poses: &'a Poses<S>,
    pub(crate) at: Separation<S>,
    pub(crate) u: Vec3<S>,
    pub(crate) w: Vec3<S>,
}

impl Product {
    /// Where the body is that carries a direction; of a difference there is none.
    pub(crate) fn end(&self, vector: Vector) -> Option<&Attachment> {
        match vector {
            Vector::Difference => None,
            Vector::WithA(_) => Some(&self.points.a),
            Vector::WithB(_) => Some(&self.points.b),
        }
    }
}

impl<'a, S: Scalar> ProductAt<'a, S> {
    pub(crate) fn new(product: &'a Product, tree: &'a Tree, poses: &'a Poses<S>) -> Self {
        let points = &product.points;
        let at = points.separation(tree, poses);
        let turned = |joint: usize, direction: Vec3| match joint {
            WORLD => Vec3::lift(direction),
            joint => poses.rotation[joint].apply(Vec3::lift(direction)),
        };
        let in_world = |vector: Vector| match vector {
            Vector::Difference => at.difference,
            Vector::WithA(direction) => turned(points.a.joint, direction),
            Vector::WithB(direction) => turned(points.b.joint, direction),
        };
        let (u, w) = (in_world(product.u), in_world(product.w));
        Self { product, tree, poses, at, u, w }
    }

    pub(crate) fn value(&self) -> S {
        self.u.dot(self.w)
    }

    /// That of its vectors which is only turned, or one of them: it changes across itself.
    pub(crate) fn direction(&self) -> Vec3<S> {
        match self.product.w {
            Vector::Difference => self.u,
            _ => self.w,
        }
    }

    /// Magnitude of what was subtracted, for round-off estimates.
    pub(crate) fn magnitude(&self) -> S::Magnitude {
        let magnitude = |vector, value: Vec3<S>| match vector {
            Vector::Difference => self.at.magnitude,
            _ => size(value),
        };
        magnitude(self.product.u, self.u) * magnitude(self.product.w, self.w)
    }

    /// Derivatives of `u` and `w` by the coordinate of a joint on the path.
    #[inline(always)]
    pub(crate) fn gradients(&self, joint: &PathJoint) -> [Vec3<S>; 2] {
        [self.gradient(joint, self.product.u, self.u), self.gradient(joint, self.product.w, self.w)]
    }

    #[inline(always)]
    fn gradient(&self, joint: &PathJoint, vector: Vector, value: Vec3<S>) -> Vec3<S> {
        match (vector, joint.carries) {
            (Vector::Difference, _) => joint.gradient(self.tree, self.poses, &self.at),
            (Vector::WithA(_), Carries::A) | (Vector::WithB(_), Carries::B) => {
                self.poses.turned(self.tree, joint.joint, value)
            }
            _ => Vec3::ZERO,
        }
    }

    /// Calls `entry(i, h_i)` for each joint on the path. Each vector pulls at the other: a difference by its points,
    /// a direction as a couple, `w·(ω × u) = ω·(u × w)`.
    pub(crate) fn for_each_derivative(&self, mut entry: impl FnMut(usize, S)) {
        let (mut forces, mut couples) = ([Vec3::ZERO; 2], [Vec3::ZERO; 2]);
        let Self { product, tree, poses, at, u, w } = self;
        for (vector, own, other) in [(product.u, u, w), (product.w, w, u)] {
            match vector {
                Vector::Difference => forces = [*other, -*other],
                Vector::WithA(_) => couples[0] += own.cross(*other),
                Vector::WithB(_) => couples[1] += own.cross(*other),
            }
        }
        let ([at_a, at_b], [turning_a, turning_b]) = (forces, couples);
        for path in &product.points.path {
            let (point, force, couple) = match path.carries {
                Carries::A => (at.a, at_a, turning_a),
                Carries::B => (at.b, at_b, turning_b),
                Carries::Both => continue,
            };
            entry(path.coordinate, poses.pushed(tree, path.joint, (point, force), couple));
        }
    }

    /// Calls `entry(i, j, h_ij)` for each ordered pair of joints on the path.
    pub(crate) fn for_each_second_derivative(&self, mut entry: impl FnMut(usize, usize, S)) {
        let (tree, poses) = (self.tree, self.poses);
        for row in &self.product.points.path {
            let [row_u, row_w] = self.gradients(row);
            for column in &self.product.points.path {
                let [u, w] = self.gradients(column);
                let u_second = row.second(row_u, tree, poses, (column, u));
                let w_second = row.second(row_w, tree, poses, (column, w));
                let mixed = row_u.dot(w) + u.dot(row_w);
                let value = mixed + u_second.dot(self.w) + self.u.dot(w_second);
                entry(row.coordinate, column.coordinate, value);
            }
        }
    }
}
