//! Cases of scenarios, run: the plant, its controller, and what is seen of them.

pub(crate) mod outcome;
pub(crate) mod prepared;
pub(crate) mod process;
pub(crate) mod run;
pub(crate) mod server;
