//! How a plant is run: in lockstep, or in a loop of its own.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio::sync::watch::Receiver;

use super::{Core, DriveError, RING_RECORDS, Session, lock};
use crate::core::frame::record_words;
use crate::core::limits::LimitExceeded;
use crate::core::realtime::event::EventKind;
use crate::core::realtime::{Handle, Live, Pace, Permit, RunSettings, Runner, Stop, TimingCounts};
use crate::core::ring::Ring;
use crate::core::watch::Relay;

/// Why a plant stands still although nobody has paused it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StoppedBy {
    /// Its step failed, or a watchdog holds it.
    #[error(transparent)]
    Drive(#[from] DriveError),
    /// It had no valid input, and was to stop then.
    #[error("no valid input")]
    InputLost,
}

/// Why a plant is not run as it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The plant was deleted.
    #[error("plant `{plant}` was deleted")]
    Deleted {
        /// Its id.
        plant: String,
    },
    /// The system gave no thread for its loop.
    #[error("no thread for plants that run: {0}")]
    NoLoop(std::io::Error),
    /// As many plants run by themselves as may.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
}

/// Where the core is.
pub(super) enum Place {
    /// Here, for whoever holds the lock.
    Rest(Box<Core>),
    /// In a loop, where it takes up room.
    Running { key: u64, handle: Handle, permit: Permit },
}

/// How a plant is being run, in short.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RunStatus {
    /// Who decides when it takes a step.
    pub pace: Pace,
    /// It may take steps.
    pub is_running: bool,
    /// Number of the call of [`Session::run`] since which it is run so.
    pub run: u64,
    /// Number of the last lease that a watchdog has taken away.
    pub revoked: u64,
}

/// How a plant is being run.
#[derive(Clone, Debug, Default)]
pub struct Run {
    /// How.
    pub settings: RunSettings,
    /// It may take steps.
    pub is_running: bool,
    /// Why it stands still although nobody has paused it.
    pub stopped_by: Option<StoppedBy>,
    /// Counts the calls of [`Session::run`].
    pub number: u64,
}

impl Session {
    /// Runs the plant, with new settings if some are given, until it is paused or `steps` are taken; 0
    /// means without end. Returns the number of the call. When it fails, the plant runs as before.
    pub fn run(
        self: &Arc<Self>,
        settings: Option<RunSettings>,
        steps: u64,
        running_max: u64,
    ) -> Result<u64, RunError> {
        let _changing = lock(&self.changing_run);
        if self.is_closed() {
            return Err(RunError::Deleted { plant: self.id.clone() });
        }
        let former = lock(&self.run).settings.clone();
        let settings = settings.unwrap_or_else(|| former.clone());
        let runs_by_itself = settings.pace != Pace::Lockstep;
        let threads = || Ok((self.realtime.pump()?, self.realtime.assign(settings.pace)?));
        let threads =
            if runs_by_itself { Some(threads().map_err(RunError::NoLoop)?) } else { None };
        // Its room is kept by a plant that has one.
        let permit = match (self.halt(), &threads) {
            (Some(permit), Some(_)) => Some(permit),
            (None, Some(_)) => Some(self.realtime.admit(running_max)?),
            (_, None) => None,
        };
        let number = {
            let mut run = lock(&self.run);
            let number = run.number + 1;
            *run = Run { settings: settings.clone(), is_running: true, stopped_by: None, number };
            number
        };
        self.gate.open(
            if runs_by_itself { 0 } else { steps },
            if runs_by_itself { 0.0 } else { settings.speed },
        );
        let (keep, speed) = (runs_by_itself && former.pace != Pace::Lockstep, settings.speed);
        self.with_core(move |core| {
            core.release();
            core.keep_loop_input(keep);
            if runs_by_itself {
                core.note(EventKind::Started, 0, speed);
            }
        });
        if let (Some((pump, (key, handle))), Some(permit)) = (threads, permit) {
            self.enter_loop(key, handle, permit, &settings, steps);
            pump.add(Arc::clone(self));
        }
        self.tell_run_status();
        Ok(number)
    }

    /// Pauses the plant between two steps.
    pub fn pause(&self) {
        let _changing = lock(&self.changing_run);
        drop(self.halt());
        lock(&self.run).is_running = false;
        self.gate.close();
        self.with_core(|core| core.note(EventKind::Paused, 0, 0.0));
        self.tell_run_status();
    }

    /// How the plant is being run, and the steps after which it pauses; 0 means never.
    pub fn run_info(&self) -> (Run, u64) {
        let mut run = lock(&self.run).clone();
        run.is_running &= self.gate.lets_through();
        let steps_left = match run.settings.pace {
            Pace::Lockstep => self.gate.steps_left(),
            _ => self.live().steps_left.load(Ordering::Relaxed),
        };
        (run, steps_left)
    }

    /// The same in short, and each change of it.
    pub fn run_status(&self) -> Receiver<RunStatus> {
        self.run_status.subscribe()
    }

    /// The plant takes its steps in a loop of its own, or would if it were not paused: inputs go there.
    pub fn runs_by_itself(&self) -> bool {
        self.run_status.borrow().pace != Pace::Lockstep
    }

    pub(crate) fn is_paced(&self) -> bool {
        self.run_status.borrow().pace == Pace::Paced
    }

    /// What the plant's own loop shares.
    pub fn live(&self) -> &Arc<Live> {
        self.live.get_or_init(|| Arc::new(Live::new(self.model.dimensions())))
    }

    /// What the loops of the server have counted.
    pub(crate) fn loop_counts(&self) -> &Arc<TimingCounts> {
        &self.realtime.counts
    }

    /// What brings the steps of the plant's own loop to its watchers.
    pub(crate) fn relay(&self) -> &Relay {
        &self.relay
    }

    /// Takes the plant out of its loop, if it is in one; the room that it had there.
    fn halt(&self) -> Option<Permit> {
        let (key, handle) = match &*lock(&self.place) {
            Place::Rest(_) => return None,
            Place::Running { key, handle, .. } => (*key, handle.clone()),
        };
        handle.stop(key)
    }

    fn enter_loop(
        self: &Arc<Self>,
        key: u64,
        handle: Handle,
        permit: Permit,
        settings: &RunSettings,
        steps: u64,
    ) {
        let ring = Arc::new(Ring::new(RING_RECORDS, record_words(self.model.dimensions())));
        let mut place = lock(&self.place);
        let running = Place::Running { key, handle: handle.clone(), permit };
        // Nobody else starts loops while `changing_run` is held.
        if let Place::Rest(mut core) = std::mem::replace(&mut *place, running) {
            self.relay.begin(core.ring_or(ring), &self.watchers);
            core.is_running = true;
            handle.run(Runner::new(key, core, Arc::clone(self), settings, steps));
        }
    }

    /// A loop gives the core back; the room that it had there.
    pub(crate) fn put_back(&self, core: Box<Core>) -> Option<Permit> {
        self.put_into(&mut lock(&self.place), core)
    }

    fn put_into(&self, place: &mut Place, mut core: Box<Core>) -> Option<Permit> {
        core.is_running = false;
        self.live().due_ns.store(0, Ordering::Relaxed);
        self.relay.end(core.records());
        match std::mem::replace(place, Place::Rest(core)) {
            Place::Running { permit, .. } => Some(permit),
            Place::Rest(_) => None,
        }
    }

    /// A loop lets go of the plant.
    pub(crate) fn loop_ended(&self, core: Box<Core>, stop: Stop) {
        let stopped_by = match stop {
            Stop::StepsTaken => {
                core.note(EventKind::StepsTaken, 0, 0.0);
                None
            }
            Stop::Closed => None,
            Stop::Refused(why) => Some(why),
        };
        {
            // Both at once: whoever learns that it stands still can step it.
            let mut place = lock(&self.place);
            drop(self.put_into(&mut place, core));
            let mut run = lock(&self.run);
            run.is_running = false;
            run.stopped_by = stopped_by;
        }
        self.tell_run_status();
    }

    pub(super) fn tell_run_status(&self) {
        let (run, _) = self.run_info();
        let Run { settings, is_running, number, .. } = run;
        let revoked = self.revoked.load(Ordering::Acquire);
        let status = RunStatus { pace: settings.pace, is_running, run: number, revoked };
        self.run_status.send_replace(status);
    }
}
