//! A recorder comes to a plant, and leaves it.

use std::sync::Arc;

use plantd_models::Plant;

use crate::core::plant::mark::{Mark, MarkReason};
use crate::core::plant::tap::Tap;
use crate::core::publish::frame::record_words;
use crate::core::publish::ring::Ring;
use crate::core::session::shared::Session;

/// Bytes of a plant's ring.
const RING_BYTES: usize = 4 << 20;
/// Fewest and most steps in it.
const RING_STEPS: (usize, usize) = (64, 8192);

impl Session {
    /// Begins to record: what is written from now on, and the plant as it is now. None when there is a
    /// recorder already.
    pub(crate) fn open_tap(&self) -> Option<(Arc<Tap>, Mark, Plant)> {
        let words = record_words(self.model().dimensions());
        let steps = (RING_BYTES / (8 * words)).clamp(RING_STEPS.0, RING_STEPS.1);
        let ring = Arc::new(Ring::new(steps, words));
        self.with_core(move |core| {
            if core.records.tap.is_some() {
                return None;
            }
            let ring = core.records.ring_or(ring);
            let at = ring.written();
            let tap = Arc::new(Tap::new(ring));
            core.records.tap = Some(Arc::clone(&tap));
            let mark = core.marked(at, MarkReason::Checkpoint);
            Some((tap, mark, core.plant.clone()))
        })
    }

    /// Marks the plant as it is.
    pub(crate) fn checkpoint(&self) {
        self.with_core(|core| core.mark(MarkReason::Checkpoint));
    }

    /// Ends a recording. The ring goes when nobody else reads it:
    /// `holders` are the core, the tap, and readers that are to be left alone.
    pub(crate) fn close_tap(&self, tap: &Arc<Tap>, holders: usize) {
        // Nobody reads any more, and nobody shall wait.
        tap.set_read(u64::MAX);
        let tap = Arc::clone(tap);
        let former = self.with_core(move |core| {
            // Another recording may have begun.
            let tap = core.records.tap.take_if(|present| Arc::ptr_eq(present, &tap));
            if tap.is_none() {
                return (None, None);
            }
            let is_last =
                core.records.ring.as_ref().is_some_and(|ring| Arc::strong_count(ring) <= holders);
            (tap, if is_last { core.records.take_ring() } else { None })
        });
        // Dropped here, not in the core's hands.
        drop(former);
    }
}
