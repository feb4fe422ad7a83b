//! Room in memory that plants share.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::core::limits::LimitExceeded;

/// Room in memory for what all plants or watchers together hold.
#[derive(Debug)]
pub struct Room {
    name: &'static str,
    what: &'static str,
    used: AtomicU64,
    limit: u64,
}

impl Room {
    /// Room for so many numbers: the limit of that name, for what it is.
    pub fn new(name: &'static str, what: &'static str, limit: u64) -> Arc<Self> {
        Arc::new(Self { name, what, used: AtomicU64::new(0), limit })
    }

    /// Takes room for so many numbers.
    pub fn reserve(self: &Arc<Self>, numbers: usize) -> Result<Reservation, LimitExceeded> {
        let numbers = u64::try_from(numbers).unwrap_or(u64::MAX);
        let take = |used: u64| used.checked_add(numbers).filter(|sum| *sum <= self.limit);
        match self.used.fetch_update(Ordering::AcqRel, Ordering::Acquire, take) {
            Ok(_) => Ok(Reservation { room: Arc::clone(self), numbers }),
            Err(used) => Err(LimitExceeded {
                name: self.name,
                limit: self.limit,
                what: self.what,
                actual: used.saturating_add(numbers),
            }),
        }
    }
}

/// Room that is taken until this is dropped.
#[derive(Debug)]
pub struct Reservation {
    room: Arc<Room>,
    numbers: u64,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.room.used.fetch_sub(self.numbers, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_is_given_back() {
        let room = Room::new("feedback_numbers", "numbers", 10);
        let first = room.reserve(6).unwrap();
        let refused = room.reserve(5).unwrap_err();
        assert_eq!((refused.name, refused.actual), ("feedback_numbers", 11));
        assert!(room.reserve(usize::MAX).is_err());
        drop(first);
        room.reserve(10).unwrap();
    }
}
