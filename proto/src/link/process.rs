//! Clock, random numbers and the identity of processes.

use std::fs;

use rustix::rand::{GetRandomFlags, getrandom};
use rustix::time::{ClockId, clock_gettime};

/// The system's monotonic clock, ns: the same for all processes of a machine.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// A random number other than zero, for `server` and `driver` of a header.
pub fn random_instance() -> u64 {
    let mut bytes = [0; 8];
    // The kernel's generator cannot fail for eight bytes once it is seeded; the clock and the process
    // id keep two instances apart should it not be.
    if getrandom(&mut bytes[..], GetRandomFlags::empty()) != Ok(bytes.len()) {
        bytes = (monotonic_ns() ^ u64::from(std::process::id()) << 40).to_le_bytes();
    }
    u64::from_le_bytes(bytes).max(1)
}

/// A process, named for good: process ids are used again, with another start time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProcessIdentity {
    /// Process id.
    pub pid: u32,
    /// Start time, clock ticks since boot.
    pub start: u64,
}

impl ProcessIdentity {
    /// This process.
    pub fn own() -> Self {
        let pid = std::process::id();
        Self { pid, start: start_time(pid).unwrap_or(0) }
    }

    /// Whether the process can be seen from here and is alive. A process in another pid namespace
    /// is not seen; a zombie is not alive.
    pub fn is_running(&self) -> bool {
        self.start != 0 && start_time(self.pid) == Some(self.start)
    }
}

/// Start time of a process that is no zombie: field 22 of `/proc/<pid>/stat`.
fn start_time(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // Field 2, the name in parentheses, may itself hold blanks and parentheses.
    let mut fields = stat.rsplit_once(')')?.1.split_ascii_whitespace();
    let state = fields.next()?;
    if matches!(state, "Z" | "X" | "x") {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_running_until_it_is_killed() {
        let mut child = std::process::Command::new("sleep").arg("60").spawn().unwrap();
        let identity = ProcessIdentity { pid: child.id(), start: start_time(child.id()).unwrap() };
        assert!(identity.is_running());
        assert!(!ProcessIdentity { start: identity.start + 1, ..identity }.is_running());
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!identity.is_running());
        assert!(ProcessIdentity::own().is_running());
    }

    #[test]
    fn the_clock_does_not_go_back() {
        let first = monotonic_ns();
        assert!(monotonic_ns() >= first);
    }

    #[test]
    fn instances_differ() {
        assert_ne!(random_instance(), random_instance());
    }
}
