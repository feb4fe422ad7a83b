//! Where a recorder gets what it writes: the ring of steps, and marks of what happens between them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use crate::core::plant::mark::Mark;
use crate::core::publish::ring::Ring;
use crate::core::workers::pool::beside_other_tasks;

/// Marks that may wait to be written. Whoever resets a plant more often than that loses steps.
const MARKS_MAX: usize = 256;
/// Longest wait of a step for the recorder, and how often it looks.
const WAIT_MAX: Duration = Duration::from_millis(if cfg!(test) { 50 } else { 5000 });
const WAIT_STEP: Duration = Duration::from_micros(100);

/// What a plant and its recorder share.
pub(crate) struct Tap {
    pub(crate) ring: Arc<Ring>,
    /// Number of the record that the recorder reads next.
    read: AtomicU64,
    /// A step has waited in vain; the next ones do not, until the recorder goes on.
    is_stalled: AtomicBool,
    marks: Mutex<VecDeque<Mark>>,
    recorder: OnceLock<Thread>,
}

impl Tap {
    /// For a recorder that reads this ring from its next record on.
    pub(crate) fn new(ring: Arc<Ring>) -> Self {
        Self {
            read: AtomicU64::new(ring.written()),
            ring,
            is_stalled: AtomicBool::new(false),
            marks: Mutex::default(),
            recorder: OnceLock::new(),
        }
    }

    /// Notes how far the recorder has come.
    pub(crate) fn set_read(&self, next: u64) {
        self.read.store(next, Ordering::Release);
        self.is_stalled.store(false, Ordering::Release);
    }

    /// Names the thread that reads.
    pub(crate) fn set_recorder(&self, thread: Thread) {
        let _ = self.recorder.set(thread);
    }

    /// Takes the first mark, if it comes before the ring's record of this number.
    pub(crate) fn mark_before(&self, record: u64) -> Option<Mark> {
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        if marks.front()?.at <= record { marks.pop_front() } else { None }
    }

    pub(super) fn push(&self, mark: Mark) {
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        // A mark that is missing shows as steps that do not follow from each other.
        if marks.len() < MARKS_MAX {
            marks.push_back(mark);
        }
        if marks.len() == MARKS_MAX / 2 {
            self.wake();
        }
    }

    pub(super) fn is_half_full(&self) -> bool {
        let waiting = self.ring.written().saturating_sub(self.read.load(Ordering::Acquire));
        waiting > self.ring.capacity() as u64 / 2 && !self.is_stalled.load(Ordering::Acquire)
    }

    /// Waits until the recorder has caught up: for steps that somebody asks for, one by one. A disk that
    /// does not answer holds nobody for ever; steps are lost then, and counted.
    pub(crate) fn wait(&self) {
        let started = Instant::now();
        beside_other_tasks(|| {
            while self.is_half_full() {
                if started.elapsed() > WAIT_MAX {
                    self.is_stalled.store(true, Ordering::Release);
                }
                self.wake();
                std::thread::sleep(WAIT_STEP);
            }
        });
    }

    /// Wakes the recorder.
    pub(crate) fn wake(&self) {
        if let Some(thread) = self.recorder.get() {
            thread.unpark();
        }
    }
}
