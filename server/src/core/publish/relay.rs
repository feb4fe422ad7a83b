//! The way of the steps of a plant's own loop to its watchers.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use crate::core::mutex::lock;
use crate::core::publish::frame::Frames;
use crate::core::publish::ring::Ring;
use crate::core::publish::watchers::Watchers;

/// Brings what a plant's own loop writes into the ring to its watchers: all of it, in order, and before
/// what comes after it.
#[derive(Default)]
pub(crate) struct Relay {
    /// Something may be on its way.
    is_busy: AtomicBool,
    /// The first record that is not the loop's; `u64::MAX` while it runs.
    end: AtomicU64,
    /// What the loop has written since it began.
    written: Mutex<Option<Written>>,
}

struct Written {
    ring: Arc<Ring>,
    /// The first record.
    first: u64,
    /// Where they are read, while there are watchers.
    frames: Option<Frames>,
}

impl Relay {
    /// A loop begins to write into this ring.
    pub(crate) fn begin(&self, ring: Arc<Ring>, watchers: &Watchers) {
        self.hand_on(watchers);
        let mut written = lock(&self.written);
        let first = ring.written();
        *written = Some(Written { ring, first, frames: None });
        self.end.store(u64::MAX, Ordering::Release);
        self.is_busy.store(true, Ordering::Release);
    }

    /// The loop has ended; the next record is not its.
    pub(crate) fn end(&self, next: u64) {
        self.end.store(next, Ordering::Release);
    }

    /// Something may be on its way.
    pub(crate) fn is_busy(&self) -> bool {
        self.is_busy.load(Ordering::Acquire)
    }

    /// Hands on what is there.
    pub(crate) fn hand_on(&self, watchers: &Watchers) {
        if !self.is_busy() {
            return;
        }
        let mut place = lock(&self.written);
        let Some(Written { ring, first, frames }) = &mut *place else { return };
        // Looked at first: what is there by then is handed on below.
        let end = self.end.load(Ordering::Acquire);
        let until = end.min(ring.written());
        if watchers.count() == 0 {
            *frames = None;
        } else {
            let frames = frames.get_or_insert_with(|| {
                Frames::from(Arc::clone(ring), watchers.first_record().max(*first))
            });
            let before = frames.lost();
            while let Some((number, frame)) = frames.read_before(until) {
                watchers.publish_record(number, &frame.published());
            }
            watchers.lose(frames.lost() - before);
        }
        if end != u64::MAX {
            *place = None;
            self.is_busy.store(false, Ordering::Release);
        }
    }
}
