//! Between messages and the types of the core, with every check on the way in.

pub mod convert;
pub(crate) mod declare;
pub(crate) mod plant_info;
pub mod report;
pub(crate) mod run_info;
pub(crate) mod saved;
