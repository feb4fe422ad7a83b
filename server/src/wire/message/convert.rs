//! Between the messages of `plantd.v1` and the types of `plantd-models`, with every check on the way
//! in.

use std::sync::Arc;

use nalgebra::{Complex, DMatrix, DVector};
use plantd_models::control::{Momentum, StageWeights, TrajectoryWeights, Weights, WeightsError};
use plantd_models::scene::Signal;
use plantd_models::{
    Diagnostics, Dimensions, Energy, ForceSplit, Initial, Linearization, Model, Plant, Precision,
    Scene, SceneError, Settings, Spare, State, Violation,
};
use plantd_proto::link::monotonic_ns;
use plantd_proto::v1;
use v1::initial_state::Form as InitialForm;
use v1::point::Source as PointSource;
use v1::weight::Form as WeightForm;

use crate::core::feedback::regulator::Constraints;
use crate::core::inputs::{Inputs, at_operating_point, hold_input};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::parameters::Parameters;
use crate::core::plant::core::Core;
use crate::core::plant::view::PlantSnapshot;
use crate::core::publish::frame::Timing;
use crate::core::realtime::clock::utc_ns;
use crate::core::session::creation::Accuracy;
use crate::core::workers::pool::Abandoned;
use crate::wire::status::RpcError;

/// How a plant starts.
#[derive(Clone, Debug)]
pub enum Start {
    /// From a description of the state.
    Initial(Initial),
    /// From a snapshot.
    Snapshot(Box<PlantSnapshot>),
}

/// Checks a name or an id: lower-case letters, digits and hyphens, 1 to 63 of them.
pub fn check_name(field: &'static str, name: &str) -> Result<(), RpcError> {
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if name.is_empty() || name.len() > 63 || !name.chars().all(is_allowed) {
        return Err(RpcError::field(
            field,
            "must be lower-case letters, digits and hyphens, 1 to 63 of them",
        ));
    }
    Ok(())
}

/// A request's page: how many entries, and the name after which they start.
pub fn page(size: i32, token: &str) -> Result<(usize, &str), RpcError> {
    const DEFAULT: usize = 100;
    const MAX: usize = 1000;
    if !token.is_empty() {
        check_name("page_token", token)?;
    }
    match usize::try_from(size) {
        Ok(0) => Ok((DEFAULT, token)),
        Ok(size) => Ok((size.min(MAX), token)),
        Err(_) => Err(RpcError::field("page_size", "must not be negative")),
    }
}

/// Reads a scene within the limits. A faulty scene is the inner error.
pub fn scene(
    text: &str,
    format: i32,
    limits: &Limits,
) -> Result<Result<Scene, SceneError>, RpcError> {
    LimitExceeded::check("scene_bytes", limits.scene_bytes, "bytes of scene", text.len())?;
    let scene = match v1::SceneFormat::try_from(format) {
        Ok(v1::SceneFormat::Unspecified) => Scene::from_text(text),
        Ok(v1::SceneFormat::Toml) => Scene::from_toml(text),
        Ok(v1::SceneFormat::Json) => Scene::from_json(text),
        Err(_) => return Err(RpcError::field("format", format!("{format} is not a format"))),
    };
    let scene = match scene {
        Ok(scene) => scene,
        Err(error) => return Ok(Err(error)),
    };
    for (what, count) in [
        ("frames", scene.frames.len()),
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
    Ok(Ok(scene))
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
fn check_method(settings: &Settings, model: &Model, limits: &Limits) -> Result<(), RpcError> {
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

/// What output channels deliver, if there are any; flags are 1 where numbers stand for lost ones.
pub fn outputs(y: &[f64], lost: &[f64]) -> Option<v1::Outputs> {
    let is_lost = |&(_, flag): &(usize, &f64)| *flag != 0.0;
    let lost_channels = lost.iter().enumerate().filter(is_lost).map(|(index, _)| index as u32);
    let outputs = || v1::Outputs { y: y.to_vec(), lost: lost_channels.collect() };
    (!lost.is_empty()).then(outputs)
}

/// What the output channels of a plant deliver, if there are any.
pub fn core_outputs(core: &Core) -> Option<v1::Outputs> {
    let published = core.published();
    outputs(published.outputs, published.lost)
}

/// What was promised of a method that a tolerance has chosen.
pub fn accuracy(accuracy: Accuracy) -> v1::Accuracy {
    let Accuracy { tolerance, error, periods } = accuracy;
    v1::Accuracy { tolerance, error, periods }
}

/// The same from a saved plant.
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

/// When a state was there; `monotonic_ns` 0 means now.
pub fn clocks(plant_s: f64, monotonic_ns: u64) -> v1::Clocks {
    let monotonic_ns = if monotonic_ns == 0 { self::monotonic_ns() } else { monotonic_ns };
    v1::Clocks { plant_s, monotonic_ns, utc_ns: utc_ns(monotonic_ns) }
}

/// Times of a step in the plant's own loop; none in lockstep.
pub fn step_timing(timing: &Timing) -> Option<v1::StepTiming> {
    (timing.ended_ns != 0).then_some(v1::StepTiming {
        due_ns: timing.due_ns,
        began_ns: timing.began_ns,
        ended_ns: timing.ended_ns,
        input_sequence: timing.input_sequence,
        input_age_ns: timing.input_age_ns,
        input_late: timing.flags & Timing::LATE != 0,
        input_safe: timing.flags & Timing::SAFE != 0,
    })
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

/// How a plant starts; not given means the scene's initial configuration.
pub fn start(
    initial: Option<v1::InitialState>,
    model: &Model,
    limits: &Limits,
) -> Result<Start, RpcError> {
    let initial = match initial.and_then(|initial| initial.form) {
        None => Initial::Scene,
        Some(InitialForm::Momentum(form)) => momentum(form.q, form.p, form.v, model),
        Some(InitialForm::Velocity(form)) => Initial::Velocity { q: form.q, v: form.v },
        Some(InitialForm::TwoConfigurations(form)) => {
            Initial::TwoConfigurations { q0: form.q0, q1: form.q1 }
        }
        Some(InitialForm::Projection(form)) => Initial::Projection { q: form.q, hold: form.hold },
        Some(InitialForm::OperatingPoint(name)) => Initial::OperatingPoint(name),
        Some(InitialForm::Equilibrium(form)) => {
            check_settling(model, limits)?;
            let q = if form.q.is_empty() { initial_configuration(model) } else { form.q };
            let zeros = || vec![0.0; model.dimensions().inputs];
            let inputs = if form.inputs.is_empty() { zeros() } else { form.inputs };
            Initial::Equilibrium { q, hold: form.hold, inputs }
        }
        Some(InitialForm::Snapshot(bytes)) => {
            return Ok(Start::Snapshot(Box::new(PlantSnapshot::from_bytes(&bytes)?)));
        }
    };
    Ok(Start::Initial(initial))
}

/// Configuration in which the scene starts.
pub fn initial_configuration(model: &Model) -> Vec<f64> {
    model.coordinates().iter().map(|coordinate| coordinate.initial).collect()
}

/// Refuses to search an equilibrium of a model so large that it would take minutes.
pub fn check_settling(model: &Model, limits: &Limits) -> Result<(), RpcError> {
    let (name, limit) = ("settle_coordinates", limits.settle_coordinates);
    let count = model.dimensions().coordinates();
    Ok(LimitExceeded::check(name, limit, "coordinates to settle", count)?)
}

fn momentum(q: Vec<f64>, p: Vec<f64>, v: Vec<f64>, model: &Model) -> Initial {
    let v = if v.is_empty() { vec![0.0; model.dimensions().prescribed] } else { v };
    Initial::Momentum { q, p, v }
}

/// A state as an initial one.
pub fn momentum_of(state: &State) -> Initial {
    Initial::Momentum { q: state.q.clone(), p: state.p.clone(), v: state.v.clone() }
}

/// A plant in its initial state. `field` names the state in errors.
pub fn plant(
    model: &Arc<Model>,
    settings: Settings,
    start: &Start,
    field: &str,
) -> Result<Plant, RpcError> {
    let refused = |error| RpcError::from_initial(error, field);
    let spare = Spare::new(Arc::clone(model), settings).map_err(refused)?;
    match start {
        Start::Initial(initial) => spare.start(initial).map_err(refused),
        Start::Snapshot(snapshot) => Ok(spare.restore(&snapshot.plant)?),
    }
}

/// A plant in its initial state, with the order and the substeps that a tolerance asks for.
pub fn accurate_plant(
    model: &Arc<Model>,
    settings: Settings,
    start: &Start,
    tolerance: f64,
    limits: &Limits,
    abandoned: &Abandoned,
) -> Result<(Plant, Accuracy), RpcError> {
    let (name, limit) = ("settle_coordinates", limits.settle_coordinates);
    let count = model.dimensions().coordinates();
    LimitExceeded::check(name, limit, "coordinates to choose a method for", count)?;
    if let Start::Snapshot(_) = start {
        return Err(RpcError::field("initial.snapshot", "has its order and substeps already"));
    }
    let choice = plant(model, settings, start, "initial")?
        .choose_method(tolerance, &mut || abandoned.check().is_ok())?;
    let settings = Settings { order: choice.order, substeps: choice.substeps, ..settings };
    check_method(&settings, model, limits)?;
    let accuracy = Accuracy { tolerance, error: choice.error, periods: choice.periods };
    Ok((plant(model, settings, start, "initial")?, accuracy))
}

/// A plant at a point, and the input there.
pub fn point(
    point: Option<v1::Point>,
    model: &Arc<Model>,
    settings: Settings,
) -> Result<(Plant, Vec<f64>), RpcError> {
    match point.and_then(|point| point.source) {
        None => Err(RpcError::field("point", "is missing")),
        Some(PointSource::Plant(_)) => Err(RpcError::field("point.plant", "is not for this call")),
        Some(PointSource::OperatingPoint(name)) => {
            let point = at_operating_point(model, settings, &name);
            point.map_err(|error| RpcError::from_initial(error, "point.operating_point"))
        }
        Some(PointSource::StateAndInput(given)) => {
            let field = "point.state_and_input.state";
            let state = given.state.ok_or_else(|| RpcError::field(field, "is missing"))?;
            let start = Start::Initial(momentum(state.q, state.p, state.v, model));
            let plant = plant(model, settings, &start, field)?;
            let input = if given.u.is_empty() { hold_input(&plant) } else { given.u };
            check_numbers("point.state_and_input.u", &input, model.dimensions().input())?;
            Ok((plant, input))
        }
    }
}

/// The initial state and the inputs of a trajectory.
pub fn trajectory(
    trajectory: Option<v1::Trajectory>,
    model: &Arc<Model>,
    settings: Settings,
    limits: &Limits,
) -> Result<(Plant, Inputs), RpcError> {
    trajectory_in("trajectory", trajectory, model, settings, limits)
}

/// The initial state and the inputs of a trajectory in a field of the request.
pub fn trajectory_in(
    field: &str,
    trajectory: Option<v1::Trajectory>,
    model: &Arc<Model>,
    settings: Settings,
    limits: &Limits,
) -> Result<(Plant, Inputs), RpcError> {
    let trajectory = trajectory.ok_or_else(|| RpcError::field(field, "is missing"))?;
    let start = match trajectory.initial {
        None => Initial::Scene,
        Some(state) => momentum(state.q, state.p, state.v, model),
    };
    let plant = plant(model, settings, &Start::Initial(start), &format!("{field}.initial"))?;
    let width = model.dimensions().input();
    let inputs = Inputs::along(&format!("{field}.u"), trajectory.u, width, limits)?;
    Ok((plant, inputs))
}

impl Inputs {
    /// Checks a matrix whose rows are inputs of `columns` entries.
    pub fn new(field: &str, u: Option<v1::Matrix>, columns: usize) -> Result<Self, RpcError> {
        let Some(u) = u else { return Ok(Self::from_numbers(columns, 0, Vec::new())) };
        check_shape(field, &u)?;
        if u.rows > 0 && u.cols as usize != columns {
            let problem = format!("has {} columns; {columns} are needed", u.cols);
            return Err(RpcError::field(format!("{field}.cols"), problem));
        }
        Ok(Self::from_numbers(columns, u.rows as usize, u.data))
    }

    /// The inputs of a trajectory: one row at least, and no more than a horizon may have.
    pub fn along(
        field: &str,
        u: Option<v1::Matrix>,
        columns: usize,
        limits: &Limits,
    ) -> Result<Self, RpcError> {
        let inputs = Self::new(field, u, columns)?;
        LimitExceeded::check("horizon", limits.horizon, "steps", inputs.count())?;
        if inputs.count() == 0 {
            return Err(RpcError::field(field, "is missing: it needs one row at least"));
        }
        Ok(inputs)
    }
}

fn check_shape(field: &str, matrix: &v1::Matrix) -> Result<(), RpcError> {
    let expected = u64::from(matrix.rows) * u64::from(matrix.cols);
    if matrix.data.len() as u64 != expected {
        return Err(RpcError::field(
            format!("{field}.data"),
            format!(
                "has {} entries; {} rows of {} are {expected}",
                matrix.data.len(),
                matrix.rows,
                matrix.cols
            ),
        ));
    }
    check_finite(&format!("{field}.data"), &matrix.data)
}

/// Checks a vector's length, and that its entries are finite.
pub fn check_numbers(field: &str, numbers: &[f64], expected: usize) -> Result<(), RpcError> {
    if numbers.len() != expected {
        let problem = format!("has {} entries; {expected} are needed", numbers.len());
        return Err(RpcError::field(field, problem));
    }
    check_finite(field, numbers)
}

/// Checks that numbers are finite.
pub fn check_finite(field: &str, numbers: &[f64]) -> Result<(), RpcError> {
    match numbers.iter().position(|number| !number.is_finite()) {
        Some(index) => {
            Err(RpcError::field(format!("{field}[{index}]"), format!("is {}", numbers[index])))
        }
        None => Ok(()),
    }
}

/// Weights of a regulator.
pub fn weights(weights: Option<v1::LqrWeights>, model: &Model) -> Result<Weights, RpcError> {
    weights_in("weights", weights, model)
}

/// Weights of a regulator in a field of the request.
pub fn weights_in(
    field: &str,
    weights: Option<v1::LqrWeights>,
    model: &Model,
) -> Result<Weights, RpcError> {
    let weights = weights.ok_or_else(|| RpcError::field(field, "are missing"))?;
    let d = model.dimensions();
    let at = |name: &str| format!("{field}.{name}");
    let q = weight(&at("q"), weights.q, d.state())?;
    let r = weight(&at("r"), weights.r, d.input())?;
    let q_final = weights.q_final.map(|given| weight(&at("q_final"), Some(given), d.state()));
    let s = weights.s.map(|s| matrix_of(&at("s"), &s, Some(d.state()), d.input()));
    let refuse = |error| RpcError::from_weights(error, field, "stages");
    let weights = Weights::new(q, r, q_final.transpose()?).map_err(refuse)?;
    match s.transpose()? {
        Some(s) => weights.with_cross(s).map_err(refuse),
        None => Ok(weights),
    }
}

/// Weights of a regulator that knows the momentum of the state alone.
pub fn state_weights_in(
    field: &str,
    weights: Option<v1::LqrWeights>,
    model: &Model,
) -> Result<Weights, RpcError> {
    match momentum_in(field, weights.as_ref())? {
        Momentum::State => weights_in(field, weights, model),
        Momentum::Projected => {
            let problem = "is projected; these weights are on the momentum of the state";
            Err(RpcError::field(format!("{field}.momentum"), problem))
        }
    }
}

/// Which momentum weights in a field of the request weigh.
pub fn momentum_in(field: &str, weights: Option<&v1::LqrWeights>) -> Result<Momentum, RpcError> {
    let momentum = weights.map_or(0, |weights| weights.momentum);
    match v1::Momentum::try_from(momentum) {
        Ok(v1::Momentum::Unspecified | v1::Momentum::State) => Ok(Momentum::State),
        Ok(v1::Momentum::Projected) => Ok(Momentum::Projected),
        Err(_) => Err(RpcError::field(
            format!("{field}.momentum"),
            format!("{momentum} is no such momentum"),
        )),
    }
}

/// Where weights stand in a request.
#[derive(Clone, Copy, Debug)]
pub struct WeightFields {
    /// Those of all steps.
    pub weights: &'static str,
    /// Those of single steps.
    pub stages: &'static str,
    /// Each step's must be convex by themselves.
    pub are_convex: bool,
}

impl Default for WeightFields {
    fn default() -> Self {
        Self { weights: "weights", stages: "stages", are_convex: true }
    }
}

/// Weights along a trajectory of so many steps: the same at all of them, or one set per step.
pub fn trajectory_weights(
    fields: WeightFields,
    weights: Option<v1::LqrWeights>,
    stages: Vec<v1::StageWeights>,
    steps: usize,
    model: &Model,
) -> Result<TrajectoryWeights, RpcError> {
    let WeightFields { weights: field, stages: stages_field, are_convex } = fields;
    let refuse = |error| RpcError::from_weights(error, field, stages_field);
    if stages.is_empty() && are_convex {
        return Ok(TrajectoryWeights::from(&weights_in(field, weights, model)?));
    }
    let size = model.dimensions().state();
    let weights = weights.unwrap_or_default();
    let is_given = weights.q_final.is_some();
    let given_final = if is_given { weights.q_final } else { weights.q.clone() };
    let final_field = format!("{field}.{}", if is_given { "q_final" } else { "q" });
    let build = if are_convex { StageWeights::new } else { StageWeights::symmetric };
    if stages.is_empty() {
        let v1::LqrWeights { q, r, s, .. } = weights;
        let all = v1::StageWeights { q, r, s, ..Default::default() };
        let (q, r, s, x_linear, u_linear) = stage_parts(field, all, model)?;
        let stage = build(q, r, s, x_linear, u_linear).map_err(refuse)?;
        let q_final = Some(weight(&final_field, given_final, size)?);
        return TrajectoryWeights::constant(stage, q_final).map_err(refuse);
    }
    if stages.len() != steps {
        let problem = format!("has {} entries; the trajectory has {steps} steps", stages.len());
        return Err(RpcError::field(stages_field, problem));
    }
    let q_final = weight(&final_field, given_final, size)?;
    let stage = |(step, stage): (usize, v1::StageWeights)| {
        let (q, r, s, x_linear, u_linear) =
            stage_parts(&format!("{stages_field}[{step}]"), stage, model)?;
        build(q, r, s, x_linear, u_linear)
            .map_err(|error| refuse(WeightsError::Step { step, error: Box::new(error) }))
    };
    let stages: Result<Vec<_>, RpcError> = stages.into_iter().enumerate().map(stage).collect();
    TrajectoryWeights::per_step(stages?, q_final).map_err(refuse)
}

type StageParts =
    (DMatrix<f64>, DMatrix<f64>, Option<DMatrix<f64>>, Option<DVector<f64>>, Option<DVector<f64>>);

fn stage_parts(
    field: &str,
    stage: v1::StageWeights,
    model: &Model,
) -> Result<StageParts, RpcError> {
    let d = model.dimensions();
    let at = |name: &str| format!("{field}.{name}");
    let linear = |name: &str, numbers: Vec<f64>, size: usize| {
        if numbers.is_empty() {
            return Ok(None);
        }
        check_numbers(&at(name), &numbers, size)?;
        Ok::<_, RpcError>(Some(DVector::from_vec(numbers)))
    };
    let s = stage.s.map(|s| matrix_of(&at("s"), &s, Some(d.state()), d.input()));
    Ok((
        weight(&at("q"), stage.q, d.state())?,
        weight(&at("r"), stage.r, d.input())?,
        s.transpose()?,
        linear("x_linear", stage.x_linear, d.state())?,
        linear("u_linear", stage.u_linear, d.input())?,
    ))
}

/// A vector's numbers.
pub fn vector(vector: DVector<f64>) -> Vec<f64> {
    vector.as_slice().to_vec()
}

/// A vector's numbers; none when all are zero.
pub fn nonzero(vector: DVector<f64>) -> Vec<f64> {
    if vector.iter().all(|&number| number == 0.0) { Vec::new() } else { self::vector(vector) }
}

/// A symmetric weight in a field of the request.
pub fn weight(
    field: &str,
    weight: Option<v1::Weight>,
    size: usize,
) -> Result<DMatrix<f64>, RpcError> {
    match weight.and_then(|weight| weight.form) {
        None => Err(RpcError::field(field, "is missing")),
        Some(WeightForm::Diagonal(diagonal)) => {
            check_numbers(&format!("{field}.diagonal"), &diagonal.values, size)?;
            Ok(DMatrix::from_diagonal(&DVector::from_vec(diagonal.values)))
        }
        Some(WeightForm::Full(matrix)) => {
            matrix_of(&format!("{field}.full"), &matrix, Some(size), size)
        }
    }
}

/// A matrix of the request: of so many columns, and rows where their number is given.
pub fn matrix_of(
    field: &str,
    matrix: &v1::Matrix,
    expected_rows: Option<usize>,
    expected_cols: usize,
) -> Result<DMatrix<f64>, RpcError> {
    check_shape(field, matrix)?;
    let (rows, cols) = (matrix.rows as usize, matrix.cols as usize);
    let needed = expected_rows.unwrap_or(rows);
    if (rows, cols) != (needed, expected_cols) {
        let problem = format!("is {rows} x {cols}; {needed} x {expected_cols} is needed");
        return Err(RpcError::field(field, problem));
    }
    Ok(DMatrix::from_row_slice(rows, cols, &matrix.data))
}

/// Complex numbers as messages.
pub fn complex(numbers: &[Complex<f64>]) -> Vec<v1::Complex> {
    numbers.iter().map(|z| v1::Complex { real: z.re, imaginary: z.im }).collect()
}

/// A matrix as a message.
pub fn matrix(matrix: &DMatrix<f64>) -> v1::Matrix {
    v1::Matrix {
        rows: matrix.nrows() as u32,
        cols: matrix.ncols() as u32,
        data: matrix.transpose().as_slice().to_vec(),
    }
}

/// The state of a plant as a message.
pub fn plant_state(plant: &Plant) -> v1::State {
    let step = plant.step_index();
    v1::State {
        step,
        time_s: plant.time_s(),
        q: plant.q().to_vec(),
        p: plant.p().to_vec(),
        v: plant.v().to_vec(),
        multipliers: multipliers(step, plant.multipliers()),
    }
}

/// A state at a time as a message.
pub fn state(state: &State, time_s: f64) -> v1::State {
    v1::State {
        step: state.step,
        time_s,
        q: state.q.clone(),
        p: state.p.clone(),
        v: state.v.clone(),
        multipliers: multipliers(state.step, &state.multipliers),
    }
}

/// There are none before the first step.
fn multipliers(step: u64, multipliers: &[f64]) -> Vec<f64> {
    if step == 0 { Vec::new() } else { multipliers.to_vec() }
}

/// `x = (q, p, v)` of a plant.
pub fn x(plant: &Plant) -> Vec<f64> {
    [plant.q(), plant.p(), plant.v()].concat()
}

/// Changed numbers of a scene as messages.
pub fn parameters(parameters: &Parameters) -> Vec<v1::Parameter> {
    let message =
        |(path, value): (&String, &f64)| v1::Parameter { path: path.clone(), value: *value };
    parameters.iter().map(message).collect()
}

/// Names of the entries of `x = (q, p, v)`: `theta`, `p(theta)`, `v(lift)`.
pub fn state_names(model: &Model) -> Vec<String> {
    let (dynamic, prescribed) = model.coordinates().split_at(model.dimensions().dynamic);
    let all = model.coordinates().iter().map(|c| c.name.clone());
    all.chain(dynamic.iter().map(|c| format!("p({})", c.name)))
        .chain(prescribed.iter().map(|c| format!("v({})", c.name)))
        .collect()
}

/// Names of the entries of `u`: inputs, and prescribed coordinates.
pub fn input_names(model: &Model) -> Vec<String> {
    let inputs = model.scene().inputs.iter().map(|input| input.name.clone());
    let prescribed = model.coordinates()[model.dimensions().dynamic..].iter();
    inputs.chain(prescribed.map(|coordinate| coordinate.name.clone())).collect()
}

/// Index of a bound's entry among `names`, and its ends; infinite where there is none.
pub fn bound(
    field: &str,
    bound: &v1::Bound,
    names: &[String],
) -> Result<(usize, f64, f64), RpcError> {
    let index = names.iter().position(|name| *name == bound.entry).ok_or_else(|| {
        RpcError::field(format!("{field}.entry"), format!("there is no entry `{}`", bound.entry))
    })?;
    if bound.min.is_none() && bound.max.is_none() {
        return Err(RpcError::field(field, "has neither `min` nor `max`"));
    }
    let (min, max) = (bound.min.unwrap_or(f64::NEG_INFINITY), bound.max.unwrap_or(f64::INFINITY));
    for (end, value) in [("min", bound.min), ("max", bound.max)] {
        if let Some(value) = value.filter(|value| !value.is_finite()) {
            return Err(RpcError::field(format!("{field}.{end}"), format!("is {value}")));
        }
    }
    if min > max {
        return Err(RpcError::field(field, format!("has min {min} above max {max}")));
    }
    Ok((index, min, max))
}

/// Indices in `x` at which the rotation vectors of ball joints begin.
pub fn rotations(model: &Model) -> Vec<u32> {
    model.orientations().iter().map(|&start| start as u32).collect()
}

/// What all gains of a map have in common: of which model and time step they are, and its rotations.
pub fn gain_of(name: &str, model: &Model, settings: &Settings) -> v1::Gain {
    v1::Gain {
        model: name.to_owned(),
        time_step_s: settings.time_step_s,
        rotations: rotations(model),
        ..Default::default()
    }
}

/// Numbers in the message of a linearization.
pub fn linearization_numbers(d: Dimensions) -> usize {
    (d.state() + d.constraints) * (d.state() + d.input())
}

/// Numbers in the message of a state.
pub fn state_numbers(d: Dimensions) -> usize {
    d.state() + d.constraints
}

/// Diagnostics of the state at `step` as a message.
pub fn diagnostics(step: u64, diagnostics: Diagnostics) -> v1::DiagnoseResponse {
    let count = |number: usize| number as u32;
    v1::DiagnoseResponse {
        step,
        degrees_of_freedom: count(diagnostics.degrees_of_freedom),
        constraint_rank: count(diagnostics.constraint_rank),
        redundant_constraints: diagnostics.redundant_constraints,
        energy: Some(energy(diagnostics.energy)),
        linear_momentum: diagnostics.linear_momentum.to_vec(),
        angular_momentum: diagnostics.angular_momentum.to_vec(),
        center_of_mass: diagnostics.center_of_mass.to_vec(),
        mass_kg: diagnostics.mass_kg,
        constraint_forces: diagnostics.constraint_forces,
        mass_matrix_reciprocal_condition: diagnostics.mass_matrix_reciprocal_condition,
        constraint_reciprocal_condition: diagnostics.constraint_reciprocal_condition,
    }
}

/// An energy as a message.
pub fn energy(energy: Energy) -> v1::Energy {
    v1::Energy { kinetic_j: energy.kinetic_j, potential_j: energy.potential_j }
}

/// A linearization at `x[step]` as a message.
pub fn linearization(step: u64, linearization: &Linearization) -> v1::Linearization {
    v1::Linearization {
        step,
        a: Some(matrix(&linearization.a())),
        b: Some(matrix(&linearization.b())),
        multipliers_x: Some(matrix(&linearization.multipliers_x())),
        multipliers_u: Some(matrix(&linearization.multipliers_u())),
    }
}

/// A model as a message; `with_texts` adds the scene and the plan.
pub fn model(name: &str, builtin: bool, model: &Model, with_texts: bool) -> v1::Model {
    let scene = model.scene();
    v1::Model {
        name: name.to_owned(),
        description: scene.description.clone(),
        builtin,
        coordinates: coordinates(model),
        inputs: scene.inputs.iter().map(|input| input.name.clone()).collect(),
        constraints: model.constraint_names().to_vec(),
        operating_points: model.operating_points().iter().map(|p| p.name.clone()).collect(),
        scene_toml: if with_texts { scene.to_toml() } else { String::new() },
        plan: if with_texts { model.plan() } else { String::new() },
        time_step_s: scene.time_step_s,
        signals: signals(model),
        initial_violations: model.initial_violations().iter().map(violation).collect(),
    }
}

fn violation(violation: &Violation) -> v1::ConstraintViolation {
    let Violation { constraint, value } = violation;
    v1::ConstraintViolation { constraint: constraint.clone(), value: *value }
}

fn signals(model: &Model) -> Vec<v1::Signal> {
    let (scene, dynamic) = (model.scene(), model.dimensions().dynamic);
    let signal = |signal: &Signal| {
        let drives = signal.drives();
        let kind = match signal {
            Signal::Constant { .. } => "constant",
            Signal::Sinusoid { .. } => "sinusoid",
            Signal::Chirp { .. } => "chirp",
            Signal::Spline { .. } => "spline",
            Signal::Table { .. } => "table",
        };
        let input = scene.inputs.iter().position(|input| input.name == drives);
        let prescribed =
            || Some(model.coordinate_index(drives)?.checked_sub(dynamic)? + scene.inputs.len());
        Some(v1::Signal {
            drives: drives.to_owned(),
            u_index: input.or_else(prescribed)? as u32,
            kind: kind.to_owned(),
            replaces: input.is_none(),
        })
    };
    scene.signals.iter().filter_map(signal).collect()
}

fn coordinates(model: &Model) -> Vec<v1::Coordinate> {
    let mut coordinates: Vec<_> = model.coordinates().iter().map(coordinate).collect();
    for &start in model.orientations() {
        let group = coordinates[start].name.trim_end_matches("_rx").to_owned();
        for component in &mut coordinates[start..start + 3] {
            component.rotation_group.clone_from(&group);
        }
    }
    coordinates
}

fn coordinate(coordinate: &plantd_models::Coordinate) -> v1::Coordinate {
    let unit = if coordinate.is_angle { v1::Unit::Radian } else { v1::Unit::Metre };
    v1::Coordinate {
        name: coordinate.name.clone(),
        prescribed: coordinate.kind == plantd_models::scene::CoordinateKind::Prescribed,
        unit: unit.into(),
        initial: coordinate.initial,
        rotation_group: String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix_of(rows: u32, cols: u32, data: Vec<f64>) -> v1::Matrix {
        v1::Matrix { rows, cols, data }
    }

    #[test]
    fn matrices_are_row_major() {
        let m = DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(matrix(&m), matrix_of(2, 3, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let full =
            v1::Weight { form: Some(WeightForm::Full(matrix_of(2, 2, vec![1.0, 2.0, 3.0, 4.0]))) };
        assert_eq!(weight("q", Some(full), 2).unwrap()[(0, 1)], 2.0);
    }

    #[test]
    fn shapes_that_lie_are_refused() {
        for (matrix, field) in [
            (matrix_of(u32::MAX, u32::MAX, vec![]), "u.data"),
            (matrix_of(2, 2, vec![0.0; 3]), "u.data"),
            (matrix_of(1, 3, vec![0.0; 3]), "u.cols"),
            (matrix_of(1, 2, vec![0.0, f64::NAN]), "u.data[1]"),
        ] {
            let fault = Inputs::new("u", Some(matrix), 2).unwrap_err();
            let status = tonic::Status::from(fault);
            assert!(status.message().starts_with(field), "{}", status.message());
        }
    }

    #[test]
    fn names_and_pages() {
        assert!(check_name("id", "a-1").is_ok());
        for name in ["", "A", "a_b", &"a".repeat(64)] {
            assert!(check_name("id", name).is_err(), "{name}");
        }
        assert_eq!(page(0, "").unwrap(), (100, ""));
        assert_eq!(page(i32::MAX, "a").unwrap(), (1000, "a"));
        assert!(page(-1, "").is_err());
    }
}
