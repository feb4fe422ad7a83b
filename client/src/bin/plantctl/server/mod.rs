//! The server that a command speaks to.

pub(crate) mod context;
pub(crate) mod known;
pub(crate) mod names;
pub(crate) mod own;
pub(crate) mod page;
