//! Round trip of one step over shared memory: driver and host in two processes, for each way of
//! waiting. Prints a table; asserts nothing.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Parser;
use hdrhistogram::Histogram;
use plantd_client::link::{LinkDriver, LinkOptions, Wait};
use plantd_tests::links::{ChildProcess, PLANT, new_plant};

/// Measures the round trip of a step over shared memory.
#[derive(Parser)]
struct Arguments {
    /// Built-in model.
    #[arg(long, default_value = "pendulum")]
    model: String,
    /// Steps per row.
    #[arg(long, default_value_t = 20_000)]
    steps: u64,
}

/// Name of a row, how the host waits, how the driver waits.
const ROWS: &[(&str, &[&str], Wait)] = &[
    ("both poll", &["--poll"], Wait::Poll),
    (
        "poll 50 us, then sleep",
        &["--poll-us", "50"],
        Wait::PollThenSleep(Duration::from_micros(50)),
    ),
    ("both sleep", &["--poll-us", "0"], Wait::PollThenSleep(Duration::ZERO)),
];

/// Largest duration that is told from longer ones, ns.
const LONGEST_NS: u64 = 10_000_000_000;

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    println!("model {}, {} steps, microseconds", arguments.model, arguments.steps);
    println!("{:<24} {:>9} {:>9} {:>9} {:>9}", "", "p50", "p99", "p99.9", "max");
    print_row("step in process", &measure_in_process(&arguments)?);
    for &(name, host, wait) in ROWS {
        print_row(name, &measure(&arguments, host, wait)?);
    }
    Ok(())
}

fn measure_in_process(arguments: &Arguments) -> Result<Histogram<u64>> {
    let mut plant = new_plant(&arguments.model)?;
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    record(arguments.steps, || Ok(plant.step(&u).map(drop)?))
}

fn measure(arguments: &Arguments, host_waits: &[&str], wait: Wait) -> Result<Histogram<u64>> {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir()?;
    let root = directory.path().join("link");
    let program = std::env::current_exe()?.with_file_name("link_host");
    let mut host = start_host(&program, &root, &arguments.model, host_waits)?;
    let mut driver =
        LinkDriver::connect(PLANT, LinkOptions { root, wait, ..LinkOptions::default() })?;
    let dimensions = driver.dimensions();
    let mut u = vec![0.0; dimensions.inputs];
    u.extend_from_slice(&driver.state().q[dimensions.dynamic..]);
    let histogram = record(arguments.steps, || Ok(driver.step(&u).map(drop)?))?;
    drop(driver);
    // A host that is killed leaves shared memory behind, and its root path is about to go.
    anyhow::ensure!(host.finish()?, "the host failed");
    Ok(histogram)
}

fn start_host(program: &Path, root: &Path, model: &str, wait: &[&str]) -> Result<ChildProcess> {
    let mut host = ChildProcess::start(program, root, &[&["--model", model], wait].concat())?;
    host.wait_for_line("open")?;
    Ok(host)
}

/// Times each call, after some that warm up.
fn record(steps: u64, mut step: impl FnMut() -> Result<()>) -> Result<Histogram<u64>> {
    let mut histogram = Histogram::new_with_max(LONGEST_NS, 3)?;
    for k in 0..steps + steps / 10 {
        let start = Instant::now();
        step()?;
        if k >= steps / 10 {
            histogram.saturating_record(start.elapsed().as_nanos() as u64);
        }
    }
    Ok(histogram)
}

fn print_row(name: &str, histogram: &Histogram<u64>) {
    let us = |ns: u64| ns as f64 / 1e3;
    let at = |quantile| us(histogram.value_at_quantile(quantile));
    println!(
        "{name:<24} {:>9.2} {:>9.2} {:>9.2} {:>9.2}",
        at(0.5),
        at(0.99),
        at(0.999),
        us(histogram.max())
    );
}
