//! A plant in a loop: when its steps are due, with which input, and why they end.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use plantd_proto::link::monotonic_ns;

use crate::core::metrics::counts::TimingCounts;
use crate::core::plant::closing::Closing;
use crate::core::plant::core::Core;
use crate::core::plant::error::DriveError;
use crate::core::plant::event::EventKind;
use crate::core::plant::leases::Leases;
use crate::core::plant::watchdog::WatchdogAction;
use crate::core::publish::frame::Timing;
use crate::core::realtime::input::{Change, LoopInput};
use crate::core::realtime::live::Live;
use crate::core::realtime::permit::Permit;
use crate::core::realtime::settings::{CATCH_UP_NS, Pace, RunSettings};

/// Overruns are told at most once in this time, ns.
const OVERRUN_PERIOD_NS: u64 = 1_000_000_000;

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

/// Why a loop lets go of a plant.
pub(crate) enum Stop {
    /// The steps that were asked for are taken.
    StepsTaken,
    /// The plant was deleted.
    Closed,
    /// It may not go on.
    Refused(StoppedBy),
}

/// Whoever lends the core of a plant to a loop.
pub(crate) trait Owner: Send + Sync {
    /// Takes the core back, which was asked for; the room that the plant had in the loop.
    fn put_back(&self, core: Box<Core>) -> Option<Permit>;

    /// Takes the core back from a loop that lets go of the plant.
    fn loop_ended(&self, core: Box<Core>, stop: Stop);

    /// Takes the lease away from the driver.
    fn revoke_lease(&self);
}

/// What a loop shares with the owner of a plant and looks at in each step.
pub(crate) struct Shared {
    pub(crate) live: Arc<Live>,
    pub(crate) leases: Arc<Leases>,
    pub(crate) closing: Arc<Closing>,
    /// What all loops have counted together.
    pub(crate) all: Arc<TimingCounts>,
    /// Overruns of all plants of the same tenant.
    pub(crate) overruns: Arc<AtomicU64>,
}

/// A plant that a loop runs.
pub(crate) struct Runner {
    key: u64,
    core: Box<Core>,
    owner: Arc<dyn Owner>,
    shared: Shared,
    input: LoopInput,
    /// Steps that may still be taken.
    steps_left: u64,
    is_paced: bool,
    speed: f64,
    /// Deadlines are `origin + k period`, so that they do not drift.
    origin_ns: u64,
    ticks: u64,
    time_step_s: f64,
    period_ns: f64,
    /// Overruns that no event has told, and when the last one did, ns.
    untold_overruns: u64,
    overruns_told_ns: u64,
}

impl Runner {
    /// A plant that begins to run now; `steps` 0 means without end.
    pub(crate) fn new(
        key: u64,
        core: Box<Core>,
        owner: Arc<dyn Owner>,
        shared: Shared,
        settings: &RunSettings,
        steps: u64,
    ) -> Box<Self> {
        let forces = core.plant().model().dimensions().inputs;
        let (held, is_valid) = core.first_input();
        let mut runner = Box::new(Self {
            key,
            owner,
            shared,
            input: LoopInput::new(settings.input.clone(), held, forces, is_valid),
            steps_left: if steps == 0 { u64::MAX } else { steps },
            is_paced: settings.pace == Pace::Paced,
            speed: settings.speed,
            origin_ns: monotonic_ns(),
            ticks: 0,
            time_step_s: 0.0,
            period_ns: 0.0,
            untold_overruns: 0,
            overruns_told_ns: 0,
            core,
        });
        runner.set_period();
        runner.shared.live.steps_left.store(steps, Ordering::Relaxed);
        // Also the first step has a time step to wait for.
        runner.ticks = 1;
        runner
    }

    /// The plant's number.
    pub(super) fn key(&self) -> u64 {
        self.key
    }

    /// What others want done is done with it between two steps.
    pub(super) fn core_mut(&mut self) -> &mut Core {
        &mut self.core
    }

    /// Gives the core back, which was asked for; the room that the plant had.
    pub(super) fn put_back(self) -> Option<Permit> {
        self.owner.put_back(self.core)
    }

    /// Lets go of the plant.
    pub(super) fn end(self, stop: Stop) {
        self.owner.loop_ended(self.core, stop);
    }

    /// The period of the plant's time step, which may change while it runs.
    fn set_period(&mut self) {
        let time_step_s = self.core.plant().settings().time_step_s;
        if time_step_s != self.time_step_s {
            self.origin_ns = self.due_ns();
            self.ticks = 0;
            self.time_step_s = time_step_s;
            self.period_ns = if self.is_paced { time_step_s / self.speed * 1e9 } else { 0.0 };
        }
    }

    /// When the next step is due.
    pub(super) fn due_ns(&self) -> u64 {
        self.origin_ns + (self.ticks as f64 * self.period_ns) as u64
    }

    /// Takes the step that is due; when the next one is due.
    pub(super) fn step(&mut self, began_ns: u64) -> Result<u64, Stop> {
        if self.shared.closing.is_closed() {
            return Err(Stop::Closed);
        }
        let mut timing = Timing { due_ns: self.due_ns(), began_ns, ..Timing::default() };
        self.find_input(began_ns, &mut timing)?;
        let outcome = self.core.step(self.input.u(), None);
        timing.ended_ns = monotonic_ns();
        match outcome {
            Ok(_) => self.core.last.timing = timing,
            Err(error) => {
                self.recover(error)?;
                self.core.write_ring();
                return Ok(self.schedule(timing.ended_ns));
            }
        }
        self.core.write_ring();
        let next_ns = self.schedule(timing.ended_ns);
        self.count(&timing);
        if let Some(trip) = self.core.take_trip() {
            match trip.dog.action {
                WatchdogAction::Freeze => {
                    return Err(Stop::Refused(DriveError::Frozen(trip).into()));
                }
                WatchdogAction::Disconnect => self.owner.revoke_lease(),
                WatchdogAction::Reset => {}
            }
        }
        if self.steps_left == u64::MAX {
            return Ok(next_ns);
        }
        self.steps_left -= 1;
        self.shared.live.steps_left.store(self.steps_left, Ordering::Relaxed);
        if self.steps_left == 0 { Err(Stop::StepsTaken) } else { Ok(next_ns) }
    }

    /// When the next step is due, after one that ended at `ended_ns`. Gives the schedule up when it cannot
    /// be caught up with.
    fn schedule(&mut self, ended_ns: u64) -> u64 {
        self.set_period();
        if self.is_paced {
            self.ticks += 1;
            let behind_ns = ended_ns.saturating_sub(self.due_ns());
            for counts in [&self.shared.live.counts, &*self.shared.all] {
                counts.overruns.fetch_add(u64::from(behind_ns > 0), Ordering::Relaxed);
                counts.slips.fetch_add(u64::from(behind_ns > CATCH_UP_NS), Ordering::Relaxed);
            }
            if behind_ns > 0 {
                self.shared.overruns.fetch_add(1, Ordering::Relaxed);
                self.tell_overrun(ended_ns);
            }
            if behind_ns > CATCH_UP_NS {
                self.core.note(EventKind::Slipped, 0, behind_ns as f64 * 1e-9);
                (self.origin_ns, self.ticks) = (ended_ns, 1);
            }
        } else {
            // The others of this loop take their turns first.
            (self.origin_ns, self.ticks) = (ended_ns, 0);
        }
        let next_ns = self.due_ns();
        self.shared.live.due_ns.store(next_ns, Ordering::Relaxed);
        next_ns
    }

    fn find_input(&mut self, now_ns: u64, timing: &mut Timing) -> Result<(), Stop> {
        let lease = self.shared.leases.input();
        let (input, slot) = (&mut self.input, &self.shared.live.slot);
        let change = input.next(slot, lease, now_ns, self.time_step_s, timing);
        let age_s = input.age_s(self.time_step_s);
        match change {
            Change::None => {}
            Change::Lost => self.core.note(EventKind::InputLost, 0, age_s),
            Change::Back => self.core.note(EventKind::InputBack, 0, 0.0),
            Change::Stop => {
                self.core.note(EventKind::InputLost, 0, age_s);
                return Err(Stop::Refused(StoppedBy::InputLost));
            }
        }
        for counts in [&self.shared.live.counts, &*self.shared.all] {
            if timing.flags & Timing::LATE == 0 {
                counts.used_inputs.fetch_add(1, Ordering::Relaxed);
            } else if lease != 0 {
                counts.late_inputs.fetch_add(1, Ordering::Relaxed);
            }
            if timing.flags & Timing::SAFE != 0 {
                counts.safe_inputs.fetch_add(1, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    /// Puts the plant back after a step that failed, or says why it stops.
    fn recover(&mut self, error: DriveError) -> Result<(), Stop> {
        if let DriveError::Step(error) = &error {
            self.core.note_failure(error);
        }
        let action = self.core.on_step_failure();
        if action == Some(WatchdogAction::Reset) && self.core.go_home() {
            return Ok(());
        }
        if action == Some(WatchdogAction::Disconnect) {
            self.owner.revoke_lease();
        }
        Err(Stop::Refused(error.into()))
    }

    /// Counts the times of a step.
    fn count(&self, timing: &Timing) {
        for counts in [&self.shared.live.counts, &*self.shared.all] {
            counts.steps.fetch_add(1, Ordering::Relaxed);
            counts.step.record(timing.ended_ns.saturating_sub(timing.began_ns));
            if self.is_paced {
                counts.lateness.record(timing.began_ns.saturating_sub(timing.due_ns));
            }
            if timing.input_sequence != 0 {
                counts.input_age.record(timing.input_age_ns);
            }
        }
    }

    fn tell_overrun(&mut self, now_ns: u64) {
        self.untold_overruns += 1;
        if now_ns.saturating_sub(self.overruns_told_ns) >= OVERRUN_PERIOD_NS {
            let count = std::mem::take(&mut self.untold_overruns);
            self.core.note(EventKind::Overran, 0, count as f64);
            self.overruns_told_ns = monotonic_ns();
        }
    }
}
