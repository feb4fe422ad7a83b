//! Scenarios of `plantctl test`: what a file may say, and whether what it expects came true.

pub(crate) mod distribution;
pub(crate) mod expectation;
pub(crate) mod expression;
pub(crate) mod file;
pub(crate) mod samples;
pub(crate) mod verdict;
