//! The linear system of a step.

pub(crate) mod loops;
pub(crate) mod planar;
pub(crate) mod space;
