//! What forces depend on.

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::tree::Tree;

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
