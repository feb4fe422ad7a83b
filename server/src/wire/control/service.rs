//! `plantd.v1.ControlService`. Everything is computed on workers, streams in portions: a slow reader
//! holds no worker.

use std::collections::VecDeque;
use std::sync::Arc;

use futures::{StreamExt, stream};
use nalgebra::{DMatrix, DVector};
use plantd_control::{self as control, Values};
use plantd_models::{Linearization, Plant, State};
use plantd_proto::v1;
use tonic::{Request, Response, Status};

use crate::core::feedback::regulator::{self, Constraints, Memory, Path};
use crate::core::inputs::Inputs;
use crate::core::workers::pool::Abandoned;
use crate::wire::answers::Answers;
use crate::wire::control::points::{along_trajectory, at_point, model_at};
use crate::wire::control::{
    analysis, derivatives, kalman, mechanics, optimize, reference, rollout,
};
use crate::wire::message::report::report_message;
use crate::wire::message::weights::{self, WeightFields};
use crate::wire::message::{matrices, states};
use crate::wire::shared::hub::{Hub, TrajectoryPermit};
use crate::wire::status::RpcError;

/// Numbers that one portion of a stream holds, about: 2 MB.
const PORTION_NUMBERS: usize = 250_000;

/// The service.
pub struct ControlService {
    hub: Arc<Hub>,
}

impl ControlService {
    /// The service on a hub.
    pub fn new(hub: Arc<Hub>) -> Self {
        Self { hub }
    }

    /// What a worker makes of a request.
    async fn answer<Q: Send + 'static, A: Send + 'static>(
        &self,
        request: Request<Q>,
        job: impl FnOnce(&Hub, Q, &Abandoned) -> Result<A, RpcError> + Send + 'static,
    ) -> Result<Response<A>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |abandoned: &Abandoned| job(&hub, request, abandoned);
        Ok(Response::new(self.hub.workers.run(job).await?))
    }
}

fn linearize(hub: &Hub, request: v1::LinearizeRequest) -> Result<v1::LinearizeResponse, RpcError> {
    let (mut plant, u) = at_point(hub, &request.model, request.settings, request.point)?;
    let state = states::plant_state(&mut plant);
    let mut linearization = Linearization::new(plant.model());
    let report = plant.step_and_linearize(&u, &mut linearization)?;
    let rank = control::controllability_rank(&linearization.a(), &linearization.b());
    Ok(v1::LinearizeResponse {
        linearization: Some(states::linearization(state.step, &linearization)),
        next: Some(states::plant_state(&mut plant)),
        controllability_rank: u32::try_from(rank).unwrap_or(u32::MAX),
        state: Some(state),
        u,
        report: Some(report_message(&report)),
    })
}

fn solve_lqr(hub: &Hub, request: v1::SolveLqrRequest) -> Result<v1::SolveLqrResponse, RpcError> {
    let constraints = Constraints::new(request.constraints)?;
    let model = model_at(hub, &request.model, request.point.as_ref())?;
    let (mut plant, u) = at_point(hub, &request.model, request.settings, request.point)?;
    let momentum = weights::momentum_in("weights", request.weights.as_ref())?;
    let weights = weights::weights(request.weights, plant.model())?;
    let regulator = regulator::about_point(&mut plant, &u, &weights, momentum, constraints)?;
    Ok(v1::SolveLqrResponse {
        gain: Some(v1::Gain {
            k: Some(matrices::matrix(&regulator.gain)),
            x_reference: states::x(&plant),
            u_reference: u,
            ..states::gain_of(&model, plant.model(), plant.settings())
        }),
        value: Some(matrices::matrix(&regulator.value)),
        spectral_radius: regulator.spectral_radius,
        residual: regulator.residual,
        iterations: regulator.iterations,
        closed_loop: matrices::complex(&regulator.closed_loop),
        reciprocal_condition: regulator.reciprocal_condition,
    })
}

/// The linearizations of a trajectory, computed portion by portion.
struct LinearizedTrajectory {
    plant: Plant,
    inputs: Inputs,
    linearization: Linearization,
    steps_taken: usize,
    portion: usize,
}

impl LinearizedTrajectory {
    fn new(hub: &Hub, request: v1::LinearizeTrajectoryRequest) -> Result<Self, RpcError> {
        let v1::LinearizeTrajectoryRequest { model, settings, trajectory } = request;
        let (plant, inputs) = along_trajectory(hub, &model, settings, trajectory)?;
        let numbers = states::linearization_numbers(plant.model().dimensions()).max(1);
        let portion = (PORTION_NUMBERS / numbers).max(1);
        let linearization = Linearization::new(plant.model());
        Ok(Self { plant, inputs, linearization, steps_taken: 0, portion })
    }

    /// The next portion; empty at the end. What precedes a failure comes first.
    fn next(&mut self, abandoned: &Abandoned) -> Result<Portion, RpcError> {
        let mut portion = VecDeque::new();
        while portion.len() < self.portion && self.steps_taken < self.inputs.count() {
            abandoned.check()?;
            let state = states::plant_state(&mut self.plant);
            let u = self.inputs.get(self.steps_taken);
            let report = match self.plant.step_and_linearize(u, &mut self.linearization) {
                Ok(report) => report_message(&report),
                Err(error) => {
                    let fault = RpcError::from(error).with("steps_taken", self.steps_taken);
                    portion.push_back(Err(fault));
                    self.steps_taken = self.inputs.count();
                    break;
                }
            };
            portion.push_back(Ok(v1::LinearizeTrajectoryResponse {
                linearization: Some(states::linearization(state.step, &self.linearization)),
                state: Some(state),
                report: Some(report),
            }));
            self.steps_taken += 1;
        }
        Ok(portion)
    }
}

type Portion = VecDeque<Result<v1::LinearizeTrajectoryResponse, RpcError>>;

fn trajectory_stream(
    hub: Arc<Hub>,
    trajectory: LinearizedTrajectory,
) -> Answers<v1::LinearizeTrajectoryResponse> {
    let state = (Some(trajectory), VecDeque::new());
    let portions = stream::unfold(state, move |(mut trajectory, mut ready)| {
        let hub = Arc::clone(&hub);
        async move {
            if ready.is_empty() {
                let mut source: LinearizedTrajectory = trajectory.take()?;
                let job = move |abandoned: &Abandoned| {
                    let portion = source.next(abandoned)?;
                    Ok((source, portion))
                };
                match hub.workers.resume(job).await {
                    Ok((source, portion)) => (trajectory, ready) = (Some(source), portion),
                    Err(fault) => ready.push_back(Err(fault)),
                }
            }
            let item = ready.pop_front()?;
            Some((item.map_err(Status::from), (trajectory, ready)))
        }
    });
    Box::pin(end_with(portions))
}

/// Ends a stream after its first error.
fn end_with<T>(
    items: impl stream::Stream<Item = Result<T, Status>>,
) -> impl stream::Stream<Item = Result<T, Status>> {
    items.scan(false, |has_failed, item| {
        let item = if *has_failed { None } else { Some(item) };
        *has_failed = matches!(item, Some(Err(_)));
        futures::future::ready(item)
    })
}

/// A solved regulator along a trajectory, delivered message by message.
struct TrajectoryRegulator {
    gains: std::vec::IntoIter<DMatrix<f64>>,
    feedforward: std::vec::IntoIter<DVector<f64>>,
    values: std::vec::IntoIter<(DMatrix<f64>, DVector<f64>)>,
    reciprocal_conditions: std::vec::IntoIter<f64>,
    states: std::vec::IntoIter<State>,
    inputs: Inputs,
    /// What the gains have in common.
    common: v1::Gain,
    next: usize,
    /// Room in memory that the server grants.
    _permit: TrajectoryPermit,
}

impl TrajectoryRegulator {
    fn solve(
        hub: &Hub,
        request: v1::SolveTrajectoryLqrRequest,
        mut permit: TrajectoryPermit,
        abandoned: &Abandoned,
    ) -> Result<Self, RpcError> {
        let constraints = Constraints::new(request.constraints)?;
        let (name, settings) = (&request.model, request.settings);
        let (plant, inputs) = along_trajectory(hub, name, settings, request.trajectory)?;
        let model = Arc::clone(plant.model());
        let values = if request.values { Values::Keep } else { Values::Drop };
        let momentum = weights::momentum_in("weights", request.weights.as_ref())?;
        let (steps, stages) = (inputs.count(), request.stages.len());
        let memory = Memory { steps, stages, momentum, values };
        permit.hold(memory.check(&hub.limits, &model)?)?;
        let fields = WeightFields::default();
        let (weights, stages) = (request.weights, request.stages);
        let weights = weights::trajectory_weights(fields, weights, stages, steps, &model)?;
        let common = states::gain_of(&request.model, &model, plant.settings());
        let path = Path::follow(plant, &inputs, momentum, constraints, abandoned)?;
        let solution = path.solve(&weights, values)?;
        Ok(Self {
            gains: solution.gains.into_iter(),
            feedforward: solution.feedforward.into_iter(),
            values: solution.values.unwrap_or_default().into_iter(),
            reciprocal_conditions: solution.reciprocal_conditions.into_iter(),
            states: path.states.into_iter(),
            inputs,
            common,
            next: 0,
            _permit: permit,
        })
    }
}

impl Iterator for TrajectoryRegulator {
    type Item = v1::SolveTrajectoryLqrResponse;

    fn next(&mut self) -> Option<Self::Item> {
        let state = self.states.next()?;
        let k = self.next;
        self.next += 1;
        let u = if k < self.inputs.count() { self.inputs.get(k).to_vec() } else { Vec::new() };
        let gain = v1::Gain {
            step: k as u64,
            k: self.gains.next().map(|gain| matrices::matrix(&gain)),
            x_reference: state.x(),
            u_reference: u,
            feedforward: self.feedforward.next().map(matrices::vector).unwrap_or_default(),
            ..self.common.clone()
        };
        let (value, linear) = self.values.next().unzip();
        Some(v1::SolveTrajectoryLqrResponse {
            gain: Some(gain),
            value: value.as_ref().map(matrices::matrix),
            value_linear: linear.map(matrices::nonzero).unwrap_or_default(),
            reciprocal_condition: self.reciprocal_conditions.next().unwrap_or_default(),
        })
    }
}

#[tonic::async_trait]
impl v1::control_service_server::ControlService for ControlService {
    type LinearizeTrajectoryStream = Answers<v1::LinearizeTrajectoryResponse>;
    type SolveTrajectoryLqrStream = Answers<v1::SolveTrajectoryLqrResponse>;
    type RolloutStream = Answers<v1::RolloutResponse>;
    type OptimizeTrajectoryStream = Answers<v1::OptimizeTrajectoryResponse>;
    type ProjectReferenceStream = Answers<v1::ProjectReferenceResponse>;
    type SolveTrajectoryKalmanStream = Answers<v1::SolveTrajectoryKalmanResponse>;

    async fn linearize(
        &self,
        request: Request<v1::LinearizeRequest>,
    ) -> Result<Response<v1::LinearizeResponse>, Status> {
        self.answer(request, |hub, request, _| linearize(hub, request)).await
    }

    async fn linearize_trajectory(
        &self,
        request: Request<v1::LinearizeTrajectoryRequest>,
    ) -> Result<Response<Self::LinearizeTrajectoryStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let job = move |_: &_| LinearizedTrajectory::new(&hub, request);
        let trajectory = self.hub.workers.run(job).await?;
        let answers = trajectory_stream(Arc::clone(&self.hub), trajectory);
        Ok(Response::new(self.hub.until_ending(answers)))
    }

    async fn solve_lqr(
        &self,
        request: Request<v1::SolveLqrRequest>,
    ) -> Result<Response<v1::SolveLqrResponse>, Status> {
        self.answer(request, |hub, request, _| solve_lqr(hub, request)).await
    }

    async fn solve_trajectory_lqr(
        &self,
        request: Request<v1::SolveTrajectoryLqrRequest>,
    ) -> Result<Response<Self::SolveTrajectoryLqrStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let permit = hub.trajectory_permit()?;
        let job = move |abandoned: &Abandoned| {
            TrajectoryRegulator::solve(&hub, request, permit, abandoned)
        };
        let solution = self.hub.workers.run(job).await?;
        let answers = Box::pin(stream::iter(solution.map(Ok)));
        Ok(Response::new(self.hub.until_ending(answers)))
    }

    async fn rollout(
        &self,
        request: Request<v1::RolloutRequest>,
    ) -> Result<Response<Self::RolloutStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        hub.check_takes_new()?;
        let job = move |_: &_| rollout::Rollout::new(&hub, request);
        let rollout = self.hub.workers.run(job).await?;
        let answers = rollout.run(self.hub.workers.clone());
        Ok(Response::new(self.hub.until_ending(answers)))
    }

    async fn linearize_second_order(
        &self,
        request: Request<v1::LinearizeSecondOrderRequest>,
    ) -> Result<Response<v1::LinearizeSecondOrderResponse>, Status> {
        self.answer(request, |hub, request, _| derivatives::linearize_second_order(hub, request))
            .await
    }

    async fn evaluate_dynamics(
        &self,
        request: Request<v1::EvaluateDynamicsRequest>,
    ) -> Result<Response<v1::EvaluateDynamicsResponse>, Status> {
        self.answer(request, |hub, request, _| derivatives::evaluate_dynamics(hub, request)).await
    }

    async fn kinematics(
        &self,
        request: Request<v1::KinematicsRequest>,
    ) -> Result<Response<v1::KinematicsResponse>, Status> {
        self.answer(request, mechanics::kinematics).await
    }

    async fn dynamics(
        &self,
        request: Request<v1::DynamicsRequest>,
    ) -> Result<Response<v1::DynamicsResponse>, Status> {
        self.answer(request, |hub, request, _| mechanics::dynamics(hub, request)).await
    }

    async fn analyze(
        &self,
        request: Request<v1::AnalyzeRequest>,
    ) -> Result<Response<v1::AnalyzeResponse>, Status> {
        self.answer(request, analysis::analyze).await
    }

    async fn optimize_trajectory(
        &self,
        request: Request<v1::OptimizeTrajectoryRequest>,
    ) -> Result<Response<Self::OptimizeTrajectoryStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let permit = hub.trajectory_permit()?;
        let job = move |_: &_| optimize::Search::new(&hub, request, permit);
        let search = self.hub.workers.run(job).await?;
        let answers = search.run(Arc::clone(&self.hub));
        Ok(Response::new(self.hub.until_ending(answers)))
    }

    async fn project_reference(
        &self,
        request: Request<v1::ProjectReferenceRequest>,
    ) -> Result<Response<Self::ProjectReferenceStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let permit = hub.trajectory_permit()?;
        let job = move |abandoned: &Abandoned| {
            reference::Projection::new(&hub, request, permit, abandoned)
        };
        let projection = self.hub.workers.run(job).await?;
        let answers = Box::pin(stream::iter(projection.map(Ok)));
        Ok(Response::new(self.hub.until_ending(answers)))
    }

    async fn solve_kalman(
        &self,
        request: Request<v1::SolveKalmanRequest>,
    ) -> Result<Response<v1::SolveKalmanResponse>, Status> {
        self.answer(request, |hub, request, _| kalman::solve(hub, request)).await
    }

    async fn solve_trajectory_kalman(
        &self,
        request: Request<v1::SolveTrajectoryKalmanRequest>,
    ) -> Result<Response<Self::SolveTrajectoryKalmanStream>, Status> {
        let (hub, request) = (Arc::clone(&self.hub), request.into_inner());
        let permit = hub.trajectory_permit()?;
        let job = move |abandoned: &Abandoned| {
            kalman::TrajectoryFilter::solve(&hub, request, permit, abandoned)
        };
        let filter = self.hub.workers.run(job).await?;
        let answers = Box::pin(stream::iter(filter.map(Ok)));
        Ok(Response::new(self.hub.until_ending(answers)))
    }
}
