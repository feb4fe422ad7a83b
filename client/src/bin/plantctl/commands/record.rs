//! `record`: recordings in files of the server.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::{Args, Subcommand};
use plantd_client::v1;
use serde_json::json;

use crate::contract::json;
use crate::output::page::{Cell, Page, table};
use crate::server::context::Context;

/// Records plants into files of the server.
#[derive(Debug, Args)]
pub(crate) struct Record {
    #[command(subcommand)]
    command: RecordCommand,
}

#[derive(Debug, Subcommand)]
enum RecordCommand {
    /// Starts to record a plant.
    Start {
        /// Plant.
        id: String,
        /// Name of the recording; the plant's id and the time if not given.
        #[arg(long)]
        name: Option<String>,
        /// Time between snapshots, from which a replay can begin, s.
        #[arg(long, value_name = "SECONDS", default_value_t = 0.0, hide_default_value = true)]
        checkpoint_interval: f64,
    },
    /// Ends a recording.
    Stop {
        /// Name of the recording.
        name: String,
    },
    /// Lists recordings.
    List,
    /// Fetches the file of a recording.
    Get {
        /// Name of the recording.
        name: String,
        /// File; NAME.mcap if not given.
        file: Option<PathBuf>,
    },
    /// Deletes a recording.
    Delete {
        /// Name of the recording.
        name: String,
    },
}

impl Record {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let output = &context.output;
        let print = |recording: &v1::Recording| {
            let one = std::slice::from_ref(recording);
            output.message("Recording", recording, || text(one))
        };
        match self.command {
            RecordCommand::Start { id, name, checkpoint_interval } => {
                let request = v1::StartRecordingRequest {
                    id,
                    name: name.unwrap_or_default(),
                    checkpoint_interval_s: checkpoint_interval,
                };
                let recording = client.start_recording(request).await?;
                let (plant, name) = (&recording.plant, &recording.name);
                output.success(&format!("plant `{plant}` is recorded as `{name}`"));
                print(&recording)?;
            }
            RecordCommand::Stop { name } => {
                let recording = client.stop_recording(name).await?;
                output.success(&format!("recording `{}` is done", recording.name));
                print(&recording)?;
            }
            RecordCommand::List => {
                let all = client.list_recordings().await?;
                output.print(|| json::messages("Recording", &all), || text(&all))?;
            }
            RecordCommand::Get { name, file } => {
                let path = file.unwrap_or_else(|| PathBuf::from(&name).with_extension("mcap"));
                let mut pieces = client.get_recording(&name).await?;
                let cannot_write = || format!("cannot write {}", path.display());
                let mut file = BufWriter::new(File::create(&path).with_context(cannot_write)?);
                let mut bytes = 0;
                while let Some(piece) = pieces.next().await? {
                    file.write_all(&piece.data).with_context(cannot_write)?;
                    bytes += piece.data.len();
                }
                file.flush().with_context(cannot_write)?;
                let said = format!("recording `{name}` is in {}: {bytes} bytes", path.display());
                output.done(json!({ "recording": name, "file": path, "bytes": bytes }), &said)?;
            }
            RecordCommand::Delete { name } => {
                client.delete_recording(&name).await?;
                let said = format!("recording `{name}` is deleted");
                output.done(json!({ "deleted": { "recording": name } }), &said)?;
            }
        }
        Ok(())
    }
}

/// Recordings as a table, with the reasons of those that failed.
fn text(recordings: &[v1::Recording]) -> Page {
    let row = |r: &v1::Recording| {
        let status = match r.status() {
            v1::RecordingStatus::Unspecified => "-",
            v1::RecordingStatus::Active => "active",
            v1::RecordingStatus::Done => "done",
            v1::RecordingStatus::Failed => "failed",
        };
        let plant = if r.plant.is_empty() { "-" } else { &r.plant };
        vec![
            Cell::from(r.name.as_str()),
            plant.into(),
            status.into(),
            r.steps.into(),
            r.lost.into(),
            r.bytes.into(),
        ]
    };
    let head = ["recording", "plant", "status", "steps", "lost", "bytes"];
    let mut text = Page::from(table(&head, recordings.iter().map(row)));
    for recording in recordings.iter().filter(|recording| !recording.failure.is_empty()) {
        let _ = writeln!(text, "{}: {}", recording.name, recording.failure);
    }
    text
}
