//! From scene to model.

pub(crate) mod cost;
pub(crate) mod forces;
pub(crate) mod loops;
mod pattern;
pub(crate) mod scene;
pub(crate) mod singular;
mod springs;
