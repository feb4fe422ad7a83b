//! Plants.

pub(crate) mod choice;
pub(crate) mod diagnose;
pub(crate) mod facade;
pub(crate) mod initial;
pub(crate) mod known;
pub(crate) mod period;
pub(crate) mod projected;
pub(crate) mod second_order;
pub(crate) mod settle;
pub(crate) mod site;
pub(crate) mod snapshot;
pub(crate) mod solve;
pub(crate) mod spare;
