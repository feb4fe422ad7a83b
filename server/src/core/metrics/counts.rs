//! What loops count.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::core::metrics::histogram::Histogram;

/// Times that loops count, for one plant or for all of them.
#[derive(Debug, Default)]
pub struct TimingCounts {
    /// How late steps began.
    pub lateness: Histogram,
    /// How long they took.
    pub step: Histogram,
    /// How old their inputs were.
    pub input_age: Histogram,
    /// From a state until its driver's answer came.
    pub round_trip: Histogram,
    /// Steps.
    pub steps: AtomicU64,
    /// Steps that ended after the next one was due.
    pub overruns: AtomicU64,
    /// Times that the schedule was given up.
    pub slips: AtomicU64,
    /// Steps without a new input while there was a driver.
    pub late_inputs: AtomicU64,
    /// Steps without a valid input.
    pub safe_inputs: AtomicU64,
    /// Inputs that a driver has sent.
    pub inputs: AtomicU64,
    /// Inputs that a step has used.
    pub used_inputs: AtomicU64,
}

impl TimingCounts {
    /// Forgets everything.
    pub fn clear(&self) {
        for histogram in [&self.lateness, &self.step, &self.input_age, &self.round_trip] {
            histogram.clear();
        }
        for count in [
            &self.steps,
            &self.overruns,
            &self.slips,
            &self.late_inputs,
            &self.safe_inputs,
            &self.inputs,
            &self.used_inputs,
        ] {
            count.store(0, Ordering::Relaxed);
        }
    }
}
