//! Where a recorder gets what it writes: the ring of steps, and marks of what happens between them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use plantd_models::{Plant, Snapshot};

use super::{Core, Session};
use crate::core::channels::timeline::Announced;
use crate::core::frame::record_words;
use crate::core::parameters::Parameters;
use crate::core::ring::Ring;
use crate::core::workers::beside_other_tasks;

/// Bytes of a plant's ring.
const RING_BYTES: usize = 4 << 20;
/// Fewest and most steps in it.
const RING_STEPS: (usize, usize) = (64, 8192);
/// Marks that may wait to be written. Whoever resets a plant more often than that loses steps.
const MARKS_MAX: usize = 256;
/// Longest wait of a step for the recorder, and how often it looks.
const WAIT_MAX: Duration = Duration::from_millis(if cfg!(test) { 50 } else { 5000 });
const WAIT_STEP: Duration = Duration::from_micros(100);

/// Why there is a mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MarkReason {
    /// It was asked for, or is due.
    Checkpoint,
    /// The plant was put into another state.
    Reset,
    /// Its parameters or its time step were changed.
    Parameters,
}

/// The plant as it is between two steps.
pub(crate) struct Mark {
    /// Number of the ring's record that comes next.
    pub(crate) at: u64,
    pub(crate) reason: MarkReason,
    pub(crate) snapshot: Snapshot,
    pub(crate) step: u64,
    pub(crate) time_s: f64,
    pub(crate) time_step_s: f64,
    pub(crate) model_digest: u64,
    pub(crate) parameters: Arc<Parameters>,
    /// Changes of parameters by faults that may come.
    pub(crate) announced: Announced,
}

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

    fn push(&self, mark: Mark) {
        let mut marks = self.marks.lock().unwrap_or_else(PoisonError::into_inner);
        // A mark that is missing shows as steps that do not follow from each other.
        if marks.len() < MARKS_MAX {
            marks.push_back(mark);
        }
        if marks.len() == MARKS_MAX / 2 {
            self.wake();
        }
    }

    fn is_half_full(&self) -> bool {
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

impl Core {
    /// The recorder's tap, if there is one and a step had better wait for it.
    pub(crate) fn full_tap(&self) -> Option<Arc<Tap>> {
        self.tap.as_ref().filter(|tap| tap.is_half_full()).map(Arc::clone)
    }

    /// Tells the recorder, if there is one, what happens between two steps.
    pub(crate) fn mark(&self, reason: MarkReason) {
        if let Some(tap) = &self.tap {
            tap.push(self.marked(tap.ring.written(), reason));
        }
    }

    fn marked(&self, at: u64, reason: MarkReason) -> Mark {
        let timeline = self.channels.as_ref().and_then(|channels| channels.timeline.as_ref());
        Mark {
            at,
            reason,
            snapshot: self.plant.snapshot(),
            step: self.plant.step_index(),
            time_s: self.plant.time_s(),
            time_step_s: self.plant.settings().time_step_s,
            model_digest: self.plant.model().digest(),
            parameters: Arc::clone(&self.parameters),
            announced: timeline.map(|timeline| timeline.announced()).unwrap_or_default(),
        }
    }
}

impl Session {
    /// Begins to record: what is written from now on, and the plant as it is now. None when there is a
    /// recorder already.
    pub(crate) fn open_tap(&self) -> Option<(Arc<Tap>, Mark, Plant)> {
        let words = record_words(self.model.dimensions());
        let steps = (RING_BYTES / (8 * words)).clamp(RING_STEPS.0, RING_STEPS.1);
        let ring = Arc::new(Ring::new(steps, words));
        self.with_core(move |core| {
            if core.tap.is_some() {
                return None;
            }
            let ring = core.ring_or(ring);
            let at = ring.written();
            let tap = Arc::new(Tap {
                ring,
                read: AtomicU64::new(at),
                is_stalled: AtomicBool::new(false),
                marks: Mutex::default(),
                recorder: OnceLock::new(),
            });
            core.tap = Some(Arc::clone(&tap));
            let mark = core.marked(at, MarkReason::Checkpoint);
            Some((tap, mark, core.plant.clone()))
        })
    }

    /// Marks the plant as it is.
    pub(crate) fn checkpoint(&self) {
        self.with_core(|core| core.mark(MarkReason::Checkpoint));
    }

    /// Ends a recording. The ring goes when nobody else reads it:
    /// `holders` are the core, the tap, and readers that are to be left alone.
    pub(crate) fn close_tap(&self, tap: &Arc<Tap>, holders: usize) {
        // Nobody reads any more, and nobody shall wait.
        tap.set_read(u64::MAX);
        let tap = Arc::clone(tap);
        let former = self.with_core(move |core| {
            // Another recording may have begun.
            let tap = core.tap.take_if(|present| Arc::ptr_eq(present, &tap));
            if tap.is_none() {
                return (None, None);
            }
            let is_last = core.ring.as_ref().is_some_and(|ring| Arc::strong_count(ring) <= holders);
            (tap, if is_last { core.take_ring() } else { None })
        });
        // Dropped here, not in the core's hands.
        drop(former);
    }
}
