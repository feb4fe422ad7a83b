//! Room for plants that run by themselves.

use prometheus_client::metrics::gauge::Gauge;

use crate::core::limits::LimitExceeded;
use crate::core::room::Reservation;

/// Room for a plant that runs by itself, until it is dropped.
pub(crate) struct Permit {
    running: Gauge,
    /// Room of the plant's owner.
    _own: Option<Reservation>,
}

impl Permit {
    /// Room for one more plant among those that this gauge counts.
    pub(super) fn take(running: &Gauge, running_max: u64) -> Result<Self, LimitExceeded> {
        let count = running.inc() + 1;
        let permit = Self { running: running.clone(), _own: None };
        let (name, what) = ("running_plants", "plants that run by themselves");
        LimitExceeded::check(name, running_max, what, count.max(0) as usize)?;
        Ok(permit)
    }

    /// With room of the plant's owner.
    pub(crate) fn and(mut self, own: Reservation) -> Self {
        self._own = Some(own);
        self
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.running.dec();
    }
}
