//! `analyze`: ranks, modes and responses of the linearized map.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Numbers, numbers, or_empty};
use crate::input::point::{Point, space};
use crate::output::page::{Page, matrix, table};
use crate::output::text::number;
use crate::server::context::Context;

/// Controllability, observability, modes and frequency response of the linearized map.
#[derive(Debug, Args)]
pub(crate) struct Analyze {
    #[command(flatten)]
    point: Point,
    /// Outputs, comma-separated: entries of x such as `theta` or `p(theta)`, velocities `v(theta)`; all of x if not
    /// given.
    #[arg(long, value_delimiter = ',')]
    outputs: Vec<String>,
    /// Frequencies of the response, comma-separated, Hz.
    #[arg(long, value_name = "HZ", value_parser = numbers)]
    frequencies: Option<Numbers>,
    /// Look at the full state of a constrained model instead of at its manifold.
    #[arg(long)]
    full: bool,
}

impl Analyze {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (model, settings, point) = self.point.resolve(&client).await?;
        let request = v1::AnalyzeRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
            outputs: self.outputs,
            frequencies_hz: or_empty(self.frequencies),
            constraints: space(self.full).into(),
            ..Default::default()
        };
        let answer = client.analyze(request).await?;
        context.output.message("AnalyzeResponse", &answer, || text(&answer, &model))
    }
}

/// Ranks, modes and responses.
fn text(answer: &v1::AnalyzeResponse, model: &v1::Model) -> Page {
    let mut text = Page::from(format!(
        "order {}\ncontrollability rank: {}\nobservability rank: {}\nspectral radius: {}\n",
        answer.order,
        answer.controllability_rank,
        answer.observability_rank,
        number(answer.spectral_radius)
    ));
    // Of a conjugate pair one stands for both.
    let shown = answer.modes.iter().filter(|mode| mode.imaginary >= 0.0);
    let rows = shown.map(|mode| {
        let eigenvalue = match mode.imaginary {
            0.0 => number(mode.real),
            imaginary => format!("{} ± {}i", number(mode.real), number(imaginary)),
        };
        vec![
            eigenvalue,
            number(mode.modulus),
            number(mode.natural_frequency_hz),
            number(mode.damping_ratio),
            number(mode.time_constant_s),
        ]
    });
    let head = ["eigenvalue", "modulus", "frequency/Hz", "damping ratio", "time constant/s"];
    let _ = write!(text, "\n{}", table(&head, rows));
    let numbers = answer.modes.iter().map(|mode| {
        let v1::Mode { real, imaginary, modulus, .. } = *mode;
        let times = [mode.natural_frequency_hz, mode.damping_ratio, mode.time_constant_s];
        [real, imaginary, modulus].into_iter().chain(times).collect()
    });
    let head = ["real", "imaginary", "modulus", "frequency/Hz", "damping ratio", "time constant/s"];
    text.data(table::<f64>(&head, numbers));
    let inputs = names::input(model);
    for response in &answer.responses {
        let title = format!("response at {} Hz", number(response.frequency_hz));
        for (what, block) in
            [("magnitude", &response.magnitude), ("phase, rad", &response.phase_rad)]
        {
            if let Some(block) = block {
                let title = format!("{title}: {what}");
                text.next_table(matrix(&title, block, &answer.outputs, &inputs));
            }
        }
    }
    text
}
