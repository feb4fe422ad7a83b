//! What a plant that runs by itself shares.

use std::sync::atomic::{AtomicU64, Ordering};

use plantd_models::Dimensions;

use crate::core::metrics::counts::TimingCounts;
use crate::core::realtime::slot::InputSlot;

/// What a plant that runs by itself shares with its driver, its watchers and the curious.
#[derive(Debug)]
pub struct Live {
    /// Where the driver's inputs arrive.
    pub slot: InputSlot,
    /// What the loop has counted.
    pub counts: TimingCounts,
    /// When the next step is due, ns; 0 when none is.
    pub due_ns: AtomicU64,
    /// Steps after which it pauses; 0 means never.
    pub steps_left: AtomicU64,
}

impl Live {
    /// For a plant of these sizes.
    pub fn new(d: Dimensions) -> Self {
        Self {
            slot: InputSlot::new(d.input()),
            counts: TimingCounts::default(),
            due_ns: AtomicU64::new(0),
            steps_left: AtomicU64::new(0),
        }
    }

    /// When to look for the step that is due: so long after it is, or, if that was before, so long after
    /// now; all in ns.
    pub(crate) fn look_ns(&self, now_ns: u64, after_ns: u64, again_ns: u64) -> u64 {
        let look_ns = self.due_ns.load(Ordering::Relaxed) + after_ns;
        if look_ns > now_ns { look_ns } else { now_ns + again_ns }
    }
}
