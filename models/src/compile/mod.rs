//! From scene to model.

pub(crate) mod cost;
mod explain;
pub(crate) mod forces;
pub(crate) mod loops;
mod pattern;
pub(crate) mod scene;
pub(crate) mod singular;
mod springs;
