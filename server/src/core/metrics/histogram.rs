//! Histograms of times that a control loop can write.
//!
//! Buckets are as wide as an eighth of their power of two, so that a quantile is known to 12 % or better
//! from 1 ns to hours. Recording is two atomic additions and an atomic maximum: no lock, no allocation.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use prometheus_client::encoding::{EncodeMetric, MetricEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;

/// Buckets of each power of two: 2 to this.
const FINE_BITS: u32 = 3;
const FINE: u64 = 1 << FINE_BITS;
/// Times of 2^44 ns (5 hours) and more share the last bucket.
const POWERS: u32 = 44;
const BUCKETS: usize = ((POWERS - FINE_BITS + 1) as usize) * FINE as usize;

/// Powers of two of which a scrape shows the upper bounds: 1 µs to 4.3 s.
const EXPORTED: std::ops::RangeInclusive<u32> = 10..=32;

/// A histogram of times, ns. Clones are the same histogram.
#[derive(Clone, Default)]
pub struct Histogram {
    counts: Arc<Counts>,
}

struct Counts {
    buckets: Box<[AtomicU64]>,
    sum_ns: AtomicU64,
    max_ns: AtomicU64,
}

/// What a histogram says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Number of times.
    pub count: u64,
    /// Their mean, ns.
    pub mean_ns: u64,
    /// Median, ns; quantiles are upper bounds of their buckets.
    pub p50_ns: u64,
    /// 99th percentile, ns.
    pub p99_ns: u64,
    /// 99.9th percentile, ns.
    pub p999_ns: u64,
    /// Largest, ns.
    pub max_ns: u64,
}

impl Default for Counts {
    fn default() -> Self {
        Self {
            buckets: (0..BUCKETS).map(|_| AtomicU64::new(0)).collect(),
            sum_ns: AtomicU64::new(0),
            max_ns: AtomicU64::new(0),
        }
    }
}

/// Index of the bucket of a time: `[0, 8)` one by one, then eight for each power of two.
fn bucket(time_ns: u64) -> usize {
    if time_ns < FINE {
        return time_ns as usize;
    }
    let power = time_ns.ilog2();
    let fine = (time_ns >> (power - FINE_BITS)) - FINE;
    let index = u64::from(power - FINE_BITS + 1) * FINE + fine;
    (index as usize).min(BUCKETS - 1)
}

/// First time beyond a bucket.
fn end_of(bucket: usize) -> u64 {
    let (octave, fine) = (bucket as u64 / FINE, bucket as u64 % FINE);
    if octave == 0 { fine + 1 } else { (FINE + fine + 1) << (octave - 1) }
}

impl Histogram {
    /// Counts a time.
    pub fn record(&self, time_ns: u64) {
        let counts = &*self.counts;
        counts.buckets[bucket(time_ns)].fetch_add(1, Ordering::Relaxed);
        counts.sum_ns.fetch_add(time_ns, Ordering::Relaxed);
        counts.max_ns.fetch_max(time_ns, Ordering::Relaxed);
    }

    /// Forgets everything. What is recorded meanwhile may be half forgotten.
    pub fn clear(&self) {
        let counts = &*self.counts;
        counts.buckets.iter().for_each(|bucket| bucket.store(0, Ordering::Relaxed));
        counts.sum_ns.store(0, Ordering::Relaxed);
        counts.max_ns.store(0, Ordering::Relaxed);
    }

    /// What it says.
    pub fn summary(&self) -> Summary {
        let counts = self.read();
        let count: u64 = counts.iter().sum();
        if count == 0 {
            return Summary::default();
        }
        let max_ns = self.counts.max_ns.load(Ordering::Relaxed);
        let quantile = |per_mille: u64| {
            // Rank from 1, rounded up: the smallest time that so many of a thousand do not exceed.
            let rank = (count * per_mille).div_ceil(1000).max(1);
            let mut seen = 0;
            let found = counts.iter().position(|bucket| {
                seen += bucket;
                seen >= rank
            });
            found.map_or(max_ns, |bucket| (end_of(bucket) - 1).min(max_ns))
        };
        Summary {
            count,
            mean_ns: self.counts.sum_ns.load(Ordering::Relaxed) / count,
            p50_ns: quantile(500),
            p99_ns: quantile(990),
            p999_ns: quantile(999),
            max_ns,
        }
    }

    fn read(&self) -> Vec<u64> {
        self.counts.buckets.iter().map(|bucket| bucket.load(Ordering::Relaxed)).collect()
    }
}

impl fmt::Debug for Histogram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.summary().fmt(f)
    }
}

/// In seconds, with an upper bound for each power of two nanoseconds.
impl EncodeMetric for Histogram {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        let counts = self.read();
        let mut next = 0;
        let mut below = |bucket: usize| {
            let sum = counts[next..bucket].iter().sum();
            next = bucket;
            sum
        };
        let mut buckets: Vec<(f64, u64)> = EXPORTED
            .map(|power| ((1_u64 << power) as f64 * 1e-9, below(bucket(1 << power))))
            .collect();
        buckets.push((f64::INFINITY, below(BUCKETS)));
        let sum = self.counts.sum_ns.load(Ordering::Relaxed) as f64 * 1e-9;
        encoder.encode_histogram::<NoLabelSet>(sum, counts.iter().sum(), &buckets, None)
    }

    fn metric_type(&self) -> MetricType {
        MetricType::Histogram
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_time_lies_in_its_bucket_and_buckets_are_narrow() {
        let mut times: Vec<u64> =
            (0..POWERS).flat_map(|k| [1 << k, (1 << k) + 1, 3 << k]).collect();
        times.extend(0..1000);
        for time_ns in times.into_iter().filter(|time| *time < 1 << POWERS) {
            let index = bucket(time_ns);
            let begin = if index == 0 { 0 } else { end_of(index - 1) };
            assert!(begin <= time_ns && time_ns < end_of(index), "{time_ns}");
            assert!((end_of(index) - begin) * 8 <= begin.max(8), "{time_ns}");
        }
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
    }

    #[test]
    fn quantiles_of_a_known_distribution() {
        let histogram = Histogram::default();
        assert_eq!(histogram.summary(), Summary::default());
        (1..=100_000).for_each(|time_ns| histogram.record(time_ns));
        let summary = histogram.summary();
        assert_eq!((summary.count, summary.mean_ns, summary.max_ns), (100_000, 50_000, 100_000));
        for (found, exact) in
            [(summary.p50_ns, 50_000.0), (summary.p99_ns, 99_000.0), (summary.p999_ns, 99_900.0)]
        {
            let ratio = found as f64 / exact;
            assert!((1.0..=1.125).contains(&ratio), "{found} for {exact}");
        }
        histogram.clear();
        assert_eq!(histogram.summary(), Summary::default());
    }

    #[test]
    fn a_scrape_counts_every_time_once() {
        let histogram = Histogram::default();
        [0, 500, 1_500, 3_000_000, u64::MAX / 4]
            .iter()
            .for_each(|time_ns| histogram.record(*time_ns));
        let mut registry = prometheus_client::registry::Registry::default();
        registry.register("time", "Time", histogram);
        let mut text = String::new();
        prometheus_client::encoding::text::encode(&mut text, &registry).unwrap();
        assert!(text.contains("time_count 5"), "{text}");
        assert!(text.contains("le=\"+Inf\"} 5"), "{text}");
        assert!(text.contains("le=\"0.000001024\"} 2"), "{text}");
    }
}
