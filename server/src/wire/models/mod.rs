//! The service of models.

pub mod model;
pub(crate) mod settle;
