//! `reset`, `snapshot` and `restore`: the state of a plant, set and kept.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use plantd_client::v1;
use serde_json::json;

use crate::input::files;
use crate::input::point::{Initial, Of};
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
        let model = context.names_of(&client, &self.id).await?;
        let initial = self.initial.resolve(&client, Of::Plant(&self.id)).await?;
        let request = v1::ResetRequest { id: self.id.clone(), initial };
        let state = client.reset_to(request).await?;
        context.output.success(&format!("plant `{}` is at step 0 again", self.id));
        context.output.message("State", &state, || plant::state(&state, &model))
    }
}

impl Snapshot {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let snapshot = client.snapshot(&self.id).await?;
        files::write(&self.file, &snapshot)?;
        let bytes = snapshot.len();
        let said = format!(
            "a snapshot of plant `{}` is in {}: {bytes} bytes",
            self.id,
            self.file.display()
        );
        context.output.done(json!({ "plant": self.id, "bytes": bytes }), &said)
    }
}

impl Restore {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let snapshot = std::fs::read(&self.file)
            .with_context(|| format!("cannot read {}", self.file.display()))?;
        let model = context.names_of(&client, &self.id).await?;
        let (id, state_alone) = (self.id.clone(), self.state_alone);
        let state = client.restore_by(v1::RestoreRequest { id, snapshot, state_alone }).await?;
        context.output.success(&format!("plant `{}` is at step {}", self.id, state.step));
        context.output.message("State", &state, || plant::state(&state, &model))
    }
}
