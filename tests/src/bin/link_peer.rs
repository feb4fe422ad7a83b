//! A driver in a process of its own, for the tests of the shared-memory link: steps a plant until
//! it is killed, or as often as it is told.
//!
//! Prints `attached` when it holds the lease, and `stepped` after the first step.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Parser;
use plantd_client::link::LinkDriver;
use plantd_tests::links::patient;

/// Drives a plant over shared memory.
#[derive(Parser)]
struct Arguments {
    /// Root path of the domain.
    #[arg(long)]
    root: PathBuf,
    /// Plant.
    #[arg(long)]
    plant: String,
    /// Steps; without it: until killed.
    #[arg(long)]
    steps: Option<u64>,
    /// Pause between two steps, microseconds.
    #[arg(long, default_value_t = 0)]
    pause_us: u64,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let mut driver = LinkDriver::connect(&arguments.plant, patient(arguments.root))?;
    println!("attached");
    let dimensions = driver.dimensions();
    let mut input = vec![0.0; dimensions.inputs];
    input.extend_from_slice(&driver.state().q[dimensions.dynamic..]);
    for step in 0..arguments.steps.unwrap_or(u64::MAX) {
        driver.step(&input)?;
        if step == 0 {
            println!("stepped");
        }
        std::thread::sleep(Duration::from_micros(arguments.pause_us));
    }
    Ok(())
}
