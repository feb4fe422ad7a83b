//! `plantctl test`: scenarios, run and judged.

mod controller;
mod draw;
mod expect;
mod expression;
mod html;
mod junit;
mod prepare;
mod run;
mod samples;
mod scenario;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context as _, Result, ensure};
use clap::Args as Group;
use futures::{StreamExt as _, stream};
use plantd_client::Client;
use serde_json::json;
use tokio::signal::unix::{SignalKind, signal};

use self::expect::short;
use self::prepare::Prepared;
use self::run::{Outcome, Place, Status, lock, summary};
use self::scenario::{Case, Controller, Pace, Scenario};
use crate::output::failure::FAILED;
use crate::output::printer::Output;
use crate::server::own::OwnServer;

/// Something could not be run or judged.
const NOT_RUN: u8 = 2;

const EXAMPLE: &str = "\
A scenario, `hold.toml`; client/TESTING.md explains every key:

  duration_s = 5.0
  seed = 1

  [plant]
  model = \"pendulum\"
  initial = { at = \"upright\" }

  [reference]
  at = \"upright\"

  [controller.lqr]
  q = [100.0, 1.0]
  r = [1.0]

  [random]
  cases = 20
  q = { theta = { uniform = [2.8, 3.4] } }

  [[events]]
  at_s = 2.5
  for_s = 0.1
  inputs = { tau = 5.0 }

  [[expect]]
  settles = { signal = \"error(theta)\", to = 0, within = 0.01, by_s = 4.5 }
  [[expect]]
  never_exceeds = { signal = \"|u(tau)|\", limit = 20 }

Examples:
  plantctl test hold.toml                          one line per case
  plantctl test scenarios --junit junit.xml --html report.html
  plantctl test hold.toml --case random-7          one case again
  plantctl test hold.toml --seed 2                 other random numbers

Exit codes:
  0  every expectation came true
  1  one did not
  2  a case could not be run or judged, or wrong usage";

/// Runs scenarios and judges them, for tests of controllers.
#[derive(Debug, Group)]
#[command(after_help = EXAMPLE)]
pub(crate) struct Options {
    /// Scenario files, and folders of them.
    #[arg(required_unless_present = "schema")]
    suites: Vec<PathBuf>,
    /// Only the cases of this name.
    #[arg(long, value_name = "NAME")]
    case: Vec<String>,
    /// Seed in place of the scenarios' own.
    #[arg(long)]
    seed: Option<u64>,
    /// Cases at a time; as many as there are processors if not given. Paced ones run one at a time.
    #[arg(long, short, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    /// The server to start; the `plantd` beside this program or in PATH if not given.
    #[arg(long, value_name = "PROGRAM")]
    server: Option<PathBuf>,
    /// Write results as JUnit XML.
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Write a report with plots, one page that needs nothing else.
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Only list the cases.
    #[arg(long)]
    list: bool,
    /// Only print the JSON Schema of scenarios.
    #[arg(long, conflicts_with = "suites")]
    schema: bool,
}

/// A scenario with what came of its cases.
struct Tested {
    prepared: Prepared,
    outcomes: Vec<Outcome>,
}

/// A file that could not be run at all.
struct Unusable {
    file: PathBuf,
    error: String,
}

/// What a run of suites came to.
struct Report {
    tested: Vec<Tested>,
    unusable: Vec<Unusable>,
}

/// Where the words of a command that replays a case come from.
struct Replay<'a> {
    address: Option<&'a str>,
    server: Option<&'a Path>,
}

impl Replay<'_> {
    fn command(&self, prepared: &Prepared, outcome: &Outcome) -> String {
        let mut command = "plantctl".to_owned();
        let mut flag = |name: &str, value: &str| {
            let _ = write!(command, " {name} {}", quoted(value));
        };
        if let Some(address) = self.address {
            flag("--address", address);
        }
        flag("test", &prepared.file.to_string_lossy());
        if let Some(server) = self.server {
            flag("--server", &server.to_string_lossy());
        }
        flag("--seed", &outcome.seed.to_string());
        if !outcome.case.is_empty() {
            flag("--case", &outcome.case);
        }
        command
    }
}

/// A word as a shell reads it.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,@%+".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Runs suites.
pub(crate) async fn run(
    address: Option<String>,
    output: Output,
    options: Options,
) -> Result<ExitCode> {
    let outcome = run_suites(address, output, options).await;
    outcome.or_else(|error| {
        // Whatever keeps a suite from being run is none of its expectations.
        eprintln!("plantctl: {error:#}");
        Ok(ExitCode::from(NOT_RUN))
    })
}

async fn run_suites(address: Option<String>, output: Output, options: Options) -> Result<ExitCode> {
    if options.schema {
        println!("{}", serde_json::to_string_pretty(&Scenario::schema())?);
        return Ok(ExitCode::SUCCESS);
    }
    let mut unusable = Vec::new();
    let mut scenarios = Vec::new();
    for file in files(&options.suites)? {
        match Scenario::read(&file) {
            Ok(mut scenario) => {
                scenario.seed = options.seed.unwrap_or(scenario.seed);
                scenarios.push((file, scenario));
            }
            Err(error) => unusable.push(Unusable { file, error: format!("{error:#}") }),
        }
    }
    let chosen = |scenario: &Scenario| {
        let mut cases = scenario.cases();
        cases.retain(|case| options.case.is_empty() || options.case.contains(&case.name));
        cases
    };
    let count: usize = scenarios.iter().map(|(_, scenario)| chosen(scenario).len()).sum();
    ensure!(count > 0 || !unusable.is_empty(), "no case has such a name");
    if options.list {
        for (file, scenario) in &scenarios {
            for case in chosen(scenario) {
                let name = title(&file.to_string_lossy(), &case.name);
                output.print(|| json!({ "file": file, "case": case.name }), || name + "\n")?;
            }
        }
        print_unusable(output, &unusable)?;
        return Ok(ExitCode::from(if unusable.is_empty() { 0 } else { NOT_RUN }));
    }

    let own = match &address {
        Some(_) => None,
        None => Some(OwnServer::start(options.server.as_deref()).await?),
    };
    let address_in_use = own.as_ref().map(OwnServer::address).or(address.as_deref());
    let address_in_use = address_in_use.context("no address")?.to_owned();
    let place = Place {
        client: Client::connect(&address_in_use).await?,
        link_root: own.as_ref().and_then(OwnServer::link_root).map(Path::to_owned),
        address: address_in_use,
        plants: Mutex::new(BTreeSet::new()),
    };
    let replay = Replay { address: address.as_deref(), server: options.server.as_deref() };
    let jobs = options.jobs.map_or_else(
        || std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        usize::from,
    );
    let mut terminated = signal(SignalKind::terminate())?;
    let all = run_all(&place, scenarios, chosen, jobs, output, &replay);
    let tested = tokio::select! {
        tested = all => Some(tested?),
        _ = tokio::signal::ctrl_c() => None,
        _ = terminated.recv() => None,
    };
    let Some((tested, more)) = tested else {
        // The controllers went with the cases; the plants of somebody else's server must go, too.
        let plants = std::mem::take(&mut *lock(&place.plants));
        for plant in plants {
            let _ = place.client.delete_plant(plant).await;
        }
        if let Some(own) = own {
            own.stop().await;
        }
        anyhow::bail!("interrupted");
    };
    unusable.extend(more);
    print_unusable(output, &unusable)?;
    let report = Report { tested, unusable };
    print_summary(output, &report)?;
    let write = |file: &Path, text: String| {
        std::fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))
    };
    if let Some(file) = &options.junit {
        write(file, junit::document(&report, &replay))?;
    }
    if let Some(file) = &options.html {
        write(file, html::page(&report, &replay))?;
    }
    let status = report.status();
    if let Some(own) = own {
        if status == Status::Error && !output.json {
            let log = own.log();
            let shown: Vec<_> =
                log.lines().filter(|l| l.contains("ERROR") || l.contains("panicked")).collect();
            if !shown.is_empty() {
                eprintln!("plantd says:\n{}", shown.join("\n"));
            }
        }
        own.stop().await;
    }
    Ok(match status {
        Status::Passed => ExitCode::SUCCESS,
        Status::Failed => ExitCode::from(FAILED),
        Status::Error => ExitCode::from(NOT_RUN),
    })
}

/// Runs the cases, some at a time, and prints each when it is done.
async fn run_all(
    place: &Place,
    scenarios: Vec<(PathBuf, Scenario)>,
    chosen: impl Fn(&Scenario) -> Vec<Case>,
    jobs: usize,
    output: Output,
    replay: &Replay<'_>,
) -> Result<(Vec<Tested>, Vec<Unusable>)> {
    let mut unusable = Vec::new();
    let mut tested = Vec::new();
    for (file, scenario) in scenarios {
        let named = file.clone();
        match Prepared::new(place, file, scenario).await {
            Ok(prepared) => tested.push(Tested { prepared, outcomes: Vec::new() }),
            Err(error) => {
                let error = format!("{}: {error:#}", named.display());
                unusable.push(Unusable { file: named, error });
            }
        }
    }
    let counter = AtomicU64::new(0);
    let mut cases = Vec::new();
    for (index, Tested { prepared, .. }) in tested.iter().enumerate() {
        cases.extend(chosen(&prepared.scenario).into_iter().map(|case| (index, case)));
    }
    let finished = {
        let tested = &tested;
        let counter = &counter;
        let run = |(order, (index, case)): (usize, (usize, Case))| async move {
            let prepared = &tested[index].prepared;
            let plant = plant_id(prepared, &case, counter.fetch_add(1, Ordering::Relaxed));
            (order, index, prepared.run(place, &case, &plant).await)
        };
        let is_paced = |(_, (index, _)): &(usize, (usize, Case))| {
            tested[*index].prepared.scenario.pace == Pace::Paced
        };
        let (paced, rest): (Vec<_>, Vec<_>) = cases.into_iter().enumerate().partition(is_paced);
        // Plants that follow the clock must not disturb each other.
        let paced = stream::iter(paced.into_iter().map(run)).buffer_unordered(1);
        let mut running =
            stream::iter(rest.into_iter().map(run)).buffer_unordered(jobs).chain(paced);
        let mut finished = Vec::new();
        while let Some((order, index, outcome)) = running.next().await {
            let prepared = &tested[index].prepared;
            let command = replay.command(prepared, &outcome);
            output.print(
                || summary(prepared, &outcome, &command),
                || text(prepared, &outcome, &command),
            )?;
            finished.push((order, index, outcome));
        }
        finished
    };
    // As they stand in the files, whichever was done first.
    let mut finished = finished;
    finished.sort_by_key(|(order, ..)| *order);
    for (_, index, outcome) in finished {
        tested[index].outcomes.push(outcome);
    }
    Ok((tested, unusable))
}

/// The id of a case's plant. Somebody who drives it from outside must be able to guess it.
fn plant_id(prepared: &Prepared, case: &Case, number: u64) -> String {
    const NAME_MAX: usize = 40;
    let name = title(&prepared.name, &case.name);
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' };
    let slug: String = name.chars().map(plain).take(NAME_MAX).collect();
    let slug = slug.trim_matches('-');
    match prepared.scenario.controller {
        Controller::External(_) => slug.to_owned(),
        _ => format!("{slug}-{}-{number}", std::process::id()),
    }
}

fn title(scenario: &str, case: &str) -> String {
    if case.is_empty() { scenario.to_owned() } else { format!("{scenario} [{case}]") }
}

/// The files themselves, and those of folders, in order.
fn files(suites: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for suite in suites {
        if !suite.is_dir() {
            all.push(suite.clone());
            continue;
        }
        let entries =
            std::fs::read_dir(suite).with_context(|| format!("cannot read {}", suite.display()))?;
        let mut inside = Vec::new();
        for entry in entries {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "toml") {
                inside.push(path);
            }
        }
        ensure!(!inside.is_empty(), "{} holds no scenario", suite.display());
        inside.sort();
        all.extend(inside);
    }
    Ok(all)
}

/// A line for a case, and what went wrong in it.
fn text(prepared: &Prepared, outcome: &Outcome, replay: &str) -> String {
    let word = match outcome.status() {
        Status::Passed => "pass ",
        Status::Failed => "FAIL ",
        Status::Error => "ERROR",
    };
    let name = title(&prepared.name, &outcome.case);
    let elapsed = outcome.elapsed.as_secs_f64();
    let mut text = format!("{word}  {name}  {} steps, {elapsed:.2} s\n", outcome.steps);
    if outcome.status() == Status::Passed {
        return text;
    }
    for line in faults(outcome) {
        let _ = writeln!(text, "       {line}");
    }
    let _ = writeln!(text, "       seed {}; again: {replay}", outcome.seed);
    if !outcome.output.is_empty() {
        let _ = writeln!(text, "       the controller wrote:");
        for line in outcome.output.lines() {
            let _ = writeln!(text, "       | {line}");
        }
    }
    text
}

/// What went wrong in a case, a line for each.
fn faults(outcome: &Outcome) -> Vec<String> {
    let broken = outcome.verdicts.iter().filter(|verdict| verdict.broken.is_some());
    let broken = broken.map(|verdict| format!("{}: {}", verdict.expectation, verdict.message));
    outcome.error.iter().chain(&outcome.ended).cloned().chain(broken).collect()
}

fn print_unusable(output: Output, unusable: &[Unusable]) -> Result<()> {
    for Unusable { file, error } in unusable {
        output.print(
            || json!({ "file": file, "status": "error", "error": error }),
            || format!("ERROR  {error}\n"),
        )?;
    }
    Ok(())
}

impl Report {
    fn outcomes(&self) -> impl Iterator<Item = &Outcome> {
        self.tested.iter().flat_map(|tested| &tested.outcomes)
    }

    fn count(&self, status: Status) -> usize {
        let cases = self.outcomes().filter(|outcome| outcome.status() == status).count();
        if status == Status::Error { cases + self.unusable.len() } else { cases }
    }

    fn status(&self) -> Status {
        let all = [Status::Error, Status::Failed];
        all.into_iter().find(|&status| self.count(status) > 0).unwrap_or(Status::Passed)
    }
}

fn print_summary(output: Output, report: &Report) -> Result<()> {
    let [passed, failed, errors] =
        [Status::Passed, Status::Failed, Status::Error].map(|status| report.count(status));
    Ok(output.print(
        || json!({ "passed": passed, "failed": failed, "errors": errors }),
        || format!("{passed} passed, {failed} failed, {errors} not run\n"),
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_survives_a_shell() {
        for word in ["plain-1", "two words", "it's", "$HOME", "", "a[b]"] {
            let echo = format!("printf %s {}", quoted(word));
            let output = std::process::Command::new("sh").args(["-c", &echo]).output().unwrap();
            assert_eq!(String::from_utf8(output.stdout).unwrap(), word);
        }
    }
}
