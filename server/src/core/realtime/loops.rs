//! The loops of a server.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use prometheus_client::metrics::gauge::Gauge;

use crate::core::limits::LimitExceeded;
use crate::core::metrics::counts::TimingCounts;
use crate::core::metrics::registry::Metrics;
use crate::core::realtime::permissions::claim;
use crate::core::realtime::permit::Permit;
use crate::core::realtime::pump::Pump;
use crate::core::realtime::scheduler::Handle;
use crate::core::realtime::settings::{Pace, RealTimeSettings};

/// The loops of a server.
pub struct RealTime {
    settings: RealTimeSettings,
    /// Started with the first plant that needs them.
    paced: OnceLock<Vec<Handle>>,
    free: OnceLock<Handle>,
    pump: OnceLock<Pump>,
    next_key: AtomicU64,
    /// Plants that run by themselves.
    running: Gauge,
    /// What all loops have counted together.
    pub counts: Arc<TimingCounts>,
}

impl RealTime {
    /// Loops that are started when they are needed.
    pub fn new(settings: RealTimeSettings, metrics: &Metrics) -> Arc<Self> {
        for refused in claim(&settings) {
            tracing::warn!("{refused}");
        }
        Arc::new(Self {
            settings,
            paced: OnceLock::new(),
            free: OnceLock::new(),
            pump: OnceLock::new(),
            next_key: AtomicU64::new(1),
            running: metrics.running.clone(),
            counts: Arc::clone(&metrics.loops),
        })
    }

    /// Room for one more plant that runs by itself.
    pub(crate) fn admit(&self, running_max: u64) -> Result<Permit, LimitExceeded> {
        Permit::take(&self.running, running_max)
    }

    /// A number for a plant that begins to run, and the loop that it is to run in.
    pub(crate) fn assign(&self, pace: Pace) -> std::io::Result<(u64, Handle)> {
        let key = self.next_key.fetch_add(1, Ordering::Relaxed);
        if pace == Pace::Free {
            let free = get_or_start(&self.free, Handle::start_free)?;
            return Ok((key, free.clone()));
        }
        let start = || (0..self.settings.threads).map(|k| Handle::start_paced(k, &self.settings));
        let paced = get_or_start(&self.paced, || start().collect())?;
        Ok((key, paced[(key % paced.len() as u64) as usize].clone()))
    }

    /// Somebody began to watch a plant.
    pub(crate) fn ring_pump(&self) {
        if let Some(pump) = self.pump.get() {
            pump.ring();
        }
    }

    /// What brings states from the loops to those who watch.
    pub(crate) fn pump(&self) -> std::io::Result<&Pump> {
        get_or_start(&self.pump, Pump::start)
    }
}

fn get_or_start<T>(
    cell: &OnceLock<T>,
    start: impl FnOnce() -> std::io::Result<T>,
) -> std::io::Result<&T> {
    if let Some(started) = cell.get() {
        return Ok(started);
    }
    // Two may start at the same time: what comes second ends at once.
    let started = start()?;
    Ok(cell.get_or_init(|| started))
}
