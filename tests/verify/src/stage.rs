//! Stages: how they run and how their results are told.

use std::cell::RefCell;
use std::fs::File;
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
    /// Beside which others it runs.
    pub(crate) lane: Lane,
    /// Runs it.
    pub(crate) run: fn(&mut Context) -> Outcome,
}

/// Beside which others a stage runs.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lane {
    /// One after the other, beside those aside.
    Main,
    /// One after the other, beside the main ones; what waits most of the time, or takes one processor.
    Aside,
    /// Alone: all before have ended, none after has begun.
    Alone,
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

/// What became of a stage.
struct Report {
    stage: &'static str,
    outcome: Outcome,
    time: Duration,
}

impl Report {
    fn line(&self) -> String {
        let (word, reason) = match &self.outcome {
            Ok(()) => ("passed", ""),
            Err(Failure::Failed(reason)) => ("FAILED", reason.as_str()),
            Err(Failure::Skipped(reason)) => ("skipped", reason.as_str()),
        };
        let time = format!("{:.1} s", self.time.as_secs_f64());
        format!("{:<12}{word:<9}{time:>8}  {reason}", self.stage).trim_end().to_owned()
    }
}

/// Runs the stages, prints a summary, and tells whether none failed.
pub(crate) fn run_all(stages: &[&'static Stage], context: &mut Context) -> bool {
    let mut reports = Vec::new();
    let mut rest = stages;
    while let Some(first) = rest.first() {
        let are_together = |stage: &&&Stage| stage.lane != Lane::Alone;
        let count = match first.lane {
            Lane::Alone => 1,
            Lane::Main | Lane::Aside => rest.iter().take_while(are_together).count(),
        };
        let (group, others) = rest.split_at(count);
        run_group(group, context, &mut reports);
        rest = others;
    }
    println!("\n==== summary");
    reports.iter().for_each(|report| println!("{}", report.line()));
    let count = |is_it: fn(&Outcome) -> bool| reports.iter().filter(|r| is_it(&r.outcome)).count();
    let failed = count(|outcome| matches!(outcome, Err(Failure::Failed(_))));
    let skipped = count(|outcome| matches!(outcome, Err(Failure::Skipped(_))));
    let skips = if skipped > 0 { format!(", {skipped} skipped") } else { String::new() };
    println!("{} passed, {failed} failed{skips}", reports.len() - failed - skipped);
    failed == 0
}

/// Runs stages in two lanes; what those aside print comes when they have ended.
fn run_group(group: &[&'static Stage], context: &mut Context, reports: &mut Vec<Report>) {
    let (aside, main): (Vec<&Stage>, Vec<&Stage>) =
        group.iter().partition(|stage| stage.lane == Lane::Aside);
    let scratch = context.scratch().join("aside.log");
    let log = std::fs::create_dir_all(context.scratch()).and_then(|()| File::create(&scratch));
    let (false, false, Ok(log)) = (aside.is_empty(), main.is_empty(), log) else {
        reports.extend(group.iter().map(|stage| run_one(stage, context)));
        return;
    };
    let mut copy = context.clone();
    let of_aside = std::thread::scope(|scope| {
        let beside = scope.spawn(move || {
            LOG.set(Some(log));
            aside.iter().map(|stage| run_one(stage, &mut copy)).collect::<Vec<_>>()
        });
        reports.extend(main.iter().map(|stage| run_one(stage, context)));
        beside.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    reports.extend(of_aside);
    print!("{}", std::fs::read_to_string(&scratch).unwrap_or_default());
}

fn run_one(stage: &'static Stage, context: &mut Context) -> Report {
    say(&format!("\n==== {}", stage.name));
    let start = Instant::now();
    let outcome = (stage.run)(context);
    let report = Report { stage: stage.name, outcome, time: start.elapsed() };
    say(&format!("---- {}", report.line()));
    report
}

thread_local! {
    /// Where this thread's stages print, if not to the terminal.
    static LOG: RefCell<Option<File>> = const { RefCell::new(None) };
}

/// Prints a line of a stage.
pub(crate) fn say(line: &str) {
    LOG.with_borrow_mut(|log| match log {
        Some(log) => drop(writeln!(log, "{line}")),
        None => println!("{line}"),
    });
}

/// Runs a command to its end, its output shown.
pub(crate) fn run(command: &mut Command) -> Outcome {
    let line = describe(command);
    say(&format!("$ {line}"));
    let _ = std::io::stdout().flush();
    let log = LOG.with_borrow(|log| log.as_ref().map(|log| (log.try_clone(), log.try_clone())));
    if let Some((Ok(output), Ok(errors))) = log {
        command.stdout(output).stderr(errors);
    }
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
