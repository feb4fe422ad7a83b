//! Room for plants that run by themselves.

use prometheus_client::metrics::gauge::Gauge;

use crate::core::limits::LimitExceeded;

/// Room for a plant that runs by itself, until it is dropped.
pub(crate) struct Permit(Gauge);

impl Permit {
    /// Room for one more plant among those that this gauge counts.
    pub(super) fn take(running: &Gauge, running_max: u64) -> Result<Self, LimitExceeded> {
        let count = running.inc() + 1;
        let permit = Self(running.clone());
        let (name, what) = ("running_plants", "plants that run by themselves");
        LimitExceeded::check(name, running_max, what, count.max(0) as usize)?;
        Ok(permit)
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.0.dec();
    }
}
