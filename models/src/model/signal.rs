//! Signals: functions of time that drive inputs and prescribed coordinates.

use plantd_scene::{self as scene, TimeFunction};

/// A signal with what it drives.
#[derive(Clone, Debug)]
pub(crate) struct Signal {
    pub(crate) target: Target,
    of: TimeFunction,
}

/// What a signal drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// Adds to an input.
    Input(usize),
    /// Replaces a prescribed position, counted among the prescribed coordinates.
    Prescribed(usize),
}

impl Signal {
    /// From a signal of a scene that has been validated.
    pub(crate) fn new(target: Target, signal: &scene::Signal) -> Self {
        Self { target, of: TimeFunction::new(signal) }
    }

    /// Value at time `t`, s.
    pub(crate) fn at(&self, t: f64) -> f64 {
        self.of.at(t)
    }
}
