//! The server's side of the shared-memory link: one thread for each open link.
//!
//! A thread makes its ports, owns them, and is the only one that touches them. It steps the plant
//! through a lease, as every other driver does. Cleaning up after dead processes takes milliseconds
//! and file access, so that a thread of its own does it.

pub mod config;
pub mod host;
pub(crate) mod worker;
