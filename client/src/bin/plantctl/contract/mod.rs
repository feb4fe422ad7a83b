//! Messages of the contract: as JSON, and the names of their entries.

pub(crate) mod json;
pub(crate) mod mistakes;
pub(crate) mod names;
