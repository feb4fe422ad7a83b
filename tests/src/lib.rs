//! plantd-tests

pub mod links;
pub mod server;
