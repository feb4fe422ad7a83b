//! How a plant is run: in lockstep, or in a loop of its own.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio::sync::watch::Receiver;

use crate::core::mutex::lock;
use crate::core::plant::core::Core;
use crate::core::plant::event::EventKind;
use crate::core::publish::frame::record_words;
use crate::core::publish::ring::{RING_RECORDS, Ring};
use crate::core::realtime::live::Live;
use crate::core::realtime::permit::Permit;
use crate::core::realtime::pump::Pumped;
use crate::core::realtime::runner::{Owner, Runner, Shared, Stop};
use crate::core::realtime::scheduler::Handle;
use crate::core::realtime::settings::{Pace, RunSettings};
use crate::core::session::place::Place;
use crate::core::session::run::{Run, RunError, RunStatus};
use crate::core::session::shared::Session;

impl Session {
    /// Runs the plant, with new settings if some are given, until it is paused or `steps` are taken; 0
    /// means without end. Returns the number of the call. When it fails, the plant runs as before.
    pub fn run(
        self: &Arc<Self>,
        settings: Option<RunSettings>,
        steps: u64,
        running_max: u64,
    ) -> Result<u64, RunError> {
        let _changing = lock(&self.run.changing);
        if self.is_closed() {
            return Err(RunError::Deleted { plant: self.id().to_owned() });
        }
        let former = lock(&self.run.present).settings.clone();
        let settings = settings.unwrap_or_else(|| former.clone());
        let runs_by_itself = settings.pace != Pace::Lockstep;
        let threads = || Ok((self.realtime.pump()?, self.realtime.assign(settings.pace)?));
        let threads =
            if runs_by_itself { Some(threads().map_err(RunError::NoLoop)?) } else { None };
        // Its room is kept by a plant that has one.
        let permit = match (self.halt(), &threads) {
            (Some(permit), Some(_)) => Some(permit),
            (None, Some(_)) => Some(self.admit(running_max)?),
            (_, None) => None,
        };
        let number = {
            let mut run = lock(&self.run.present);
            let number = run.number + 1;
            *run = Run { settings: settings.clone(), is_running: true, stopped_by: None, number };
            number
        };
        self.run.gate.open(
            if runs_by_itself { 0 } else { steps },
            if runs_by_itself { 0.0 } else { settings.speed },
        );
        let (keep, speed) = (runs_by_itself && former.pace != Pace::Lockstep, settings.speed);
        self.with_core(move |core| {
            core.release();
            core.own_loop.keeps_input = keep;
            if runs_by_itself {
                core.note(EventKind::Started, 0, speed);
            }
        });
        if let (Some((pump, (key, handle))), Some(permit)) = (threads, permit) {
            self.enter_loop(key, handle, permit, &settings, steps);
            let (feed, live) = (Arc::clone(&self.feed), Arc::clone(self.live()));
            pump.add(Pumped { feed, live, pace: settings.pace });
        }
        self.tell_run_status();
        Ok(number)
    }

    /// Room in the loops, and among the plants of its owner that run.
    fn admit(&self, running_max: u64) -> Result<Permit, RunError> {
        let permit = self.realtime.admit(running_max)?;
        match &self.creation.owner.running {
            Some(room) => Ok(permit.and(room.reserve(1)?)),
            None => Ok(permit),
        }
    }

    /// Pauses the plant between two steps.
    pub fn pause(&self) {
        let _changing = lock(&self.run.changing);
        drop(self.halt());
        lock(&self.run.present).is_running = false;
        self.run.gate.close();
        self.with_core(|core| core.note(EventKind::Paused, 0, 0.0));
        self.tell_run_status();
    }

    /// How the plant is being run, and the steps after which it pauses; 0 means never.
    pub fn run_info(&self) -> (Run, u64) {
        let mut run = lock(&self.run.present).clone();
        run.is_running &= self.run.gate.lets_through();
        let steps_left = match run.settings.pace {
            Pace::Lockstep => self.run.gate.steps_left(),
            _ => self.live().steps_left.load(Ordering::Relaxed),
        };
        (run, steps_left)
    }

    /// How the plant is run, in short, and each change of it.
    pub fn run_status(&self) -> Receiver<RunStatus> {
        self.run.status.subscribe()
    }

    /// The plant takes its steps in a loop of its own, or would if it were not paused: inputs go there.
    pub fn runs_by_itself(&self) -> bool {
        self.run.status.borrow().pace != Pace::Lockstep
    }

    /// What the plant's own loop shares.
    pub fn live(&self) -> &Arc<Live> {
        self.run.live.get_or_init(|| Arc::new(Live::new(self.model().dimensions())))
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
        let ring = Arc::new(Ring::new(RING_RECORDS, record_words(self.model().dimensions())));
        let mut place = lock(&self.place);
        let running = Place::Running { key, handle: handle.clone(), permit };
        // Nobody else starts loops while `run.changing` is held.
        if let Place::Rest(mut core) = std::mem::replace(&mut *place, running) {
            self.feed.relay.begin(core.records.ring_or(ring), &self.feed.watchers);
            core.own_loop.has_core = true;
            let shared = Shared {
                live: Arc::clone(self.live()),
                leases: Arc::clone(&self.leases),
                closing: Arc::clone(&self.closing),
                all: Arc::clone(&self.realtime.counts),
                overruns: Arc::clone(&self.creation.owner.overruns),
            };
            let owner: Arc<dyn Owner> = Arc::clone(self) as _;
            handle.run(Runner::new(key, core, owner, shared, settings, steps));
        }
    }

    fn put_into(&self, place: &mut Place, mut core: Box<Core>) -> Option<Permit> {
        core.own_loop.has_core = false;
        self.live().due_ns.store(0, Ordering::Relaxed);
        self.feed.relay.end(core.records.written());
        match std::mem::replace(place, Place::Rest(core)) {
            Place::Running { permit, .. } => Some(permit),
            Place::Rest(_) => None,
        }
    }

    pub(super) fn tell_run_status(&self) {
        let (run, _) = self.run_info();
        let Run { settings, is_running, number, .. } = run;
        let revoked = self.leases.revoked();
        let status = RunStatus { pace: settings.pace, is_running, run: number, revoked };
        self.run.status.send_replace(status);
    }
}

impl Owner for Session {
    fn put_back(&self, core: Box<Core>) -> Option<Permit> {
        self.put_into(&mut lock(&self.place), core)
    }

    fn loop_ended(&self, core: Box<Core>, stop: Stop) {
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
            let mut run = lock(&self.run.present);
            run.is_running = false;
            run.stopped_by = stopped_by;
        }
        self.tell_run_status();
    }

    fn revoke_lease(&self) {
        self.revoke_driver();
    }
}
