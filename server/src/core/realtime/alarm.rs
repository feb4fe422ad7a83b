//! Sleeping until a time that does not move, unless there is something to do.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::thread::futex::{self, Flags, Timespec};

/// A thread's sleep, and what ends it early.
#[derive(Clone, Debug, Default)]
pub struct Alarm {
    rung: Arc<AtomicU32>,
}

impl Alarm {
    /// Wakes the sleeper, or keeps it from falling asleep.
    pub fn ring(&self) {
        self.rung.store(1, Ordering::Release);
        // It fails when there is nobody to wake.
        let _ = futex::wake(&self.rung, Flags::PRIVATE, 1);
    }

    /// Whether it has rung since the last call.
    pub fn take(&self) -> bool {
        self.rung.load(Ordering::Relaxed) != 0 && self.rung.swap(0, Ordering::Acquire) != 0
    }

    /// Sleeps until a time on the system's monotonic clock, ns, or until it rings: one system call.
    pub fn sleep_until(&self, time_ns: u64) {
        const EVERYBODY: NonZeroU32 = NonZeroU32::MAX;
        const SECOND_NS: u64 = 1_000_000_000;
        let time = Timespec {
            tv_sec: (time_ns / SECOND_NS) as i64,
            tv_nsec: (time_ns % SECOND_NS) as i64,
        };
        // The time is absolute. A signal may end the sleep early: the caller looks at the clock.
        let _ = futex::wait_bitset(&self.rung, Flags::PRIVATE, 0, Some(&time), EVERYBODY);
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use plantd_proto::link::monotonic_ns;

    use super::*;

    #[test]
    fn it_sleeps_until_the_time() {
        let alarm = Alarm::default();
        let until = monotonic_ns() + 20_000_000;
        while monotonic_ns() < until {
            alarm.sleep_until(until);
        }
        alarm.sleep_until(0);
        assert!(!alarm.take());
    }

    #[test]
    fn ringing_ends_the_sleep_or_keeps_from_it() {
        let alarm = Alarm::default();
        let sleeper = {
            let alarm = alarm.clone();
            std::thread::spawn(move || {
                while !alarm.take() {
                    alarm.sleep_until(u64::MAX / 2);
                }
            })
        };
        alarm.ring();
        let patience = Instant::now() + Duration::from_secs(60);
        while !sleeper.is_finished() && Instant::now() < patience {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(sleeper.is_finished(), "the sleeper was not woken");
        sleeper.join().unwrap();
    }
}
