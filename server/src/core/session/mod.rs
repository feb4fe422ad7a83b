//! A plant session: one plant, its lease, and what it publishes.
//!
//! Only the holder of the lease moves the plant. Others lock the core to copy a state or a plant
//! out of it, which takes microseconds; energies, linearizations and gains are computed on copies.

pub mod creation;
pub(crate) mod feedback;
pub(crate) mod gate;
pub mod lease;
pub mod life;
pub(crate) mod place;
pub(crate) mod recording;
pub mod run;
pub(crate) mod running;
pub mod shared;
