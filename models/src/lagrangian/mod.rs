//! The Lagrangian.

pub(crate) mod arrangement;
pub(crate) mod curvature;
pub(crate) mod derivatives;
pub(crate) mod energy;
pub(crate) mod forces;
pub(crate) mod kinematics;
pub(crate) mod mechanics;
pub(crate) mod momenta;
pub(crate) mod planar;
pub(crate) mod plane;
pub(crate) mod potentials;
#[cfg(test)]
pub(crate) mod samples;
pub(crate) mod vectors;
