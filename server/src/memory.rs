//! Memory that is free goes back to the system.
//!
//! The C library keeps what is freed for the thread pool that took it. Requests come and go on many
//! threads: after large models or many streams hundreds of megabytes stay with the process, more each
//! time. So now and then it is asked to give back what is not in use. Plants in their own loops do not
//! notice: they take no memory.

use std::time::Duration;

use crate::core::metrics::process;

/// How often the process looks at its size.
const PERIOD: Duration = Duration::from_secs(2);
/// The longest pause after there was nothing to give back.
const PERIOD_MAX: Duration = Duration::from_secs(32);
/// A process that has grown by less than this since it started keeps what it has.
const KEPT_BYTES: u64 = 32 << 20;
/// Less than this is not worth the trouble.
const WORTH_BYTES: u64 = 1 << 20;

/// Gives memory back, over and over; never returns.
pub(crate) async fn give_back() {
    let start = resident_bytes();
    let mut pause = PERIOD;
    loop {
        tokio::time::sleep(pause).await;
        let before = resident_bytes();
        if before <= start + KEPT_BYTES {
            pause = PERIOD;
            continue;
        }
        // Takes milliseconds, and longer where there is much.
        let _ = tokio::task::spawn_blocking(trim).await;
        let given_back = before.saturating_sub(resident_bytes());
        pause = if given_back >= WORTH_BYTES { PERIOD } else { PERIOD_MAX.min(2 * pause) };
    }
}

/// Memory of the process that is in use or kept; 0 where that cannot be told.
fn resident_bytes() -> u64 {
    process::resident_bytes().unwrap_or(0)
}

#[cfg(target_env = "gnu")]
fn trim() {
    // SAFETY: it may be called at any time from any thread.
    unsafe { libc::malloc_trim(0) };
}

/// Other C libraries give back by themselves.
#[cfg(not(target_env = "gnu"))]
fn trim() {}
