//! The loop that runs plants.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, channel};

use plantd_proto::link::monotonic_ns;

use super::alarm::Alarm;
use super::event::EventKind;
use super::input::{Change, LoopInput};
use super::watchdog::WatchdogAction;
use super::{CATCH_UP_NS, Live, Pace, Permit, RealTimeSettings, RunSettings, TimingCounts};
use crate::core::frame::Timing;
use crate::core::priority::{Priority, allow_cpus, sharpen_timers};
use crate::core::session::{Core, DriveError, Session, StoppedBy};

/// Overruns are told at most once in this time, ns.
const OVERRUN_PERIOD_NS: u64 = 1_000_000_000;
/// Least time after which a command is obeyed although there is no time for it before the next step, ns;
/// it is also this many times as long as commands take.
const PATIENCE_NS: u64 = 1_000_000;
const PATIENCE: u64 = 8;

/// What is done with the core of a running plant between two steps. Without a core the plant does not
/// run here.
type Act = Box<dyn FnOnce(Option<&mut Core>) + Send>;

/// What a loop is told.
enum Command {
    Start(Box<Runner>),
    Act(u64, Act),
    /// Gives the core back to its session, and says what room the plant had.
    Stop(u64, Sender<Option<Permit>>),
}

/// A loop, for those who tell it something.
#[derive(Clone)]
pub(crate) struct Handle {
    commands: Sender<Command>,
    alarm: Alarm,
}

impl Handle {
    /// A loop for plants that follow the wall clock.
    pub(super) fn start_paced(index: usize, settings: &RealTimeSettings) -> std::io::Result<Self> {
        let (settings, name) = (settings.clone(), format!("pace-{index}"));
        Self::start(name, move |scheduler| {
            allow_cpus(&settings.cpus);
            settings.scheduling.apply();
            sharpen_timers();
            scheduler.run(settings.spin_us * 1000);
        })
    }

    /// A loop for plants that take one step after the other.
    pub(super) fn start_free() -> std::io::Result<Self> {
        Self::start("free".to_owned(), |scheduler| {
            Priority::Nice.apply("free-running plants");
            scheduler.run(0);
        })
    }

    fn start(name: String, body: impl FnOnce(Scheduler) + Send + 'static) -> std::io::Result<Self> {
        let (commands, inbox) = channel();
        let alarm = Alarm::default();
        let scheduler = Scheduler {
            inbox,
            alarm: alarm.clone(),
            attention: Attention::default(),
            due: BinaryHeap::new(),
            runners: Vec::new(),
        };
        std::thread::Builder::new().name(name).spawn(move || body(scheduler))?;
        Ok(Self { commands, alarm })
    }

    /// Begins to run a plant.
    pub(crate) fn run(&self, runner: Box<Runner>) {
        self.tell(Command::Start(runner));
    }

    /// Does something with the core of a plant between two steps.
    pub(crate) fn act(&self, key: u64, act: Act) {
        self.tell(Command::Act(key, act));
    }

    /// Takes a plant out of the loop, if it still runs here: its session has it then. The room that it had.
    pub(crate) fn stop(&self, key: u64) -> Option<Permit> {
        let (give, taken) = channel();
        self.tell(Command::Stop(key, give));
        taken.recv().ok().flatten()
    }

    fn tell(&self, command: Command) {
        // The loop ends when its last handle is gone: it is there.
        let _ = self.commands.send(command);
        self.alarm.ring();
    }
}

/// A loop with its plants.
struct Scheduler {
    inbox: Receiver<Command>,
    alarm: Alarm,
    attention: Attention,
    /// When which plant is due, the earliest first.
    due: BinaryHeap<Reverse<(u64, usize)>>,
    runners: Vec<Option<Box<Runner>>>,
}

impl Scheduler {
    /// Runs until nobody can tell it anything any more.
    fn run(mut self, spin_ns: u64) {
        loop {
            let Some(&Reverse((due_ns, _))) = self.due.peek() else {
                let Ok(command) = self.inbox.recv() else { return };
                self.obey(command);
                continue;
            };
            let mut now_ns = monotonic_ns();
            if self.alarm.take() {
                self.attention.call(now_ns);
            }
            if self.attention.is_due(now_ns, due_ns) {
                self.obey_next(now_ns);
                continue;
            }
            if now_ns + spin_ns < due_ns {
                self.alarm.sleep_until(due_ns - spin_ns);
                continue;
            }
            while now_ns < due_ns {
                std::hint::spin_loop();
                now_ns = monotonic_ns();
            }
            self.step_first(now_ns);
        }
    }

    /// Obeys a command, if there is one.
    fn obey_next(&mut self, now_ns: u64) {
        match self.inbox.try_recv() {
            Ok(command) => {
                self.obey(command);
                self.attention.obeyed(now_ns, monotonic_ns());
            }
            Err(_) => self.attention.is_called = false,
        }
    }

    /// The step of the plant that is due first.
    fn step_first(&mut self, now_ns: u64) {
        let Some(Reverse((_, slot))) = self.due.pop() else { return };
        let Some(runner) = &mut self.runners[slot] else { return };
        match runner.step(now_ns) {
            Ok(due_ns) => self.due.push(Reverse((due_ns, slot))),
            Err(stop) => {
                if let Some(runner) = self.runners[slot].take() {
                    runner.session.loop_ended(runner.core, stop);
                }
            }
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start(runner) => {
                let slot = self.runners.iter().position(Option::is_none).unwrap_or_else(|| {
                    self.runners.push(None);
                    self.runners.len() - 1
                });
                self.due.push(Reverse((runner.due_ns(), slot)));
                self.runners[slot] = Some(runner);
            }
            Command::Act(key, act) => {
                let runner = self.runners.iter_mut().flatten().find(|runner| runner.key == key);
                act(runner.map(|runner| &mut *runner.core));
            }
            Command::Stop(key, give) => {
                let has_key = |runner: &Option<Box<Runner>>| {
                    runner.as_ref().is_some_and(|runner| runner.key == key)
                };
                let slot = self.runners.iter().position(has_key);
                let runner = slot.and_then(|slot| {
                    self.due.retain(|Reverse((_, other))| *other != slot);
                    self.runners[slot].take()
                });
                let permit = runner.and_then(|runner| runner.session.put_back(runner.core));
                // The receiver waits for it.
                let _ = give.send(permit);
            }
        }
    }
}

/// When a loop attends to commands: while there is time for one before the next step; beyond that now and
/// then, so that however many there are they take a small part of its time.
#[derive(Debug, Default)]
struct Attention {
    /// There may be commands.
    is_called: bool,
    /// Since when one waits, ns.
    since_ns: u64,
    /// What the longest one of late has taken, ns.
    cost_ns: u64,
}

impl Attention {
    /// Somebody has a command.
    fn call(&mut self, now_ns: u64) {
        if !self.is_called {
            self.is_called = true;
            self.since_ns = now_ns;
        }
    }

    /// It is time for a command, while the next step is due at `due_ns`.
    fn is_due(&self, now_ns: u64, due_ns: u64) -> bool {
        let has_waited_ns = now_ns.saturating_sub(self.since_ns);
        self.is_called
            && (now_ns + self.cost_ns < due_ns
                || has_waited_ns >= PATIENCE_NS.max(PATIENCE * self.cost_ns))
    }

    /// A command was obeyed; the next one may wait already.
    fn obeyed(&mut self, began_ns: u64, ended_ns: u64) {
        self.cost_ns = (ended_ns - began_ns).max(self.cost_ns / 2);
        self.since_ns = ended_ns;
    }
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

/// A plant that a loop runs.
pub(crate) struct Runner {
    key: u64,
    core: Box<Core>,
    session: Arc<Session>,
    live: Arc<Live>,
    all: Arc<TimingCounts>,
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
        session: Arc<Session>,
        settings: &RunSettings,
        steps: u64,
    ) -> Box<Self> {
        let live = Arc::clone(session.live());
        let forces = session.model().dimensions().inputs;
        let (held, is_valid) = core.first_input();
        let mut runner = Box::new(Self {
            key,
            live,
            all: Arc::clone(session.loop_counts()),
            session,
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
        runner.live.steps_left.store(steps, Ordering::Relaxed);
        // Also the first step has a time step to wait for.
        runner.ticks = 1;
        runner
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

    fn due_ns(&self) -> u64 {
        self.origin_ns + (self.ticks as f64 * self.period_ns) as u64
    }

    /// Takes the step that is due; when the next one is due.
    fn step(&mut self, began_ns: u64) -> Result<u64, Stop> {
        if self.session.is_closed() {
            return Err(Stop::Closed);
        }
        let mut timing = Timing { due_ns: self.due_ns(), began_ns, ..Timing::default() };
        self.find_input(began_ns, &mut timing)?;
        let outcome = self.core.step(self.input.u(), None);
        timing.ended_ns = monotonic_ns();
        match outcome {
            Ok(_) => self.core.timing = timing,
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
                WatchdogAction::Disconnect => self.session.revoke_lease(),
                WatchdogAction::Reset => {}
            }
        }
        if self.steps_left == u64::MAX {
            return Ok(next_ns);
        }
        self.steps_left -= 1;
        self.live.steps_left.store(self.steps_left, Ordering::Relaxed);
        if self.steps_left == 0 { Err(Stop::StepsTaken) } else { Ok(next_ns) }
    }

    /// When the next step is due, after one that ended at `ended_ns`. Gives the schedule up when it cannot
    /// be caught up with.
    fn schedule(&mut self, ended_ns: u64) -> u64 {
        self.set_period();
        if self.is_paced {
            self.ticks += 1;
            let behind_ns = ended_ns.saturating_sub(self.due_ns());
            for counts in [&self.live.counts, &*self.all] {
                counts.overruns.fetch_add(u64::from(behind_ns > 0), Ordering::Relaxed);
                counts.slips.fetch_add(u64::from(behind_ns > CATCH_UP_NS), Ordering::Relaxed);
            }
            if behind_ns > 0 {
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
        self.live.due_ns.store(next_ns, Ordering::Relaxed);
        next_ns
    }

    fn find_input(&mut self, now_ns: u64, timing: &mut Timing) -> Result<(), Stop> {
        let lease = self.session.input_lease();
        let (input, slot) = (&mut self.input, &self.live.slot);
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
        for counts in [&self.live.counts, &*self.all] {
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
            self.session.revoke_lease();
        }
        Err(Stop::Refused(error.into()))
    }

    /// Counts the times of a step.
    fn count(&self, timing: &Timing) {
        for counts in [&self.live.counts, &*self.all] {
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps that leave no time, and commands without end: time goes on as either is taken.
    #[test]
    fn commands_take_a_small_part_of_a_busy_loop() {
        const STEP_NS: u64 = 100_000;
        const COMMAND_NS: u64 = 400_000;
        let (mut attention, mut now_ns, mut steps, mut commands) = (Attention::default(), 0, 0, 0);
        while now_ns < 10_000_000_000 {
            attention.call(now_ns);
            if attention.is_due(now_ns, now_ns) {
                attention.obeyed(now_ns, now_ns + COMMAND_NS);
                now_ns += COMMAND_NS;
                commands += 1;
            } else {
                now_ns += STEP_NS;
                steps += 1;
            }
        }
        let part = (commands * COMMAND_NS) as f64 / now_ns as f64;
        assert!(part > 0.1 && part < 0.112, "{part}");
        assert!(steps > 80_000);
    }

    #[test]
    fn a_command_waits_when_it_would_make_a_step_late() {
        let mut attention = Attention::default();
        assert!(!attention.is_due(0, 1_000_000), "there is none");
        attention.call(1000);
        assert!(attention.is_due(1000, 1_000_000));
        attention.obeyed(1000, 51_000);
        assert!(attention.is_due(900_000, 1_000_000));
        assert!(!attention.is_due(960_000, 1_000_000));
        // One that took long once is forgotten.
        for _ in 0..20 {
            attention.obeyed(900_000, 901_000);
        }
        assert!(attention.is_due(960_000, 1_000_000));
    }
}
