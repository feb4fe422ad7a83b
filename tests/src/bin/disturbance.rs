//! What long computations do to a running plant: lockstep round trips of a pendulum over gRPC and over
//! shared memory, with and without optimisations of the marionette in progress on the same server, for
//! each scheduling priority of the workers. Prints a table; asserts nothing.
//!
//! ```text
//! cargo run --release -p plantd-tests --bin disturbance
//! ```

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

use anyhow::{Context as _, Result, bail};
use clap::Parser;
use hdrhistogram::Histogram;
use plantd_client::link::{LinkDriver, LinkOptions};
use plantd_client::{Client, MatrixExt as _, StateExt as _, diagonal, v1};
use plantd_tests::server::ServerProcess;
use tokio::task::JoinSet;
use v1::optimize_trajectory_response::Response as Message;

/// Measures what optimisations do to the round trips of a plant.
#[derive(Parser)]
struct Arguments {
    /// Steps per row.
    #[arg(long, default_value_t = 20_000)]
    steps: u64,
    /// Optimisations at a time.
    #[arg(long, default_value_t = 1)]
    searches: usize,
    /// Steps of the trajectory that is optimised.
    #[arg(long, default_value_t = 300)]
    horizon: usize,
    /// Scheduling priorities of the workers.
    #[arg(long, value_delimiter = ',', default_values = ["normal", "nice", "idle"])]
    priorities: Vec<String>,
}

/// Largest duration that is told from longer ones, ns.
const LONGEST_NS: u64 = 60_000_000_000;

#[tokio::main]
async fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let Arguments { steps, searches, horizon, .. } = arguments;
    println!(
        "round trips of a pendulum in lockstep, {steps} each, microseconds; with {searches} searches \
         over {horizon} steps of the marionette\n"
    );
    let head = "p50       p90       p99     p99.9       max";
    println!("{:<22} {:^49}   {:^49}   iterations", "", "alone", "with searches");
    println!("{:<22}    {head:>46}      {head:>46}   meanwhile", "workers, link");
    for priority in &arguments.priorities {
        measure(&arguments, priority).await?;
    }
    Ok(())
}

/// The rows of one priority.
async fn measure(arguments: &Arguments, priority: &str) -> Result<()> {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir()?;
    let root = directory.path().join("link");
    let server = ServerProcess::start_with(|command| {
        command.args(["--worker-priority", priority]).arg("--link-root").arg(&root);
    })?;
    let client = Client::connect(server.unix_address()).await?;
    for (link, over_link) in [("gRPC", false), ("shared memory", true)] {
        let row = async || match over_link {
            false => over_grpc(&client, arguments.steps).await,
            true => over_shared_memory(&client, root.clone(), arguments.steps).await,
        };
        let alone = row().await?;
        let searches = Searches::start(&server, arguments).await?;
        let disturbed = row().await?;
        let iterations = searches.stop().await?;
        println!(
            "{:<22} {}   {}   {iterations:>9}",
            format!("{priority}, {link}"),
            columns(&alone),
            columns(&disturbed)
        );
    }
    Ok(())
}

fn columns(histogram: &Histogram<u64>) -> String {
    let us = |ns: u64| ns as f64 / 1e3;
    let at = |quantile| us(histogram.value_at_quantile(quantile));
    format!(
        "{:>9.1} {:>9.1} {:>9.1} {:>9.1} {:>9.1}",
        at(0.5),
        at(0.9),
        at(0.99),
        at(0.999),
        us(histogram.max())
    )
}

async fn new_plant(client: &Client, open_link: bool) -> Result<String> {
    let model = "pendulum".to_owned();
    let request = v1::CreatePlantRequest { model, open_link, ..Default::default() };
    Ok(client.create_plant(request).await?.id)
}

async fn over_grpc(client: &Client, steps: u64) -> Result<Histogram<u64>> {
    let mut driver = client.drive(new_plant(client, false).await?).await?;
    let mut histogram = Histogram::new_with_max(LONGEST_NS, 3)?;
    for k in 0..steps + steps / 10 {
        let start = Instant::now();
        driver.step(&[torque(k)]).await?;
        note(&mut histogram, start, k >= steps / 10);
    }
    Ok(histogram)
}

async fn over_shared_memory(client: &Client, root: PathBuf, steps: u64) -> Result<Histogram<u64>> {
    let id = new_plant(client, true).await?;
    let work = tokio::task::spawn_blocking(move || {
        let mut driver = LinkDriver::connect(&id, LinkOptions { root, ..LinkOptions::default() })?;
        let mut histogram = Histogram::new_with_max(LONGEST_NS, 3)?;
        for k in 0..steps + steps / 10 {
            let start = Instant::now();
            driver.step(&[torque(k)])?;
            note(&mut histogram, start, k >= steps / 10);
        }
        anyhow::Ok(histogram)
    });
    work.await?
}

fn torque(k: u64) -> f64 {
    0.5 * (0.01 * k as f64).sin()
}

fn note(histogram: &mut Histogram<u64>, start: Instant, counts: bool) {
    if counts {
        histogram.saturating_record(start.elapsed().as_nanos() as u64);
    }
}

/// Searches that begin anew when they end, until they are stopped.
struct Searches {
    tasks: JoinSet<Result<()>>,
    is_over: Arc<AtomicBool>,
    iterations: Arc<AtomicU64>,
}

impl Searches {
    /// Starts them, and waits until each has begun.
    async fn start(server: &ServerProcess, arguments: &Arguments) -> Result<Self> {
        let (is_over, iterations) = (Arc::default(), Arc::default());
        let mut searches = Self { tasks: JoinSet::new(), is_over, iterations };
        for _ in 0..arguments.searches {
            // A connection of its own, as another process would have.
            let client = Client::connect(server.unix_address()).await?;
            let request = request(&client, arguments.horizon).await?;
            let mut first = client.optimize_trajectory(request.clone()).await?;
            first.next().await?.context("a search has a first iteration")?;
            let is_over = Arc::clone(&searches.is_over);
            let iterations = Arc::clone(&searches.iterations);
            searches.tasks.spawn(async move {
                let mut answers = first;
                while !is_over.load(Ordering::Acquire) {
                    match answers.next().await?.and_then(|answer| answer.response) {
                        Some(Message::Progress(_)) => {
                            iterations.fetch_add(1, Ordering::AcqRel);
                        }
                        Some(Message::Result(_)) => {}
                        None => answers = client.optimize_trajectory(request.clone()).await?,
                    }
                }
                Ok(())
            });
        }
        searches.iterations.store(0, Ordering::Release);
        Ok(searches)
    }

    /// Ends them; returns how many iterations they did.
    async fn stop(mut self) -> Result<u64> {
        let iterations = self.iterations.load(Ordering::Acquire);
        self.is_over.store(true, Ordering::Release);
        self.tasks.abort_all();
        while let Some(end) = self.tasks.join_next().await {
            match end {
                Ok(end) => end?,
                Err(error) if error.is_cancelled() => {}
                Err(error) => bail!(error),
            }
        }
        Ok(iterations)
    }
}

/// The marionette at rest shall move as if two of its strings were pulled.
async fn request(client: &Client, horizon: usize) -> Result<v1::OptimizeTrajectoryRequest> {
    let name = "marionette";
    let model = client.get_model(name).await?;
    let (dynamic, prescribed): (Vec<_>, Vec<_>) =
        model.coordinates.iter().partition(|coordinate| !coordinate.prescribed);
    let (inputs, strings) = (model.inputs.len(), prescribed.len());
    let row = |k: usize, pull: f64| -> Vec<f64> {
        let lift = pull * (0.02 * k as f64).sin();
        let string = |(i, c): (usize, &&v1::Coordinate)| match i {
            0 => c.initial + lift,
            1 => c.initial - lift,
            _ => c.initial,
        };
        let forces = std::iter::repeat_n(0.0, inputs);
        forces.chain(prescribed.iter().enumerate().map(string)).collect()
    };
    let rows = |pull: f64| -> v1::Matrix {
        let rows: Vec<_> = (0..horizon).map(|k| row(k, pull)).collect();
        v1::Matrix::from_rows(&rows)
    };
    let case =
        v1::RolloutCase { initial: None, u: Some(rows(0.05)), hold: 0, ..Default::default() };
    let rollout = v1::RolloutRequest {
        model: name.to_owned(),
        cases: vec![case],
        every: 1,
        ..Default::default()
    };
    let states = client.rollout(rollout).await?.collect().await?.remove(0).states;
    let size = 2 * (dynamic.len() + strings);
    let mut desired: Vec<_> = states.iter().map(|state| state.x()).collect();
    desired.insert(0, desired.first().context("the motion has states")?.clone());
    let weights = v1::LqrWeights {
        q: Some(diagonal(vec![1.0; size])),
        r: Some(diagonal(vec![1.0; inputs + strings])),
        ..Default::default()
    };
    Ok(v1::OptimizeTrajectoryRequest {
        model: name.to_owned(),
        cost: Some(v1::TrajectoryCost {
            x: Some(v1::Matrix::from_rows(&desired)),
            u: Some(rows(0.05)),
            weights: Some(weights),
            ..Default::default()
        }),
        guess: Some(v1::Trajectory { initial: None, u: Some(rows(0.0)) }),
        ..Default::default()
    })
}
