//! The service of models.

pub(crate) mod drawing;
pub(crate) mod kept;
pub mod model;
pub(crate) mod settle;
