//! All joints of a scene, and points and directions of its frames by them.

use std::collections::BTreeMap;

use plantd_math::spatial::{Mat3, Vec3};
use plantd_scene::Point;

use crate::compile::scene::{Placement, frames};
use crate::lagrangian::kinematics::Poses as JointPoses;
use crate::model::mechanism::Model;
use crate::model::tree::{Attachment, JointKind, Tree, WORLD};

/// The joints of a scene, those without mass too, with its frames and coordinates.
#[derive(Clone, Debug)]
pub(super) struct Rig {
    pub(super) tree: Tree,
    /// Coordinates below this are dynamic.
    pub(super) dynamic: usize,
    frames: BTreeMap<String, Placement>,
    coordinates: BTreeMap<String, usize>,
    /// The joint that each coordinate moves.
    joints: BTreeMap<usize, usize>,
}

/// A vector fixed in the frame of a joint, or in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Direction {
    joint: usize,
    vector: Vec3,
}

impl Direction {
    /// Along an axis of the world.
    pub(super) fn of_world(axis: usize) -> Self {
        Self { joint: WORLD, vector: Mat3::IDENTITY.0[axis] }
    }

    /// In world axes.
    pub(super) fn in_world(&self, poses: &JointPoses) -> Vec3 {
        match self.joint {
            WORLD => self.vector,
            joint => poses.rotation[joint].apply(self.vector),
        }
    }
}

impl Rig {
    pub(super) fn new(model: &Model) -> Self {
        let (tree, placed) = frames(&model.scene);
        let world = ("world".to_owned(), Placement::HERE);
        let names = model.coordinates.iter().enumerate();
        let joints = tree.joints.iter().enumerate().map(|(j, joint)| (joint.coordinate, j));
        Self {
            joints: joints.collect(),
            dynamic: model.dimensions.dynamic,
            tree,
            frames: placed.into_iter().chain([world]).collect(),
            coordinates: names.map(|(i, coordinate)| (coordinate.name.clone(), i)).collect(),
        }
    }

    /// Where a frame of the scene is fixed.
    pub(super) fn frame(&self, name: &str) -> Placement {
        self.frames[name]
    }

    /// Index of a coordinate of the scene.
    pub(super) fn coordinate(&self, name: &str) -> usize {
        self.coordinates[name]
    }

    /// A point of a frame.
    pub(super) fn at(&self, frame: &str, point: [f64; 3]) -> Attachment {
        let Placement { joint, rotation, translation } = self.frames[frame];
        Attachment { joint, point: translation + rotation.apply(Vec3(point)) }
    }

    /// A point of the scene.
    pub(super) fn point(&self, point: &Point) -> Attachment {
        self.at(&point.frame, point.at)
    }

    /// A direction fixed in a frame.
    pub(super) fn direction(&self, frame: &str, vector: [f64; 3]) -> Direction {
        let Placement { joint, rotation, .. } = self.frames[frame];
        Direction { joint, vector: rotation.apply(Vec3(vector)) }
    }

    /// The joint that a coordinate moves, and its axis; none for the length of a constraint.
    pub(super) fn axis(&self, coordinate: usize) -> Option<(usize, Direction)> {
        let joint = *self.joints.get(&coordinate)?;
        Some((joint, Direction { joint, vector: Mat3::IDENTITY.0[2] }))
    }

    /// Whether the axis of a joint is one about which it turns.
    pub(super) fn turns(&self, joint: usize) -> bool {
        self.tree.joints[joint].kind != JointKind::Prismatic
    }

    /// A point in the world.
    pub(super) fn place(&self, poses: &JointPoses, at: &Attachment) -> Vec3 {
        let (point, origin) = poses.point(&self.tree, at);
        point + origin
    }
}
