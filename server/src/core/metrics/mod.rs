//! What the server counts.

pub mod counts;
pub mod histogram;
pub mod process;
pub mod registry;
pub mod tenants;
