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
    /// What this is a part of, which has bounds of its own.
    whole: Option<Arc<Room>>,
}

impl Room {
    /// Room for so many numbers: the limit of that name, for what it is.
    pub fn new(name: &'static str, what: &'static str, limit: u64) -> Arc<Self> {
        Arc::new(Self { name, what, used: AtomicU64::new(0), limit, whole: None })
    }

    /// Such a room within another one.
    pub fn part_of(&self, whole: &Arc<Self>) -> Arc<Self> {
        let Self { name, what, limit, .. } = *self;
        let whole = Some(Arc::clone(whole));
        Arc::new(Self { name, what, used: AtomicU64::new(0), limit, whole })
    }

    /// How much is taken.
    pub fn used(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    /// Takes room for so many numbers.
    pub fn reserve(self: &Arc<Self>, numbers: usize) -> Result<Reservation, LimitExceeded> {
        let whole =
            self.whole.as_ref().map(|whole| whole.reserve(numbers)).transpose()?.map(Box::new);
        let numbers = u64::try_from(numbers).unwrap_or(u64::MAX);
        let take = |used: u64| used.checked_add(numbers).filter(|sum| *sum <= self.limit);
        match self.used.fetch_update(Ordering::AcqRel, Ordering::Acquire, take) {
            Ok(_) => Ok(Reservation { room: Arc::clone(self), numbers, _whole: whole }),
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
    /// The same of the whole, given back with it.
    _whole: Option<Box<Reservation>>,
}

impl Reservation {
    /// Counts what has been taken already, whatever the limit. Of a room that is no part of another.
    pub fn count(&mut self, numbers: u64) {
        self.room.used.fetch_add(numbers.saturating_sub(self.numbers), Ordering::AcqRel);
        self.numbers = self.numbers.max(numbers);
    }
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

    #[test]
    fn a_part_takes_of_the_whole() {
        let whole = Room::new("watch_numbers", "numbers", 10);
        let part = Room::new("tenant.watch_numbers", "numbers", 8).part_of(&whole);
        let first = part.reserve(6).unwrap();
        assert_eq!((part.used(), whole.used()), (6, 6));
        assert_eq!(part.reserve(4).unwrap_err().name, "tenant.watch_numbers");
        assert_eq!(part.reserve(5).unwrap_err().name, "watch_numbers");
        assert_eq!((part.used(), whole.used()), (6, 6), "what is refused takes nothing");
        drop(first);
        assert_eq!((part.used(), whole.used()), (0, 0));
    }
}
