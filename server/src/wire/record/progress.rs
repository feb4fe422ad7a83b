//! What a recording is asked for, and how far it is.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use mcap::McapError;
use plantd_proto::v1;

/// What is asked for.
pub(super) struct Options {
    /// Name.
    pub(super) name: String,
    /// Time between two snapshots.
    pub(super) checkpoint_interval: Duration,
    /// Most bytes of the file.
    pub(super) bytes_max: u64,
}

/// What the thread shares with whoever ends it.
pub(super) struct Shared {
    pub(super) is_ending: AtomicBool,
    pub(super) bytes: Arc<AtomicU64>,
    pub(super) info: Mutex<v1::Recording>,
}

impl Shared {
    pub(super) fn info(&self) -> MutexGuard<'_, v1::Recording> {
        self.info.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// An error with its cause.
pub(super) fn sentence(error: &McapError) -> String {
    match error {
        McapError::Io(error) => error.to_string(),
        other => other.to_string(),
    }
}

pub(super) fn unix_ns(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}
