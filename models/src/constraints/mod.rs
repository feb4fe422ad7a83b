//! Constraints.

pub(crate) mod closure;
pub(crate) mod conditioning;
pub(crate) mod in_plane;
pub(crate) mod projection;
