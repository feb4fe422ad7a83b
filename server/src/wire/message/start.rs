//! How plants start.

use std::sync::Arc;

use plantd_models::{Initial, Model, Plant, Settings, Spare, State};
use plantd_proto::v1;
use v1::initial_state::Form as InitialForm;
use v1::point::Source as PointSource;

use crate::core::inputs::{at_operating_point, hold_input};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::plant::view::PlantSnapshot;
use crate::core::session::creation::Accuracy;
use crate::core::workers::pool::Abandoned;
use crate::wire::message::checks::check_numbers;
use crate::wire::message::settings::check_method;
use crate::wire::status::RpcError;

/// How a plant starts.
#[derive(Clone, Debug)]
pub enum Start {
    /// From a description of the state.
    Initial(Initial),
    /// From a snapshot.
    Snapshot(Box<PlantSnapshot>),
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

pub(super) fn momentum(q: Vec<f64>, p: Vec<f64>, v: Vec<f64>, model: &Model) -> Initial {
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
