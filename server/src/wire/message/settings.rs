//! A plant's scene, settings and changed numbers.

use std::collections::HashMap;
use std::time::Duration;

use plantd_import::{ImportError, Options, Report};
use plantd_models::parameters::Parameters;
use plantd_models::{ForceSplit, Model, Precision, Problem, Scene, SceneError, Settings};
use plantd_proto::v1;

use crate::core::feedback::regulator::Constraints;
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::session::creation::Accuracy;
use crate::wire::status::RpcError;

/// Times for which plants are kept that nobody uses.
const EXPIRY_MIN_S: f64 = 1.0;
const EXPIRY_MAX_S: f64 = 31_536_000.0;

/// A scene, and what became of the robot that it was made of.
pub type Read = (Scene, Option<Report>);

/// Reads a scene, or a robot in another format, within the limits. A faulty one is the inner error.
pub fn scene(
    text: &str,
    format: i32,
    files: &HashMap<String, Vec<u8>>,
    limits: &Limits,
) -> Result<Result<Read, SceneError>, RpcError> {
    LimitExceeded::check("scene_bytes", limits.scene_bytes, "bytes of scene", text.len())?;
    let read = match v1::SceneFormat::try_from(format) {
        Ok(v1::SceneFormat::Unspecified) if plantd_import::is_xml(text) => robot(text, files),
        Ok(v1::SceneFormat::Urdf | v1::SceneFormat::Mjcf) => robot(text, files),
        Ok(v1::SceneFormat::Unspecified) => Scene::from_text(text).map(|scene| (scene, None)),
        Ok(v1::SceneFormat::Toml) => Scene::from_toml(text).map(|scene| (scene, None)),
        Ok(v1::SceneFormat::Json) => Scene::from_json(text).map(|scene| (scene, None)),
        Err(_) => return Err(RpcError::field("format", format!("{format} is not a format"))),
    };
    let (scene, report) = match read {
        Ok(read) => read,
        Err(error) => return Ok(Err(error)),
    };
    for (what, count) in [
        ("frames", scene.frames.len()),
        ("armatures", scene.armatures.len()),
        ("springs", scene.springs.len()),
        ("inputs", scene.inputs.len()),
        ("forces", scene.forces.len()),
        ("signals", scene.signals.len()),
        ("constraints", scene.constraints.len()),
        ("coordinate settings", scene.coordinates.len()),
        ("operating points", scene.operating_points.len()),
    ] {
        LimitExceeded::check("scene_items", limits.scene_items, what, count)?;
    }
    // Every coordinate belongs to a joint or to a setting, so this bounds them before compilation.
    let joints = scene.frames.iter().filter(|frame| frame.joint.is_some()).count();
    LimitExceeded::check("coordinates", limits.coordinates, "joints", joints)?;
    Ok(Ok((scene, report)))
}

fn robot(text: &str, files: &HashMap<String, Vec<u8>>) -> Result<Read, SceneError> {
    let options = Options::default();
    let mut find =
        |name: &str| files.get(name).cloned().ok_or_else(|| "it is not among `files`".to_owned());
    let robot = match files.is_empty() {
        true => plantd_import::import(text, &options),
        false => plantd_import::import_with_files(text, &options, &mut find),
    };
    match robot {
        Ok(robot) => Ok((robot.scene, Some(robot.report))),
        Err(ImportError { problems }) => {
            let problem = |problem: plantd_import::Problem| {
                let place = format!("{}:{}", problem.line, problem.column);
                let is_main = problem.file.is_empty();
                let path = if is_main { place } else { format!("{}:{place}", problem.file) };
                Problem { path, message: problem.message }
            };
            Err(SceneError { problems: problems.into_iter().map(problem).collect() })
        }
    }
}

/// How long a plant is kept that nobody uses; 0 means as long as the server.
pub fn expires(seconds: f64) -> Result<Option<Duration>, RpcError> {
    match seconds {
        0.0 => Ok(None),
        EXPIRY_MIN_S..=EXPIRY_MAX_S => Ok(Some(Duration::from_secs_f64(seconds))),
        _ => {
            let problem = format!(
                "is {seconds}; it must be 0 or lie between {EXPIRY_MIN_S} and {EXPIRY_MAX_S}"
            );
            Err(RpcError::field("expires_s", problem))
        }
    }
}

/// Settings of a plant, with the model's defaults filled in.
pub fn settings(
    settings: Option<v1::PlantSettings>,
    model: &Model,
    limits: &Limits,
) -> Result<Settings, RpcError> {
    let given = settings.unwrap_or_default();
    let mut settings = Settings::new(model);
    if given.time_step_s != 0.0 {
        if !(given.time_step_s.is_finite() && given.time_step_s > 0.0) {
            return Err(RpcError::field(
                "settings.time_step_s",
                "must be finite and greater than zero",
            ));
        }
        settings.time_step_s = given.time_step_s;
    }
    settings.force_split = match v1::ForceSplit::try_from(given.force_split) {
        Ok(v1::ForceSplit::Unspecified | v1::ForceSplit::Symmetric) => ForceSplit::Symmetric,
        Ok(v1::ForceSplit::Paper) => ForceSplit::Paper,
        Err(_) => return Err(RpcError::field("settings.force_split", "is not a force split")),
    };
    if given.max_iterations != 0 {
        let (asked, limit) = (given.max_iterations as usize, limits.max_iterations);
        LimitExceeded::check("max_iterations", limit, "iterations", asked)?;
        settings.max_iterations = given.max_iterations;
    }
    if given.singular_below != 0.0 {
        if !(given.singular_below > 0.0 && given.singular_below < 1.0) {
            return Err(RpcError::field("settings.singular_below", "must lie between 0 and 1"));
        }
        settings.singular_below = given.singular_below;
    }
    if given.order != 0 {
        settings.order = given.order;
    }
    if given.substeps != 0 {
        settings.substeps = given.substeps;
    }
    settings.halvings = given.halvings.unwrap_or(settings.halvings);
    settings.precision = match v1::Precision::try_from(given.precision) {
        Ok(v1::Precision::Unspecified | v1::Precision::Exact) => Precision::Exact,
        Ok(v1::Precision::Fast) => Precision::Fast,
        Ok(v1::Precision::Coarse) => Precision::Coarse,
        Err(_) => return Err(RpcError::field("settings.precision", "is not a precision")),
    };
    if given.tolerance != 0.0 {
        let description = "is for CreatePlant: a method is chosen when a plant is created";
        return Err(RpcError::field("settings.tolerance", description));
    }
    check_method(&settings, model, limits)?;
    Ok(settings)
}

/// Refuses methods that would take too long.
pub(super) fn check_method(
    settings: &Settings,
    model: &Model,
    limits: &Limits,
) -> Result<(), RpcError> {
    let (name, substeps) = ("max_substeps", settings.substeps as usize);
    LimitExceeded::check(name, limits.max_substeps, "substeps", substeps)?;
    if settings.order > 2 {
        // No method has more than six stages.
        let unknowns = (settings.order as usize / 2).min(6) * model.dimensions().dynamic;
        let (name, limit) = ("stage_coordinates", limits.stage_coordinates);
        LimitExceeded::check(name, limit, "coordinates of all stages", unknowns)?;
    }
    Ok(())
}

/// About how many instructions a control period takes whose steps would take `step` of them at order 2:
/// at worst the stages of a higher order are solved together.
pub fn period_instructions(step: f64, settings: &Settings) -> f64 {
    let stages = f64::from(settings.order) / 2.0;
    step * f64::from(settings.substeps) * stages.powi(3)
}

/// What was promised of a method that a tolerance has chosen.
pub fn accuracy(accuracy: Accuracy) -> v1::Accuracy {
    let Accuracy { tolerance, error, periods } = accuracy;
    v1::Accuracy { tolerance, error, periods }
}

/// What was promised of a saved plant's method.
pub fn accuracy_of(accuracy: v1::Accuracy) -> Accuracy {
    let v1::Accuracy { tolerance, error, periods } = accuracy;
    Accuracy { tolerance, error, periods }
}

impl Constraints {
    /// From a request.
    pub fn new(handling: i32) -> Result<Self, RpcError> {
        match v1::ConstraintHandling::try_from(handling) {
            Ok(v1::ConstraintHandling::Unspecified | v1::ConstraintHandling::Manifold) => {
                Ok(Self::Manifold)
            }
            Ok(v1::ConstraintHandling::Full) => Ok(Self::Full),
            Err(_) => Err(RpcError::field("constraints", format!("{handling} is no such space"))),
        }
    }
}

/// Settings as a message.
pub fn settings_message(settings: &Settings) -> v1::PlantSettings {
    let force_split = match settings.force_split {
        ForceSplit::Symmetric => v1::ForceSplit::Symmetric,
        ForceSplit::Paper => v1::ForceSplit::Paper,
    };
    let precision = match settings.precision {
        Precision::Exact => v1::Precision::Exact,
        Precision::Fast => v1::Precision::Fast,
        Precision::Coarse => v1::Precision::Coarse,
    };
    v1::PlantSettings {
        time_step_s: settings.time_step_s,
        force_split: force_split.into(),
        max_iterations: settings.max_iterations,
        singular_below: settings.singular_below,
        order: settings.order,
        substeps: settings.substeps,
        halvings: Some(settings.halvings),
        precision: precision.into(),
        tolerance: 0.0,
    }
}

/// Changed numbers of a scene as messages.
pub fn parameters(parameters: &Parameters) -> Vec<v1::Parameter> {
    let message =
        |(path, value): (&String, &f64)| v1::Parameter { path: path.clone(), value: *value };
    parameters.iter().map(message).collect()
}
