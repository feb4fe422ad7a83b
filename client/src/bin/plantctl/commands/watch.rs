//! `watch`: what a plant does while somebody drives it.

use anyhow::Result;
use clap::{Args, ValueEnum};
use plantd_client::{Client, v1};

use crate::contract::names;
use crate::input::weights::RegulatorWeights;
use crate::output::page::Page;
use crate::output::text::numbers;
use crate::output::{derivatives, plant};
use crate::server::context::{Context, for_each, model_of};

/// Prints what a plant does while somebody drives it. Ends with Ctrl-C or after `--count`.
#[derive(Debug, Args)]
pub(crate) struct Watch {
    /// Plant.
    id: String,
    /// What to print.
    #[arg(long, value_delimiter = ',', default_value = "state")]
    fields: Vec<Field>,
    /// Only steps divisible by this.
    #[arg(long, default_value_t = 1)]
    every: u32,
    /// Coordinates to print, comma-separated; all if not given.
    #[arg(long, value_delimiter = ',')]
    coordinates: Vec<String>,
    /// End after this many messages.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// At most this many messages a second; the latest state wins.
    #[arg(long, value_name = "HZ", default_value_t = 0.0, hide_default_value = true)]
    at_most_hz: f64,
    /// Messages that may wait to be printed; of more, the oldest are lost.
    #[arg(long, value_name = "N", default_value_t = 1)]
    queue: u32,
    #[command(flatten)]
    weights: RegulatorWeights,
}

/// What a watch prints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Field {
    State,
    Report,
    Energy,
    Linearization,
    Gain,
    Input,
    Outputs,
    Poses,
    Poles,
}

impl From<Field> for v1::WatchField {
    fn from(field: Field) -> Self {
        match field {
            Field::State => Self::State,
            Field::Report => Self::Report,
            Field::Energy => Self::Energy,
            Field::Linearization => Self::Linearization,
            Field::Gain => Self::Gain,
            Field::Input => Self::Input,
            Field::Outputs => Self::Outputs,
            Field::Poses => Self::Poses,
            Field::Poles => Self::Poles,
        }
    }
}

impl Watch {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Self { id, fields, every, coordinates, count, at_most_hz, queue, weights } = self;
        let frames = match fields.contains(&Field::Poses) {
            true => drawn(&client, &id).await?,
            false => Vec::new(),
        };
        let has_gain = fields.contains(&Field::Gain);
        let mut model = match has_gain {
            true => model_of(&client, &id).await?,
            false => context.names_of(&client, &id).await?,
        };
        let request = v1::WatchRequest {
            fields: fields.into_iter().map(|f| v1::WatchField::from(f).into()).collect(),
            weights: has_gain.then(|| weights.for_model(&model)).transpose()?,
            id,
            every,
            coordinates,
            queue,
            at_most_hz,
        };
        if !request.coordinates.is_empty() {
            model.coordinates.retain(|c| request.coordinates.contains(&c.name));
        }
        for_each(client.watch(request).await?, count, |message| {
            context.output.message("WatchResponse", &message, || watched(&message, &model, &frames))
        })
        .await
    }
}

/// Names of the frames whose poses a watch prints.
async fn drawn(client: &Client, id: &str) -> Result<Vec<String>> {
    let of = Some(v1::get_drawing_request::Of::Plant(id.to_owned()));
    let drawing = client.get_drawing(v1::GetDrawingRequest { of }).await?.drawing;
    Ok(drawing.unwrap_or_default().frames.into_iter().map(|frame| frame.name).collect())
}

/// Where frames are, and their orientations.
fn poses(poses: &v1::Poses, frames: &[String]) -> String {
    let each = frames.iter().zip(poses.frames.chunks_exact(7));
    each.map(|(name, pose)| {
        format!("  {name}: at {}  turned {}\n", numbers(&pose[..3]), numbers(&pose[3..]))
    })
    .collect()
}

fn poles(poles: &v1::Poles) -> String {
    let line = |what: &str, poles: &[v1::Complex]| {
        let pole = |z: &v1::Complex| format!("{:.6}{:+.6}i", z.real, z.imaginary);
        let poles: Vec<String> = poles.iter().map(pole).collect();
        (!poles.is_empty()).then(|| format!("  {what}: {}\n", poles.join("  ")))
    };
    let lines = [line("poles", &poles.open_loop), line("closed loop", &poles.closed_loop)];
    lines.into_iter().flatten().collect()
}

/// A message of a watch as text.
fn watched(message: &v1::WatchResponse, model: &v1::Model, frames: &[String]) -> Page {
    let head = match &message.state {
        Some(state) => plant::state(state, model),
        None => format!("step {}\n", message.step).into(),
    };
    let lost = (message.dropped > 0).then(|| format!("  {} messages lost\n", message.dropped));
    let failure = message.failure.as_ref().map(|f| format!("  {}: {}\n", f.reason, f.message));
    let u = || plant::listed(&names::input(model), &message.u);
    let input = (!message.u.is_empty()).then(|| format!("  u: {}\n", u()));
    let parts: [Option<Page>; 11] = [
        Some(head),
        input.map(Page::from),
        message.outputs.as_ref().map(|o| plant::outputs(o).into()),
        message.report.as_ref().map(|r| plant::report(r).into()),
        message.energy.as_ref().map(|e| plant::energy(e).into()),
        message.linearization.as_ref().map(|l| derivatives::linearization(l, model)),
        message.gain.as_ref().map(|g| derivatives::gain(g, model)),
        message.poses.as_ref().map(|p| poses(p, frames).into()),
        message.poles.as_ref().map(|p| poles(p).into()),
        failure.map(Page::from),
        lost.map(Page::from),
    ];
    parts.into_iter().flatten().collect()
}
