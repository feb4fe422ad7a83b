//! `kalman`: the filter about an equilibrium.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Vector, vector};
use crate::input::point::{Point, space};
use crate::output::page::{Page, matrix};
use crate::output::text::number;
use crate::server::context::Context;

/// Solves the steady-state Kalman filter about an equilibrium.
#[derive(Debug, Args)]
pub(crate) struct Kalman {
    #[command(flatten)]
    point: Point,
    /// What is measured, comma-separated: entries of x such as `theta` or `p(theta)`, velocities `v(theta)`; all
    /// of x if not given.
    #[arg(long, value_delimiter = ',')]
    outputs: Vec<String>,
    /// Variances of the measurements' noise, comma-separated, one number stands for all; or some by name.
    #[arg(long, value_name = "R", value_parser = vector, default_value = "1")]
    measurement: Vector,
    /// Variances of the state's noise per step, comma-separated, one number stands for all; those that are not
    /// named, `theta=1e-6`, are 0.
    #[arg(long, value_name = "Q", value_parser = vector)]
    process: Option<Vector>,
    /// Variances of the inputs' noise, in the same way.
    #[arg(long, value_name = "W", value_parser = vector)]
    input: Option<Vector>,
    /// Solve on the full state of a constrained model instead of on its manifold.
    #[arg(long)]
    full: bool,
}

impl Kalman {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Self { point, outputs, measurement, process, input, full } = self;
        let (model, settings, point) = point.resolve(&client).await?;
        let (states, inputs) = (names::state(&model), names::input(&model));
        let measured = if outputs.is_empty() { states.clone() } else { outputs.clone() };
        let process = process.map(|p| p.diagonal("process", &states, 0.0)).transpose()?;
        let input = input.map(|i| i.diagonal("input", &inputs, 0.0)).transpose()?;
        let measurement = measurement.diagonal("measurement", &measured, 1.0)?;
        let request = v1::SolveKalmanRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
            measurement: Some(v1::Measurement { outputs, ..Default::default() }),
            noise: Some(v1::NoiseCovariances { process, input, measurement: Some(measurement) }),
            constraints: space(full).into(),
        };
        let answer = client.solve_kalman(request).await?;
        context.output.message("SolveKalmanResponse", &answer, || text(&answer, &model))
    }
}

/// A steady-state Kalman filter.
fn text(answer: &v1::SolveKalmanResponse, model: &v1::Model) -> Page {
    let radius = answer.error_modes.iter().map(|z| z.real.hypot(z.imaginary)).fold(0.0, f64::max);
    let mut page = Page::from("x = x_predicted + L (y - C x_predicted)\n".to_owned());
    let gain = answer.gain.iter();
    gain.for_each(|l| page.next_table(matrix("L", l, &names::state(model), &answer.outputs)));
    let (radius, residual) = (number(radius), number(answer.residual));
    let _ =
        write!(page, "\nspectral radius of the error: {radius}\nRiccati residual: {residual}\n");
    page
}
