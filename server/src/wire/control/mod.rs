//! The service of linearizations, regulators, filters and optimisations.

pub(crate) mod analysis;
pub(crate) mod case;
pub(crate) mod derivatives;
pub(crate) mod expected;
pub(crate) mod kalman;
pub(crate) mod mechanics;
pub(crate) mod optimize;
pub(crate) mod points;
pub(crate) mod reference;
pub(crate) mod rollout;
pub mod service;
