//! `kalman`: the filter about an equilibrium.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Numbers, numbers};
use crate::input::point::{Point, space};
use crate::output::text::{matrix, number};
use crate::server::context::Context;

/// Solves the steady-state Kalman filter about an equilibrium.
#[derive(Debug, Args)]
pub(crate) struct Kalman {
    #[command(flatten)]
    point: Point,
    /// What is measured, comma-separated entries of x such as `theta` or `p(theta)`; all if not
    /// given.
    #[arg(long, value_delimiter = ',')]
    outputs: Vec<String>,
    /// Variances of the measurements' noise, comma-separated; one number stands for all.
    #[arg(long, value_name = "R", value_parser = numbers, default_value = "1")]
    measurement: Numbers,
    /// Variances of the state's noise per step, comma-separated; one number stands for all.
    #[arg(long, value_name = "Q", value_parser = numbers)]
    process: Option<Numbers>,
    /// Variances of the inputs' noise, comma-separated; one number stands for all.
    #[arg(long, value_name = "W", value_parser = numbers)]
    input: Option<Numbers>,
    /// Solve on the full state of a constrained model instead of on its manifold.
    #[arg(long)]
    full: bool,
}

impl Kalman {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Self { point, outputs, measurement, process, input, full } = self;
        let (model, settings, point) = point.resolve(&client).await?;
        let (states, inputs) = (names::state(&model).len(), names::input(&model).len());
        let count = if outputs.is_empty() { states } else { outputs.len() };
        let request = v1::SolveKalmanRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
            measurement: Some(v1::Measurement { outputs, ..Default::default() }),
            noise: Some(v1::NoiseCovariances {
                process: process.map(|p| p.diagonal(states)),
                input: input.map(|i| i.diagonal(inputs)),
                measurement: Some(measurement.diagonal(count)),
            }),
            constraints: space(full).into(),
        };
        let answer = client.solve_kalman(request).await?;
        context.output.message("SolveKalmanResponse", &answer, || text(&answer, &model))
    }
}

/// A steady-state Kalman filter.
fn text(answer: &v1::SolveKalmanResponse, model: &v1::Model) -> String {
    let gain = answer.gain.as_ref();
    let gain = gain.map(|l| matrix("L", l, &names::state(model), &answer.outputs));
    let radius = answer.error_modes.iter().map(|z| z.real.hypot(z.imaginary)).fold(0.0, f64::max);
    format!(
        "x = x_predicted + L (y - C x_predicted)\n\n{}\nspectral radius of the error: {}\nRiccati \
         residual: {}\n",
        gain.unwrap_or_default(),
        number(radius),
        number(answer.residual),
    )
}
