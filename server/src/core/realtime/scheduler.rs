//! The loop that runs plants.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::mpsc::{Receiver, Sender, channel};

use plantd_proto::link::monotonic_ns;

use crate::core::plant::core::Core;
use crate::core::priority::{Priority, allow_cpus, sharpen_timers};
use crate::core::realtime::alarm::Alarm;
use crate::core::realtime::permit::Permit;
use crate::core::realtime::runner::Runner;
use crate::core::realtime::settings::RealTimeSettings;

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
    /// Gives the core back to its owner, and says what room the plant had.
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

    /// Takes a plant out of the loop, if it still runs here: its owner has it then. The room that it had.
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
                    runner.end(stop);
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
                let runner = self.runners.iter_mut().flatten().find(|runner| runner.key() == key);
                act(runner.map(|runner| runner.core_mut()));
            }
            Command::Stop(key, give) => {
                let has_key = |runner: &Option<Box<Runner>>| {
                    runner.as_ref().is_some_and(|runner| runner.key() == key)
                };
                let slot = self.runners.iter().position(has_key);
                let runner = slot.and_then(|slot| {
                    self.due.retain(|Reverse((_, other))| *other != slot);
                    self.runners[slot].take()
                });
                let permit = runner.and_then(|runner| runner.put_back());
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
