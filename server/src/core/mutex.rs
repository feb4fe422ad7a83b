//! Locks that hold although somebody panicked with them in hand.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Takes a lock. Whatever is behind one here is whole between any two statements, or left as it was by a
/// failure: a panic elsewhere does not spoil it.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
