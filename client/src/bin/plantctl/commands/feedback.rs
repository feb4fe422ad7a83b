//! `feedback` and `gains`: regulators that the server keeps for a plant.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::{Args, Subcommand, ValueEnum};
use plantd_client::{Client, operating_point, present_state, v1};
use serde_json::json;

use crate::contract::names;
use crate::input::files::read_result;
use crate::input::point::space;
use crate::input::weights::RegulatorWeights;
use crate::output::page::{Page, matrix};
use crate::output::plant::{feedback, listed};
use crate::output::printer::Output;
use crate::server::context::{Context, for_each, model_of, plant};

/// Gives a plant a reference with its regulator, or takes it away.
#[derive(Debug, Args)]
pub(crate) struct Feedback {
    #[command(subcommand)]
    command: FeedbackCommand,
}

#[derive(Debug, Subcommand)]
enum FeedbackCommand {
    Set(Box<Set>),
    /// Takes the feedback away.
    Clear {
        /// Plant.
        id: String,
    },
}

/// Sets the feedback: about an operating point, where the plant is now, or along a trajectory.
#[derive(Debug, Args)]
struct Set {
    /// Plant.
    id: String,
    #[command(flatten)]
    reference: Reference,
    #[command(flatten)]
    weights: RegulatorWeights,
    /// Solve on the full state of a constrained model instead of on its manifold.
    #[arg(long)]
    full: bool,
    /// What it does in the plant's own loop.
    #[arg(long, default_value = "watch-only")]
    mode: Mode,
    /// Step of the plant at which a trajectory begins; the present one if not given.
    #[arg(long, value_name = "STEP", requires = "trajectory")]
    first_step: Option<u64>,
    /// Bounds of entries of x - x_reference, for the mode `guard`; an end may be left out.
    #[arg(long, num_args = 1.., value_name = "ENTRY=MIN:MAX", value_parser = bound)]
    guard: Vec<v1::Bound>,
}

/// What a feedback keeps a plant at.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct Reference {
    /// Operating point of the plant's scene.
    #[arg(long, value_name = "POINT")]
    at: Option<String>,
    /// Where the plant is now.
    #[arg(long)]
    here: bool,
    /// The trajectory of this file: a result of `optimize --save`.
    #[arg(long, value_name = "FILE")]
    trajectory: Option<PathBuf>,
}

/// What a feedback does in the plant's own loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Mode {
    /// Nothing: the gains are for those who watch them.
    WatchOnly,
    /// u = law; what the driver sends is not used.
    Replace,
    /// u = law + what the driver sends.
    Add,
    /// u = law once an entry has left its bounds.
    Guard,
}

impl From<Mode> for v1::FeedbackMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::WatchOnly => Self::WatchOnly,
            Mode::Replace => Self::Replace,
            Mode::Add => Self::Add,
            Mode::Guard => Self::Guard,
        }
    }
}

/// Prints the gains of a plant's feedback. Ends with Ctrl-C or after `--count`.
#[derive(Debug, Args)]
pub(crate) struct Gains {
    /// Plant.
    id: String,
    /// End after this many messages.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

impl Feedback {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        match self.command {
            FeedbackCommand::Set(set) => set.run(&client, &context.output).await,
            FeedbackCommand::Clear { id } => {
                let had = plant(&client, &id).await?.feedback;
                client.clear_feedback(&id).await?;
                if had.is_none() {
                    context.output.nothing_to_do(&format!("plant `{id}` has no feedback"));
                }
                let said = format!("plant `{id}` has no feedback any more");
                context.output.confirm(had.is_some(), json!({ "cleared": { "plant": id } }), &said)
            }
        }
    }
}

impl Set {
    async fn run(self, client: &Client, output: &Output) -> Result<()> {
        use v1::set_feedback_request::Reference as Form;
        let form = match self.reference {
            Reference { trajectory: Some(file), .. } => {
                let checkpoint = read_result(&file)?.checkpoint.unwrap_or_default();
                Form::Trajectory(checkpoint.trajectory.context("no trajectory in the file")?)
            }
            Reference { at: Some(name), .. } => Form::Point(operating_point(name)),
            Reference { .. } => Form::Point(present_state(&self.id)),
        };
        let model = model_of(client, &self.id).await?;
        let request = v1::SetFeedbackRequest {
            id: self.id,
            weights: Some(self.weights.for_model(&model)?),
            constraints: space(self.full).into(),
            mode: v1::FeedbackMode::from(self.mode).into(),
            first_step: self.first_step,
            guard: self.guard,
            reference: Some(form),
            ..Default::default()
        };
        let said = format!("plant `{}` has a feedback", request.id);
        let info = client.set_feedback(request).await?;
        output.success(&said);
        output.message("FeedbackInfo", &info, || feedback(&info))
    }
}

impl Gains {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let model = model_of(&client, &self.id).await?;
        for_each(client.watch_gains(self.id).await?, self.count, |message| {
            context.output.message("WatchGainsResponse", &message, || watched(&message, &model))
        })
        .await
    }
}

/// Reads `entry=min:max`, of which an end may be left out.
fn bound(text: &str) -> Result<v1::Bound, String> {
    let (entry, ends) =
        text.split_once('=').ok_or("an entry and its bounds with `=` are needed")?;
    let (min, max) = ends.split_once(':').ok_or("two ends with `:` between are needed")?;
    let end = |text: &str| match text.trim() {
        "" => Ok(None),
        text => text.parse().map(Some).map_err(|_| format!("`{text}` is not a number")),
    };
    Ok(v1::Bound { entry: entry.trim().to_owned(), min: end(min)?, max: end(max)? })
}

/// One message of a stream of gains.
fn watched(message: &v1::WatchGainsResponse, model: &v1::Model) -> Page {
    let mut text = Page::default();
    if let Some(failure) = &message.failure {
        let _ = writeln!(text, "{}: {}", failure.reason, failure.message);
    }
    if let Some(law) = &message.gain {
        let _ = writeln!(text, "from step {} on, revision {}", law.step, message.revision);
        let (x, u) = (names::state(model), names::input(model));
        let lines = [
            ("x_reference", &x, &law.x_reference),
            ("u_reference", &u, &law.u_reference),
            ("feedforward", &u, &law.feedforward),
        ];
        for (name, entries, values) in lines.into_iter().filter(|(.., values)| !values.is_empty()) {
            let _ = writeln!(text, "  {name}: {}", listed(entries, values));
        }
        if let Some(k) = &law.k {
            text.table(matrix("K", k, &u, &x));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_of_a_bound_may_be_left_out() {
        let both = bound("p(theta)=-1:2").unwrap();
        assert_eq!((both.entry.as_str(), both.min, both.max), ("p(theta)", Some(-1.0), Some(2.0)));
        assert_eq!(bound("theta=:3").unwrap().min, None);
        assert!(bound("theta=3").is_err() && bound("theta=a:3").unwrap_err().contains("`a`"));
    }
}
