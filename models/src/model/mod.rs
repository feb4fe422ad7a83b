//! The compiled mechanism: immutable data without algorithms.

pub(crate) mod mechanism;
pub(crate) mod planar_tree;
pub(crate) mod signal;
pub(crate) mod tree;
