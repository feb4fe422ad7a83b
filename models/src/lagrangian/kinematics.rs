//! Poses of the joints at a configuration.

use plantd_math::scalar::{Scalar, in_registers};
use plantd_math::spatial::{Mat3, Vec3};

use crate::model::tree::{Attachment, JointKind, Tree, WORLD};

/// Poses of the joints of a tree, each position measured from the origin of its own tree.
#[derive(Clone, Debug)]
pub(crate) struct Poses<S = f64> {
    pub(crate) rotation: Vec<Mat3<S>>,
    pub(crate) position: Vec<Vec3<S>>,
    /// World position of the origin of the tree rooted at a joint; meaningful for roots.
    pub(crate) origin: Vec<Vec3<S>>,
    /// Position of a joint relative to its parent.
    edge: Vec<Vec3<S>>,
    /// Angles by which hinges and screws turn about their axes, in their order, and their sines and cosines.
    angles: Vec<S>,
    turns: Vec<[S; 2]>,
}

/// A configuration, as far as potentials and constraints depend on it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place<'a, S = f64> {
    pub(crate) tree: &'a Tree,
    pub(crate) poses: &'a Poses<S>,
    /// All coordinates.
    pub(crate) q: &'a [S],
}

impl<S: Scalar> Poses<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        let turns = tree.joints.iter().filter(|joint| joint.kind.turns_about_axis()).count();
        Self {
            rotation: vec![Mat3::IDENTITY; n],
            position: vec![Vec3::ZERO; n],
            origin: vec![Vec3::ZERO; n],
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
    pub(crate) fn axis(&self, joint: usize) -> Vec3<S> {
        self.rotation[joint].0[2]
    }

    /// Poses at the configuration `q`, with the orientations of ball joints: one pass from the roots
    /// to the leaves, about 50 flops and one sine and cosine for each joint.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, tree: &Tree, q: &[S], orientations: &[Mat3<S>]) {
        in_registers!(S, {
            if tree.has_other_joints {
                self.walk::<true>(tree, q, orientations);
            } else {
                self.walk::<false>(tree, q, orientations);
            }
        })
    }

    /// `OTHER`: some joint is neither revolute nor prismatic.
    #[inline(always)]
    fn walk<const OTHER: bool>(&mut self, tree: &Tree, q: &[S], orientations: &[Mat3<S>]) {
        let hinges = tree.joints.iter().filter(|joint| joint.kind.turns_about_axis());
        for (angle, hinge) in self.angles.iter_mut().zip(hinges) {
            *angle = q[hinge.coordinate];
        }
        S::sin_cos_of_all(&self.angles, &mut self.turns);
        let mut hinges_before = 0;
        for (i, joint) in tree.joints.iter().enumerate() {
            if let (true, JointKind::Ball(1 | 2)) = (OTHER, joint.kind) {
                // The entry before has turned already.
                let Mat3([x, y, z]) = self.rotation[i - 1];
                self.rotation[i] = Mat3([y, z, x]);
                self.position[i] = self.position[i - 1];
                if joint.anchor {
                    self.move_origin(tree, i);
                }
                continue;
            }
            // In the parent's frame, which nothing waits for.
            let own = if joint.kind.turns_about_axis() {
                let turn = self.turns[hinges_before];
                hinges_before += 1;
                turned_about_z(&joint.rotation, turn)
            } else {
                Mat3::lift(joint.rotation)
            };
            let (turned, mut edge) = if joint.parent == WORLD {
                self.origin[i] = Vec3::lift(joint.translation);
                (own, Vec3::ZERO)
            } else {
                let parent = &self.rotation[joint.parent];
                (parent.times(&own), parent.apply(Vec3::lift(joint.translation)))
            };
            let z = turned.0[2];
            self.rotation[i] = match joint.kind {
                JointKind::Ball(0) if OTHER => {
                    let Mat3([x, y, z]) = turned.times(&orientations[joint.orientation]);
                    Mat3([y, z, x])
                }
                _ => turned,
            };
            match joint.kind {
                JointKind::Prismatic => edge += z * q[joint.coordinate],
                JointKind::Screw(pitch) if OTHER => edge += z * (q[joint.coordinate] * pitch),
                _ => {}
            }
            self.edge[i] = edge;
            self.position[i] =
                if joint.parent == WORLD { edge } else { self.position[joint.parent] + edge };
            if joint.anchor {
                self.move_origin(tree, i);
            }
        }
    }

    /// Makes joint `anchor` the origin. All joints placed so far in its tree are its ancestors.
    fn move_origin(&mut self, tree: &Tree, anchor: usize) {
        self.origin[tree.joints[anchor].root] += self.position[anchor];
        self.position[anchor] = Vec3::ZERO;
        let mut i = anchor;
        while tree.joints[i].parent != WORLD {
            let parent = tree.joints[i].parent;
            self.position[parent] = self.position[i] - self.edge[i];
            i = parent;
        }
    }

    /// A point relative to the origin of its tree, and that origin.
    #[inline]
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
        let axis = self.axis(joint);
        match tree.joints[joint].kind {
            JointKind::Prismatic => axis,
            JointKind::Revolute | JointKind::Ball(_) => axis.cross(point - self.position[joint]),
            JointKind::Screw(pitch) => {
                axis.cross(point - self.position[joint]) + axis.scaled(pitch)
            }
        }
    }

    /// Derivative of a free vector carried by a joint by the joint's coordinate.
    #[inline]
    pub(crate) fn turned(&self, tree: &Tree, joint: usize, vector: Vec3<S>) -> Vec3<S> {
        match tree.joints[joint].kind {
            JointKind::Prismatic => Vec3::ZERO,
            _ => self.axis(joint).cross(vector),
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

#[inline(always)]
fn turned_about_z<S: Scalar>(frame: &Mat3, [s, c]: [S; 2]) -> Mat3<S> {
    let Mat3([x, y, z]) = Mat3::lift(*frame);
    Mat3([x * c + y * s, y * c - x * s, z])
}
