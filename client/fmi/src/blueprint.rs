//! What all instances of an FMU have in common: the mechanism, its settings, its variables.

use std::sync::Arc;

use plantd_models::scene::CoordinateKind;
use plantd_models::{Initial, InitialError, Model, Scene, SceneError, Settings, Spare, fnv1a};

use crate::recipe::Recipe;
use crate::variables::{Variable, tunable, variables};

/// What an FMU is of.
pub(crate) struct Blueprint {
    pub(crate) model: Arc<Model>,
    pub(crate) settings: Settings,
    /// Where it starts if nothing else is asked for.
    pub(crate) initial: Initial,
    pub(crate) start: Start,
    /// Numbers of the scene that can be changed, by path.
    pub(crate) numbers: Vec<(String, f64)>,
    pub(crate) variables: Vec<Variable>,
    /// Version of the library, and a digest of scene and settings.
    pub(crate) token: String,
}

/// Start values of variables.
pub(crate) struct Start {
    pub(crate) q: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) input: Vec<f64>,
}

/// Why a scene and settings are no FMU.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BlueprintError {
    #[error("the scene has errors:\n{0}")]
    Scene(#[from] SceneError),
    #[error("the settings: {0}")]
    Settings(#[from] serde_json::Error),
    #[error("the plant cannot start: {0}")]
    Initial(#[from] InitialError),
    #[error(
        "two variables would be called `{0}`: an input and a prescribed coordinate have one name"
    )]
    SameName(String),
}

impl Blueprint {
    /// Reads a scene, TOML or JSON, and a recipe, JSON.
    pub(crate) fn new(scene: &str, recipe: &str) -> Result<Self, BlueprintError> {
        let digest = fnv1a([scene, "\0", recipe].concat().as_bytes());
        let recipe: Recipe = serde_json::from_str(recipe)?;
        let model = Arc::new(Model::compile(&Scene::from_text(scene)?)?);
        let settings = recipe.settings(&model);
        let initial = match &recipe.at {
            Some(name) => Initial::OperatingPoint(name.clone()),
            None if model.initial_violations().is_empty() => Initial::Scene,
            // The scene's configuration is a guess.
            None => {
                let q = model.coordinates().iter().map(|c| c.initial).collect();
                Initial::Projection { q, hold: Vec::new() }
            }
        };
        let mut plant = Spare::new(Arc::clone(&model), settings)?.start(&initial)?;
        let mut input = vec![0.0; model.dimensions().input()];
        plant.hold_input(&mut input);
        let point =
            model.operating_points().iter().find(|point| Some(&point.name) == recipe.at.as_ref());
        if let Some(point) = point {
            let inputs = model.dimensions().inputs;
            input[..inputs].copy_from_slice(&point.u[..inputs]);
        }
        let start = Start { q: plant.q().to_vec(), velocity: plant.velocity(), input };
        let numbers = tunable(&model);
        let variables = variables(&model, &numbers);
        let token = format!("plantd {} {digest:016x}", env!("CARGO_PKG_VERSION"));
        let blueprint = Self { model, settings, initial, start, numbers, variables, token };
        blueprint.check_names()?;
        Ok(blueprint)
    }

    /// Name that the C interface allows.
    pub(crate) fn identifier(&self) -> String {
        let name = &self.model.scene().name;
        let mut identifier: String =
            name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        if !identifier.starts_with(|first: char| first.is_ascii_alphabetic()) {
            identifier.insert_str(0, "fmu_");
        }
        identifier
    }

    /// Whether a prescribed coordinate is driven by entry `i` of `u`.
    pub(crate) fn prescribed(&self, i: usize) -> Option<usize> {
        let d = self.model.dimensions();
        i.checked_sub(d.inputs).map(|k| d.dynamic + k)
    }

    fn check_names(&self) -> Result<(), BlueprintError> {
        let scene = self.model.scene();
        let prescribed = scene.coordinates.iter().filter(|c| c.kind == CoordinateKind::Prescribed);
        let same =
            prescribed.map(|c| &c.name).find(|name| scene.inputs.iter().any(|i| i.name == **name));
        match same {
            Some(name) => Err(BlueprintError::SameName(format!("u({name})"))),
            None => Ok(()),
        }
    }
}
