//! Poses of the joints at a configuration.

use plantd_math::scalar::{Beside, Scalar, Wide};
use plantd_math::sided::{Composite, Sided};
use plantd_math::spatial::{Mat3, Pose, Vec3};

use crate::model::tree::{Attachment, JointKind, Tree, WORLD};

/// Poses of the joints of a tree, each position measured from the origin of its own tree. A ball joint has its pose at
/// its last axis.
#[derive(Clone, Debug)]
pub(crate) struct Poses<S: Scalar = f64> {
    pub(crate) rotation: Vec<Mat3<S>>,
    pub(crate) position: Vec<Vec3<S>>,
    /// World position of the origin of the tree rooted at a joint; meaningful for roots.
    pub(crate) origin: Vec<Vec3<S>>,
    /// Poses by slot, where those of several lie side by side; of the first two axes of a ball joint the `z` axis and
    /// the position alone.
    sides: Sided<Pose<S::Several>>,
    /// Position of a joint relative to what it hangs from.
    edge: Vec<Vec3<S>>,
    /// Angles by which hinges and screws turn about their axes, in their order, and their sines and cosines: whole fours,
    /// as many as are found at once, of which the last may be zero.
    angles: Vec<S>,
    turns: Vec<[S; 2]>,
}

/// A configuration, as far as potentials and constraints depend on it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place<'a, S: Scalar = f64> {
    pub(crate) tree: &'a Tree,
    pub(crate) poses: &'a Poses<S>,
    /// All coordinates.
    pub(crate) q: &'a [S],
}

/// What [`Poses::evaluate`] does.
struct Walk<'a, S: Scalar> {
    poses: &'a mut Poses<S>,
    tree: &'a Tree,
    q: &'a [S],
    orientations: &'a [Mat3<S>],
}

impl<S: Scalar> Beside<S> for Walk<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<S>>(self) {
        let Self { poses, tree, q, orientations } = self;
        if tree.has_other_joints {
            poses.walk::<W, true>(tree, q, orientations);
        } else {
            poses.walk::<W, false>(tree, q, orientations);
        }
    }
}

/// A matrix in registers.
#[inline(always)]
fn columns<S: Scalar, W: Wide<S>>(matrix: &Mat3<S>) -> [W::Triple; 3] {
    let Mat3([x, y, z]) = matrix;
    [W::triple(&x.0), W::triple(&y.0), W::triple(&z.0)]
}

/// A matrix times a vector that does not change.
#[inline(always)]
fn fixed<S: Scalar, W: Wide<S>>([x, y, z]: &[W::Triple; 3], v: &Vec3) -> W::Triple {
    let sum = W::triple_sum(W::triple_times(*x, v[0]), W::triple_times(*y, v[1]));
    W::triple_sum(sum, W::triple_times(*z, v[2]))
}

/// A matrix times a vector.
#[inline(always)]
fn moving<S: Scalar, W: Wide<S>>([x, y, z]: &[W::Triple; 3], v: &Vec3<S>) -> W::Triple {
    let sum = W::triple_sum(W::triple_scaled(*x, v[0]), W::triple_scaled(*y, v[1]));
    W::triple_sum(sum, W::triple_scaled(*z, v[2]))
}

impl<S: Scalar> Poses<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        let hinges = tree.joints.iter().filter(|joint| joint.kind.turns_about_axis()).count();
        let turns = if S::BESIDE > 1 { hinges.next_multiple_of(4) } else { hinges };
        Self {
            rotation: vec![Mat3::IDENTITY; n],
            position: vec![Vec3::ZERO; n],
            origin: vec![Vec3::ZERO; n],
            sides: Sided::zeros::<S>(if S::BESIDE > 1 { n } else { 0 }),
            edge: vec![Vec3::ZERO; n],
            angles: vec![S::ZERO; turns],
            turns: vec![[S::ZERO, S::ONE]; turns],
        }
    }

    /// The rotation of a ball joint, by the first of its three joints.
    pub(crate) fn of_ball(&self, tree: &Tree, first: usize) -> Mat3<S> {
        // The last of the three has the axes of the body in their order.
        let body = &self.rotation[first + 2];
        let joint = &tree.joints[first];
        let own = Mat3::lift(joint.rotation);
        let before = match joint.parent {
            WORLD => own,
            parent => self.rotation[parent].times(&own),
        };
        before.transpose().times(body)
    }

    /// World-axes direction of the axis of a joint.
    #[inline(always)]
    pub(crate) fn axis(&self, tree: &Tree, joint: usize) -> Vec3<S> {
        let [at, axis] = tree.slots.lines[joint];
        self.rotation[at].0[axis]
    }

    /// Where a joint is.
    #[inline(always)]
    pub(crate) fn place(&self, tree: &Tree, joint: usize) -> Vec3<S> {
        self.position[tree.slots.lines[joint][0]]
    }

    /// Poses of the slots that begin with `i`; of the first two axes of a ball joint, the `z` axis and the position
    /// alone. `BALLS`: some joint is a ball joint.
    #[inline(always)]
    pub(crate) fn wide<W: Wide<S>, const BALLS: bool>(&self, tree: &Tree, i: usize) -> Pose<W> {
        if S::BESIDE > 1 {
            return self.sides.wide::<S, W>(i);
        }
        if !BALLS {
            return self.pose(i).map(W::of_one);
        }
        let [at, axis] = tree.slots.lines[tree.slots.joints[i]];
        let z = self.rotation[at].0[axis];
        Pose { z, ..self.pose(at) }.map(W::of_one)
    }

    #[inline(always)]
    fn pose(&self, joint: usize) -> Pose<S> {
        let Mat3([x, y, z]) = self.rotation[joint];
        Pose { x, y, z, at: self.position[joint] }
    }

    /// Puts the pose of a joint, at its last axis, into its slots; `OTHER`: it may be a ball joint.
    #[inline(always)]
    fn put_beside<const OTHER: bool>(&mut self, tree: &Tree, joint: usize) {
        if S::BESIDE == 1 {
            return;
        }
        let pose = self.pose(joint);
        if !OTHER {
            return self.sides.put::<S>(joint, pose);
        }
        self.sides.put::<S>(tree.slots.of(joint), pose);
        if let JointKind::Ball(_) = tree.joints[joint].kind {
            for (axis, z) in [pose.x, pose.y].into_iter().enumerate() {
                let slot = tree.slots.of(joint - 2 + axis);
                let (sides, lane) = (&mut self.sides.0[slot / S::BESIDE], slot % S::BESIDE);
                let put = |several: &mut S::Several, number: S| number.put(several, lane);
                sides.z.zip(z, put);
                sides.at.zip(pose.at, put);
            }
        }
    }

    /// Poses at the configuration `q`, with the orientations of ball joints: one pass from the roots
    /// to the leaves, about 50 flops and one sine and cosine for each joint.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, tree: &Tree, q: &[S], orientations: &[Mat3<S>]) {
        S::beside(tree.joints.len(), Walk { poses: self, tree, q, orientations });
    }

    /// `OTHER`: some joint is neither revolute nor prismatic.
    #[inline(always)]
    fn walk<W: Wide<S>, const OTHER: bool>(
        &mut self,
        tree: &Tree,
        q: &[S],
        orientations: &[Mat3<S>],
    ) {
        let hinges = tree.joints.iter().filter(|joint| joint.kind.turns_about_axis());
        for (angle, hinge) in self.angles.iter_mut().zip(hinges) {
            *angle = q[hinge.coordinate];
        }
        S::sin_cos_of_all(&self.angles, &mut self.turns);
        let mut hinges_before = 0;
        let zero = W::triple(&[S::ZERO; 3]);
        let world = columns::<S, W>(&Mat3::IDENTITY);
        // The pose of the joint before stays in registers.
        let (mut last, mut last_position) = (world, zero);
        for (i, joint) in tree.joints.iter().enumerate() {
            if let (true, JointKind::Ball(1 | 2)) = (OTHER, joint.kind) {
                // The whole joint has its pose.
                continue;
            }
            let (parent, position) = match joint.parent {
                WORLD => (world, zero),
                parent if parent + 1 == i => (last, last_position),
                parent => {
                    (columns::<S, W>(&self.rotation[parent]), W::triple(&self.position[parent].0))
                }
            };
            let Mat3([x, y, z]) = &joint.rotation;
            let [mut x, mut y, z] =
                [fixed::<S, W>(&parent, x), fixed::<S, W>(&parent, y), fixed::<S, W>(&parent, z)];
            if joint.kind.turns_about_axis() {
                let [s, c] = self.turns[hinges_before];
                hinges_before += 1;
                let turned = W::triple_sum(W::triple_scaled(x, c), W::triple_scaled(y, s));
                y = W::triple_sum(W::triple_scaled(y, c), W::triple_scaled(x, -s));
                x = turned;
            }
            let mut edge = zero;
            if joint.parent == WORLD {
                self.origin[i] = Vec3::lift(joint.translation);
            } else {
                edge = fixed::<S, W>(&parent, &joint.translation);
            }
            last = [x, y, z];
            match joint.kind {
                JointKind::Prismatic => {
                    edge = W::triple_sum(edge, W::triple_scaled(z, q[joint.coordinate]));
                }
                JointKind::Screw(pitch) if OTHER => {
                    let slide = W::triple_scaled(z, q[joint.coordinate] * pitch);
                    edge = W::triple_sum(edge, slide);
                }
                JointKind::Ball(0) if OTHER => {
                    let Mat3([x, y, z]) = &orientations[joint.orientation];
                    last = [
                        moving::<S, W>(&last, x),
                        moving::<S, W>(&last, y),
                        moving::<S, W>(&last, z),
                    ];
                }
                _ => {}
            }
            let own = if OTHER { joint.last_axis(i) } else { i };
            W::put_triple(edge, &mut self.edge[own].0);
            let position = W::triple_sum(position, edge);
            last_position = self.set_aside::<W, OTHER>(tree, own, last, position);
        }
    }

    /// Takes note of the pose of a joint; returns its position, from the origin that counts from now on.
    #[inline(always)]
    fn set_aside<W: Wide<S>, const OTHER: bool>(
        &mut self,
        tree: &Tree,
        joint: usize,
        rotation: [W::Triple; 3],
        mut position: W::Triple,
    ) -> W::Triple {
        for (column, to) in rotation.into_iter().zip(&mut self.rotation[joint].0) {
            W::put_triple(column, &mut to.0);
        }
        W::put_triple(position, &mut self.position[joint].0);
        if tree.joints[joint].anchor {
            self.move_origin(tree, joint);
            position = W::triple(&[S::ZERO; 3]);
        }
        self.put_beside::<OTHER>(tree, joint);
        position
    }

    /// Makes joint `anchor` the origin. All joints placed so far in its tree are its ancestors.
    fn move_origin(&mut self, tree: &Tree, anchor: usize) {
        self.origin[tree.joints[anchor].root] += self.position[anchor];
        self.position[anchor] = Vec3::ZERO;
        let mut i = anchor;
        loop {
            let parent = tree.joints[tree.joints[i].first_axis(i)].parent;
            if parent == WORLD {
                return;
            }
            self.position[parent] = self.position[i] - self.edge[i];
            self.put_beside::<true>(tree, parent);
            i = parent;
        }
    }

    /// A point relative to the origin of its tree, and that origin.
    #[inline(always)]
    pub(crate) fn point(&self, tree: &Tree, at: &Attachment) -> (Vec3<S>, Vec3<S>) {
        let point = Vec3::lift(at.point);
        if at.joint == WORLD {
            (point, Vec3::ZERO)
        } else {
            (
                self.position[at.joint] + self.rotation[at.joint].apply(point),
                self.origin[tree.joints[at.joint].root],
            )
        }
    }

    /// Derivative of a point carried by a joint by the joint's coordinate; `point` is relative to the
    /// origin of the joint's tree.
    #[inline(always)]
    pub(crate) fn point_gradient(&self, tree: &Tree, joint: usize, point: Vec3<S>) -> Vec3<S> {
        let (axis, arm) = (self.axis(tree, joint), point - self.place(tree, joint));
        match tree.joints[joint].kind {
            JointKind::Prismatic => axis,
            JointKind::Revolute | JointKind::Ball(_) => axis.cross(arm),
            JointKind::Screw(pitch) => axis.cross(arm) + axis.scaled(pitch),
        }
    }

    /// What a force `f` at a point `p` that a joint carries, and a couple `c`, push along the joint's coordinate.
    ///
    /// ```text
    /// hinge: axis · ((p − o) × f + c)      slider: axis · f      screw: both
    /// ```
    #[inline(always)]
    pub(crate) fn pushed(
        &self,
        tree: &Tree,
        joint: usize,
        (point, force): (Vec3<S>, Vec3<S>),
        couple: Vec3<S>,
    ) -> S {
        let (axis, arm) = (self.axis(tree, joint), point - self.place(tree, joint));
        let turned = || axis.dot(arm.cross(force) + couple);
        match tree.joints[joint].kind {
            JointKind::Prismatic => axis.dot(force),
            JointKind::Revolute | JointKind::Ball(_) => turned(),
            JointKind::Screw(pitch) => turned() + axis.dot(force) * pitch,
        }
    }

    /// Derivative of a free vector carried by a joint by the joint's coordinate.
    #[inline]
    pub(crate) fn turned(&self, tree: &Tree, joint: usize, vector: Vec3<S>) -> Vec3<S> {
        match tree.joints[joint].kind {
            JointKind::Prismatic => Vec3::ZERO,
            _ => self.axis(tree, joint).cross(vector),
        }
    }

    /// How the gradient by joint `row` of a vector that both joints carry changes with joint `column`,
    /// one of them above the other: the axis of the upper one turns what the lower one moves. Within a
    /// ball joint the axes turn with it.
    #[inline]
    pub(crate) fn turned_gradient(
        &self,
        tree: &Tree,
        (row, row_gradient): (usize, Vec3<S>),
        (column, column_gradient): (usize, Vec3<S>),
    ) -> Vec3<S> {
        let (turning, turned) = if row < column && !tree.one_ball(row, column) {
            (row, column_gradient)
        } else {
            (column, row_gradient)
        };
        self.turned(tree, turning, turned)
    }
}
