//! What the system knows of the server's process, under the names that all programs give it.

use std::fmt;
use std::time::{SystemTime, UNIX_EPOCH};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use rustix::process::{Resource, getrlimit};
use rustix::time::{ClockId, clock_gettime};

/// The process, asked anew at each scrape.
#[derive(Debug)]
pub(super) struct Process {
    start_s: f64,
}

impl Process {
    /// A process whose server starts now.
    pub(super) fn starts_now() -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { start_s: since.as_secs_f64() }
    }
}

fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Bytes of memory that are in use or kept; none where `/proc` is closed.
pub fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let size = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.strip_suffix("kB"));
    let kib: u64 = size?.trim().parse().ok()?;
    Some(kib << 10)
}

/// Files, sockets and the like that are open; the folder itself is one of them while it is read.
fn open_files() -> Option<f64> {
    let count = std::fs::read_dir("/proc/self/fd").ok()?.count();
    Some(count.saturating_sub(1) as f64)
}

impl Collector for Process {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let mut write = |name: &str, help: &str, metric: &dyn EncodeMetric| {
            let kind = metric.metric_type();
            metric.encode(encoder.encode_descriptor(name, help, None, kind)?)
        };
        let cpu = ConstCounter::new(cpu_s());
        write("process_cpu_seconds", "Processor time of all threads", &cpu)?;
        let start = ConstGauge::new(self.start_s);
        write("process_start_time_seconds", "When the server started, Unix time", &start)?;
        if let Some(bytes) = resident_bytes() {
            let bytes = ConstGauge::new(bytes as f64);
            write("process_resident_memory_bytes", "Memory in use", &bytes)?;
        }
        if let Some(count) = open_files() {
            write("process_open_fds", "Open files and sockets", &ConstGauge::new(count))?;
        }
        if let Some(limit) = getrlimit(Resource::Nofile).current {
            let limit = ConstGauge::new(limit as f64);
            write("process_max_fds", "Files and sockets that may be open", &limit)?;
        }
        Ok(())
    }
}
