//! Between messages and the types of the core, with every check on the way in.

pub mod checks;
pub(crate) mod declare;
pub mod drawing;
pub mod matrices;
pub mod models;
pub(crate) mod plant_info;
pub mod poles;
pub mod report;
pub(crate) mod run_info;
pub(crate) mod saved;
pub mod settings;
pub mod start;
pub mod states;
pub mod weights;
