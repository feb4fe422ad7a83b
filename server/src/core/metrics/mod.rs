//! What the server counts.

pub mod counts;
pub mod histogram;
pub mod registry;
