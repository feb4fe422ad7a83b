//! `ControlService.ProjectReference`: references from outside.

use nalgebra::DMatrix;
use plantd_control::Values;
use plantd_control::reference::{self, Assessment, Projected};
use plantd_models::Spare;
use plantd_proto::v1;
use v1::project_reference_response::Response as Answer;

use crate::core::feedback::regulator::{Constraints, Memory, Path};
use crate::core::inputs::Inputs;
use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::Abandoned;
use crate::wire::control::points::model_and_settings;
use crate::wire::message::start::{self, Start};
use crate::wire::message::{matrices, states, weights};
use crate::wire::shared::hub::{Hub, TrajectoryPermit};
use crate::wire::status::RpcError;

/// Error in an acceleration or a constraint up to which a reference is feasible.
const TOLERANCE: f64 = 1e-6;

/// An answered call, delivered message by message.
pub(crate) struct Projection {
    report: Option<v1::ReferenceReport>,
    inputs: DMatrix<f64>,
    states: DMatrix<f64>,
    gains: std::vec::IntoIter<DMatrix<f64>>,
    /// What the gains have in common.
    common: v1::Gain,
    next: usize,
    /// Room in memory that the server grants.
    _permit: TrajectoryPermit,
}

impl Projection {
    pub(crate) fn new(
        hub: &Hub,
        request: v1::ProjectReferenceRequest,
        mut permit: TrajectoryPermit,
        abandoned: &Abandoned,
    ) -> Result<Self, RpcError> {
        let constraints = Constraints::new(request.constraints)?;
        let tolerance = tolerance(request.tolerance)?;
        let (model, settings) = model_and_settings(hub, &request.model, request.settings)?;
        let d = model.dimensions();
        let q = request.q.ok_or_else(|| RpcError::field("q", "is missing"))?;
        let q = matrices::matrix_of("q", &q, None, d.coordinates())?;
        if q.nrows() < 2 {
            return Err(RpcError::field("q", format!("has {} rows; two are needed", q.nrows())));
        }
        let steps = q.nrows() - 1;
        LimitExceeded::check("horizon", hub.limits.horizon, "steps", steps)?;
        let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
        let numbers = steps.saturating_mul(2 * d.input());
        LimitExceeded::check(name, limit, "numbers in the report's inputs", numbers)?;
        let momentum = weights::momentum_in("weights", request.weights.as_ref())?;
        let memory = Memory { steps, stages: 0, momentum, values: Values::Drop };
        permit.hold(memory.check(&hub.limits, &model)?)?;
        let u =
            request.u.map(|u| matrices::matrix_of("u", &u, Some(steps), d.input())).transpose()?;
        let pull = match request.projection {
            None => None,
            given => Some(weights::state_weights_in("projection", given, &model)?),
        };
        let weights = match request.weights {
            None => None,
            given => Some(weights::weights(given, &model)?),
        };

        let mut spare = Spare::new(model.clone(), settings)
            .map_err(|error| RpcError::from_initial(error, "settings"))?;
        let assessment = reference::check_reference(&spare, &q, u.as_ref())?;
        abandoned.check()?;
        if request.strict && !assessment.is_feasible(tolerance) {
            return Err(infeasible(&assessment, tolerance));
        }
        let on_manifold = constraints == Constraints::Manifold;
        let projected = reference::project(&spare, &q, &assessment, pull.as_ref(), on_manifold)?;
        abandoned.check()?;
        let initial = states::state(&projected.initial, &mut spare)
            .map_err(|error| RpcError::from_initial(error, "q"))?;
        let gains = match weights {
            None => Vec::new(),
            Some(weights) => {
                let inputs = Inputs::from_rows(&projected.inputs);
                let start = Start::Initial(start::momentum_of(&projected.initial));
                let plant = start::plant(&model, settings, &start, "q")?;
                let path = Path::follow(plant, &inputs, momentum, constraints, abandoned)?;
                path.solve(&weights.into(), Values::Drop)?.gains
            }
        };
        Ok(Self {
            report: Some(report(&assessment, &projected, tolerance, initial)),
            common: states::gain_of(&request.model, &model, &settings),
            inputs: projected.inputs,
            states: projected.states,
            gains: gains.into_iter(),
            next: 0,
            _permit: permit,
        })
    }
}

fn tolerance(given: f64) -> Result<f64, RpcError> {
    match given {
        0.0 => Ok(TOLERANCE),
        given if given.is_finite() && given > 0.0 => Ok(given),
        _ => Err(RpcError::field("tolerance", "must be finite and greater than zero")),
    }
}

fn infeasible(assessment: &Assessment, tolerance: f64) -> RpcError {
    let message = if assessment.unexplained_acceleration > tolerance {
        format!(
            "no input and no constraint explains an acceleration of {:e} of `{}` at step {}; \
             project the reference (`strict` off), or raise the tolerance above {tolerance:e}",
            assessment.unexplained_acceleration,
            assessment.unexplained_coordinate,
            assessment.unexplained_step
        )
    } else {
        format!(
            "constraint `{}` is violated by {:e} at step {}; project the reference (`strict` off), \
             or raise the tolerance above {tolerance:e}",
            assessment.constraint,
            assessment.constraint_violation,
            assessment.constraint_violation_step
        )
    };
    RpcError::precondition("INFEASIBLE_REFERENCE", "q", message)
        .with("unexplained_acceleration", assessment.unexplained_acceleration)
        .with("unexplained_coordinate", &assessment.unexplained_coordinate)
        .with("unexplained_step", assessment.unexplained_step)
        .with("constraint_violation", assessment.constraint_violation)
        .with("constraint_violation_step", assessment.constraint_violation_step)
}

fn report(
    assessment: &Assessment,
    projected: &Projected,
    tolerance: f64,
    initial: v1::State,
) -> v1::ReferenceReport {
    let u = Some(matrices::matrix(&projected.inputs));
    v1::ReferenceReport {
        feasible: assessment.is_feasible(tolerance),
        constraint_violation: assessment.constraint_violation,
        constraint_violation_step: assessment.constraint_violation_step as u32,
        constraint: assessment.constraint.clone(),
        unexplained_force: assessment.unexplained_force,
        unexplained_force_step: assessment.unexplained_force_step as u32,
        unexplained_force_coordinate: assessment.unexplained_force_coordinate.clone(),
        unexplained_acceleration: assessment.unexplained_acceleration,
        unexplained_step: assessment.unexplained_step as u32,
        unexplained_coordinate: assessment.unexplained_coordinate.clone(),
        u: Some(matrices::matrix(&assessment.inputs)),
        deviation: projected.deviation,
        deviation_step: projected.deviation_step as u32,
        deviation_coordinate: projected.deviation_coordinate.clone(),
        trajectory: Some(v1::Trajectory { initial: Some(initial), u }),
    }
}

fn row(matrix: &DMatrix<f64>, k: usize) -> Vec<f64> {
    if k < matrix.nrows() { matrix.row(k).iter().copied().collect() } else { Vec::new() }
}

impl Iterator for Projection {
    type Item = v1::ProjectReferenceResponse;

    fn next(&mut self) -> Option<Self::Item> {
        let response = match self.report.take() {
            Some(report) => Answer::Report(report),
            None => {
                let k = self.next;
                if k >= self.states.nrows() {
                    return None;
                }
                self.next += 1;
                Answer::Step(v1::Gain {
                    step: k as u64,
                    k: self.gains.next().map(|gain| matrices::matrix(&gain)),
                    x_reference: row(&self.states, k),
                    u_reference: row(&self.inputs, k),
                    ..self.common.clone()
                })
            }
        };
        Some(v1::ProjectReferenceResponse { response: Some(response) })
    }
}
