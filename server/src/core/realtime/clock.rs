//! Clocks.

use plantd_proto::link::monotonic_ns;

/// The instant of a time on the monotonic clock, UTC, ns since 1970.
pub fn utc_ns(monotonic: u64) -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Realtime);
    let utc = now.tv_sec * 1_000_000_000 + now.tv_nsec;
    utc - (monotonic_ns() as i64 - monotonic as i64)
}
