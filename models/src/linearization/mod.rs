//! Linearization.

pub(crate) mod chain;
pub(crate) mod collocation;
pub(crate) mod linearize;
pub(crate) mod map;
pub(crate) mod parameters;
pub(crate) mod second_order;
pub(crate) mod step;
