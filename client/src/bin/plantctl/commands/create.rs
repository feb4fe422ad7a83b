//! `create`: a plant of a model.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::input::point::{Initial, Of};
use crate::input::settings::Settings;
use crate::output::page::Page;
use crate::output::plant;
use crate::server::context::Context;

/// Creates a plant.
#[derive(Debug, Args)]
pub(crate) struct Create {
    /// Name of a model.
    model: String,
    /// Id; chosen by the server if not given.
    #[arg(long)]
    id: Option<String>,
    #[command(flatten)]
    settings: Settings,
    /// Choose order and substeps: largest error of a coordinate over the next 50 steps, rad or m.
    #[arg(long, value_name = "ERROR", conflicts_with_all = ["order", "substeps"])]
    tolerance: Option<f64>,
    #[command(flatten)]
    initial: Initial,
    /// Open the shared-memory link at once.
    #[arg(long)]
    link: bool,
    /// Delete it when nobody has used it for so long; 0 means never.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    expires: f64,
}

impl Create {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let initial = self.initial.resolve(&client, Of::Model(&self.model)).await?;
        let tolerance = self.tolerance.unwrap_or(0.0);
        let request = v1::CreatePlantRequest {
            id: self.id.unwrap_or_default(),
            model: self.model,
            settings: Some(v1::PlantSettings { tolerance, ..self.settings.into() }),
            initial,
            open_link: self.link,
            expires_s: self.expires,
            ..Default::default()
        };
        let plant = client.create_plant(request).await?;
        context.output.success(&format!("there is a plant `{}` now", plant.id));
        context.output.message("PlantInfo", &plant, || {
            let mut page = Page::from(plant::list(std::slice::from_ref(&plant)));
            page.append(plant::stepping(&plant));
            page
        })
    }
}
