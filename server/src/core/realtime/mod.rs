//! Plants that run by themselves: by the wall clock, or as fast as possible.
//!
//! ```text
//!  driver ── slot (latest input wins) ──►  loop: due? ─► input ─► step ─► ring ── pump ──► watchers,
//!                                          │   one thread, many plants     │               driver
//!                        commands ── alarm ┘   (between two steps)         └── recorder
//! ```
//!
//! A loop owns the cores of its plants. It makes no system call but for the clock and its own sleep,
//! takes no lock and allocates nothing: inputs come through a triple buffer, states leave through a ring,
//! and what others want done with a core is done between two steps. `REALTIME.md` says what that is
//! worth on a given machine.

pub mod alarm;
pub mod counts;
pub mod event;
pub mod histogram;
pub mod input;
mod permissions;
mod pump;
mod scheduler;
pub mod slot;
pub mod watchdog;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use plantd_models::Dimensions;
use plantd_proto::link::monotonic_ns;
use prometheus_client::metrics::gauge::Gauge;
use serde::{Deserialize, Serialize};

pub use self::counts::TimingCounts;
use self::input::InputPolicy;
use self::pump::Pump;
pub(crate) use self::scheduler::{Handle, Runner, Stop};
use self::slot::InputSlot;
use crate::core::limits::LimitExceeded;
use crate::core::metrics::Metrics;
use crate::core::priority::Scheduling;

/// A plant that is late by up to this long takes its steps one after the other until it has caught up;
/// beyond it goes on from where it is, and the schedule has slipped.
pub(crate) const CATCH_UP_NS: u64 = 100_000_000;

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// Its driver.
    #[default]
    Lockstep,
    /// The wall clock.
    Paced,
    /// Nobody.
    Free,
}

/// How a plant is run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunSettings {
    /// Who decides when it takes a step.
    pub pace: Pace,
    /// Seconds of the plant's clock in one of the wall clock; 0 in lockstep means as fast as inputs come.
    pub speed: f64,
    /// What to do without a valid input.
    pub input: InputPolicy,
}

/// How the loops of a server run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RealTimeSettings {
    /// Threads for paced plants, which share them out among themselves, 1 to 64.
    pub threads: usize,
    /// Scheduling of these threads.
    pub scheduling: Scheduling,
    /// Processors on which they may run; empty means all.
    pub cpus: Vec<usize>,
    /// Keep the server's memory from being paged out.
    pub lock_memory: bool,
    /// Time before a deadline from which a thread polls the clock instead of sleeping, µs; 0 means that
    /// it never polls. Takes a processor for that part of the time.
    pub spin_us: u64,
}

impl Default for RealTimeSettings {
    fn default() -> Self {
        Self {
            threads: 1,
            scheduling: Scheduling::default(),
            cpus: Vec::new(),
            lock_memory: false,
            spin_us: 0,
        }
    }
}

/// What a plant that runs by itself shares with its driver, its watchers and the curious.
#[derive(Debug)]
pub struct Live {
    /// Where the driver's inputs arrive.
    pub slot: InputSlot,
    /// What the loop has counted.
    pub counts: TimingCounts,
    /// When the next step is due, ns; 0 when none is.
    pub due_ns: AtomicU64,
    /// Steps after which it pauses; 0 means never.
    pub steps_left: AtomicU64,
}

impl Live {
    /// For a plant of these sizes.
    pub fn new(d: Dimensions) -> Self {
        Self {
            slot: InputSlot::new(d.input()),
            counts: TimingCounts::default(),
            due_ns: AtomicU64::new(0),
            steps_left: AtomicU64::new(0),
        }
    }

    /// When to look for the step that is due: so long after it is, or, if that was before, so long after
    /// now; all in ns.
    pub(crate) fn look_ns(&self, now_ns: u64, after_ns: u64, again_ns: u64) -> u64 {
        let look_ns = self.due_ns.load(Ordering::Relaxed) + after_ns;
        if look_ns > now_ns { look_ns } else { now_ns + again_ns }
    }
}

/// Room for a plant that runs by itself, until it is dropped.
pub(crate) struct Permit(Gauge);

impl Drop for Permit {
    fn drop(&mut self) {
        self.0.dec();
    }
}

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
        for refused in permissions::claim(&settings) {
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
        let running = self.running.inc() + 1;
        let permit = Permit(self.running.clone());
        let (name, what) = ("running_plants", "plants that run by themselves");
        LimitExceeded::check(name, running_max, what, running.max(0) as usize)?;
        Ok(permit)
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

/// The instant of a time on the monotonic clock, UTC, ns since 1970.
pub fn utc_ns(monotonic: u64) -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Realtime);
    let utc = now.tv_sec * 1_000_000_000 + now.tv_nsec;
    utc - (monotonic_ns() as i64 - monotonic as i64)
}
