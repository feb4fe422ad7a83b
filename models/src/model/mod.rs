//! The compiled mechanism: immutable data, shared by all plants, without algorithms.
//!
//! Read [`mechanism`] first: `Model` and all that it lists, springs, forces and constraints with their
//! formulas. Joints are in [`tree`], or in [`planar_tree`] where they move in planes, loops of these in
//! [`loop_plan`]. [`manifold`] has sums and differences of configurations, [`conditioning`] what pivots are
//! measured against, [`signal`] functions of time, [`site`] points of frames.

pub(crate) mod conditioning;
pub(crate) mod held;
pub(crate) mod loop_plan;
pub(crate) mod manifold;
pub(crate) mod mechanism;
pub(crate) mod planar_tree;
pub(crate) mod signal;
pub(crate) mod site;
pub(crate) mod slots;
pub(crate) mod tree;
