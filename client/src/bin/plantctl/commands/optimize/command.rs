//! The command: runs a search and prints its iterations.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use clap::Args;
use plantd_client::{Client, v1};

use crate::commands::optimize::problem::{HELP, Method, Problem};
use crate::contract::json;
use crate::input::files::{read_result, read_text, write};
use crate::output::failure::SearchStopped;
use crate::output::page::{Cell, Page, table};
use crate::output::printer::Output;
use crate::output::text::number;
use crate::server::context::Context;

/// Finds a trajectory of least cost: prints one line per iteration, then the result.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(crate) struct Optimize {
    /// File with the problem, TOML or JSON; `-` reads standard input.
    problem: PathBuf,
    /// Write the result to this file, as JSON.
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Go on, bit for bit, where the search of this file left off: a result or a checkpoint.
    #[arg(long, value_name = "FILE", conflicts_with = "guess")]
    resume: Option<PathBuf>,
    /// Begin with the trajectory of this result.
    #[arg(long, value_name = "FILE")]
    guess: Option<PathBuf>,
    /// How a direction of descent is found, in place of the problem's `options.method`.
    #[arg(long)]
    method: Option<Method>,
    /// Iterations at most, in place of the problem's `options.max_iterations`.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    iterations: Option<u32>,
}

impl Optimize {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let text = read_text(&self.problem)?;
        let named = || self.problem.display().to_string();
        let mut problem = Problem::parse(&text).with_context(named)?;
        problem.options.method = self.method.or(problem.options.method);
        problem.options.max_iterations = self.iterations.unwrap_or(problem.options.max_iterations);
        let model = problem.model(&client).await?;
        let resume = match &self.resume {
            Some(file) => Some(read_result(file)?.checkpoint.context("no checkpoint in the file")?),
            None => None,
        };
        let guess = match &self.guess {
            Some(file) => read_result(file)?.checkpoint.and_then(|c| c.trajectory),
            None if resume.is_some() => None,
            None => Some(problem.first_guess(&client, &model).await?),
        };
        let request = problem.request(&model, guess, resume)?;
        let result = search(&client, &context.output, request).await?;
        if let Some(file) = &self.save {
            write(file, format!("{}\n", json::message("OptimizationResult", &result)))?;
        }
        match result.converged {
            true => Ok(()),
            false => Err(stopped(result, self.save.as_deref()).into()),
        }
    }
}

/// Why the search of this result ended early, and what helps.
fn stopped(result: v1::OptimizationResult, saved: Option<&Path>) -> SearchStopped {
    let failure = result.failure.unwrap_or_default();
    let mut help = match failure.reason.as_str() {
        "MAX_ITERATIONS" => "more iterations (`--iterations`) may help".to_owned(),
        _ => "another guess (`--guess`), method (`--method`) or tolerance may help".to_owned(),
    };
    let _ = match saved {
        Some(file) => {
            let file = file.display();
            write!(help, "; what was found is in {file}: `--resume {file}` goes on with it")
        }
        None => {
            write!(help, "; `--save FILE` keeps what was found, `--resume FILE` goes on with it")
        }
    };
    SearchStopped { refusal: failure.into(), help }
}

async fn search(
    client: &Client,
    output: &Output,
    request: v1::OptimizeTrajectoryRequest,
) -> Result<v1::OptimizationResult> {
    use v1::optimize_trajectory_response::Response;
    let mut messages = client.optimize_trajectory(request).await?;
    let mut is_first = true;
    while let Some(message) = messages.next().await? {
        const NAME: &str = "OptimizeTrajectoryResponse";
        match &message.response {
            Some(Response::Progress(progress)) => output.message(NAME, &message, || {
                let mut page = iteration(progress);
                if is_first {
                    page = [ITERATIONS.to_owned().into(), page].into_iter().collect();
                }
                page
            })?,
            Some(Response::Result(result)) => {
                output.message(NAME, &message, || optimum(result))?;
                return Ok(result.clone());
            }
            None => {}
        }
        is_first = false;
    }
    Err(plantd_client::Error::StreamClosed.into())
}

/// One iteration of a search, as a row of a table under [`ITERATIONS`].
fn iteration(progress: &v1::OptimizationProgress) -> Page {
    let mut text = format!(
        "{:>9}  {:<12}  {:>14}  {:>14}  {:>12}  {:>12}\n",
        progress.iteration,
        method(progress.method()),
        number(progress.cost),
        number(progress.directional_derivative),
        number(progress.step_length),
        number(progress.bound_violation),
    );
    if !progress.fallback.is_empty() {
        let _ = writeln!(text, "           {}", progress.fallback);
    }
    let row = [
        progress.cost,
        progress.directional_derivative,
        progress.step_length,
        progress.bound_violation,
    ];
    let start = [Cell::from(u64::from(progress.iteration)), method(progress.method()).into()];
    let row = start.into_iter().chain(row.map(Cell::from)).collect();
    let head = ["iteration", "method", "cost", "derivative", "step_length", "out_of_bounds"];
    let mut page = Page::from(text);
    page.data(table(&head, [row]));
    page
}

/// Head of a table of iterations.
const ITERATIONS: &str =
    "iteration  method                  cost      derivative   step length  out of bounds\n";

fn method(method: v1::DescentMethod) -> &'static str {
    match method {
        v1::DescentMethod::Unspecified => "",
        v1::DescentMethod::Steepest => "steepest",
        v1::DescentMethod::QuasiNewton => "quasi-newton",
        v1::DescentMethod::Newton => "newton",
    }
}

/// The end of a search.
fn optimum(result: &v1::OptimizationResult) -> String {
    let mut text = match &result.failure {
        // Standard error says why, and what helps.
        Some(failure) => format!("stopped early: {}\n", failure.reason),
        None => "converged\n".to_owned(),
    };
    let _ = write!(text, "cost {}", number(result.cost));
    if result.bound_violation != 0.0 {
        let _ = write!(text, ", out of bounds by {}", number(result.bound_violation));
    }
    let iterations = result.checkpoint.as_ref().map_or(0, |c| c.iterations);
    let _ = writeln!(text, " after {iterations} iterations");
    text
}
