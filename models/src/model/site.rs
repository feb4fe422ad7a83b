//! Points of frames, by the joints that move them.

use plantd_math::spatial::{Mat3, Vec3};

use crate::model::tree::Joint;

/// A frame of a model, with a point of it.
#[derive(Clone, Debug)]
pub struct Site {
    /// The joints that carry it, root first.
    pub(crate) joints: Vec<Joint>,
    /// The frame's axes in those of the last joint.
    pub(crate) rotation: Mat3,
    /// The point in the frame of the last joint.
    pub(crate) point: Vec3,
}
