//! `test`: scenarios, run in parallel and judged.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use futures::{StreamExt as _, stream};
use serde_json::json;
use tokio::signal::unix::{SignalKind, signal};

use crate::input::files::write;
use crate::output::failure::FAILED;
use crate::output::page::{Page, table};
use crate::output::printer::{Output, complain};
use crate::report::results::{Replay, Report, ScenarioResult, UnusableFile};
use crate::report::text::{print_case, print_summary, print_unusable, title};
use crate::report::{html, junit};
use crate::scenario::file::{Case, Controller, Pace, Scenario};
use crate::server::context::Context;
use crate::server::own::OwnServer;
use crate::trial::outcome::Status;
use crate::trial::prepared::PreparedScenario;
use crate::trial::run::run_case;
use crate::trial::server::TestServer;

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
  plantctl test scenarios --over http://a:50051,http://b:50051   spread over two servers

Exit codes:
  0  every expectation came true
  1  one did not
  2  a case could not be run or judged, or wrong usage";

/// Runs scenarios and judges them, for tests of controllers.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLE)]
pub(crate) struct Test {
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
    /// The `plantd` to start; that beside this program or in PATH if not given.
    #[arg(long, value_name = "PROGRAM", alias = "server")]
    plantd: Option<PathBuf>,
    /// Servers over which the cases are spread, comma-separated addresses, in place of one.
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',', conflicts_with = "plantd")]
    over: Vec<String>,
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

/// A scenario, and the file that it is from.
type Suite = (PathBuf, Scenario);

impl Test {
    pub(crate) async fn run(self, context: &Context) -> Result<ExitCode> {
        let status = self.run_suites(context).await;
        status.or_else(|error| {
            // Whatever keeps a suite from being run is none of its expectations.
            complain(&error);
            Ok(ExitCode::from(NOT_RUN))
        })
    }

    async fn run_suites(&self, context: &Context) -> Result<ExitCode> {
        if self.schema {
            println!("{}", serde_json::to_string_pretty(&Scenario::schema())?);
            return Ok(ExitCode::SUCCESS);
        }
        let (scenarios, mut unusable) = self.read_suites()?;
        let count: usize = scenarios.iter().map(|(_, scenario)| self.cases(scenario).len()).sum();
        ensure!(count > 0 || !unusable.is_empty(), "no case has such a name");
        if self.list {
            self.print_cases(&context.output, &scenarios)?;
            print_unusable(&context.output, &unusable)?;
            return Ok(ExitCode::from(if unusable.is_empty() { 0 } else { NOT_RUN }));
        }
        let given = match &context.address {
            Some(address) if self.over.is_empty() => vec![address.clone()],
            _ => self.over.clone(),
        };
        let (own, addresses) = match given.is_empty() {
            false => (None, given),
            true => {
                let own = OwnServer::start(self.plantd.as_deref()).await?;
                let address = own.address().to_owned();
                (Some(own), vec![address])
            }
        };
        let mut servers = Vec::new();
        for address in addresses {
            servers.push(TestServer {
                client: context.connect_to(&address).await?,
                link_root: own.as_ref().and_then(OwnServer::link_root).map(Path::to_owned),
                address,
                plants: Mutex::new(BTreeSet::new()),
            });
        }
        let replay = Replay { address: context.address.as_deref(), plantd: self.plantd.as_deref() };
        let mut terminated = signal(SignalKind::terminate())?;
        let all = self.run_all(&servers, scenarios, &context.output, &replay);
        let tested = tokio::select! {
            tested = all => Some(tested?),
            _ = tokio::signal::ctrl_c() => None,
            _ = terminated.recv() => None,
        };
        let Some((tested, more)) = tested else {
            // The controllers went with the cases; the plants of somebody else's server must go, too.
            for server in &servers {
                let plants = std::mem::take(&mut *server.plants());
                for plant in plants {
                    let _ = server.client.delete_plant(plant).await;
                }
            }
            if let Some(own) = own {
                own.stop().await;
            }
            bail!("interrupted");
        };
        unusable.extend(more);
        print_unusable(&context.output, &unusable)?;
        let report = Report { tested, unusable };
        print_summary(&context.output, &report)?;
        if let Some(file) = &self.junit {
            write(file, junit::document(&report, &replay))?;
        }
        if let Some(file) = &self.html {
            write(file, html::page(&report, &replay))?;
        }
        let status = report.status();
        if let Some(own) = own {
            if status == Status::Error && context.output.is_for_people() {
                print_errors(&own.log());
            }
            own.stop().await;
        }
        Ok(match status {
            Status::Passed => ExitCode::SUCCESS,
            Status::Failed => ExitCode::from(FAILED),
            Status::Error => ExitCode::from(NOT_RUN),
        })
    }

    /// The scenarios, and the files that are none.
    fn read_suites(&self) -> Result<(Vec<Suite>, Vec<UnusableFile>)> {
        let mut unusable = Vec::new();
        let mut scenarios = Vec::new();
        for file in files(&self.suites)? {
            match Scenario::read(&file) {
                Ok(mut scenario) => {
                    scenario.seed = self.seed.unwrap_or(scenario.seed);
                    scenarios.push((file, scenario));
                }
                Err(error) => unusable.push(UnusableFile { file, error: format!("{error:#}") }),
            }
        }
        Ok((scenarios, unusable))
    }

    /// The cases of a scenario that are asked for.
    fn cases(&self, scenario: &Scenario) -> Vec<Case> {
        let mut cases = scenario.cases();
        cases.retain(|case| self.case.is_empty() || self.case.contains(&case.name));
        cases
    }

    fn print_cases(&self, output: &Output, scenarios: &[Suite]) -> Result<()> {
        for (file, scenario) in scenarios {
            for case in self.cases(scenario) {
                let name = title(&file.to_string_lossy(), &case.name);
                let json = || json!({ "file": file, "case": case.name });
                let row = || vec![file.display().to_string(), case.name.clone()];
                output.print(json, || {
                    let mut page = Page::from(name + "\n");
                    page.data(table(&["file", "case"], [row()]));
                    page
                })?;
            }
        }
        Ok(())
    }

    /// Runs the cases on the servers in turn, some at a time on each, and prints each when it is done.
    async fn run_all(
        &self,
        servers: &[TestServer],
        scenarios: Vec<Suite>,
        output: &Output,
        replay: &Replay<'_>,
    ) -> Result<(Vec<ScenarioResult>, Vec<UnusableFile>)> {
        let jobs = self.jobs.map_or_else(
            || std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            usize::from,
        );
        let mut unusable = Vec::new();
        let mut tested = Vec::new();
        for (file, scenario) in scenarios {
            let named = file.clone();
            match prepare(servers, file, scenario).await {
                Ok(prepared) => tested.push(ScenarioResult { prepared, outcomes: Vec::new() }),
                Err(error) => {
                    let error = format!("{}: {error:#}", named.display());
                    unusable.push(UnusableFile { file: named, error });
                }
            }
        }
        let counter = AtomicU64::new(0);
        let mut cases = Vec::new();
        for (index, ScenarioResult { prepared, .. }) in tested.iter().enumerate() {
            cases.extend(self.cases(&prepared.scenario).into_iter().map(|case| (index, case)));
        }
        let finished = {
            let tested = &tested;
            let counter = &counter;
            let run = |(order, (index, case)): (usize, (usize, Case))| async move {
                let prepared = &tested[index].prepared;
                let plant = plant_id(prepared, &case, counter.fetch_add(1, Ordering::Relaxed));
                let server = &servers[order % servers.len()];
                (order, index, run_case(server, prepared, &case, &plant).await)
            };
            let is_paced = |(_, (index, _)): &(usize, (usize, Case))| {
                tested[*index].prepared.scenario.pace == Pace::Paced
            };
            let (paced, rest): (Vec<_>, Vec<_>) = cases.into_iter().enumerate().partition(is_paced);
            // Plants that follow the clock must not disturb each other.
            let paced = stream::iter(paced.into_iter().map(run)).buffer_unordered(1);
            let mut running = stream::iter(rest.into_iter().map(run))
                .buffer_unordered(jobs * servers.len())
                .chain(paced);
            let mut finished = Vec::new();
            while let Some((order, index, outcome)) = running.next().await {
                let prepared = &tested[index].prepared;
                let command = replay.command(prepared, &outcome);
                print_case(output, prepared, &outcome, &command)?;
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
}

/// Makes the model of a scenario known to all servers; what it refers to is computed by the first.
async fn prepare(
    servers: &[TestServer],
    file: PathBuf,
    scenario: Scenario,
) -> Result<PreparedScenario> {
    let [first, others @ ..] = servers else { bail!("there is no server to run it on") };
    for server in others {
        PreparedScenario::new(server, file.clone(), scenario.clone()).await?;
    }
    PreparedScenario::new(first, file, scenario).await
}

/// Prints the errors in the log of a server.
fn print_errors(log: &str) {
    let is_error = |line: &&str| line.contains("ERROR") || line.contains("panicked");
    let shown: Vec<_> = log.lines().filter(is_error).collect();
    if !shown.is_empty() {
        eprintln!("plantd says:\n{}", shown.join("\n"));
    }
}

/// The id of a case's plant. Somebody who drives it from outside must be able to guess it.
fn plant_id(prepared: &PreparedScenario, case: &Case, number: u64) -> String {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scenarios_in_the_help_and_in_the_guide_are_some() {
        let (_, help) = EXAMPLE.split_once(":\n\n").unwrap();
        let (help, _) = help.split_once("\n\nExamples").unwrap();
        assert_eq!(Scenario::parse(help).unwrap().cases().len(), 20);
        let guide = concat!(env!("CARGO_MANIFEST_DIR"), "/TESTING.md");
        let guide = std::fs::read_to_string(guide).unwrap();
        let (_, block) = guide.split_once("```toml\n").unwrap();
        let (block, _) = block.split_once("```").unwrap();
        assert_eq!(Scenario::parse(block).unwrap().cases().len(), 12);
    }
}
