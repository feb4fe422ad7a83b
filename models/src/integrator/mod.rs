//! The integrator.

pub(crate) mod balls;
pub(crate) mod blocks;
pub(crate) mod collocation;
pub(crate) mod conditioning;
pub(crate) mod matrix;
pub(crate) mod newton;
pub(crate) mod predictor;
pub(crate) mod scheme;
pub(crate) mod settings;
