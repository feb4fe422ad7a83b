//! `dynamics`: accelerations of continuous time.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Vector, given, vector};
use crate::input::point::configuration;
use crate::output::derivatives::slices;
use crate::output::page::{Cell, Page, matrix, table};
use crate::server::context::Context;

/// Accelerations and constraint forces of continuous time, and their derivatives.
#[derive(Debug, Args)]
pub(crate) struct Dynamics {
    /// Name of a model.
    model: String,
    /// Operating point whose configuration and inputs hold where others are not given.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    at: String,
    /// Configuration, comma-separated, dynamic coordinates first; or some of it, `theta=0.1`.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    q: Option<Vector>,
    /// Velocity, comma-separated or by name; zero if not given.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    v: Option<Vector>,
    /// Input forces, comma-separated or by name.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    inputs: Option<Vector>,
    /// Accelerations of the prescribed coordinates, comma-separated or by name; zero if not given.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    prescribed_acceleration: Option<Vector>,
    /// Highest order of the derivatives to print.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(0..=2))]
    order: u32,
}

impl Dynamics {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let model = client.get_model(&self.model).await?;
        let request = v1::EvaluateDynamicsRequest {
            q: configuration(&client, self.q.as_ref(), &model, &self.at).await?,
            v: given(self.v.as_ref(), "v", &names::coordinates(&model))?,
            inputs: given(self.inputs.as_ref(), "inputs", &model.inputs)?,
            prescribed_acceleration: given(
                self.prescribed_acceleration.as_ref(),
                "prescribed-acceleration",
                &names::prescribed(&model).collect::<Vec<_>>(),
            )?,
            model: self.model,
            operating_point: self.at,
            order: self.order,
        };
        let answer = client.evaluate_dynamics(request).await?;
        context.output.message("EvaluateDynamicsResponse", &answer, || text(&answer, &model))
    }
}

/// Accelerations, constraint forces, and their derivatives where there are any.
fn text(answer: &v1::EvaluateDynamicsResponse, model: &v1::Model) -> Page {
    let all = || model.coordinates.iter();
    let dynamic: Vec<_> = names::dynamic(model).cloned().collect();
    let forces = answer.multipliers.iter().zip(&model.constraints);
    let rows = answer
        .acceleration
        .iter()
        .zip(&dynamic)
        .map(|(value, name)| vec![Cell::from(format!("d²({name})/dt²")), (*value).into()])
        .chain(forces.map(|(value, name)| vec![format!("λ({name})").into(), (*value).into()]));
    let mut text = Page::from(table(&["", "value"], rows));
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
        text.next_table(matrix("derivatives", jacobian, &outputs, &parameters));
    }
    if answer.hessian.is_some() {
        let hessian = slices(
            "second derivatives",
            answer.hessian.as_ref(),
            &outputs,
            &parameters,
            &parameters,
        );
        hessian.into_iter().for_each(|slice| text.next_table(slice));
    }
    text
}
