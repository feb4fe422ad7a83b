//! The server's metrics, in the text format of Prometheus (OpenMetrics).
//!
//! | metric | type | labels |
//! | --- | --- | --- |
//! | `plantd_plants` | gauge | |
//! | `plantd_models` | gauge (uploaded ones) | |
//! | `plantd_links` | gauge (open shared-memory links) | |
//! | `plantd_drivers` | gauge | `driver`: `step`, `drive`, `link` |
//! | `plantd_watchers` | gauge | |
//! | `plantd_steps_total` | counter | `driver` |
//! | `plantd_step_failures_total` | counter | `reason` |
//! | `plantd_step_duration_seconds` | histogram of one step in 64 | |
//! | `plantd_watch_dropped_total` | counter | |
//! | `plantd_running_plants` | gauge (plants that run by themselves) | |
//! | `plantd_loop_lateness_seconds` | histogram: how late paced steps began | |
//! | `plantd_loop_step_seconds` | histogram: how long steps of these plants took | |
//! | `plantd_loop_input_age_seconds` | histogram: age of their inputs | |
//! | `plantd_loop_round_trip_seconds` | histogram: from a state to its driver's answer | |
//! | `plantd_loop_steps_total`, `_overruns_total`, `_slips_total` | counters | |
//! | `plantd_loop_late_inputs_total`, `_safe_inputs_total` | counters | |
//! | `plantd_rpcs_total` | counter of finished calls | `method`, `code` |
//! | `plantd_tenant_plants`, `_running_plants`, `_streams` | gauges | `tenant` |
//! | `plantd_tenant_overruns_total` | counter | `tenant` |
//! | `plantd_tenant_rpcs_total` | counter of finished calls | `tenant`, `code` |
//! | `plantd_waiting_jobs` | gauge: computations that wait for a worker, looked at once a second | |
//! | `plantd_state_saved_timestamp_seconds` | gauge: when all plants were saved last; 0 for never | |
//! | `plantd_server_info` | 1 | `name`, `version` |
//! | `plantd_draining` | 1 where nothing new is taken, else 0 | |
//! | `plantd_build_info` | 1 | `version`, `arch`, `profile` |
//! | `process_cpu_seconds_total` | counter | |
//! | `process_resident_memory_bytes`, `process_open_fds`, `process_max_fds`, `process_start_time_seconds` | gauges | |
//!
//! No plant's id is ever a label: the number of time series is bounded.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric as _};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use crate::core::driver::DriverKind;
use crate::core::metrics::counts::TimingCounts;
use crate::core::metrics::process::Process;
use crate::core::metrics::tenants::TenantCounters;
use crate::core::tenant::{Tenant, Tenants};

/// Shortest step that the histogram tells apart, s, and its number of buckets, each twice as wide:
/// up to half a second.
const STEP_BUCKET_MIN_S: f64 = 0.5e-6;
const STEP_BUCKETS: u16 = 20;

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct DriverLabel {
    driver: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ReasonLabel {
    reason: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RpcLabel {
    method: &'static str,
    code: &'static str,
}

/// Steps and drivers of one kind.
struct DriverMetrics {
    steps: Counter,
    drivers: Gauge,
}

/// Everything that the server counts.
pub struct Metrics {
    registry: Registry,
    tenants: Arc<Tenants>,
    plants: Gauge,
    draining: Gauge,
    waiting_jobs: Gauge,
    state_saved: Gauge,
    /// Uploaded models.
    pub(crate) models: Gauge,
    links: Gauge,
    watchers: Gauge,
    // Resolved once, so that a step costs one atomic addition.
    by_driver: [DriverMetrics; 3],
    step_failures: Family<ReasonLabel, Counter>,
    step_duration: Histogram,
    watch_dropped: Counter,
    /// Plants that run by themselves.
    pub(crate) running: Gauge,
    /// What their loops count.
    pub(crate) loops: Arc<TimingCounts>,
    rpcs: Family<RpcLabel, Counter>,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new(Arc::default(), "plantd")
    }
}

impl Metrics {
    /// Nothing counted yet, of the server of that name.
    pub fn new(tenants: Arc<Tenants>, name: &str) -> Self {
        let steps = Family::<DriverLabel, Counter>::default();
        let drivers = Family::<DriverLabel, Gauge>::default();
        let by_driver = [DriverKind::Step, DriverKind::Drive, DriverKind::Link].map(|kind| {
            let label = DriverLabel { driver: kind.as_str() };
            DriverMetrics {
                steps: steps.get_or_create_owned(&label),
                drivers: drivers.get_or_create_owned(&label),
            }
        });
        let metrics = Self {
            plants: Gauge::default(),
            draining: Gauge::default(),
            waiting_jobs: Gauge::default(),
            state_saved: Gauge::default(),
            models: Gauge::default(),
            links: Gauge::default(),
            watchers: Gauge::default(),
            by_driver,
            step_failures: Family::default(),
            step_duration: Histogram::new(exponential_buckets(
                STEP_BUCKET_MIN_S,
                2.0,
                STEP_BUCKETS,
            )),
            watch_dropped: Counter::default(),
            running: Gauge::default(),
            loops: Arc::default(),
            rpcs: Family::default(),
            tenants,
            registry: Registry::default(),
        };
        let mut whole = Registry::default();
        whole.register_collector(Box::new(Process::starts_now()));
        let registry = whole.sub_registry_with_prefix("plantd");
        registry.register("build", "The server's version", build_info());
        let server = [("name", name.to_owned()), ("version", env!("CARGO_PKG_VERSION").to_owned())];
        registry.register("server", "The server's name", Info::new(server));
        registry.register("draining", "1 where nothing new is taken", metrics.draining.clone());
        registry.register(
            "waiting_jobs",
            "Computations that wait for a worker",
            metrics.waiting_jobs.clone(),
        );
        registry.register(
            "state_saved_timestamp_seconds",
            "When all plants were saved last, in seconds since 1970; 0 for never",
            metrics.state_saved.clone(),
        );
        registry.register("plants", "Plants", metrics.plants.clone());
        registry.register("models", "Uploaded models", metrics.models.clone());
        registry.register("links", "Open shared-memory links", metrics.links.clone());
        registry.register("drivers", "Leases held", drivers);
        registry.register("watchers", "Watch streams", metrics.watchers.clone());
        registry.register("steps", "Steps taken", steps);
        registry.register("step_failures", "Steps that failed", metrics.step_failures.clone());
        registry.register_with_unit(
            "step_duration",
            "Time of one step, sampled",
            Unit::Seconds,
            metrics.step_duration.clone(),
        );
        registry.register(
            "watch_dropped",
            "States that slow watchers lost",
            metrics.watch_dropped.clone(),
        );
        registry.register(
            "running_plants",
            "Plants that run by themselves",
            metrics.running.clone(),
        );
        let loops = &metrics.loops;
        for (name, help, histogram) in [
            ("loop_lateness", "How late paced steps began", &loops.lateness),
            ("loop_step", "Time of a step of a plant that runs by itself", &loops.step),
            ("loop_input_age", "Age of the input of such a step", &loops.input_age),
            ("loop_round_trip", "From a state to its driver's answer", &loops.round_trip),
        ] {
            registry.register_with_unit(name, help, Unit::Seconds, histogram.clone());
        }
        registry.register_collector(Box::new(LoopCounters(Arc::clone(loops))));
        registry.register("rpcs", "Calls that ended", metrics.rpcs.clone());
        let tenants = Arc::clone(&metrics.tenants);
        registry.register_collector(Box::new(TenantCounters { tenants, only: None }));
        Self { registry: whole, ..metrics }
    }

    /// All metrics as text.
    pub fn encode(&self) -> Result<String, fmt::Error> {
        let mut text = String::new();
        encode(&mut text, &self.registry)?;
        Ok(text)
    }

    /// What one tenant may know: what is counted of it alone.
    pub fn encode_of(&self, tenant: Tenant) -> Result<String, fmt::Error> {
        let mut registry = Registry::with_prefix("plantd");
        registry.register("build", "The server's version", build_info());
        let tenants = Arc::clone(&self.tenants);
        registry.register_collector(Box::new(TenantCounters { tenants, only: Some(tenant) }));
        let mut text = String::new();
        encode(&mut text, &registry)?;
        Ok(text)
    }

    /// The server takes nothing new.
    pub fn draining(&self) {
        self.draining.set(1);
    }

    /// Sets the number of computations that wait for a worker.
    pub fn set_waiting_jobs(&self, count: usize) {
        self.waiting_jobs.set(gauge_value(count));
    }

    /// All plants have been saved, at this time.
    pub fn state_saved(&self, at: SystemTime) {
        let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
        self.state_saved.set(i64::try_from(since.as_secs()).unwrap_or(i64::MAX));
    }

    /// Sets the number of plants.
    pub fn set_plants(&self, count: usize) {
        self.plants.set(gauge_value(count));
    }

    /// A shared-memory link was opened.
    pub fn link_opened(&self) {
        self.links.inc();
    }

    /// A shared-memory link was closed.
    pub fn link_closed(&self) {
        self.links.dec();
    }

    /// A lease was taken.
    pub fn driver_started(&self, kind: DriverKind) {
        self.of(kind).drivers.inc();
    }

    /// A lease ended.
    pub fn driver_ended(&self, kind: DriverKind) {
        self.of(kind).drivers.dec();
    }

    /// A watch began.
    pub fn watcher_started(&self) {
        self.watchers.inc();
    }

    /// A watch ended.
    pub fn watcher_ended(&self) {
        self.watchers.dec();
    }

    /// A step was taken.
    pub fn stepped(&self, kind: DriverKind) {
        self.of(kind).steps.inc();
    }

    /// A step failed.
    pub fn step_failed(&self, reason: &'static str) {
        self.step_failures.get_or_create(&ReasonLabel { reason }).inc();
    }

    /// A step took this long.
    pub fn step_timed(&self, duration: Duration) {
        self.step_duration.observe(duration.as_secs_f64());
    }

    /// A watcher lost states.
    pub fn watch_dropped(&self, count: u64) {
        if count > 0 {
            self.watch_dropped.inc_by(count);
        }
    }

    /// A call ended, which was a tenant's, or nobody's who is known.
    pub fn rpc_ended(&self, method: &'static str, code: &'static str, tenant: Tenant) {
        self.rpcs.get_or_create(&RpcLabel { method, code }).inc();
        if tenant != Tenant::NONE {
            self.tenants.account(tenant).counts.call_ended(code);
        }
    }

    fn of(&self, kind: DriverKind) -> &DriverMetrics {
        match kind {
            DriverKind::Step => &self.by_driver[0],
            DriverKind::Drive => &self.by_driver[1],
            DriverKind::Link => &self.by_driver[2],
        }
    }
}

/// The counters of the loops, which count by themselves.
#[derive(Debug)]
struct LoopCounters(Arc<TimingCounts>);

impl Collector for LoopCounters {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let counts = &self.0;
        for (name, help, count) in [
            ("loop_steps", "Steps of plants that run by themselves", &counts.steps),
            ("loop_overruns", "Steps that ended after the next was due", &counts.overruns),
            ("loop_slips", "Times that a schedule was given up", &counts.slips),
            ("loop_late_inputs", "Steps without a new input", &counts.late_inputs),
            ("loop_safe_inputs", "Steps without a valid input", &counts.safe_inputs),
        ] {
            let counter = ConstCounter::new(count.load(Ordering::Relaxed));
            let metric = encoder.encode_descriptor(name, help, None, counter.metric_type())?;
            counter.encode(metric)?;
        }
        Ok(())
    }
}

fn build_info() -> Info<[(&'static str, &'static str); 3]> {
    Info::new([
        ("version", env!("CARGO_PKG_VERSION")),
        ("arch", std::env::consts::ARCH),
        ("profile", if cfg!(debug_assertions) { "debug" } else { "release" }),
    ])
}

fn gauge_value(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}
