//! Plants: a state and the memory of a step, behind one facade.
//!
//! Read [`facade`] first: what a user of a plant calls. [`solve`] takes a control period, [`period`] says what
//! it is a sequence of; the steps themselves are the integrator's, their derivatives the linearization's.
//! [`fleet`] steps many plants together.
//!
//! - where a plant starts: [`initial`], [`settle`] (at rest), [`targets`] (of frames), [`snapshot`], [`spare`]
//!   (made ahead);
//! - what can be asked of it: [`diagnose`], [`site`] (poses and pushes), [`projected`] (momentum), [`choice`]
//!   (accuracy);
//! - its derivatives: [`second_order`], [`known`] (of a step whose solution is known).

pub(crate) mod choice;
pub(crate) mod derivative;
pub(crate) mod diagnose;
pub(crate) mod facade;
pub(crate) mod fleet;
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
pub(crate) mod targets;
