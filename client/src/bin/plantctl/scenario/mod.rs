//! Scenarios of `plantctl test`: what a file may say, and the signals of a plant by their names.

pub(crate) mod columns;
pub(crate) mod distribution;
pub(crate) mod file;
