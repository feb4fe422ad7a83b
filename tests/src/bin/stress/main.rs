//! Tries to break the integrator: long runs, extreme parameters, violent motion, random scenes.
//!
//! Each case states what it must satisfy, and prints what it found in one line. A table and plots come
//! at the end. The exit code is 1 if a case failed whose limit is not known.
//!
//! ```text
//! cargo run --release -p plantd-tests --bin stress -- --long --out stress-output
//! ```

mod case;
mod derivatives;
mod determinism;
mod energy;
mod geometry;
mod inputs;
mod invariants;
#[allow(dead_code, reason = "tests of the mechanics use all of it")]
#[path = "../../../../models/tests/common/numbers.rs"]
mod numbers;
mod orders;
mod parameters;
mod plants;
mod random;
#[allow(dead_code, reason = "tests of the mechanics use all of it")]
#[path = "../../../../models/tests/common/random_scene.rs"]
mod random_scene;
mod report;
mod singular;
mod spin;
mod steps;
mod stiffness;
mod violent;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use case::{Outcome, Setup, Verdict};
use clap::Parser;

/// Tries to break the integrator.
#[derive(Parser)]
struct Arguments {
    /// Longer runs, larger mechanisms, thousands of random scenes.
    #[arg(long)]
    long: bool,
    /// Only cases whose name contains this.
    #[arg(long, default_value = "")]
    only: String,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for the table and the plots.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print the names of the cases and what they must satisfy.
    #[arg(long)]
    list: bool,
}

fn main() -> Result<ExitCode> {
    let Arguments { long, only, seed, out, list } = Arguments::parse();
    let setup = Setup { long, seed };
    let groups = [
        energy::cases(),
        invariants::cases(),
        orders::cases(),
        parameters::cases(),
        stiffness::cases(),
        singular::cases(),
        spin::cases(),
        steps::cases(&setup),
        inputs::cases(),
        violent::cases(&setup),
        random::cases(),
        determinism::cases(),
    ];
    let cases: Vec<_> =
        groups.into_iter().flatten().filter(|case| case.name.contains(&only)).collect();
    if list {
        cases.iter().for_each(|case| println!("{}\n    {}", case.name, case.criterion));
        return Ok(ExitCode::SUCCESS);
    }
    let mut outcomes: Vec<Outcome> = Vec::new();
    for case in cases {
        println!("{}\n    {}", case.name, case.criterion);
        let outcome = case.run(&setup);
        println!("    {}\n", outcome.line());
        outcomes.push(outcome);
    }
    let count = |verdict| outcomes.iter().filter(|o| o.verdict == verdict).count();
    let (failed, limits) = (count(Verdict::Fail), count(Verdict::KnownLimit));
    println!("{} passed, {limits} at known limits, {failed} failed", count(Verdict::Pass));
    for outcome in outcomes.iter().filter(|o| o.verdict == Verdict::Fail) {
        let form = if long { " --long" } else { "" };
        println!("again: stress{form} --seed {seed} --only '{}'", outcome.name);
    }
    if let Some(out) = out {
        std::fs::create_dir_all(&out).with_context(|| format!("cannot make {}", out.display()))?;
        report::write(&out, &outcomes)?;
    }
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
