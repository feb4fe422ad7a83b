//! Controllers: what they have in common, and how the director runs them.

use std::path::Path;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use plantd_client::Client;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::process::{Child, Command};

use crate::{latency, marionette, pendulum, show};

/// A controller takes seconds; one that takes this long hangs.
const PATIENCE: Duration = Duration::from_secs(120);

/// The controllers of the demo.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Name {
    /// The paper's pendulum: one step, linearization, LQR about upright, over gRPC.
    Pendulum,
    /// The marionette: time-varying LQR along a motion, over shared memory.
    Marionette,
    /// Round trips of a pendulum over gRPC.
    GrpcLatency,
    /// Round trips of a pendulum over shared memory.
    LinkLatency,
    /// The marionette dancing and the pendulum being pushed, for people to look at.
    Show,
}

/// A line that a controller prints.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Event {
    /// How far it is.
    Progress { task: String, done: usize, of: usize },
    /// What it found; the last line.
    Result(serde_json::Value),
}

/// Tells the director how far a controller is; about twenty times per task.
pub(crate) fn progress(task: &str, done: usize, of: usize) {
    if done.is_multiple_of((of / 20).max(1)) || done == of {
        emit(&Event::Progress { task: task.to_owned(), done, of });
    }
}

fn emit(event: &Event) {
    println!("{}", serde_json::to_string(event).expect("an event has only names as keys"));
}

/// Runs a controller in this process.
pub(crate) fn run(name: Name, address: &str) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = runtime.block_on(async {
        let client = Client::connect(address).await?;
        match name {
            Name::Pendulum => to_value(pendulum::control(&client).await?),
            Name::Marionette => to_value(marionette::control(&client).await?),
            Name::GrpcLatency => to_value(latency::over_grpc(&client).await?),
            Name::LinkLatency => to_value(latency::over_shared_memory(&client).await?),
            Name::Show => to_value(show::control(&client).await?),
        }
    })?;
    emit(&Event::Result(result));
    Ok(())
}

fn to_value(result: impl Serialize) -> Result<serde_json::Value> {
    Ok(serde_json::to_value(result)?)
}

/// A controller in a process of its own, which ends with this value.
pub(crate) struct Process {
    name: String,
    child: Child,
}

impl Process {
    /// Starts a controller, a subcommand of `program`, against the server at `address`.
    pub(crate) fn start(program: &Path, name: Name, address: &str) -> Result<Self> {
        let value = name.to_possible_value().expect("every controller has a name");
        let name = format!("controller {}", value.get_name());
        let child = Command::new(program)
            .args(["controller", value.get_name(), "--address", address])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start the {name}"))?;
        Ok(Self { name, child })
    }

    /// Its process id.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id().unwrap_or_default()
    }

    /// Waits for its result, with a progress bar where a person waits.
    pub(crate) async fn result<T: DeserializeOwned>(mut self) -> Result<T> {
        let (value, status, complaint) = tokio::time::timeout(PATIENCE, self.follow())
            .await
            .with_context(|| format!("the {} does not end", self.name))??;
        if !status.success() {
            bail!("the {} failed: {}", self.name, complaint.trim());
        }
        let value = value.with_context(|| format!("the {} ended without a result", self.name))?;
        Ok(serde_json::from_value(value)?)
    }

    /// Waits until it ends, however long it goes on.
    pub(crate) async fn end(mut self) -> Result<()> {
        let (_, status, complaint) = self.follow().await?;
        match status.success() {
            true => Ok(()),
            false => bail!("the {} failed: {}", self.name, complaint.trim()),
        }
    }

    async fn follow(&mut self) -> Result<(Option<serde_json::Value>, ExitStatus, String)> {
        let events = self.child.stdout.take().context("the output has been read before")?;
        let mut errors = self.child.stderr.take().context("the errors have been read before")?;
        let mut lines = BufReader::new(events).lines();
        // indicatif shows nothing unless standard error is a terminal.
        let style = ProgressStyle::with_template("   {msg:28} {bar:40.cyan} {pos:>5}/{len}")?;
        let bar = ProgressBar::no_length().with_style(style);
        let (mut result, mut complaint) = (None, String::new());
        while let Some(line) = lines.next_line().await? {
            match serde_json::from_str(&line).with_context(|| format!("from {}", self.name))? {
                Event::Progress { task, done, of } => {
                    bar.set_length(of as u64);
                    bar.set_position(done as u64);
                    bar.set_message(task);
                }
                Event::Result(value) => result = Some(value),
            }
        }
        bar.finish_and_clear();
        errors.read_to_string(&mut complaint).await?;
        Ok((result, self.child.wait().await?, complaint))
    }
}
