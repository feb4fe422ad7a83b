//! What a plant publishes to its watchers: per watcher a queue, of one frame unless it asks for more, in
//! which the latest frames win.
//!
//! The driver copies the state into the queue of each watcher whose turn it is and goes on; of a full
//! queue the oldest frame is overwritten and counted. Without watchers this costs one load. A watcher
//! takes its frame by swapping buffers, so the driver never waits for more than that.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use futures::task::AtomicWaker;

use crate::core::limits::LimitExceeded;
use crate::core::mutex::lock;
use crate::core::publish::frame::{Frame, Published};

/// The watchers of one plant.
#[derive(Default)]
pub(crate) struct Watchers {
    count: AtomicUsize,
    slots: Mutex<Vec<Arc<Slot>>>,
}

impl Watchers {
    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.count.load(Ordering::Acquire)
    }

    /// Offers a state to all watchers whose turn it is.
    pub(crate) fn publish(&self, published: &Published<'_>) {
        self.publish_record(u64::MAX, published);
    }

    /// Offers a record of the plant's ring, but not to those who came after it.
    pub(super) fn publish_record(&self, record: u64, published: &Published<'_>) {
        if self.count() == 0 {
            return;
        }
        for slot in lock(&self.slots).iter().filter(|slot| slot.from <= record) {
            slot.offer(published);
        }
    }

    /// So many records of the ring were overwritten before anybody saw them.
    pub(super) fn lose(&self, records: u64) {
        if records > 0 {
            for slot in lock(&self.slots).iter() {
                lock(&slot.cell).dropped += records / slot.every;
            }
        }
    }

    /// The first record of the plant's ring that somebody wants.
    pub(super) fn first_record(&self) -> u64 {
        lock(&self.slots).iter().map(|slot| slot.from).min().unwrap_or(u64::MAX)
    }

    pub(super) fn add(&self, slot: Arc<Slot>, watchers_max: u64) -> Result<(), LimitExceeded> {
        let mut slots = lock(&self.slots);
        let (name, what) = ("watchers_per_plant", "watchers");
        LimitExceeded::check(name, watchers_max, what, slots.len() + 1)?;
        slots.push(slot);
        self.count.store(slots.len(), Ordering::Release);
        Ok(())
    }

    pub(super) fn remove(&self, slot: &Arc<Slot>) {
        let mut slots = lock(&self.slots);
        slots.retain(|other| !Arc::ptr_eq(other, slot));
        self.count.store(slots.len(), Ordering::Release);
    }
}

/// A watcher's queue.
pub(super) struct Slot {
    every: u64,
    /// The first record of the plant's ring that came after the watcher.
    from: u64,
    pub(super) cell: Mutex<Cell>,
    pub(super) filled: AtomicWaker,
}

/// A queue of frames, in memory that is there from the beginning.
pub(super) struct Cell {
    frames: Vec<Frame>,
    /// Index of the oldest that waits.
    first: usize,
    /// How many wait.
    count: usize,
    pub(super) dropped: u64,
}

impl Cell {
    fn push(&mut self, published: &Published<'_>) {
        if self.count == self.frames.len() {
            self.first = (self.first + 1) % self.frames.len();
            self.count -= 1;
            self.dropped += 1;
        }
        let next = (self.first + self.count) % self.frames.len();
        self.frames[next].copy_from(published);
        self.count += 1;
    }

    /// Takes the oldest, and leaves `frame`'s memory in its place.
    pub(super) fn pop(&mut self, frame: &mut Frame) -> bool {
        if self.count == 0 {
            return false;
        }
        std::mem::swap(&mut self.frames[self.first], frame);
        self.first = (self.first + 1) % self.frames.len();
        self.count -= 1;
        true
    }
}

impl Slot {
    /// A queue in these frames, for a watcher of every `every`-th state that came before the record `from`.
    pub(super) fn new(every: u64, from: u64, frames: Vec<Frame>) -> Self {
        let cell = Mutex::new(Cell { frames, first: 0, count: 0, dropped: 0 });
        Self { every: every.max(1), from, cell, filled: AtomicWaker::new() }
    }

    pub(super) fn offer(&self, published: &Published<'_>) {
        if !published.step.is_multiple_of(self.every) {
            return;
        }
        let mut cell = lock(&self.cell);
        let was_empty = cell.count == 0;
        cell.push(published);
        drop(cell);
        if was_empty {
            self.filled.wake();
        }
    }
}
