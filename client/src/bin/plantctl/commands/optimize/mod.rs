//! `optimize`: trajectories of least cost, from a problem file.

mod command;
mod problem;

pub(crate) use command::Optimize;
