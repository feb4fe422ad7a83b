//! The lease of a session: the right to move its plant.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use plantd_models::{Initial, InitialError, Linearization, SnapshotError, StepReport};
use plantd_proto::link::monotonic_ns;

use crate::core::driver::DriverKind;
use crate::core::failure::step_error_reason;
use crate::core::mutex::lock;
use crate::core::plant::core::Core;
use crate::core::plant::error::DriveError;
use crate::core::plant::event::EventKind;
use crate::core::plant::view::PlantSnapshot;
use crate::core::plant::watchdog::WatchdogAction;
use crate::core::publish::frame::Frame;
use crate::core::realtime::slot::Arrival;
use crate::core::session::place::Place;
use crate::core::session::shared::Session;

/// One step in this many is timed for the histogram of step times.
const TIMED_STEP_INTERVAL: u64 = 64;

/// The lease is held by somebody else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the plant is driven over `{}`", .by.as_str())]
pub struct LeaseHeld {
    /// What the holder is.
    pub by: DriverKind,
}

impl Session {
    /// Takes the lease, which ends when the returned value is dropped.
    pub fn acquire(self: &Arc<Self>, kind: DriverKind) -> Result<Lease, LeaseHeld> {
        self.leases.claim(kind).map_err(|by| LeaseHeld { by })?;
        let lease = self.new_lease(kind);
        self.leases.put_in_force(lease.number);
        lease.begin();
        Ok(lease)
    }

    /// Takes the lease of that name over from whoever holds it: a stream whose connection broke, noticed
    /// or not.
    pub fn take_over(self: &Arc<Self>, token: &str) -> Option<Lease> {
        let former = self.leases.take_named(token)?;
        let lease = self.new_lease(DriverKind::Drive);
        // Dropped, it gives up nothing that is not its own.
        if !self.leases.replace(former, lease.number) {
            return None;
        }
        self.leases.revoke(former);
        self.tell_run_status();
        lease.tell(EventKind::DriverLeft, 0);
        lease.begin();
        Some(lease)
    }

    /// Gives the plant's own loop an input under the lease of that name; none when that has ended.
    pub fn offer_named(
        &self,
        token: &str,
        sequence: u64,
        u: &[f64],
    ) -> Option<Result<(), DriveError>> {
        let lease = self.leases.named(token)?;
        Some(self.offer(lease, sequence, u, 0))
    }

    fn offer(
        &self,
        lease: u64,
        sequence: u64,
        u: &[f64],
        answers_ns: u64,
    ) -> Result<(), DriveError> {
        self.model().check_input(u)?;
        let (live, arrived_ns) = (self.live(), monotonic_ns());
        live.slot.put(Arrival { lease, sequence, arrived_ns }, u);
        for counts in [&live.counts, &*self.realtime.counts] {
            counts.inputs.fetch_add(1, Ordering::Relaxed);
            if answers_ns != 0 && answers_ns <= arrived_ns {
                counts.round_trip.record(arrived_ns - answers_ns);
            }
        }
        Ok(())
    }

    fn new_lease(self: &Arc<Self>, kind: DriverKind) -> Lease {
        self.metrics.driver_started(kind);
        let number = self.leases.issue();
        Lease { session: Arc::clone(self), kind, number, untimed_steps: 0 }
    }

    /// Who drives the plant.
    pub fn driver(&self) -> Option<DriverKind> {
        self.leases.driver()
    }
}

/// The right to move a plant. Dropping it gives it up.
pub struct Lease {
    session: Arc<Session>,
    kind: DriverKind,
    number: u64,
    untimed_steps: u64,
}

impl Lease {
    /// The session.
    pub fn session(&self) -> &Arc<Session> {
        &self.session
    }

    /// Takes one step.
    pub fn step(&mut self, u: &[f64]) -> Result<StepReport, DriveError> {
        self.step_and(u, None, |core| core.last.report)
    }

    /// Takes one step and linearizes it.
    pub fn step_and_linearize(
        &mut self,
        u: &[f64],
        out: &mut Linearization,
    ) -> Result<StepReport, DriveError> {
        self.step_and(u, Some(out), |core| core.last.report)
    }

    /// Takes one step, linearizes it when asked to, and looks at the core before anybody else does.
    pub fn step_and<R>(
        &mut self,
        u: &[f64],
        linearization: Option<&mut Linearization>,
        look: impl FnOnce(&mut Core) -> R,
    ) -> Result<R, DriveError> {
        self.step_pushed_and(u, &[], linearization, look)
    }

    /// Steps after an impulse is added to the momentum (none if it is empty), and looks at the core then.
    pub fn step_pushed_and<R>(
        &mut self,
        u: &[f64],
        impulse: &[f64],
        linearization: Option<&mut Linearization>,
        look: impl FnOnce(&mut Core) -> R,
    ) -> Result<R, DriveError> {
        if self.session.is_closed() {
            return Err(DriveError::Closed);
        }
        if self.is_revoked() {
            return Err(DriveError::Revoked);
        }
        let is_timed = self.is_step_timed();
        let (session, is_gated) = (&self.session, self.kind != DriverKind::Step);
        let mut place = lock(&session.place);
        let Place::Rest(core) = &mut *place else { return Err(DriveError::Running) };
        if is_gated {
            session.run.gate.pass()?;
        }
        let started = is_timed.then(Instant::now);
        let outcome = core.step_pushed(u, impulse, linearization);
        if let Some(started) = started {
            session.metrics.step_timed(started.elapsed());
        }
        if let Err(error) = outcome {
            if let DriveError::Step(error) = &error {
                session.metrics.step_failed(step_error_reason(error));
                core.note_failure(error);
            }
            return Err(error);
        }
        session.publish(core);
        core.write_ring();
        session.metrics.stepped(self.kind);
        let is_last = is_gated && session.run.gate.passed(core.plant.settings().time_step_s);
        if is_last {
            core.note(EventKind::StepsTaken, 0, 0.0);
        }
        let trip = core.take_trip();
        let (seen, full) = (look(core), core.records.full_tap());
        drop(place);
        if trip.is_some_and(|trip| trip.dog.action == WatchdogAction::Disconnect) {
            session.revoke_driver();
        }
        if is_last {
            session.tell_run_status();
        }
        // Whoever steps a plant waits for its recorder; a plant that runs by itself does not.
        if let Some(tap) = full {
            tap.wait();
        }
        Ok(seen)
    }

    /// Looks at the plant, unless it runs by itself. Waits for nothing longer than a step.
    pub fn look<R>(&self, look: impl FnOnce(&Core) -> R) -> Result<R, DriveError> {
        match &*lock(&self.session.place) {
            Place::Rest(core) => Ok(look(core)),
            Place::Running { .. } => Err(DriveError::Running),
        }
    }

    /// Gives the plant's own loop an input, which acts from its next step on. `answers_ns` is when the
    /// state was there that the input answers, 0 if that is not known.
    pub fn offer(&mut self, sequence: u64, u: &[f64], answers_ns: u64) -> Result<(), DriveError> {
        if self.session.is_closed() {
            return Err(DriveError::Closed);
        }
        if self.is_revoked() {
            return Err(DriveError::Revoked);
        }
        self.session.offer(self.number, sequence, u, answers_ns)
    }

    /// Gives it a name, under which it can be taken over.
    pub fn set_name(&self, token: String) {
        self.session.leases.set_name(token, self.number);
    }

    /// It was taken away.
    pub fn is_revoked(&self) -> bool {
        self.session.leases.revoked() >= self.number
    }

    /// Puts the plant back into the state in which the session began, and tells it. Changed parameters stay changed.
    pub fn reset(&mut self) -> Result<Frame, InitialError> {
        let _replacing = self.session.replacing();
        let plant = self.session.plant_at_start()?;
        Ok(self.session.replace_plant(plant, None))
    }

    /// Puts the plant into a state, step 0, and tells it.
    pub fn initialize(&mut self, initial: &Initial) -> Result<Frame, InitialError> {
        let _replacing = self.session.replacing();
        let plant = self.session.copy_plants().swap_remove(0).start(initial)?;
        Ok(self.session.replace_plant(plant, None))
    }

    /// Puts the plant into the state of a snapshot: one of the same parameters and time step.
    pub fn restore(&mut self, snapshot: PlantSnapshot) -> Result<Frame, SnapshotError> {
        self.session.restore(snapshot)
    }

    /// From now on it is in force.
    fn begin(&self) {
        self.tell(EventKind::DriverAttached, self.number);
    }

    /// Lets the plant know of a driver that comes or goes: from then on inputs come under that lease.
    fn tell(&self, event: EventKind, input_lease: u64) {
        if self.kind == DriverKind::Step {
            return;
        }
        let (session, code) = (Arc::clone(&self.session), self.kind.code().into());
        self.session.post(move |core| {
            session.leases.set_input(input_lease);
            core.note(event, code, 0.0);
        });
    }

    fn is_step_timed(&mut self) -> bool {
        let timed = self.untimed_steps == 0;
        self.untimed_steps = (self.untimed_steps + 1) % TIMED_STEP_INTERVAL;
        timed
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        let (session, kind) = (&self.session, self.kind);
        session.metrics.driver_ended(kind);
        if !session.leases.replace(self.number, 0) {
            // Somebody has taken it over.
            return;
        }
        self.tell(EventKind::DriverLeft, 0);
        session.leases.vacate();
    }
}
