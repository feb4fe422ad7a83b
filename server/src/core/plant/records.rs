//! Where a plant writes what it does.

use std::sync::Arc;

use crate::core::plant::tap::Tap;
use crate::core::publish::ring::Ring;

/// The ring of a plant's steps, and the recorder's tap.
#[derive(Default)]
pub(crate) struct Records {
    /// Where each step is written, as long as somebody reads it.
    pub(crate) ring: Option<Arc<Ring>>,
    /// Records written into rings that nobody reads any more.
    past: u64,
    /// Where the recorder learns what happens between steps.
    pub(crate) tap: Option<Arc<Tap>>,
}

impl Records {
    /// The ring into which each step is written; this one if there is none.
    pub(crate) fn ring_or(&mut self, ring: Arc<Ring>) -> Arc<Ring> {
        let ring = self.ring.get_or_insert_with(|| {
            ring.begin_at(self.past);
            ring
        });
        Arc::clone(ring)
    }

    /// Takes the ring away; records are counted on.
    pub(crate) fn take_ring(&mut self) -> Option<Arc<Ring>> {
        self.past = self.written();
        self.ring.take()
    }

    /// Records written into rings.
    pub(crate) fn written(&self) -> u64 {
        self.ring.as_ref().map_or(self.past, |ring| ring.written())
    }

    /// The recorder's tap, if there is one and a step had better wait for it.
    pub(crate) fn full_tap(&self) -> Option<Arc<Tap>> {
        self.tap.as_ref().filter(|tap| tap.is_half_full()).map(Arc::clone)
    }
}
