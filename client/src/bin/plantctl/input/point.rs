//! Points of a model's map, and states in which a plant starts.

use anyhow::Result;
use clap::Args;
use plantd_client::{Client, operating_point, present_state, v1};

use crate::contract::names;
use crate::input::numbers::{Vector, vector};
use crate::input::settings::Settings;
use crate::server::context::{model_of, plant};

/// The operating point that every model has.
const INITIAL: &str = "initial";

/// Where a plant starts; the scene's initial configuration at rest if nothing is given.
#[derive(Debug, Args)]
pub(crate) struct Initial {
    /// Operating point of the scene, at rest.
    #[arg(long, value_name = "POINT", conflicts_with_all = ["q", "velocity", "p"])]
    at: Option<String>,
    /// Configuration, comma-separated, dynamic coordinates first; or some of it, `theta=0.1,x=0`.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    q: Option<Vector>,
    /// Velocity of all coordinates, comma-separated; zero if only `--q` is given.
    #[arg(long, visible_alias = "v", requires = "q", conflicts_with = "p", value_parser = vector, allow_hyphen_values = true)]
    velocity: Option<Vector>,
    /// Discrete momentum of the dynamic coordinates, comma-separated.
    #[arg(long, requires = "q", value_parser = vector, allow_hyphen_values = true)]
    p: Option<Vector>,
}

/// Whose coordinates are named.
#[derive(Clone, Copy)]
pub(crate) enum Of<'a> {
    /// A model by its name.
    Model(&'a str),
    /// The model of a plant by its id.
    Plant(&'a str),
}

impl Initial {
    /// The initial state. Coordinates that `--q` does not name are those of the scene, velocities and momenta that
    /// are not named are zero.
    pub(crate) async fn resolve(
        self,
        client: &Client,
        of: Of<'_>,
    ) -> Result<Option<v1::InitialState>> {
        use v1::initial_state::{Form, Momentum, Velocity};
        let Self { at, q, velocity, p } = self;
        let has_names = [&q, &velocity, &p].into_iter().flatten().any(Vector::is_named);
        let model = match of {
            _ if !has_names => v1::Model::default(),
            Of::Model(name) => client.get_model(name).await?,
            Of::Plant(id) => model_of(client, id).await?,
        };
        let form = match (at, q) {
            (Some(point), _) => Form::OperatingPoint(point),
            (None, None) => return Ok(None),
            (None, Some(q)) => {
                let names = names::coordinates(&model);
                let initial: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
                let q = q.over("q", &names, &initial)?;
                match p {
                    Some(p) => {
                        let dynamic: Vec<_> = names::dynamic(&model).collect();
                        let p = p.over("p", &dynamic, &[])?;
                        Form::Momentum(Momentum { q, p, v: Vec::new() })
                    }
                    None => {
                        let rest = Vector::All(vec![0.0; q.len()]);
                        let v = velocity.unwrap_or(rest).over("velocity", &names, &[])?;
                        Form::Velocity(Velocity { q, v })
                    }
                }
            }
        };
        Ok(Some(v1::InitialState { form: Some(form) }))
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

/// The configuration of an option; none if it was not given. Coordinates that it does not name are those of the
/// operating point.
pub(crate) async fn configuration(
    client: &Client,
    q: Option<&Vector>,
    model: &v1::Model,
    at: &str,
) -> Result<Vec<f64>> {
    let rest = match q {
        None => return Ok(Vec::new()),
        Some(q) if q.is_named() && at != INITIAL => {
            let request = v1::LinearizeRequest {
                model: model.name.clone(),
                point: Some(operating_point(at)),
                ..Default::default()
            };
            client.linearize(request).await?.state.unwrap_or_default().q
        }
        Some(_) => model.coordinates.iter().map(|c| c.initial).collect(),
    };
    q.map_or_else(|| Ok(Vec::new()), |q| q.over("q", &names::coordinates(model), &rest))
}

/// The space on which a constrained model is looked at.
pub(crate) fn space(full: bool) -> v1::ConstraintHandling {
    if full { v1::ConstraintHandling::Full } else { v1::ConstraintHandling::Manifold }
}
