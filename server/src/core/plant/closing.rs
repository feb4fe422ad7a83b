//! The end of a plant.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

/// Whether a plant was deleted: asked for at each step, and waited for by streams.
#[derive(Debug, Default)]
pub(crate) struct Closing {
    is_closed: AtomicBool,
    token: CancellationToken,
    /// Address of the server on which it goes on.
    moved_to: OnceLock<String>,
}

impl Closing {
    /// The plant is deleted. False when it was before.
    pub(crate) fn close(&self) -> bool {
        let was_open = !self.is_closed.swap(true, Ordering::AcqRel);
        self.token.cancel();
        was_open
    }

    /// Says where the plant goes on, before it is closed here.
    pub(crate) fn note_move(&self, address: String) {
        let _ = self.moved_to.set(address);
    }

    /// Address of the server on which it goes on.
    pub(crate) fn moved_to(&self) -> Option<&str> {
        self.moved_to.get().map(String::as_str)
    }

    /// The plant was deleted.
    pub(crate) fn is_closed(&self) -> bool {
        self.is_closed.load(Ordering::Acquire)
    }

    /// Completes when the plant is deleted.
    pub(crate) fn closed(&self) -> WaitForCancellationFutureOwned {
        self.token.clone().cancelled_owned()
    }
}
