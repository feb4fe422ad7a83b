//! `dynamics`: accelerations of continuous time.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Numbers, numbers, or_empty};
use crate::output::derivatives::slices;
use crate::output::text::{matrix, number, table};
use crate::server::context::Context;

/// Accelerations and constraint forces of continuous time, and their derivatives.
#[derive(Debug, Args)]
pub(crate) struct Dynamics {
    /// Name of a model.
    model: String,
    /// Operating point whose configuration and inputs hold where others are not given.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    at: String,
    /// Configuration, comma-separated, dynamic coordinates first.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    q: Option<Numbers>,
    /// Velocity, comma-separated; zero if not given.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    v: Option<Numbers>,
    /// Input forces, comma-separated.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    inputs: Option<Numbers>,
    /// Accelerations of the prescribed coordinates, comma-separated; zero if not given.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    prescribed_acceleration: Option<Numbers>,
    /// Highest order of the derivatives to print.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(0..=2))]
    order: u32,
}

impl Dynamics {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let model = client.get_model(&self.model).await?;
        let request = v1::EvaluateDynamicsRequest {
            model: self.model,
            operating_point: self.at,
            q: or_empty(self.q),
            v: or_empty(self.v),
            inputs: or_empty(self.inputs),
            prescribed_acceleration: or_empty(self.prescribed_acceleration),
            order: self.order,
        };
        let answer = client.evaluate_dynamics(request).await?;
        context.output.message("EvaluateDynamicsResponse", &answer, || text(&answer, &model))
    }
}

/// Accelerations, constraint forces, and their derivatives where there are any.
fn text(answer: &v1::EvaluateDynamicsResponse, model: &v1::Model) -> String {
    let all = || model.coordinates.iter();
    let dynamic: Vec<_> = names::dynamic(model).cloned().collect();
    let forces = answer.multipliers.iter().zip(&model.constraints);
    let rows: Vec<_> = answer
        .acceleration
        .iter()
        .zip(&dynamic)
        .map(|(value, name)| vec![format!("d²({name})/dt²"), number(*value)])
        .chain(forces.map(|(value, name)| vec![format!("λ({name})"), number(*value)]))
        .collect();
    let mut text = table(&["", "value"], &rows);
    let outputs: Vec<_> = dynamic.iter().chain(&model.constraints).cloned().collect();
    let rates = all().map(|c| format!("d({})/dt", c.name));
    let accelerations = names::prescribed(model).map(|name| format!("d²({name})/dt²"));
    let parameters: Vec<_> = all()
        .map(|c| c.name.clone())
        .chain(rates)
        .chain(model.inputs.iter().cloned())
        .chain(accelerations)
        .collect();
    if let Some(jacobian) = &answer.jacobian {
        let _ = write!(text, "\n{}", matrix("derivatives", jacobian, &outputs, &parameters));
    }
    if answer.hessian.is_some() {
        let hessian = slices(
            "second derivatives",
            answer.hessian.as_ref(),
            &outputs,
            &parameters,
            &parameters,
        );
        let _ = write!(text, "\n{hessian}");
    }
    text
}
