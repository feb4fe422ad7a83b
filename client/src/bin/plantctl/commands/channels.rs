//! `channels`: sensors and actuators of a plant.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};
use plantd_client::v1;
use serde_json::json;

use crate::input::files::{parse_message, read_text};
use crate::output::page::{Cell, Page, table};
use crate::server::context::Context;

const CHANNELS: &str = "\
The file, in the field names of the contract, TOML or JSON; here for a pendulum:

  seed = 7                          # of all noise and chance

  [[outputs]]
  name = \"encoder\"                  # source -> sampled -> + bias + noise -> quantised -> limited
  coordinate = \"theta\"              #   -> lost at times -> late
  sample_period_s = 0.1
  latency_s = 0.2
  noise = 0.001                     # standard deviation
  quantum = 0.0015
  drop_out = 0.01                   # probability

  [[outputs]]
  name = \"tip\"                      # others: velocity, acceleration, orientation,
  position = { frame = \"rod\", at = [0.0, -1.0, 0.0] }     # constraint_force, input, energy

  [[inputs]]
  input = \"tau\"                     # sampled and held -> late -> dead band -> limited
  delay_s = 0.1                     #   -> rate limited -> quantised
  min = -5.0
  max = 5.0
  max_rate = 50.0

Times become whole steps; the answer says which.";

/// Sensors and actuators of a plant.
#[derive(Debug, Args)]
pub(crate) struct Channels {
    #[command(subcommand)]
    command: ChannelsCommand,
}

#[derive(Debug, Subcommand)]
enum ChannelsCommand {
    /// Declares the channels, in place of those before.
    #[command(after_help = CHANNELS)]
    Set {
        /// Plant.
        id: String,
        /// File; `-` reads standard input.
        file: PathBuf,
    },
    /// Shows the channels with their present numbers.
    Show {
        /// Plant.
        id: String,
    },
    /// Takes the channels away.
    Clear {
        /// Plant.
        id: String,
    },
}

impl Channels {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let output = &context.output;
        match self.command {
            ChannelsCommand::Set { id, file } => {
                let channels: v1::Channels = parse_message("Channels", &read_text(&file)?)?;
                let said = format!(
                    "plant `{id}` has {} output and {} input channels",
                    channels.outputs.len(),
                    channels.inputs.len()
                );
                let answer = client.set_channels(id, channels).await?;
                output.success(&said);
                let outputs = v1::Outputs { y: answer.y.clone(), lost: Vec::new() };
                let as_text = || declared(answer.info.as_ref(), &outputs);
                output.message("SetChannelsResponse", &answer, as_text)
            }
            ChannelsCommand::Show { id } => {
                let answer = client.get_channels(id).await?;
                let outputs = v1::Outputs { y: answer.y.clone(), lost: answer.lost.clone() };
                let as_text = || declared(answer.info.as_ref(), &outputs);
                output.message("GetChannelsResponse", &answer, as_text)
            }
            ChannelsCommand::Clear { id } => {
                let had = client.get_channels(&id).await?.info.and_then(|info| info.channels);
                client.set_channels(&id, v1::Channels::default()).await?;
                let had = had.is_some_and(|had| !(had.outputs.is_empty() && had.inputs.is_empty()));
                if !had {
                    output.nothing_to_do(&format!("plant `{id}` has no channels"));
                }
                let said = format!("plant `{id}` has no channels any more");
                output.confirm(had, json!({ "cleared": { "plant": id } }), &said)
            }
        }
    }
}

/// The outputs with their numbers, and the inputs, a line each.
fn declared(info: Option<&v1::ChannelsInfo>, outputs: &v1::Outputs) -> Page {
    let mut text = Page::default();
    let Some(v1::ChannelsInfo { channels: Some(channels), names }) = info else {
        return "no channels\n".to_owned().into();
    };
    let _ = writeln!(text, "seed {}", channels.seed);
    if !names.is_empty() {
        let row = |(name, y): (&String, &f64)| vec![Cell::from(name.as_str()), (*y).into()];
        text.table(table(&["output", "value"], names.iter().zip(&outputs.y).map(row)));
    }
    for index in &outputs.lost {
        let name = channels.outputs.get(*index as usize).map_or("", |output| &output.name);
        let _ = writeln!(text, "lost: {name}");
    }
    if !channels.inputs.is_empty() {
        let row = |i: &v1::InputChannel| vec![Cell::from(i.input.as_str()), i.delay_s.into()];
        text.table(table(&["input", "delay/s"], channels.inputs.iter().map(row)));
    }
    text
}
