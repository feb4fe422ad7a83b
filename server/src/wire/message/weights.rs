//! Weights of regulators, filters and optimisations.

use nalgebra::{DMatrix, DVector};
use plantd_control::{Momentum, StageWeights, TrajectoryWeights, Weights, WeightsError};
use plantd_models::Model;
use plantd_proto::v1;
use v1::weight::Form as WeightForm;

use crate::wire::message::checks::check_numbers;
use crate::wire::message::matrices::matrix_of;
use crate::wire::status::RpcError;

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
