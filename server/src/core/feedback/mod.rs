//! Feedback laws in a plant's own loop, and the regulators that compute them.

pub mod active;
pub mod law;
pub mod regulator;
pub mod space;
