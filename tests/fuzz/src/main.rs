//! `plantd-fuzz`: feeds what comes from strangers with nonsense, on the stable toolchain.
//!
//! A target runs in a process of its own, which says before each input what it is. If the process panics, hangs or
//! takes too much memory, the input is saved and the command printed that runs it again. Inputs follow from a seed.

mod message;
mod mutate;
mod targets;
mod work;

// Scenarios belong to a program, and no library has them.
#[path = "../../../client/src/bin/plantctl/scenario/mod.rs"]
#[expect(dead_code, reason = "only the reading of files is of interest")]
mod scenario;

#[path = "../../../client/src/bin/plantctl/contract"]
mod contract {
    #[expect(dead_code, reason = "see above")]
    pub(crate) mod names;
}

#[path = "../../../client/src/bin/plantctl/input"]
mod input {
    #[expect(dead_code, reason = "see above")]
    pub(crate) mod numbers;
}

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode};
use std::thread;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use clap::{Parser, Subcommand};

use crate::targets::TARGETS;

/// Bytes of an input that are printed.
const SHOWN_MAX: usize = 400;

#[derive(Parser)]
#[command(name = "plantd-fuzz", about = "Feeds what comes from strangers with nonsense")]
struct Cli {
    #[command(subcommand)]
    command: Option<Action>,
    #[command(flatten)]
    run: Run,
}

#[derive(Subcommand)]
enum Action {
    /// Runs one saved input.
    Replay {
        /// The target.
        target: String,
        /// The input.
        file: PathBuf,
    },
    /// Runs one target in this process.
    #[command(hide = true)]
    Work(work::Work),
}

#[derive(clap::Args)]
struct Run {
    /// The targets; all if none is given.
    targets: Vec<String>,
    /// Seconds for each target.
    #[arg(long, default_value_t = 3.0)]
    seconds: f64,
    /// Inputs for each target, at most.
    #[arg(long, default_value_t = u64::MAX)]
    inputs: u64,
    /// Targets that run at a time.
    #[arg(long, default_value_t = 2)]
    jobs: usize,
    /// The seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Where inputs are saved on which a target fails.
    #[arg(long, default_value = "target/fuzz")]
    failures: PathBuf,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let outcome = match cli.command {
        Some(Action::Replay { target, file }) => work::replay(&target, &file).map(|()| true),
        Some(Action::Work(work)) => work.run().map(|()| true),
        None => cli.run.run(),
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("plantd-fuzz: {error:#}");
            ExitCode::from(2)
        }
    }
}

/// A target at work.
struct Running {
    target: &'static str,
    child: Child,
    current: PathBuf,
}

impl Run {
    /// Runs the targets; whether none has failed.
    fn run(&self) -> Result<bool> {
        for name in &self.targets {
            let is_known = TARGETS.iter().any(|(known, _)| known == name);
            let known = TARGETS.map(|(known, _)| known).join(", ");
            ensure!(is_known, "there is no target `{name}`, but {known}");
        }
        let chosen =
            |name: &&str| self.targets.is_empty() || self.targets.iter().any(|t| t == name);
        let mut waiting: Vec<&str> = TARGETS.iter().map(|(name, _)| *name).filter(chosen).collect();
        waiting.reverse();
        let folder = tempfile::Builder::new().prefix("fuzz-").tempdir()?;
        let (mut running, mut is_well): (Vec<Running>, _) = (Vec::new(), true);
        while !waiting.is_empty() || !running.is_empty() {
            while running.len() < self.jobs.max(1)
                && let Some(target) = waiting.pop()
            {
                running.push(self.start(target, folder.path())?);
            }
            let mut at_work = Vec::new();
            for mut one in running {
                match one.child.try_wait()? {
                    None => at_work.push(one),
                    Some(status) if status.success() => {}
                    Some(status) => {
                        is_well = false;
                        println!("{}: FAILED, {status}", one.target);
                        self.keep(&one)?;
                    }
                }
            }
            running = at_work;
            thread::sleep(Duration::from_millis(20));
        }
        Ok(is_well)
    }

    fn start(&self, target: &'static str, folder: &Path) -> Result<Running> {
        let current = folder.join(target);
        let child = Command::new(std::env::current_exe()?)
            .args(["work", target, "--seed", &self.seed.to_string()])
            .args(["--seconds", &self.seconds.to_string(), "--inputs", &self.inputs.to_string()])
            // However it ends, what it leaves goes with the folder.
            .env("TMPDIR", folder)
            .arg("--current")
            .arg(&current)
            .spawn()
            .context("the target does not start")?;
        Ok(Running { target, child, current })
    }

    /// Saves the input on which a target has failed, and says how to run it again.
    fn keep(&self, failed: &Running) -> Result<()> {
        let input = work::current(&failed.current)?;
        std::fs::create_dir_all(&self.failures)?;
        let path = self.failures.join(format!("{}-{}", failed.target, self.seed));
        std::fs::write(&path, &input)?;
        let shown = &input[..input.len().min(SHOWN_MAX)];
        println!("input, {} bytes, begins {}", input.len(), shown.escape_ascii());
        println!("again: cargo run -p plantd-fuzz -- replay {} {}", failed.target, path.display());
        Ok(())
    }
}
