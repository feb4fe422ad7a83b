//! Poses of the joints at a configuration.

use crate::spatial::{Mat3, Vec3};
use crate::tree::{Attachment, JointKind, Tree, WORLD};

/// Poses of the joints of a tree, each position measured from the origin of its own tree.
#[derive(Clone, Debug)]
pub(crate) struct Poses {
    pub(crate) rotation: Vec<Mat3>,
    pub(crate) position: Vec<Vec3>,
    /// World position of the origin of the tree rooted at a joint; meaningful for roots.
    pub(crate) origin: Vec<Vec3>,
    /// Position of a joint relative to its parent.
    edge: Vec<Vec3>,
}

impl Poses {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        Self {
            rotation: vec![Mat3::IDENTITY; n],
            position: vec![Vec3::ZERO; n],
            origin: vec![Vec3::ZERO; n],
            edge: vec![Vec3::ZERO; n],
        }
    }

    /// World-axes direction of the axis of a joint.
    #[inline(always)]
    pub(crate) fn axis(&self, joint: usize) -> Vec3 {
        self.rotation[joint].0[2]
    }

    /// Poses at the configuration `q`: one pass from the roots to the leaves, about 50 flops and one
    /// sine and cosine for each joint.
    pub(crate) fn evaluate(&mut self, tree: &Tree, q: &[f64]) {
        for (i, joint) in tree.joints.iter().enumerate() {
            let (turned, mut edge) = if joint.parent == WORLD {
                self.origin[i] = joint.translation;
                (joint.rotation, Vec3::ZERO)
            } else {
                let parent = &self.rotation[joint.parent];
                (parent.times(&joint.rotation), parent.apply(joint.translation))
            };
            let Mat3([x, y, z]) = turned;
            match joint.kind {
                JointKind::Revolute => {
                    let (s, c) = q[joint.coordinate].sin_cos();
                    self.rotation[i] = Mat3([x * c + y * s, y * c - x * s, z]);
                }
                JointKind::Prismatic => {
                    self.rotation[i] = turned;
                    edge += z * q[joint.coordinate];
                }
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
    pub(crate) fn point(&self, tree: &Tree, at: &Attachment) -> (Vec3, Vec3) {
        if at.joint == WORLD {
            (at.point, Vec3::ZERO)
        } else {
            (
                self.position[at.joint] + self.rotation[at.joint].apply(at.point),
                self.origin[tree.joints[at.joint].root],
            )
        }
    }

    /// Derivative of a point carried by a joint by the joint's coordinate; `point` is relative to the
    /// origin of the joint's tree.
    #[inline]
    pub(crate) fn point_gradient(&self, tree: &Tree, joint: usize, point: Vec3) -> Vec3 {
        match tree.joints[joint].kind {
            JointKind::Revolute => self.axis(joint).cross(point - self.position[joint]),
            JointKind::Prismatic => self.axis(joint),
        }
    }
}
