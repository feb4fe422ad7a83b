//! `set-parameter`: numbers of a plant's scene.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::input::numbers::{Assignment, assignment};
use crate::output::page::Page;
use crate::output::plant;
use crate::server::context::Context;

/// Changes numbers of a plant's scene, or its time step, while it runs.
#[derive(Debug, Args)]
pub(crate) struct SetParameter {
    /// Plant.
    id: String,
    /// Where a number stands, and its value: `gravity[1]=-1.6`, `frames[pole].body.mass=2`.
    #[arg(value_name = "PATH=VALUE", value_parser = assignment, required_unless_present = "dt")]
    parameters: Vec<Assignment>,
    /// Time step, seconds.
    #[arg(long, value_name = "SECONDS", visible_alias = "time-step", alias = "time-step-s")]
    dt: Option<f64>,
}

impl SetParameter {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let parameter = |Assignment(path, value)| v1::Parameter { path, value };
        let request = v1::SetParametersRequest {
            id: self.id,
            parameters: self.parameters.into_iter().map(parameter).collect(),
            time_step_s: self.dt.unwrap_or(0.0),
        };
        let plant = client.set_parameters(request).await?;
        context.output.success(&format!("plant `{}` has them from its next step on", plant.id));
        context.output.message("PlantInfo", &plant, || {
            let mut page = Page::from(plant::list(std::slice::from_ref(&plant)));
            page.append(plant::parameters(&plant));
            page
        })
    }
}
