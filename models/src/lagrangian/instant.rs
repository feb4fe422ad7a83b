//! What forces depend on.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Motion;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::tree::{Attachment, Tree, WORLD};

/// Where and how fast a mechanism is, and its inputs: what forces depend on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Instant<'a, S: Scalar = f64> {
    pub(crate) tree: &'a Tree,
    pub(crate) poses: &'a Poses<S>,
    /// With axes and twists of the same configuration and velocity.
    pub(crate) momenta: &'a Momenta<S>,
    /// Of all coordinates.
    pub(crate) q: &'a [S],
    /// Of all coordinates.
    pub(crate) velocity: &'a [S],
    pub(crate) inputs: &'a [S],
}

impl<S: Scalar> Instant<'_, S> {
    /// Twist of what a point is fixed to.
    pub(crate) fn twist(&self, end: &Attachment) -> Motion<S> {
        match end.joint {
            WORLD => Motion::default(),
            joint => self.momenta.twist_of(self.tree, joint),
        }
    }
}
