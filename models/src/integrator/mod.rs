//! The integrator.

pub(crate) mod balls;
pub(crate) mod blocks;
pub(crate) mod collocation;
pub(crate) mod explain;
pub(crate) mod matrix;
pub(crate) mod midpoint;
pub(crate) mod newton;
pub(crate) mod predictor;
pub(crate) mod report;
pub(crate) mod residual;
pub(crate) mod scheme;
pub(crate) mod settings;
pub(crate) mod state;
pub(crate) mod turning;
pub(crate) mod workspace;
