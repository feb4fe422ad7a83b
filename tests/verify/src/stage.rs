//! Stages: how they run and how their results are told.

use std::io::Write as _;
use std::os::unix::process::CommandExt as _;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::Context;

/// One check.
pub(crate) struct Stage {
    /// Name on the command line and in the summary.
    pub(crate) name: &'static str,
    /// Whether `--quick` keeps it.
    pub(crate) quick: bool,
    /// Runs it.
    pub(crate) run: fn(&mut Context) -> Outcome,
}

/// Result of a stage.
pub(crate) type Outcome = Result<(), Failure>;

/// Why a stage did not pass.
pub(crate) enum Failure {
    /// It failed.
    Failed(String),
    /// This machine cannot run it.
    Skipped(String),
}

/// Runs the stages, prints a summary, and tells whether none failed.
pub(crate) fn run_all(stages: &[&Stage], context: &mut Context) -> bool {
    let mut lines = Vec::new();
    let (mut passed, mut failed, mut skipped) = (0, 0, 0);
    for stage in stages {
        println!("\n==== {}", stage.name);
        let start = Instant::now();
        let (word, reason) = match (stage.run)(context) {
            Ok(()) => {
                passed += 1;
                ("passed", String::new())
            }
            Err(Failure::Failed(reason)) => {
                failed += 1;
                ("FAILED", reason)
            }
            Err(Failure::Skipped(reason)) => {
                skipped += 1;
                ("skipped", reason)
            }
        };
        let time = seconds(start.elapsed());
        let line = format!("{:<12}{word:<9}{time:>8}  {reason}", stage.name);
        println!("---- {}", line.trim_end());
        lines.push(line);
    }
    println!("\n==== summary");
    lines.iter().for_each(|line| println!("{}", line.trim_end()));
    let skips = if skipped > 0 { format!(", {skipped} skipped") } else { String::new() };
    println!("{passed} passed, {failed} failed{skips}");
    failed == 0
}

/// Runs a command to its end, its output shown.
pub(crate) fn run(command: &mut Command) -> Outcome {
    let line = describe(command);
    println!("$ {line}");
    let _ = std::io::stdout().flush();
    die_with_parent(command);
    plantd_launch::leave_package(command);
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(Failure::Failed(format!("`{line}`: {status}"))),
        Err(error) => Err(Failure::Failed(format!("`{line}` did not start: {error}"))),
    }
}

/// Has the command end when this process ends, however it ends; Ctrl-C reaches both anyway.
fn die_with_parent(command: &mut Command) {
    let ask = || {
        let signal = Some(rustix::process::Signal::TERM);
        rustix::process::set_parent_process_death_signal(signal).map_err(Into::into)
    };
    // SAFETY: between fork and exec the closure makes one system call and touches no memory.
    unsafe { command.pre_exec(ask) };
}

fn describe(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}

fn seconds(time: Duration) -> String {
    format!("{:.1} s", time.as_secs_f64())
}
