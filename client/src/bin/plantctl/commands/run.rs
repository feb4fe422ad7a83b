//! `run` and `pause`: plants that run by themselves.

use anyhow::Result;
use clap::{Args, ValueEnum};
use plantd_client::{Client, Error, v1};

use crate::contract::names;
use crate::input::numbers::{Vector, vector};
use crate::output::plant::state;
use crate::output::printer::Output;
use crate::server::context::{Context, model_of, plant, resting};

const RUN: &str = "\
Examples:
  plantctl run arm --pace paced                     by the wall clock; its driver's latest input acts
  plantctl run arm --pace paced --speed 0.1         ten times slower
  plantctl run arm --pace paced --timeout 0.05 --action ramp --ramp 0.2 --safe 0,0
  plantctl pause arm
  plantctl run arm -n 1 --wait                      a single step, and wait until it is taken";

/// Runs a plant: by the wall clock, as fast as possible, or in lockstep. `plantctl run ID` goes on
/// after a pause.
#[derive(Debug, Args)]
#[command(after_help = RUN)]
pub(crate) struct Run {
    /// Plant.
    id: String,
    /// Who decides when it takes a step; as before if not given.
    #[arg(long, value_enum)]
    pace: Option<Pace>,
    /// Seconds of the plant's clock in a second of the wall clock.
    #[arg(long, requires = "pace")]
    speed: Option<f64>,
    /// Pause again after this many steps.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Wait until the plant stands still again: the steps are taken, or something has stopped it.
    #[arg(long)]
    wait: bool,
    /// How long an input is valid, seconds on the plant's clock; for ever if not given.
    #[arg(long, value_name = "SECONDS", requires = "pace")]
    timeout: Option<f64>,
    /// What to do without a valid input.
    #[arg(long, value_enum, requires = "pace")]
    action: Option<InputAction>,
    /// Duration of a ramp, seconds on the plant's clock.
    #[arg(long, value_name = "SECONDS", requires = "action")]
    ramp: Option<f64>,
    /// The safe input, comma-separated, or some of it, `tau=0`.
    #[arg(long, value_parser = vector, allow_hyphen_values = true, requires = "pace")]
    safe: Option<Vector>,
    /// Once the safe input acts, it acts until `run` is called again.
    #[arg(long, requires = "pace")]
    latch: bool,
}

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Pace {
    /// The driver, one step for each input.
    Lockstep,
    /// The wall clock.
    Paced,
    /// Nobody: as fast as possible.
    Free,
}

/// What to do without a valid input.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum InputAction {
    /// The last input acts on.
    Hold,
    /// The safe input acts at once.
    Safe,
    /// The safe input acts after a ramp.
    Ramp,
    /// The plant stands still.
    Stop,
}

/// Pauses a plant between two steps.
#[derive(Debug, Args)]
pub(crate) struct Pause {
    /// Plant.
    id: String,
}

impl Run {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Self { id, pace, speed, steps, wait, timeout, action, ramp, safe, latch } = self;
        let pace = pace.map(|pace| match pace {
            Pace::Lockstep => v1::Pace::Lockstep,
            Pace::Paced => v1::Pace::Paced,
            Pace::Free => v1::Pace::Free,
        });
        let has_policy = action.is_some() || timeout.is_some() || safe.is_some() || latch;
        let action = action.map(|action| match action {
            InputAction::Hold => v1::InputAction::Hold,
            InputAction::Safe => v1::InputAction::Safe,
            InputAction::Ramp => v1::InputAction::Ramp,
            InputAction::Stop => v1::InputAction::Stop,
        });
        let safe = match safe {
            None => Vec::new(),
            Some(safe) if safe.is_named() => {
                let model = model_of(&client, &id).await?;
                let rest = resting(&plant(&client, &id).await?, &model);
                safe.over("safe", &names::input(&model), &rest)?
            }
            Some(safe) => safe.over("safe", &[""], &[])?,
        };
        let policy = has_policy.then(|| v1::InputPolicy {
            timeout_s: timeout.unwrap_or(0.0),
            action: action.unwrap_or_default().into(),
            ramp_s: ramp.unwrap_or(0.0),
            safe,
            latch,
        });
        // Without a pace the settings stay as they are.
        let settings = pace.map(|pace| v1::RunSettings {
            pace: pace.into(),
            speed: speed.unwrap_or(0.0),
            input: policy,
        });
        if settings.is_none() && steps.is_none() {
            say_if_it_runs(&client, &context.output, &id).await?;
        }
        let name = id.clone();
        let request = v1::RunRequest { id, settings, steps: steps.unwrap_or(0), wait };
        let run = client.run(request).await?;
        context.output.success(&said(&name, &run));
        context.output.message("RunInfo", &run, String::new)?;
        match run.stopped_by {
            Some(failure) if wait => Err(Error::Rpc(Box::new(failure.into())).into()),
            _ => Ok(()),
        }
    }
}

impl Pause {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let id = self.id;
        let run = plant(&client, &id).await?.run.unwrap_or_default();
        if !run.running {
            context.output.nothing_to_do(&match run.stopped_by {
                Some(failure) => format!("plant `{id}` stands still already: {}", failure.message),
                None => format!("plant `{id}` is paused already"),
            });
        }
        let model = context.names_of(&client, &id).await?;
        let paused = client.pause(&id).await?;
        if run.running {
            context.output.success(&format!("plant `{id}` is paused"));
        }
        let as_text = || paused.state.as_ref().map(|s| state(s, &model)).unwrap_or_default();
        context.output.message("PauseResponse", &paused, as_text)
    }
}

/// What becomes of a plant that was told to run.
fn said(id: &str, run: &v1::RunInfo) -> String {
    let pace = match run.settings.clone().unwrap_or_default().pace() {
        v1::Pace::Unspecified | v1::Pace::Lockstep => "waits for its driver's inputs",
        v1::Pace::Paced => "runs by the wall clock",
        v1::Pace::Free => "runs as fast as it can",
    };
    match (run.running, run.steps_left) {
        (false, _) => format!("plant `{id}` stands still again"),
        (true, 0) => format!("plant `{id}` {pace}"),
        (true, steps) => format!("plant `{id}` {pace} for {steps} steps"),
    }
}

/// `run` without more lets a plant go on that stands still; any other stays as it is.
async fn say_if_it_runs(client: &Client, output: &Output, id: &str) -> Result<()> {
    let plant = plant(client, id).await?;
    let run = plant.run.unwrap_or_default();
    let is_frozen = plant.safety.is_some_and(|safety| safety.frozen.is_some());
    if !run.running || is_frozen || run.steps_left > 0 {
        return Ok(());
    }
    output.nothing_to_do(&match run.settings.unwrap_or_default().pace() {
        v1::Pace::Unspecified | v1::Pace::Lockstep => format!(
            "plant `{id}` is in lockstep, one step for each input of its driver; with `--pace paced` it \
             runs by itself"
        ),
        v1::Pace::Paced | v1::Pace::Free => format!("plant `{id}` runs already"),
    });
    Ok(())
}
