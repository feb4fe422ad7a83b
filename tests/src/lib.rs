//! plantd-tests

pub mod server;
