//! How much of something may be had in a second.

use std::sync::{Arc, Mutex};
use std::time::Instant;

use crate::core::limits::LimitExceeded;
use crate::core::mutex::lock;

/// Seconds for which somebody waits at most who has taken too much at once.
const DEBT_MAX_S: f64 = 10.0;

/// A store that fills at a constant rate up to what comes in a second.
#[derive(Debug)]
pub struct Rate {
    name: &'static str,
    what: &'static str,
    /// None without a limit: then nothing is counted.
    per_second: Option<u64>,
    store: Mutex<Store>,
}

#[derive(Debug)]
struct Store {
    level: f64,
    filled: Instant,
}

impl Store {
    fn fill(&mut self, per_second: u64, now: Instant) {
        let (rate, since) = (per_second as f64, now.saturating_duration_since(self.filled));
        self.level = (self.level + rate * since.as_secs_f64()).min(rate.max(1.0));
        self.filled = now;
    }
}

impl Rate {
    /// So much in a second: the limit of that name, for what it is.
    pub fn new(name: &'static str, what: &'static str, per_second: Option<u64>) -> Arc<Self> {
        let level = per_second.map_or(0.0, |rate| rate as f64);
        let store = Mutex::new(Store { level, filled: Instant::now() });
        Arc::new(Self { name, what, per_second, store })
    }

    /// Takes so many, if there are as many.
    pub fn take(&self, count: u64) -> Result<(), LimitExceeded> {
        self.take_at(count, Instant::now())
    }

    fn take_at(&self, count: u64, now: Instant) -> Result<(), LimitExceeded> {
        let Some(per_second) = self.per_second else { return Ok(()) };
        let mut store = lock(&self.store);
        store.fill(per_second, now);
        if store.level >= count as f64 {
            store.level -= count as f64;
            return Ok(());
        }
        Err(self.exceeded(per_second))
    }

    /// Refuses whoever has taken more than there was.
    pub fn check(&self) -> Result<(), LimitExceeded> {
        self.check_at(Instant::now())
    }

    fn check_at(&self, now: Instant) -> Result<(), LimitExceeded> {
        let Some(per_second) = self.per_second else { return Ok(()) };
        let mut store = lock(&self.store);
        store.fill(per_second, now);
        if store.level >= 0.0 && per_second > 0 { Ok(()) } else { Err(self.exceeded(per_second)) }
    }

    /// Takes what some work has used, be there as much or not; `meter` tells how much was used until now, and is not
    /// asked without a limit.
    pub fn spent_by<T>(&self, meter: impl Fn() -> f64, work: impl FnOnce() -> T) -> T {
        if self.per_second.is_none() {
            return work();
        }
        let before = meter();
        let outcome = work();
        self.spend_at(meter() - before, Instant::now());
        outcome
    }

    fn spend_at(&self, amount: f64, now: Instant) {
        let Some(per_second) = self.per_second else { return };
        let mut store = lock(&self.store);
        store.fill(per_second, now);
        store.level = (store.level - amount).max(-DEBT_MAX_S * per_second as f64);
    }

    fn exceeded(&self, per_second: u64) -> LimitExceeded {
        let actual = per_second.saturating_add(1);
        LimitExceeded { name: self.name, limit: per_second, what: self.what, actual }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_second_gives_what_the_limit_says() {
        let rate = Rate::new("tenant.messages_per_s", "messages", Some(10));
        let start = Instant::now();
        rate.take_at(10, start).unwrap();
        let refused = rate.take_at(1, start).unwrap_err();
        assert_eq!((refused.name, refused.limit), ("tenant.messages_per_s", 10));
        rate.take_at(5, start + Duration::from_millis(501)).unwrap();
        rate.take_at(1, start + Duration::from_millis(502)).unwrap_err();
        // However long nobody comes, no more than a second's is there.
        rate.take_at(11, start + Duration::from_secs(60)).unwrap_err();
        rate.take_at(10, start + Duration::from_secs(60)).unwrap();
    }

    #[test]
    fn what_was_used_is_waited_for() {
        let rate = Rate::new("tenant.worker_ms_per_s", "milliseconds", Some(100));
        let start = Instant::now();
        rate.check_at(start).unwrap();
        rate.spend_at(300.0, start);
        rate.check_at(start + Duration::from_millis(1900)).unwrap_err();
        rate.check_at(start + Duration::from_millis(2100)).unwrap();
        rate.spend_at(1e9, start + Duration::from_millis(2100));
        rate.check_at(start + Duration::from_millis(12_200)).unwrap();
    }

    #[test]
    fn without_a_limit_nothing_is_refused() {
        let rate = Rate::new("tenant.messages_per_s", "messages", None);
        rate.take(u64::MAX).unwrap();
        rate.spend_at(1e12, Instant::now());
        assert_eq!(rate.spent_by(|| panic!("nobody asks"), || 7), 7);
        rate.check().unwrap();
        Rate::new("tenant.worker_ms_per_s", "milliseconds", Some(0)).check().unwrap_err();
    }
}
