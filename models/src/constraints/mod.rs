//! Constraints.

pub(crate) mod closure;
pub(crate) mod in_plane;
