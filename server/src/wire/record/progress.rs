//! What a recording is asked for, and how far it is.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use mcap::McapError;
use plantd_proto::v1;

use crate::core::room::{Reservation, Room};

/// What is asked for.
pub(super) struct Options {
    /// Name.
    pub(super) name: String,
    /// Time between two snapshots.
    pub(super) checkpoint_interval: Duration,
    /// Most bytes of the file.
    pub(super) bytes_max: u64,
    /// What its tenant has left.
    pub(super) share: Share,
    /// Its tenant's room for a recording in progress.
    pub(super) _in_progress: Reservation,
}

/// What a tenant's recordings have taken, and may take.
#[derive(Clone)]
pub(super) struct Share {
    pub(super) room: Arc<Room>,
    /// Bytes of this one, counted until it is deleted.
    pub(super) own: Arc<Mutex<Reservation>>,
    /// Most bytes of all that this server has begun.
    pub(super) bytes_max: u64,
}

impl Share {
    /// Counts the bytes of this recording; whether the tenant has used up what it may.
    pub(super) fn is_used_up(&self, bytes: u64) -> bool {
        self.own.lock().unwrap_or_else(PoisonError::into_inner).count(bytes);
        self.room.used() > self.bytes_max
    }
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
