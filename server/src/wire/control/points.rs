//! Models and points that calls of the control service name.

use std::sync::Arc;

use plantd_models::scene::UnknownName;
use plantd_models::{Model, OperatingPoint, Plant, Settings};
use plantd_proto::v1;

use crate::core::inputs::Inputs;
use crate::core::limits::LimitExceeded;
use crate::wire::message::{checks, matrices, settings, start, states};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// The model and the settings of a request.
pub(crate) fn model_and_settings(
    hub: &Hub,
    name: &str,
    settings: Option<v1::PlantSettings>,
) -> Result<(Arc<Model>, Settings), RpcError> {
    let model = hub.catalog.get(name)?.model;
    let settings = settings::settings(settings, &model, &hub.limits)?;
    Ok((model, settings))
}

/// A plant at a point, of which matrices are asked for, and the input there.
pub(crate) fn at_point(
    hub: &Hub,
    model: &str,
    settings: Option<v1::PlantSettings>,
    point: Option<v1::Point>,
) -> Result<(Plant, Vec<f64>), RpcError> {
    let (plant, u) = match &point {
        Some(v1::Point { source: Some(v1::point::Source::Plant(id)) }) => {
            hub.session(id)?.copy_plant_and_input()
        }
        _ => {
            let (model, settings) = model_and_settings(hub, model, settings)?;
            start::point(point, &model, settings)?
        }
    };
    check_linearization(hub, plant.model())?;
    Ok((plant, u))
}

/// A plant at the start of a trajectory, of which matrices are asked for, and the inputs along it.
pub(crate) fn along_trajectory(
    hub: &Hub,
    model: &str,
    settings: Option<v1::PlantSettings>,
    trajectory: Option<v1::Trajectory>,
) -> Result<(Plant, Inputs), RpcError> {
    let (model, settings) = model_and_settings(hub, model, settings)?;
    check_linearization(hub, &model)?;
    matrices::trajectory_in("trajectory", trajectory, &model, settings, &hub.limits)
}

/// Name of the model that such a point is of.
pub(crate) fn model_at(
    hub: &Hub,
    model: &str,
    point: Option<&v1::Point>,
) -> Result<String, RpcError> {
    match point {
        Some(v1::Point { source: Some(v1::point::Source::Plant(id)) }) => {
            Ok(hub.session(id)?.model_name().to_owned())
        }
        _ => Ok(model.to_owned()),
    }
}

/// The operating point of that name in a field of the request; empty means `initial`.
pub(crate) fn operating_point<'a>(
    model: &'a Model,
    field: &str,
    name: &str,
) -> Result<&'a OperatingPoint, RpcError> {
    let name = if name.is_empty() { "initial" } else { name };
    let point = model.operating_points().iter().find(|point| point.name == name);
    point.ok_or_else(|| {
        let known = model.operating_points().iter().map(|point| &point.name);
        let name = UnknownName::among(name, known);
        RpcError::field(field, format!("there is no operating point {name}"))
    })
}

/// The vector in a field of the request; empty means the other one.
pub(crate) fn given(field: &str, given: Vec<f64>, default: Vec<f64>) -> Result<Vec<f64>, RpcError> {
    if given.is_empty() {
        return Ok(default);
    }
    checks::check_numbers(field, &given, default.len())?;
    Ok(given)
}

/// Refuses matrices that no client would take.
fn check_linearization(hub: &Hub, model: &Model) -> Result<(), RpcError> {
    let numbers = states::linearization_numbers(model.dimensions());
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    Ok(LimitExceeded::check(name, limit, "numbers in a linearization", numbers)?)
}
