//! Second-order linearization of the map, and the dynamics of continuous time.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, Dimensions, Linearization, SecondOrder,
};
use plantd_proto::v1;

use crate::core::limits::LimitExceeded;
use crate::wire::control::points::{at_point, given, operating_point};
use crate::wire::message::report::report_message;
use crate::wire::message::{checks, matrices, states};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Answers a LinearizeSecondOrder call.
pub(crate) fn linearize_second_order(
    hub: &Hub,
    request: v1::LinearizeSecondOrderRequest,
) -> Result<v1::LinearizeSecondOrderResponse, RpcError> {
    let (mut plant, u) = at_point(hub, &request.model, request.settings, request.point)?;
    let model = Arc::clone(plant.model());
    let d = model.dimensions();
    check_second_order(hub, d.state() + d.constraints, d.state() + d.input())?;
    let state = states::plant_state(&mut plant);
    let mut first = Linearization::new(&model);
    let (report, tensors, contraction) = match request.weights {
        None => {
            let numbers = (d.state() + d.constraints) * (d.state() + d.input()).pow(2);
            let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in the tensors; give weights", numbers)?;
            let mut second = SecondOrder::new(&model)?;
            let report = plant.linearize_second_order(&u, &mut first, &mut second)?;
            (report, Some(tensors(&second, d)), None)
        }
        Some(weights) => {
            let x = weights_of("weights.x", weights.x, d.state())?;
            let multipliers =
                weights_of("weights.multipliers", weights.multipliers, d.constraints)?;
            let mut sum = Contraction::new(&model);
            let report = plant.contract_second_order(&u, &x, &multipliers, &mut first, &mut sum)?;
            (report, None, Some(contraction(&sum)))
        }
    };
    plant.step(&u)?;
    Ok(v1::LinearizeSecondOrderResponse {
        linearization: Some(states::linearization(state.step, &first)),
        next: Some(states::plant_state(&mut plant)),
        state: Some(state),
        u,
        tensors,
        contraction,
        report: Some(report_message(&report)),
    })
}

/// Answers an EvaluateDynamics call.
pub(crate) fn evaluate_dynamics(
    hub: &Hub,
    request: v1::EvaluateDynamicsRequest,
) -> Result<v1::EvaluateDynamicsResponse, RpcError> {
    let model = hub.catalog.get(&request.model)?.model;
    let d = model.dimensions();
    let n = d.coordinates();
    let parameters = 2 * n + d.input();
    let outputs = d.dynamic + d.constraints;
    let point = operating_point(&model, "operating_point", &request.operating_point)?;
    let zeros = |count| vec![0.0; count];
    let at = ContinuousPoint {
        q: given("q", request.q, point.q.clone())?,
        v: given("v", request.v, zeros(n))?,
        inputs: given("inputs", request.inputs, point.u[..d.inputs].to_vec())?,
        prescribed_acceleration: given(
            "prescribed_acceleration",
            request.prescribed_acceleration,
            zeros(d.prescribed),
        )?,
    };
    let numbers = match request.order {
        0 => outputs,
        1 => outputs * (1 + parameters),
        2 => outputs * (1 + parameters + parameters * parameters),
        order => {
            return Err(RpcError::field(
                "order",
                format!("is {order}; derivatives end with the second"),
            ));
        }
    };
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    LimitExceeded::check(name, limit, "numbers in the derivatives", numbers)?;
    let mut continuous = Continuous::new(Arc::clone(&model));
    let (value, jacobian) = match request.order {
        0 => (continuous.evaluate(&at)?, None),
        _ => {
            let first = continuous.linearize(&at)?;
            (first.value, Some(first.jacobian))
        }
    };
    let hessian = match request.order {
        2 => Some(tensor(&continuous.second_order(&at)?, parameters, parameters)),
        _ => None,
    };
    Ok(v1::EvaluateDynamicsResponse {
        acceleration: value.acceleration,
        multipliers: value.multipliers,
        jacobian: jacobian.map(|jacobian| matrices::matrix(&jacobian)),
        hessian,
    })
}

/// Refuses second derivatives that would take too long, formed or not.
fn check_second_order(hub: &Hub, outputs: usize, parameters: usize) -> Result<(), RpcError> {
    let numbers = outputs.saturating_mul(parameters.saturating_mul(parameters));
    let (name, limit) = ("second_order_numbers", hub.limits.second_order_numbers);
    Ok(LimitExceeded::check(name, limit, "second derivatives", numbers)?)
}

/// Weights of the request; empty means zero.
fn weights_of(field: &str, weights: Vec<f64>, expected: usize) -> Result<Vec<f64>, RpcError> {
    if weights.is_empty() {
        return Ok(vec![0.0; expected]);
    }
    checks::check_numbers(field, &weights, expected)?;
    Ok(weights)
}

fn tensors(second: &SecondOrder, d: Dimensions) -> v1::SecondOrder {
    let (nx, nu) = (d.state(), d.input());
    let of = |outputs: usize, slice: &dyn Fn(usize) -> DMatrix<f64>, first, second| {
        let slices: Vec<_> = (0..outputs).map(slice).collect();
        Some(tensor(&slices, first, second))
    };
    v1::SecondOrder {
        xx: of(nx, &|i| second.xx(i), nx, nx),
        xu: of(nx, &|i| second.xu(i), nx, nu),
        uu: of(nx, &|i| second.uu(i), nu, nu),
        multipliers_xx: of(d.constraints, &|c| second.multiplier_xx(c), nx, nx),
        multipliers_xu: of(d.constraints, &|c| second.multiplier_xu(c), nx, nu),
        multipliers_uu: of(d.constraints, &|c| second.multiplier_uu(c), nu, nu),
    }
}

/// One matrix [first][second] per output.
fn tensor(slices: &[DMatrix<f64>], first: usize, second: usize) -> v1::Tensor {
    let mut data = Vec::with_capacity(slices.len() * first * second);
    for slice in slices {
        data.extend_from_slice(slice.transpose().as_slice());
    }
    v1::Tensor { outputs: slices.len() as u32, first: first as u32, second: second as u32, data }
}

fn contraction(sum: &Contraction) -> v1::Contraction {
    v1::Contraction {
        xx: Some(matrices::matrix(&sum.xx)),
        xu: Some(matrices::matrix(&sum.xu)),
        uu: Some(matrices::matrix(&sum.uu)),
    }
}
