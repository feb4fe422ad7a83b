//! A plant with all that has a say in its steps, and what is told of it.

pub(crate) mod closing;
pub mod core;
pub mod error;
pub mod event;
pub(crate) mod last_step;
pub(crate) mod leases;
pub(crate) mod mark;
pub(crate) mod records;
pub(crate) mod tap;
pub mod view;
pub mod watchdog;
