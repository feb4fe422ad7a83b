//! The service of models.

pub(crate) mod drawing;
pub mod model;
pub(crate) mod settle;
