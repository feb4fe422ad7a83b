//! What the tests of plantd share: servers, links, reference data.

pub mod links;
pub mod reference;
pub use plantd_process as server;
