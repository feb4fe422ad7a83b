//! Points of frames, by the joints that move them.

use crate::math::spatial::{Mat3, Vec3};
use crate::model::tree::JointKind;

/// A frame of a model, with a point of it.
#[derive(Clone, Debug)]
pub struct Site {
    /// The joints that carry it, root first.
    pub(crate) joints: Vec<SiteJoint>,
    /// The frame's axes in those of the last joint.
    pub(crate) rotation: Mat3,
    /// The point in the frame of the last joint.
    pub(crate) point: Vec3,
}

/// A joint above a site.
#[derive(Clone, Debug)]
pub(crate) struct SiteJoint {
    pub(crate) kind: JointKind,
    pub(crate) coordinate: usize,
    pub(crate) orientation: usize,
    /// Pose at zero in the joint above.
    pub(crate) rotation: Mat3,
    pub(crate) translation: Vec3,
}
