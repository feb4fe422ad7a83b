//! How long a plant lives that nobody uses, and what is kept of it beyond its server.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use plantd_models::Model;
use plantd_proto::link::monotonic_ns;

/// What the file holds in which a plant survives its server.
#[derive(Clone, Debug)]
pub struct Kept {
    /// The model in force when it was written.
    pub model: Arc<Model>,
    /// Hash of everything else.
    pub hash: u64,
}

/// When a plant was used last, and how long it is kept after that.
#[derive(Debug)]
pub struct Life {
    expires: Option<Duration>,
    /// Streams and calls under way that use it.
    users: AtomicUsize,
    last_use_ns: AtomicU64,
}

impl Life {
    pub(super) fn new(expires: Option<Duration>) -> Self {
        let last_use_ns = AtomicU64::new(monotonic_ns());
        Self { expires, users: AtomicUsize::new(0), last_use_ns }
    }

    /// How long the plant is kept when nobody uses it; `None` for as long as the server.
    pub fn expires(&self) -> Option<Duration> {
        self.expires
    }

    /// It is used at this moment.
    pub fn touch(&self) {
        self.last_use_ns.store(monotonic_ns(), Ordering::Relaxed);
    }

    /// It is used until the returned value is dropped.
    pub fn in_use(self: &Arc<Self>) -> Use {
        self.users.fetch_add(1, Ordering::Relaxed);
        Use { life: Arc::clone(self) }
    }

    pub(super) fn is_over(&self) -> bool {
        let Some(expires) = self.expires else { return false };
        let unused_ns = monotonic_ns().saturating_sub(self.last_use_ns.load(Ordering::Relaxed));
        self.users.load(Ordering::Relaxed) == 0 && Duration::from_nanos(unused_ns) > expires
    }
}

/// Somebody uses a plant.
#[derive(Debug)]
pub struct Use {
    life: Arc<Life>,
}

impl Drop for Use {
    fn drop(&mut self) {
        self.life.touch();
        self.life.users.fetch_sub(1, Ordering::Relaxed);
    }
}
