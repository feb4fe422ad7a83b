//! `reset`, `snapshot` and `restore`: the state of a plant, set and kept.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use plantd_client::v1;
use serde_json::json;

use crate::input::files;
use crate::input::point::Initial;
use crate::output::plant;
use crate::server::context::Context;

/// Puts a plant back to step 0.
#[derive(Debug, Args)]
pub(crate) struct Reset {
    /// Plant.
    id: String,
    #[command(flatten)]
    initial: Initial,
}

/// Writes a snapshot of a plant to a file.
#[derive(Debug, Args)]
pub(crate) struct Snapshot {
    /// Plant.
    id: String,
    /// File.
    file: PathBuf,
}

/// Restores a plant from a snapshot.
#[derive(Debug, Args)]
pub(crate) struct Restore {
    /// Plant.
    id: String,
    /// File.
    file: PathBuf,
    /// The state alone: the plant's channels and faults, which may be others than the snapshot's, begin there.
    #[arg(long)]
    state_alone: bool,
}

impl Reset {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let request = v1::ResetRequest { id: self.id, initial: self.initial.into() };
        let state = client.reset_to(request).await?;
        context.output.message("State", &state, || plant::state(&state))
    }
}

impl Snapshot {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let snapshot = client.snapshot(&self.id).await?;
        files::write(&self.file, &snapshot)?;
        context.output.done(json!({ "plant": self.id, "bytes": snapshot.len() }))
    }
}

impl Restore {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let snapshot = std::fs::read(&self.file)
            .with_context(|| format!("cannot read {}", self.file.display()))?;
        let request = v1::RestoreRequest { id: self.id, snapshot, state_alone: self.state_alone };
        let state = client.restore_by(request).await?;
        context.output.message("State", &state, || plant::state(&state))
    }
}
