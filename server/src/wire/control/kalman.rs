//! `ControlService.SolveKalman` and `SolveTrajectoryKalman`.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use plantd_control::{self as control, Kalman, Momentum, NoiseCovariances, Sample, Values};
use plantd_models::{Linearization, Model, State};
use plantd_proto::v1;

use crate::core::feedback::regulator::{Constraints, Path, check_equilibrium};
use crate::core::inputs::Inputs;
use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::Abandoned;
use crate::wire::control::analysis::Outputs;
use crate::wire::control::points::{along_trajectory, at_point};
use crate::wire::message::{matrices, states, weights};
use crate::wire::shared::hub::{Hub, TrajectoryPermit};
use crate::wire::status::RpcError;

/// Answers a SolveKalman call.
pub(crate) fn solve(
    hub: &Hub,
    request: v1::SolveKalmanRequest,
) -> Result<v1::SolveKalmanResponse, RpcError> {
    let constraints = Constraints::new(request.constraints)?;
    let (mut plant, u) = at_point(hub, &request.model, request.settings, request.point)?;
    let v1::Measurement { outputs, output_x, output_u } = request.measurement.unwrap_or_default();
    let (output_x, output_u) = (output_x.as_ref(), output_u.as_ref());
    let outputs =
        Outputs::with_velocities("measurement.", outputs, output_x, output_u, &mut plant)?;
    let noise = noise(request.noise, &outputs, plant.model())?;
    check_equilibrium(plant.clone(), &u)?;
    let step = plant.step_index();
    let mut linearization = Linearization::new(plant.model());
    plant.linearize(&u, &mut linearization)?;
    let (a, b) = (linearization.a(), linearization.b());
    let filter: Kalman = match constraints.tangent(&mut plant) {
        Some(tangent) => {
            control::steady_state_kalman_on_manifold(&a, &b, &outputs.x, &tangent, &noise)?
        }
        None => control::steady_state_kalman(&a, &b, &outputs.x, &noise)?,
    };
    let x = states::x(&plant);
    Ok(v1::SolveKalmanResponse {
        gain: Some(matrices::matrix(&filter.gain)),
        predicted_covariance: Some(matrices::matrix(&filter.predicted)),
        filtered_covariance: Some(matrices::matrix(&filter.filtered)),
        error_modes: matrices::complex(&filter.error_modes),
        residual: filter.residual,
        iterations: filter.iterations,
        reciprocal_condition: filter.reciprocal_condition,
        linearization: Some(states::linearization(step, &linearization)),
        y_reference: outputs.at(&x, &u),
        x_reference: x,
        u_reference: u,
        output_x: Some(matrices::matrix(&outputs.x)),
        output_u: Some(matrices::matrix(&outputs.u)),
        outputs: outputs.names,
        rotations: states::rotations(plant.model()),
    })
}

fn outputs(measurement: Option<v1::Measurement>, model: &Model) -> Result<Outputs, RpcError> {
    let v1::Measurement { outputs, output_x, output_u } = measurement.unwrap_or_default();
    Outputs::new("measurement.", outputs, output_x.as_ref(), output_u.as_ref(), model)
}

impl Outputs {
    /// `y` at a state; without the part of the input where there is none.
    fn at(&self, x: &[f64], u: &[f64]) -> Vec<f64> {
        let mut y = &self.x * DVector::from_column_slice(x);
        if !u.is_empty() {
            y += &self.u * DVector::from_column_slice(u);
        }
        matrices::vector(y)
    }
}

fn noise(
    noise: Option<v1::NoiseCovariances>,
    outputs: &Outputs,
    model: &Model,
) -> Result<NoiseCovariances, RpcError> {
    let noise = noise.ok_or_else(|| RpcError::field("noise", "is missing"))?;
    let d = model.dimensions();
    let optional = |field: &str, given: Option<v1::Weight>, size: usize| {
        given.map(|given| weights::weight(field, Some(given), size)).transpose()
    };
    let process = optional("noise.process", noise.process, d.state())?;
    let input = optional("noise.input", noise.input, d.input())?;
    let measurement = weights::weight("noise.measurement", noise.measurement, outputs.x.nrows())?;
    Ok(NoiseCovariances::new(process, input, measurement)?)
}

/// Filters along a trajectory, delivered message by message.
pub(crate) struct TrajectoryFilter {
    gains: std::vec::IntoIter<DMatrix<f64>>,
    covariances: std::vec::IntoIter<(DMatrix<f64>, DMatrix<f64>)>,
    reciprocal_conditions: std::vec::IntoIter<f64>,
    states: std::vec::IntoIter<State>,
    samples: std::vec::IntoIter<Sample>,
    inputs: Inputs,
    outputs: Outputs,
    rotations: Vec<u32>,
    next: usize,
    /// Room in memory that the server grants.
    _permit: TrajectoryPermit,
}

impl TrajectoryFilter {
    pub(crate) fn solve(
        hub: &Hub,
        request: v1::SolveTrajectoryKalmanRequest,
        mut permit: TrajectoryPermit,
        abandoned: &Abandoned,
    ) -> Result<Self, RpcError> {
        let constraints = Constraints::new(request.constraints)?;
        let (name, settings) = (&request.model, request.settings);
        let (plant, inputs) = along_trajectory(hub, name, settings, request.trajectory)?;
        let model = Arc::clone(plant.model());
        let outputs = outputs(request.measurement, &model)?;
        let noise = [noise(request.noise, &outputs, &model)?];
        let size = model.dimensions().state();
        let initial = weights::weight("initial_covariance", request.initial_covariance, size)?;
        let values = if request.covariances { Values::Keep } else { Values::Drop };
        let (steps, rows) = (inputs.count(), outputs.x.nrows());
        permit.hold(check_memory(hub, &model, steps, rows, request.covariances)?)?;
        let path = Path::follow(plant, &inputs, Momentum::State, constraints, abandoned)?;
        let (samples, c) = (&path.samples, [outputs.x.clone()]);
        let solution = if path.tangents.is_empty() {
            control::time_varying_kalman(samples, &c, &noise, &initial, values)?
        } else {
            let tangents = &path.tangents;
            control::time_varying_kalman_on_manifold(
                samples, &c, tangents, &noise, &initial, values,
            )?
        };
        Ok(Self {
            gains: solution.gains.into_iter(),
            covariances: solution.covariances.unwrap_or_default().into_iter(),
            reciprocal_conditions: solution.reciprocal_conditions.into_iter(),
            states: path.states.into_iter(),
            samples: path.samples.into_iter(),
            inputs,
            outputs,
            rotations: states::rotations(&model),
            next: 0,
            _permit: permit,
        })
    }
}

/// Refuses a trajectory whose matrices would need too much memory: A, B, the tangent space twice, the
/// gain, and covariances if they are kept.
fn check_memory(
    hub: &Hub,
    model: &Model,
    steps: usize,
    outputs: usize,
    covariances: bool,
) -> Result<usize, RpcError> {
    let d = model.dimensions();
    let (nx, nu) = (d.state(), d.input());
    let tangents = if d.constraints > 0 { 2 * nx * nx } else { 0 };
    let covariances = if covariances { 2 * nx * nx } else { 0 };
    let of_state = nx * nx + nx * nu + nx * outputs + tangents + covariances;
    let numbers = (steps + 1).saturating_mul(of_state);
    let (name, limit) = ("trajectory_numbers", hub.limits.trajectory_numbers);
    LimitExceeded::check(name, limit, "numbers in the trajectory's matrices", numbers)?;
    Ok(numbers)
}

impl Iterator for TrajectoryFilter {
    type Item = v1::SolveTrajectoryKalmanResponse;

    fn next(&mut self) -> Option<Self::Item> {
        let x = self.states.next()?.x();
        let k = self.next;
        self.next += 1;
        let u = if k < self.inputs.count() { self.inputs.get(k).to_vec() } else { Vec::new() };
        let linearization = self.samples.next().map(|sample| v1::Linearization {
            step: k as u64,
            a: Some(matrices::matrix(&sample.a)),
            b: Some(matrices::matrix(&sample.b)),
            ..Default::default()
        });
        let (predicted, filtered) = self.covariances.next().unzip();
        let is_first = k == 0;
        Some(v1::SolveTrajectoryKalmanResponse {
            step: k as u64,
            gain: self.gains.next().map(|gain| matrices::matrix(&gain)),
            linearization,
            y_reference: self.outputs.at(&x, &u),
            x_reference: x,
            u_reference: u,
            predicted_covariance: predicted.as_ref().map(matrices::matrix),
            filtered_covariance: filtered.as_ref().map(matrices::matrix),
            reciprocal_condition: self.reciprocal_conditions.next().unwrap_or_default(),
            rotations: self.rotations.clone(),
            output_x: is_first.then(|| matrices::matrix(&self.outputs.x)),
            output_u: is_first.then(|| matrices::matrix(&self.outputs.u)),
        })
    }
}
