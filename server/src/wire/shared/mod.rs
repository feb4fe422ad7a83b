//! What the services share.

pub mod hub;
pub mod jobs;
pub mod state;
