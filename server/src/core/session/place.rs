//! Where the core of a session is.

use crate::core::plant::core::Core;
use crate::core::realtime::permit::Permit;
use crate::core::realtime::scheduler::Handle;

/// Where the core is.
pub(super) enum Place {
    /// Here, for whoever holds the lock.
    Rest(Box<Core>),
    /// In a loop, where it takes up room.
    Running { key: u64, handle: Handle, permit: Permit },
}
