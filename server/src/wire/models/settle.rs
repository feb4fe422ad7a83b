//! Configurations found from a guess: on the constraints, or at rest.

use std::collections::HashMap;
use std::sync::Arc;

use plantd_models::{Initial, Model, Plant, Problem, Settings, SettleRequest, Target};
use plantd_proto::v1;

use crate::wire::message::{checks, declare, start};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Targets of frames in a request at most.
const TARGETS_MAX: usize = 64;

/// Answers a Settle call.
pub(crate) fn settle(
    hub: &Hub,
    request: v1::SettleRequest,
) -> Result<v1::SettleResponse, RpcError> {
    let model = hub.catalog.get(&request.model)?.model;
    let goal = v1::SettleGoal::try_from(request.goal)
        .map_err(|_| RpcError::field("goal", format!("{} is no such goal", request.goal)))?;
    let guess = guess(&model, request.q, &request.guess)?;
    let constraints = model.dimensions().constraints;
    let model = held(model, request.targets)?;
    let inputs = inputs(&model, &request.inputs)?;
    if goal == v1::SettleGoal::Constraints {
        let projection = Initial::Projection { q: guess, hold: request.hold };
        let plant = Plant::at(Arc::clone(&model), Settings::new(&model), &projection)
            .map_err(|error| RpcError::from_initial(error, "guess"))?;
        let q = plant.q().to_vec();
        return Ok(v1::SettleResponse { u: input(&model, &inputs, &q), q, equilibrium: None });
    }
    start::check_settling(&model, &hub.limits)?;
    let rest = model
        .settle(&SettleRequest { q: guess, hold: request.hold, inputs })
        .map_err(|error| RpcError::from_settle(error, "guess"))?;
    Ok(v1::SettleResponse {
        u: input(&model, &rest.inputs, &rest.q),
        q: rest.q,
        equilibrium: Some(v1::Equilibrium {
            potential_j: rest.potential_j,
            residual: rest.residual,
            constraint_forces: rest.constraint_forces[..constraints].to_vec(),
            stable: rest.stable,
            smallest_stiffness: rest.smallest_stiffness,
            iterations: rest.iterations,
        }),
    })
}

/// The model held at targets of frames.
fn held(model: Arc<Model>, targets: Vec<v1::SettleTarget>) -> Result<Arc<Model>, RpcError> {
    if targets.is_empty() {
        return Ok(model);
    }
    let count = targets.len();
    if count > TARGETS_MAX {
        let message = format!("{count} targets; at most {TARGETS_MAX} are allowed");
        return Err(RpcError::field("targets", message));
    }
    let targets = targets.into_iter().enumerate().map(|(i, target)| self::target(i, target));
    let held = model.held_at(&targets.collect::<Result<Vec<_>, _>>()?).map_err(|error| {
        let Problem { path, message } = error.problems.into_iter().next().unwrap_or_else(|| {
            Problem { path: "targets".to_owned(), message: "cannot be held".to_owned() }
        });
        RpcError::field(path, message)
    })?;
    Ok(Arc::new(held))
}

fn target(i: usize, target: v1::SettleTarget) -> Result<Target, RpcError> {
    let v1::SettleTarget { point, position, orientation } = target;
    let point = point.unwrap_or_default();
    let field = |name: &str| format!("targets[{i}].{name}");
    if position.is_empty() && orientation.is_empty() {
        let message = "a target has a position, an orientation, or both";
        return Err(RpcError::field(format!("targets[{i}]"), message));
    }
    Ok(Target {
        frame: point.frame,
        at: declare::vector(field("point.at"), &point.at)?,
        position: declare::optional(field("position"), &position, "three")?,
        orientation: declare::optional(field("orientation"), &orientation, "four")?,
    })
}

/// The initial configuration, or `q`, with single values put in.
fn guess(model: &Model, q: Vec<f64>, values: &HashMap<String, f64>) -> Result<Vec<f64>, RpcError> {
    let mut guess = if q.is_empty() {
        start::initial_configuration(model)
    } else {
        checks::check_numbers("q", &q, model.dimensions().coordinates())?;
        q
    };
    for (name, &value) in values {
        let index = model.coordinate_index(name).ok_or_else(|| unknown("guess", name))?;
        guess[index] = finite("guess", name, value)?;
    }
    Ok(guess)
}

/// Input forces, zero where none are given.
fn inputs(model: &Model, values: &HashMap<String, f64>) -> Result<Vec<f64>, RpcError> {
    let names = &model.scene().inputs;
    let mut inputs = vec![0.0; names.len()];
    for (name, &value) in values {
        let index = names.iter().position(|input| input.name == *name);
        inputs[index.ok_or_else(|| unknown("inputs", name))?] = finite("inputs", name, value)?;
    }
    Ok(inputs)
}

/// `u` that holds a configuration.
fn input(model: &Model, inputs: &[f64], q: &[f64]) -> Vec<f64> {
    [inputs, &q[model.dimensions().dynamic..]].concat()
}

fn unknown(field: &str, name: &str) -> RpcError {
    RpcError::field(format!("{field}[{name}]"), "there is none of that name")
}

fn finite(field: &str, name: &str, value: f64) -> Result<f64, RpcError> {
    if value.is_finite() {
        return Ok(value);
    }
    Err(RpcError::field(format!("{field}[{name}]"), format!("is {value}")))
}
