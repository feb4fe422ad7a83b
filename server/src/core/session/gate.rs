//! When the driver of a plant in lockstep may step.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use plantd_proto::link::monotonic_ns;

use crate::core::plant::error::DriveError;
use crate::core::realtime::settings::CATCH_UP_NS;

/// Lets steps through: all, none, so many, or at a speed. Open, it costs one load.
#[derive(Debug)]
pub(super) struct Gate {
    is_open: AtomicBool,
    rules: Mutex<Rules>,
}

#[derive(Debug)]
struct Rules {
    /// Steps that may be taken.
    steps: u64,
    /// Seconds of the plant's clock in one of the wall clock; 0 means as many as it takes.
    speed: f64,
    /// When the next step is due, ns.
    due_ns: f64,
}

impl Default for Gate {
    fn default() -> Self {
        let rules = Rules { steps: u64::MAX, speed: 0.0, due_ns: 0.0 };
        Self { is_open: AtomicBool::new(true), rules: Mutex::new(rules) }
    }
}

impl Gate {
    /// Lets so many steps through, 0 for all, at a speed, 0 for as fast as they come.
    pub(super) fn open(&self, steps: u64, speed: f64) {
        let steps = if steps == 0 { u64::MAX } else { steps };
        let mut rules = self.rules();
        *rules = Rules { steps, speed, due_ns: monotonic_ns() as f64 };
        self.is_open.store(steps == u64::MAX && speed == 0.0, Ordering::Release);
    }

    /// Lets nothing through.
    pub(super) fn close(&self) {
        let mut rules = self.rules();
        rules.steps = 0;
        self.is_open.store(false, Ordering::Release);
    }

    /// It lets a step through, now or when it is due.
    pub(super) fn lets_through(&self) -> bool {
        self.rules().steps > 0
    }

    /// Steps that may still be taken; 0 when there is no bound.
    pub(super) fn steps_left(&self) -> u64 {
        match self.rules().steps {
            u64::MAX => 0,
            steps => steps,
        }
    }

    /// Lets one step through, or says why not.
    pub(super) fn pass(&self) -> Result<(), DriveError> {
        if self.is_open.load(Ordering::Acquire) {
            return Ok(());
        }
        let rules = self.rules();
        if rules.steps == 0 {
            return Err(DriveError::Paused);
        }
        if (monotonic_ns() as f64) < rules.due_ns {
            return Err(DriveError::NotDue(rules.due_ns as u64));
        }
        Ok(())
    }

    /// Notes that a step was taken. True when it was the last one.
    pub(super) fn passed(&self, time_step_s: f64) -> bool {
        if self.is_open.load(Ordering::Acquire) {
            return false;
        }
        let mut rules = self.rules();
        if rules.speed > 0.0 {
            let next_ns = rules.due_ns + time_step_s / rules.speed * 1e9;
            rules.due_ns = next_ns.max(monotonic_ns().saturating_sub(CATCH_UP_NS) as f64);
        }
        // It may have been closed since.
        if matches!(rules.steps, 0 | u64::MAX) {
            return false;
        }
        rules.steps -= 1;
        rules.steps == 0
    }

    fn rules(&self) -> MutexGuard<'_, Rules> {
        self.rules.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_lets_through_what_it_was_told() {
        let gate = Gate::default();
        let step = |time_step_s| gate.pass().map(|()| gate.passed(time_step_s));
        assert_eq!(step(0.01), Ok(false));
        gate.close();
        assert_eq!(step(0.01), Err(DriveError::Paused));
        assert!(!gate.lets_through());
        gate.open(2, 0.0);
        // A step that failed is none.
        assert_eq!(gate.pass(), Ok(()));
        assert_eq!([step(0.01), step(0.01)], [Ok(false), Ok(true)]);
        assert_eq!(step(0.01), Err(DriveError::Paused));
        gate.open(0, 0.0);
        assert_eq!([step(0.01), step(0.01)], [Ok(false), Ok(false)]);
    }

    /// The period follows the time step of each step.
    #[test]
    fn at_a_speed_the_next_step_is_due_a_time_step_later() {
        let gate = Gate::default();
        gate.open(0, 0.5);
        for (time_step_s, period_ns) in [(0.0, 0), (1800.0, 3_600_000_000_000)] {
            let before_ns = monotonic_ns();
            assert_eq!(gate.pass().map(|()| gate.passed(time_step_s)), Ok(false));
            if period_ns > 0 {
                let Err(DriveError::NotDue(due_ns)) = gate.pass() else { panic!("it is not due") };
                let wait_ns = due_ns + CATCH_UP_NS - before_ns;
                assert!((period_ns..period_ns + 2 * CATCH_UP_NS).contains(&wait_ns), "{wait_ns}");
            }
        }
    }
}
