//! Points of a model's map, and states in which a plant starts.

use anyhow::Result;
use clap::Args;
use plantd_client::{Client, operating_point, present_state, v1};

use crate::input::numbers::{Numbers, numbers};
use crate::input::settings::Settings;
use crate::server::context::plant;

/// Where a plant starts; the scene's initial configuration at rest if nothing is given.
#[derive(Debug, Args)]
pub(crate) struct Initial {
    /// Operating point of the scene, at rest.
    #[arg(long, value_name = "POINT", conflicts_with_all = ["q", "velocity", "p"])]
    at: Option<String>,
    /// Configuration, comma-separated, dynamic coordinates first.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    q: Option<Numbers>,
    /// Velocity of all coordinates, comma-separated; zero if only `--q` is given.
    #[arg(long, visible_alias = "v", requires = "q", conflicts_with = "p", value_parser = numbers, allow_hyphen_values = true)]
    velocity: Option<Numbers>,
    /// Discrete momentum of the dynamic coordinates, comma-separated.
    #[arg(long, requires = "q", value_parser = numbers, allow_hyphen_values = true)]
    p: Option<Numbers>,
}

impl From<Initial> for Option<v1::InitialState> {
    fn from(initial: Initial) -> Self {
        use v1::initial_state::{Form, Momentum, Velocity};
        let form = match initial {
            Initial { at: Some(point), .. } => Form::OperatingPoint(point),
            Initial { q: Some(q), p: Some(p), .. } => {
                Form::Momentum(Momentum { q: q.0, p: p.0, v: Vec::new() })
            }
            Initial { q: Some(q), velocity, .. } => {
                let rest = || vec![0.0; q.0.len()];
                let v = velocity.map_or_else(rest, |v| v.0);
                Form::Velocity(Velocity { q: q.0, v })
            }
            _ => return None,
        };
        Some(v1::InitialState { form: Some(form) })
    }
}

/// A model, how it is stepped, and a point of its map.
#[derive(Debug, Args)]
pub(crate) struct Point {
    /// Name of a model.
    #[arg(required_unless_present = "plant")]
    model: Option<String>,
    /// Operating point.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    at: String,
    /// Instead: the model, the settings and the present state of this plant.
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at", "Settings"])]
    plant: Option<String>,
    #[command(flatten)]
    settings: Settings,
}

impl Point {
    /// The model, the settings and the point that the command line names.
    pub(crate) async fn resolve(
        self,
        client: &Client,
    ) -> Result<(v1::Model, v1::PlantSettings, v1::Point)> {
        let Some(id) = self.plant else {
            let model = client.get_model(self.model.unwrap_or_default()).await?;
            return Ok((model, self.settings.into(), operating_point(self.at)));
        };
        let plant = plant(client, &id).await?;
        let model = client.get_model(plant.model).await?;
        Ok((model, plant.settings.unwrap_or_default(), present_state(plant.id)))
    }
}

/// The space on which a constrained model is looked at.
pub(crate) fn space(full: bool) -> v1::ConstraintHandling {
    if full { v1::ConstraintHandling::Full } else { v1::ConstraintHandling::Manifold }
}
