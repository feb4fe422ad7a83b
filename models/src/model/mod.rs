//! The compiled mechanism: immutable data without algorithms.

pub(crate) mod conditioning;
pub(crate) mod loop_plan;
pub(crate) mod manifold;
pub(crate) mod mechanism;
pub(crate) mod planar_tree;
pub(crate) mod signal;
pub(crate) mod site;
pub(crate) mod tree;
