//! Kinematics of frames, and the terms of the equation of motion.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_models::{Continuous, ContinuousPoint, FrameMotion, FramePoint, Kinematics, Model};
use plantd_proto::v1;

use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::Abandoned;
use crate::wire::control::points::{given, operating_point};
use crate::wire::message::{declare, matrices, states};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// A state of a mechanism, and the inputs there.
struct Mechanism {
    model: Arc<Model>,
    q: Vec<f64>,
    v: Vec<f64>,
    inputs: Vec<f64>,
}

impl Mechanism {
    fn new(hub: &Hub, state: Option<v1::MechanicalState>) -> Result<Self, RpcError> {
        let v1::MechanicalState { plant: id, model, operating_point: name, q, v } =
            state.ok_or_else(|| RpcError::field("state", "is missing"))?;
        let (model, present_q, present_v, mut inputs) = if id.is_empty() {
            let model = hub.catalog.get(&model)?.model;
            let point = operating_point(&model, "state.operating_point", &name)?;
            let (at, u) = (point.q.clone(), point.u.clone());
            (model, at, None, u)
        } else {
            for (field, given) in [("state.model", &model), ("state.operating_point", &name)] {
                if !given.is_empty() {
                    return Err(RpcError::field(field, "is given together with `plant`"));
                }
            }
            let (mut plant, u) = hub.session(&id)?.copy_plant_and_input();
            let velocity = if q.is_empty() && v.is_empty() { Some(plant.velocity()) } else { None };
            (Arc::clone(plant.model()), plant.q().to_vec(), velocity, u)
        };
        inputs.truncate(model.dimensions().inputs);
        let rest = vec![0.0; present_q.len()];
        let q = given("state.q", q, present_q)?;
        let v = given("state.v", v, present_v.unwrap_or(rest))?;
        Ok(Self { model, q, v, inputs })
    }
}

fn coordinates(model: &Model) -> Vec<String> {
    model.coordinates().iter().map(|coordinate| coordinate.name.clone()).collect()
}

/// Answers a Kinematics call.
pub(crate) fn kinematics(
    hub: &Hub,
    request: v1::KinematicsRequest,
    abandoned: &Abandoned,
) -> Result<v1::KinematicsResponse, RpcError> {
    let v1::KinematicsRequest { state, frames, points, jacobians } = request;
    let Mechanism { model, q, v, .. } = Mechanism::new(hub, state)?;
    let all = frames.is_empty() && points.is_empty();
    let frames: Vec<String> =
        if all { model.scene().frames.iter().map(|f| f.name.clone()).collect() } else { frames };
    let columns = if jacobians { q.len() } else { 0 };
    let numbers = frames.len() * (13 + 6 * columns) + (points.len() + 1) * (6 + 3 * columns);
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    LimitExceeded::check(name, limit, "numbers of frames and points", numbers)?;

    let mut kinematics = Kinematics::new(Arc::clone(&model));
    kinematics.place(&q, &v)?;
    let wanted = |jacobian: DMatrix<f64>| Some(matrices::matrix(&jacobian));
    let of_frame = |(i, name): (usize, String)| {
        abandoned.check()?;
        let field = format!("frames[{i}]");
        let (place, motion) = motion(&model, &kinematics, [&field, &field], &name, [0.0; 3])?;
        Ok(v1::FrameMotion {
            frame: name,
            position: motion.position.to_vec(),
            orientation: motion.orientation.to_vec(),
            linear_velocity: motion.linear_velocity.to_vec(),
            angular_velocity: motion.angular_velocity.to_vec(),
            jacobian: jacobians.then(|| kinematics.jacobian(&place)).and_then(wanted),
        })
    };
    let of_point = |(i, point): (usize, &v1::FramePoint)| {
        abandoned.check()?;
        let [frame, at] = ["frame", "at"].map(|part| format!("points[{i}].{part}"));
        let position = declare::vector(at.clone(), &point.at)?;
        let (place, motion) = motion(&model, &kinematics, [&frame, &at], &point.frame, position)?;
        let linear = || kinematics.jacobian(&place).rows(0, 3).into_owned();
        Ok(v1::PointMotion {
            position: motion.position.to_vec(),
            velocity: motion.linear_velocity.to_vec(),
            jacobian: jacobians.then(linear).and_then(wanted),
        })
    };
    let frames: Result<_, RpcError> = frames.into_iter().enumerate().map(of_frame).collect();
    let points: Result<_, RpcError> = points.iter().enumerate().map(of_point).collect();
    let center = kinematics.center_of_mass();
    Ok(v1::KinematicsResponse {
        coordinates: coordinates(&model),
        frames: frames?,
        points: points?,
        center_of_mass: Some(v1::CenterOfMass {
            position: center.position.to_vec(),
            velocity: center.velocity.to_vec(),
            mass_kg: center.mass_kg,
            jacobian: jacobians.then(|| kinematics.center_of_mass_jacobian()).and_then(wanted),
        }),
        q,
        v,
    })
}

/// A point of a frame, and how it moves; `fields` name the frame and the point in errors.
fn motion(
    model: &Model,
    kinematics: &Kinematics,
    [frame, at]: [&str; 2],
    name: &str,
    position: [f64; 3],
) -> Result<(FramePoint, FrameMotion), RpcError> {
    let place =
        kinematics.point(name, position).ok_or_else(|| states::no_frame(frame, name, model))?;
    let motion = kinematics.motion(&place);
    let numbers = motion.position.iter().chain(&motion.linear_velocity);
    if !numbers.copied().all(f64::is_finite) {
        return Err(RpcError::field(at, "is too far away to compute with"));
    }
    Ok((place, motion))
}

/// Answers a Dynamics call.
pub(crate) fn dynamics(
    hub: &Hub,
    request: v1::DynamicsRequest,
) -> Result<v1::DynamicsResponse, RpcError> {
    let v1::DynamicsRequest { state, inputs, acceleration, prescribed_acceleration, forward } =
        request;
    let Mechanism { model, q, v, inputs: present } = Mechanism::new(hub, state)?;
    let (d, n) = (model.dimensions(), q.len());
    let numbers = n * (n + d.constraints + 8) + d.inputs + 3 * d.constraints;
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    LimitExceeded::check(name, limit, "numbers in the mass matrix and the forces", numbers)?;
    let zeros = vec![0.0; d.prescribed];
    let field = "prescribed_acceleration";
    let at = ContinuousPoint {
        inputs: given("inputs", inputs, present)?,
        prescribed_acceleration: given(field, prescribed_acceleration, zeros)?,
        q,
        v,
    };
    let asks_for_forces = !acceleration.is_empty();
    let acceleration = given("acceleration", acceleration, vec![0.0; d.dynamic])?;

    let mut continuous = Continuous::new(Arc::clone(&model));
    let terms = continuous.terms(&at)?;
    let forward = if forward { Some(continuous.evaluate(&at)?) } else { None };
    let inverse =
        if asks_for_forces { Some(continuous.inverse(&at, &acceleration)?) } else { None };
    let all = |dynamic: Vec<f64>| [&dynamic[..], &at.prescribed_acceleration].concat();
    Ok(v1::DynamicsResponse {
        coordinates: coordinates(&model),
        constraints: model.constraint_names().to_vec(),
        mass_matrix: Some(matrices::matrix(&terms.mass_matrix)),
        bias: terms.bias,
        gravity: terms.gravity,
        passive: terms.passive,
        input: terms.input,
        constraint_jacobian: Some(matrices::matrix(&terms.constraint_jacobian)),
        energy: Some(states::energy(terms.energy)),
        forward: forward.map(|value| v1::ForwardDynamics {
            acceleration: all(value.acceleration),
            multipliers: value.multipliers,
        }),
        inverse: inverse.map(|inverse| v1::InverseDynamics {
            force: inverse.force,
            multipliers: inverse.multipliers,
            constraint_acceleration: inverse.constraint_acceleration,
        }),
        q: at.q,
        v: at.v,
        inputs: at.inputs,
    })
}
