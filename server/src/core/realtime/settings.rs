//! How plants are run, and how the loops of a server run.

use serde::{Deserialize, Serialize};

use crate::core::priority::Scheduling;
use crate::core::realtime::input::InputPolicy;

/// A plant that is late by up to this long takes its steps one after the other until it has caught up;
/// beyond it goes on from where it is, and the schedule has slipped.
pub(crate) const CATCH_UP_NS: u64 = 100_000_000;

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// Its driver.
    #[default]
    Lockstep,
    /// The wall clock.
    Paced,
    /// Nobody.
    Free,
}

/// How a plant is run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunSettings {
    /// Who decides when it takes a step.
    pub pace: Pace,
    /// Seconds of the plant's clock in one of the wall clock; 0 in lockstep means as fast as inputs come.
    pub speed: f64,
    /// What to do without a valid input.
    pub input: InputPolicy,
}

/// How the loops of a server run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RealTimeSettings {
    /// Threads for paced plants, which share them out among themselves, 1 to 64.
    pub threads: usize,
    /// Scheduling of these threads.
    pub scheduling: Scheduling,
    /// Processors on which they may run; empty means all.
    pub cpus: Vec<usize>,
    /// Keep the server's memory from being paged out.
    pub lock_memory: bool,
    /// Time before a deadline from which a thread polls the clock instead of sleeping, µs; 0 means that
    /// it never polls. Takes a processor for that part of the time.
    pub spin_us: u64,
}

impl Default for RealTimeSettings {
    fn default() -> Self {
        Self {
            threads: 1,
            scheduling: Scheduling::default(),
            cpus: Vec::new(),
            lock_memory: false,
            spin_us: 0,
        }
    }
}
