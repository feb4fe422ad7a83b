//! `lqr`: the regulator about an equilibrium.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::input::point::{Point, space};
use crate::input::weights::RegulatorWeights;
use crate::output::derivatives;
use crate::output::text::number;
use crate::server::context::Context;

/// Solves the infinite-horizon linear-quadratic regulator about an equilibrium.
#[derive(Debug, Args)]
pub(crate) struct Lqr {
    #[command(flatten)]
    point: Point,
    #[command(flatten)]
    weights: RegulatorWeights,
    /// Solve on the full state of a constrained model instead of on its manifold.
    #[arg(long)]
    full: bool,
}

impl Lqr {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (model, settings, point) = self.point.resolve(&client).await?;
        let request = v1::SolveLqrRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
            weights: Some(self.weights.for_model(&model)?),
            constraints: space(self.full).into(),
        };
        let answer = client.solve_lqr(request).await?;
        context.output.message("SolveLqrResponse", &answer, || {
            let gain = answer.gain.as_ref().map(|g| derivatives::gain(g, &model));
            let mut page = gain.unwrap_or_default();
            let _ = write!(
                page,
                "\nspectral radius of the closed loop: {}\nRiccati residual: {}\n",
                number(answer.spectral_radius),
                number(answer.residual),
            );
            page
        })
    }
}
