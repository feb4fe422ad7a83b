//! Scheduling priority of threads.

use serde::{Deserialize, Serialize};

/// How much of a processor the threads of a pool get while others want it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Priority {
    /// As every other thread.
    Normal,
    /// Little: nice 19.
    #[default]
    Nice,
    /// What others leave, and a trickle besides: SCHED_IDLE. For processors that controllers poll on
    /// all the time; on a machine that is busy with other things nothing gets done.
    Idle,
}

impl Priority {
    /// Gives the calling thread this priority, which the threads that it starts inherit. Where the
    /// system refuses, the thread stays as it is, and the log says so.
    pub fn apply(self, pool: &str) {
        let outcome = match self {
            Self::Normal => Ok(()),
            Self::Nice => rustix::process::setpriority_process(None, 19).map_err(Into::into),
            Self::Idle => schedule_when_idle(),
        };
        if let Err(error) = outcome {
            tracing::warn!(pool, priority = ?self, %error, "workers keep the usual priority");
        }
    }
}

/// Scheduling of the threads that run paced plants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scheduling {
    /// As every other thread.
    #[default]
    Normal,
    /// SCHED_FIFO at this priority, 1 to 99: before all threads of the usual kind. Needs the right to it
    /// (CAP_SYS_NICE, or `LimitRTPRIO` of a service).
    Fifo(u8),
}

impl Scheduling {
    /// Schedules the calling thread so. Where the system refuses, the thread stays as it is, and the log
    /// says so.
    pub fn apply(self) {
        let Self::Fifo(priority) = self else { return };
        if let Err(error) = schedule(priority) {
            tracing::warn!(priority, %error, "paced plants run without SCHED_FIFO: steps may be late");
        }
    }
}

/// Lets the calling thread run on these processors alone; on all when there are none.
pub fn allow_cpus(cpus: &[usize]) {
    if cpus.is_empty() {
        return;
    }
    let mut set = rustix::thread::CpuSet::new();
    cpus.iter().filter(|cpu| **cpu < rustix::thread::CpuSet::MAX_CPU).for_each(|cpu| set.set(*cpu));
    if let Err(error) = rustix::thread::sched_setaffinity(None, &set) {
        tracing::warn!(?cpus, %error, "paced plants run on any processor");
    }
}

/// Whether the calling thread may run on a processor.
pub fn usable_cpus() -> std::io::Result<impl Fn(usize) -> bool> {
    let set = rustix::thread::sched_getaffinity(None)?;
    Ok(move |cpu| cpu < rustix::thread::CpuSet::MAX_CPU && set.is_set(cpu))
}

/// Lets sleeps of the calling thread end as soon as the system can, not up to 50 µs later.
pub fn sharpen_timers() {
    let slack_ns = std::num::NonZeroU64::MIN;
    if let Err(error) = rustix::thread::set_current_timer_slack(Some(slack_ns)) {
        tracing::warn!(%error, "sleeps of paced plants may end 50 µs late");
    }
}

/// Keeps all memory of the process, present and future, from being paged out.
pub fn lock_memory() -> std::io::Result<()> {
    use rustix::mm::{MlockAllFlags, mlockall};
    Ok(mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)?)
}

/// Schedules the calling thread by SCHED_FIFO.
#[cfg(target_os = "linux")]
pub(crate) fn schedule(priority: u8) -> std::io::Result<()> {
    let parameters = libc::sched_param { sched_priority: priority.into() };
    // SAFETY: the call reads `parameters`, which lives until it returns; 0 is the calling thread.
    match unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn schedule(_: u8) -> std::io::Result<()> {
    Err(std::io::ErrorKind::Unsupported.into())
}

#[cfg(target_os = "linux")]
fn schedule_when_idle() -> std::io::Result<()> {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: the call reads `parameters`, which lives until it returns; 0 is the calling thread.
    match unsafe { libc::sched_setscheduler(0, libc::SCHED_IDLE, &raw const parameters) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

#[cfg(not(target_os = "linux"))]
fn schedule_when_idle() -> std::io::Result<()> {
    rustix::process::setpriority_process(None, 19).map_err(Into::into)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    /// Policy and nice value of a thread, from what the system tells of it.
    fn policy_and_nice(thread: &str) -> (u32, i64) {
        let text = std::fs::read_to_string(format!("/proc/{thread}/stat")).unwrap();
        // After the name in parentheses, which may hold blanks, comes field 3.
        let fields: Vec<&str> = text.rsplit_once(')').unwrap().1.split_whitespace().collect();
        (fields[41 - 3].parse().unwrap(), fields[19 - 3].parse().unwrap())
    }

    fn in_a_thread<R: Send + 'static>(work: impl FnOnce() -> R + Send + 'static) -> R {
        std::thread::spawn(work).join().unwrap()
    }

    #[test]
    fn a_thread_and_its_children_have_the_priority() {
        const SCHED_OTHER: u32 = 0;
        const SCHED_IDLE: u32 = 5;
        let usual = policy_and_nice("thread-self");
        assert_eq!(usual.0, SCHED_OTHER);
        for (priority, expected) in [
            (Priority::Normal, usual),
            (Priority::Nice, (SCHED_OTHER, 19)),
            (Priority::Idle, (SCHED_IDLE, usual.1)),
        ] {
            let (own, childs) = in_a_thread(move || {
                priority.apply("test");
                let own = policy_and_nice("thread-self");
                (own, in_a_thread(|| policy_and_nice("thread-self")))
            });
            assert_eq!((own, childs), (expected, expected), "{priority:?}");
        }
        assert_eq!(policy_and_nice("thread-self"), usual, "nobody else has changed");
    }
}
