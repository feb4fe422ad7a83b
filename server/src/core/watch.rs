//! What a plant publishes to its watchers: per watcher a queue, of one frame unless it asks for more, in
//! which the latest frames win.
//!
//! The driver copies the state into the queue of each watcher whose turn it is and goes on; of a full
//! queue the oldest frame is overwritten and counted. Without watchers this costs one load. A watcher
//! takes its frame by swapping buffers, so the driver never waits for more than that.

use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use futures::task::AtomicWaker;

use crate::core::frame::{Frame, Frames, Published};
use crate::core::limits::LimitExceeded;
use crate::core::ring::Ring;
use crate::core::session::Session;

/// The watchers of one plant.
#[derive(Default)]
pub struct Watchers {
    count: AtomicUsize,
    slots: Mutex<Vec<Arc<Slot>>>,
}

impl Watchers {
    /// How many there are.
    pub fn count(&self) -> usize {
        self.count.load(Ordering::Acquire)
    }

    /// Offers a state to all watchers whose turn it is.
    pub(crate) fn publish(&self, published: &Published<'_>) {
        self.publish_record(u64::MAX, published);
    }

    /// The same for a record of the plant's ring: not to those who came after it.
    fn publish_record(&self, record: u64, published: &Published<'_>) {
        if self.count() == 0 {
            return;
        }
        for slot in lock(&self.slots).iter().filter(|slot| slot.from <= record) {
            slot.offer(published);
        }
    }

    /// So many records of the ring were overwritten before anybody saw them.
    fn lose(&self, records: u64) {
        if records > 0 {
            for slot in lock(&self.slots).iter() {
                lock(&slot.cell).dropped += records / slot.every;
            }
        }
    }

    /// The first record of the plant's ring that somebody wants.
    fn first_record(&self) -> u64 {
        lock(&self.slots).iter().map(|slot| slot.from).min().unwrap_or(u64::MAX)
    }

    fn add(&self, slot: Arc<Slot>, watchers_max: u64) -> Result<(), LimitExceeded> {
        let mut slots = lock(&self.slots);
        let (name, what) = ("watchers_per_plant", "watchers");
        LimitExceeded::check(name, watchers_max, what, slots.len() + 1)?;
        slots.push(slot);
        self.count.store(slots.len(), Ordering::Release);
        Ok(())
    }

    fn remove(&self, slot: &Arc<Slot>) {
        let mut slots = lock(&self.slots);
        slots.retain(|other| !Arc::ptr_eq(other, slot));
        self.count.store(slots.len(), Ordering::Release);
    }
}

/// Brings what a plant's own loop writes into the ring to its watchers: all of it, in order, and before
/// what comes after it.
#[derive(Default)]
pub(crate) struct Relay {
    /// Something may be on its way.
    is_busy: AtomicBool,
    /// The first record that is not the loop's; `u64::MAX` while it runs.
    end: AtomicU64,
    /// What the loop has written since it began.
    written: Mutex<Option<Written>>,
}

struct Written {
    ring: Arc<Ring>,
    /// The first record.
    first: u64,
    /// Where they are read, while there are watchers.
    frames: Option<Frames>,
}

impl Relay {
    /// A loop begins to write into this ring.
    pub(crate) fn begin(&self, ring: Arc<Ring>, watchers: &Watchers) {
        self.hand_on(watchers);
        let mut written = lock(&self.written);
        let first = ring.written();
        *written = Some(Written { ring, first, frames: None });
        self.end.store(u64::MAX, Ordering::Release);
        self.is_busy.store(true, Ordering::Release);
    }

    /// The loop has ended; the next record is not its.
    pub(crate) fn end(&self, next: u64) {
        self.end.store(next, Ordering::Release);
    }

    /// Something may be on its way.
    pub(crate) fn is_busy(&self) -> bool {
        self.is_busy.load(Ordering::Acquire)
    }

    /// Hands on what is there.
    pub(crate) fn hand_on(&self, watchers: &Watchers) {
        if !self.is_busy() {
            return;
        }
        let mut place = lock(&self.written);
        let Some(Written { ring, first, frames }) = &mut *place else { return };
        // Looked at first: what is there by then is handed on below.
        let end = self.end.load(Ordering::Acquire);
        let until = end.min(ring.written());
        if watchers.count() == 0 {
            *frames = None;
        } else {
            let frames = frames.get_or_insert_with(|| {
                Frames::from(Arc::clone(ring), watchers.first_record().max(*first))
            });
            let before = frames.lost();
            while let Some((number, frame)) = frames.read_before(until) {
                watchers.publish_record(number, &frame.published());
            }
            watchers.lose(frames.lost() - before);
        }
        if end != u64::MAX {
            *place = None;
            self.is_busy.store(false, Ordering::Release);
        }
    }
}

struct Slot {
    every: u64,
    /// The first record of the plant's ring that came after the watcher.
    from: u64,
    cell: Mutex<Cell>,
    filled: AtomicWaker,
}

/// A queue of frames, in memory that is there from the beginning.
struct Cell {
    frames: Vec<Frame>,
    /// Index of the oldest that waits.
    first: usize,
    /// How many wait.
    count: usize,
    dropped: u64,
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
    fn pop(&mut self, frame: &mut Frame) -> bool {
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
    fn offer(&self, published: &Published<'_>) {
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

/// A watcher's place; dropping it ends the watch.
pub struct Subscription {
    session: Arc<Session>,
    slot: Arc<Slot>,
    frame: Frame,
    dropped: u64,
}

impl Subscription {
    pub(crate) fn new(
        session: Arc<Session>,
        every: u64,
        from: u64,
        frames: Vec<Frame>,
        watchers_max: u64,
    ) -> Result<Self, LimitExceeded> {
        let frame = frames.first().cloned().unwrap_or_default();
        let cell = Mutex::new(Cell { frames, first: 0, count: 0, dropped: 0 });
        let every = every.max(1);
        let slot = Arc::new(Slot { every, from, cell, filled: AtomicWaker::new() });
        session.watchers().add(Arc::clone(&slot), watchers_max)?;
        session.metrics().watcher_started();
        Ok(Self { session, slot, frame, dropped: 0 })
    }

    pub(crate) fn offer(&self, published: &Published<'_>) {
        self.slot.offer(published);
    }

    /// The session that is watched.
    pub fn session(&self) -> &Arc<Session> {
        &self.session
    }

    /// Waits for the next frame; returns it with the number of frames lost so far.
    pub async fn next(&mut self) -> (&Frame, u64) {
        poll_fn(|context| self.poll_taken(context)).await;
        (&self.frame, self.dropped)
    }

    /// The next frame, with the number of frames lost so far.
    pub fn poll_next(&mut self, context: &mut Context<'_>) -> Poll<(&Frame, u64)> {
        self.poll_taken(context).map(|()| (&self.frame, self.dropped))
    }

    fn poll_taken(&mut self, context: &mut Context<'_>) -> Poll<()> {
        if self.take() {
            return Poll::Ready(());
        }
        self.slot.filled.register(context.waker());
        // A frame may have come in between.
        if self.take() { Poll::Ready(()) } else { Poll::Pending }
    }

    /// Fetches the frame in the slot, if it is a new one.
    fn take(&mut self) -> bool {
        let mut cell = lock(&self.slot.cell);
        if !cell.pop(&mut self.frame) {
            return false;
        }
        let lost = cell.dropped - self.dropped;
        self.dropped = cell.dropped;
        drop(cell);
        self.session.metrics().watch_dropped(lost);
        true
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.session.watchers().remove(&self.slot);
        self.session.metrics().watcher_ended();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
