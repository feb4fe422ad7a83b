//! Holonomic constraints `h(q) = 0`.
//!
//! Each equation is a file in [`equations`]. [`closure`] evaluates `h`, `Dh` and `Σ λ D²h` of all constraints of a model, which [`bends`] has as products of vectors; [`in_plane`] has them as wrenches
//! on bodies, for loops of planar mechanisms. [`conditioning`] tells redundant from singular, and
//! [`projection`] finds the configuration and the momentum on them that are nearest.

pub(crate) mod bends;
pub(crate) mod closure;
pub(crate) mod conditioning;
pub(crate) mod equations;
pub(crate) mod in_plane;
pub(crate) mod projection;
