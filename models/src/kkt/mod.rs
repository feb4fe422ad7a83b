//! The linear system of a step.

pub(crate) mod loops;
pub(crate) mod planar;
pub(crate) mod schur;
pub(crate) mod space;
pub(crate) mod system;
