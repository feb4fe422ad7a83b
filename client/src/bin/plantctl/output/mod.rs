//! What commands print: results and failures, for people, as JSON or as comma-separated values.

pub(crate) mod derivatives;
pub(crate) mod failure;
pub(crate) mod markup;
pub(crate) mod model;
pub(crate) mod page;
pub(crate) mod plant;
pub(crate) mod printer;
pub(crate) mod text;
