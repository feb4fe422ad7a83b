//! What commands print: results and failures, as text for people or as JSON.

pub(crate) mod derivatives;
pub(crate) mod failure;
pub(crate) mod markup;
pub(crate) mod model;
pub(crate) mod plant;
pub(crate) mod printer;
pub(crate) mod text;
