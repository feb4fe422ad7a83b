//! What loops ask of the system, asked for when the server starts: a priority that is refused is to be known
//! before the first plant is late.

use std::io;

use rustix::process::{Resource, getrlimit};

use crate::core::priority::{Scheduling, lock_memory, schedule, usable_cpus};
use crate::core::realtime::settings::RealTimeSettings;

/// Locks the memory if that is asked for, and tries everything else in a thread that ends at once. Returns a
/// sentence for each key that is not granted.
pub(super) fn claim(settings: &RealTimeSettings) -> Vec<String> {
    let mut refused = Vec::new();
    if let Scheduling::Fifo(priority) = settings.scheduling
        && let Err(error) = std::thread::spawn(move || schedule(priority)).join().unwrap_or(Ok(()))
    {
        refused.push(no_priority(priority, &error));
    }
    let missing = missing_cpus(&settings.cpus);
    if !missing.is_empty() {
        refused.push(format!(
            "`realtime.cpus` names the processors {missing:?}, on which this process may not run: paced plants \
             run on the others, or on all if there are none; see CPUAffinity of the unit, and `taskset`"
        ));
    }
    if settings.lock_memory
        && let Err(error) = lock_memory()
    {
        refused.push(no_memory(&error));
    }
    refused
}

fn no_priority(priority: u8, error: &io::Error) -> String {
    format!(
        "`realtime.scheduling` asks for SCHED_FIFO at {priority}, which is not granted ({error}): paced plants \
         run without it, and steps may be late. RLIMIT_RTPRIO of this process is {}; raise it to {priority} \
         (LimitRTPRIO= of the unit, `rtprio` in limits.conf, --ulimit rtprio= of a container), give the \
         process CAP_SYS_NICE, or ask for less",
        limit(Resource::Rtprio)
    )
}

fn no_memory(error: &io::Error) -> String {
    format!(
        "`realtime.lock_memory` is not granted ({error}): the server's memory may be paged out. RLIMIT_MEMLOCK \
         of this process is {} bytes; lift it (LimitMEMLOCK=infinity of the unit, `memlock` in limits.conf, \
         --ulimit memlock=-1 of a container), or give the process CAP_IPC_LOCK",
        limit(Resource::Memlock)
    )
}

fn limit(resource: Resource) -> String {
    getrlimit(resource).current.map_or_else(|| "unlimited".to_owned(), |limit| limit.to_string())
}

/// Those among the processors on which the process may not run.
fn missing_cpus(cpus: &[usize]) -> Vec<usize> {
    match usable_cpus() {
        Ok(usable) => cpus.iter().copied().filter(|cpu| !usable(*cpu)).collect(),
        Err(_) => Vec::new(),
    }
}
