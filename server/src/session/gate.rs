//! When the driver of a plant in lockstep may step.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use plantd_proto::link::monotonic_ns;

use super::DriveError;

/// A plant that is late by more than this goes on from where it is, ns.
const CATCH_UP_NS: f64 = 1e8;

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
    /// Time between two steps, ns; 0 means none.
    period_ns: f64,
    /// When the next step is due, ns.
    due_ns: f64,
}

impl Default for Gate {
    fn default() -> Self {
        let rules = Rules { steps: u64::MAX, period_ns: 0.0, due_ns: 0.0 };
        Self { is_open: AtomicBool::new(true), rules: Mutex::new(rules) }
    }
}

impl Gate {
    /// Lets so many steps through, 0 for all, one in each `period_s`, 0 for as fast as they come.
    pub(super) fn open(&self, steps: u64, period_s: f64) {
        let steps = if steps == 0 { u64::MAX } else { steps };
        let (period_ns, due_ns) = (period_s * 1e9, monotonic_ns() as f64);
        let mut rules = self.rules();
        *rules = Rules { steps, period_ns, due_ns };
        self.is_open.store(steps == u64::MAX && period_ns == 0.0, Ordering::Release);
    }

    /// Lets nothing through.
    pub(super) fn close(&self) {
        let mut rules = self.rules();
        rules.steps = 0;
        self.is_open.store(false, Ordering::Release);
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
        let mut rules = self.rules();
        if rules.steps == 0 {
            return Err(DriveError::Paused);
        }
        let now_ns = monotonic_ns() as f64;
        if now_ns < rules.due_ns {
            return Err(DriveError::NotDue(rules.due_ns as u64));
        }
        rules.due_ns = (rules.due_ns + rules.period_ns).max(now_ns - CATCH_UP_NS);
        if rules.steps != u64::MAX {
            rules.steps -= 1;
        }
        Ok(())
    }

    fn rules(&self) -> std::sync::MutexGuard<'_, Rules> {
        self.rules.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_lets_through_what_it_was_told() {
        let gate = Gate::default();
        assert_eq!(gate.pass(), Ok(()));
        gate.close();
        assert_eq!(gate.pass(), Err(DriveError::Paused));
        gate.open(2, 0.0);
        assert_eq!([gate.pass(), gate.pass()], [Ok(()), Ok(())]);
        assert_eq!(gate.pass(), Err(DriveError::Paused));
        gate.open(0, 3600.0);
        assert_eq!(gate.pass(), Ok(()));
        let Err(DriveError::NotDue(due_ns)) = gate.pass() else { panic!("an hour has passed") };
        assert!(due_ns > monotonic_ns() + 3_500_000_000_000);
        gate.open(0, 0.0);
        assert_eq!([gate.pass(), gate.pass()], [Ok(()), Ok(())]);
    }
}
