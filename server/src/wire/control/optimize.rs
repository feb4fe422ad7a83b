//! `ControlService.OptimizeTrajectory`: a search on the workers, one iteration after the other. Between
//! two of them, and now and then within one, others have their turn. Ending the call ends the search.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

use futures::stream;
use nalgebra::DMatrix;
use plantd_control::Momentum;
use plantd_control::optimize::{
    Bound, Bounds, Checkpoint, FreeInitialState, Method, Optimizer, Options, Progress, Status,
    TrajectoryCost,
};
use plantd_models::scene::UnknownName;
use plantd_models::{Model, Plant, Spare, State};
use plantd_proto::v1;
use v1::optimize_trajectory_response::Response as Answer;

use crate::core::inputs::Inputs;
use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::{Abandoned, Helpers};
use crate::wire::answers::Answers;
use crate::wire::control::points::model_and_settings;
use crate::wire::message::weights::{self, WeightFields};
use crate::wire::message::{checks, matrices, states};
use crate::wire::shared::hub::{Hub, TrajectoryPermit};
use crate::wire::status::RpcError;

/// A search.
pub(crate) struct Search {
    optimizer: Optimizer,
    /// What the threads of the search have used besides this one's.
    helpers: Arc<Helpers>,
    /// Finds the velocities of states.
    spare: Spare,
    checkpoint_every: u32,
    /// Room in memory that the server grants.
    _permit: TrajectoryPermit,
}

impl Search {
    /// Checks the request and simulates the guess.
    pub(crate) fn new(
        hub: &Hub,
        request: v1::OptimizeTrajectoryRequest,
        mut permit: TrajectoryPermit,
    ) -> Result<Self, RpcError> {
        let (model, settings) = model_and_settings(hub, &request.model, request.settings)?;
        let (given, checkpoint_every) = given_options(hub, request.options, &model)?;
        let start = Start::new(hub, request.guess, request.resume, &model, settings)?;
        let steps = start.steps();
        let cost = request.cost.ok_or_else(|| RpcError::field("cost", "is missing"))?;
        let uses_newton = [Some(given.method), given.first_method].contains(&Some(Method::Newton));
        permit.hold(check_memory(hub, &model, steps, &cost, uses_newton)?)?;
        let cost = trajectory_cost(cost, steps, &model)?;
        let bounds = bounds(request.bounds.unwrap_or_default(), &model)?;
        let free = request.free_initial.map(|free| free_initial(free, &model)).transpose()?;
        let mut optimizer = match start {
            Start::Guess(plant, inputs) => {
                Optimizer::new(*plant, inputs, cost, &bounds, free, given)?
            }
            Start::Resume(plant, checkpoint) => {
                Optimizer::resume(*plant, cost, &bounds, free, given, &checkpoint)?
            }
        };
        optimizer.set_threads(hub.search_threads);
        let helpers = Arc::new(Helpers::default());
        let counted = Arc::clone(&helpers);
        optimizer.set_around(move |work| counted.count(work));
        let spare = Spare::new(model, settings)
            .map_err(|error| RpcError::from_initial(error, "settings"))?;
        Ok(Self { optimizer, helpers, spare, checkpoint_every, _permit: permit })
    }

    /// The messages of the search.
    pub(crate) fn run(self, hub: Arc<Hub>) -> Answers<v1::OptimizeTrajectoryResponse> {
        let begin = (Some(self), VecDeque::new());
        Box::pin(stream::unfold(begin, move |(mut search, mut ready)| {
            let hub = Arc::clone(&hub);
            async move {
                if ready.is_empty() {
                    let mut running: Search = search.take()?;
                    let job = move |abandoned: &Abandoned| {
                        let (messages, is_over) = running.iterate(abandoned)?;
                        Ok((messages, (!is_over).then_some(running)))
                    };
                    match hub.workers.resume(job).await {
                        Ok((messages, rest)) => (search, ready) = (rest, messages),
                        Err(fault) => return Some((Err(fault.into()), (None, ready))),
                    }
                }
                let response = Some(ready.pop_front()?);
                Some((Ok(v1::OptimizeTrajectoryResponse { response }), (search, ready)))
            }
        }))
    }

    /// One iteration, with the result after the last; true when there is none to come.
    fn iterate(&mut self, abandoned: &Abandoned) -> Result<(VecDeque<Answer>, bool), RpcError> {
        let mut messages = VecDeque::new();
        if self.optimizer.status() == Status::Running {
            let iterated = self.optimizer.iterate(&mut || abandoned.check().is_ok());
            abandoned.helped(self.helpers.take());
            match iterated {
                Ok(progress) => messages.push_back(Answer::Progress(self.progress(&progress)?)),
                // A trajectory that the search cannot leave: what there is is the answer.
                Err(error) => {
                    abandoned.check()?;
                    messages.push_back(Answer::Result(self.result(Some(error.into()))?));
                    return Ok((messages, true));
                }
            }
        }
        let failure = match self.optimizer.status() {
            Status::Running => return Ok((messages, false)),
            Status::Converged => None,
            Status::Stuck(stuck) => Some(RpcError::from(stuck)),
        };
        messages.push_back(Answer::Result(self.result(failure)?));
        Ok((messages, true))
    }

    fn progress(&mut self, progress: &Progress) -> Result<v1::OptimizationProgress, RpcError> {
        let every = self.checkpoint_every;
        let is_wanted = every > 0 && (progress.iteration + 1).is_multiple_of(every);
        Ok(v1::OptimizationProgress {
            iteration: progress.iteration,
            cost_before: progress.cost_before,
            cost: progress.cost,
            directional_derivative: progress.directional_derivative,
            method: method_message(progress.method).into(),
            fallback: progress.fallback.map(|fallback| fallback.to_string()).unwrap_or_default(),
            step_length: progress.step_length,
            backtracks: progress.backtracks,
            bound_violation: progress.bound_violation,
            checkpoint: if is_wanted { Some(self.checkpoint()?) } else { None },
        })
    }

    fn checkpoint(&mut self) -> Result<v1::OptimizationCheckpoint, RpcError> {
        let Checkpoint {
            initial,
            inputs,
            iterations,
            first_cost,
            bound_multipliers,
            penalty,
            bound_violation,
            initial_reference,
            backtracks,
            last_derivative,
        } = self.optimizer.checkpoint();
        let mut state = |state: &State| {
            states::state(state, &mut self.spare)
                .map(Some)
                .map_err(|error| RpcError::from_initial(error, "guess.initial"))
        };
        let u = Some(matrices::matrix(&inputs));
        Ok(v1::OptimizationCheckpoint {
            trajectory: Some(v1::Trajectory { initial: state(&initial)?, u }),
            iterations,
            first_cost,
            bound_multipliers,
            penalty,
            bound_violation,
            initial_reference: state(&initial_reference)?,
            backtracks,
            last_derivative,
        })
    }

    fn result(&mut self, failure: Option<RpcError>) -> Result<v1::OptimizationResult, RpcError> {
        Ok(v1::OptimizationResult {
            converged: failure.is_none(),
            failure: failure.map(Into::into),
            cost: self.optimizer.cost(),
            bound_violation: self.optimizer.bound_violation(),
            checkpoint: Some(self.checkpoint()?),
            x: Some(matrices::matrix(&self.optimizer.states())),
        })
    }
}

/// Where a search begins.
enum Start {
    Guess(Box<Plant>, DMatrix<f64>),
    Resume(Box<Plant>, Box<Checkpoint>),
}

impl Start {
    fn new(
        hub: &Hub,
        guess: Option<v1::Trajectory>,
        resume: Option<v1::OptimizationCheckpoint>,
        model: &Arc<Model>,
        settings: plantd_models::Settings,
    ) -> Result<Self, RpcError> {
        match (guess, resume) {
            (None, None) => Err(RpcError::field("guess", "is missing, and so is `resume`")),
            (Some(_), Some(_)) => Err(RpcError::field("resume", "is given together with `guess`")),
            (Some(guess), None) => {
                let (plant, inputs) = trajectory(hub, "guess", guess, model, settings)?;
                Ok(Self::Guess(Box::new(plant), inputs))
            }
            (None, Some(resume)) => {
                let missing = |name: &str| RpcError::field(format!("resume.{name}"), "is missing");
                let given = resume.trajectory.ok_or_else(|| missing("trajectory"))?;
                let initial = given.initial.clone().ok_or_else(|| missing("trajectory.initial"))?;
                let reference =
                    resume.initial_reference.ok_or_else(|| missing("initial_reference"))?;
                let initial = state("resume.trajectory.initial", initial, model)?;
                let initial_reference = state("resume.initial_reference", reference, model)?;
                let (plant, inputs) = trajectory(hub, "resume.trajectory", given, model, settings)?;
                let checkpoint = Checkpoint {
                    initial,
                    inputs,
                    iterations: resume.iterations,
                    first_cost: resume.first_cost,
                    bound_multipliers: resume.bound_multipliers,
                    penalty: resume.penalty,
                    bound_violation: resume.bound_violation,
                    initial_reference,
                    backtracks: resume.backtracks,
                    last_derivative: resume.last_derivative,
                };
                Ok(Self::Resume(Box::new(plant), Box::new(checkpoint)))
            }
        }
    }

    fn steps(&self) -> usize {
        match self {
            Self::Guess(_, inputs) => inputs.nrows(),
            Self::Resume(_, checkpoint) => checkpoint.inputs.nrows(),
        }
    }
}

fn trajectory(
    hub: &Hub,
    field: &str,
    given: v1::Trajectory,
    model: &Arc<Model>,
    settings: plantd_models::Settings,
) -> Result<(Plant, DMatrix<f64>), RpcError> {
    let (plant, inputs) =
        matrices::trajectory_in(field, Some(given), model, settings, &hub.limits)?;
    if inputs.count() == 0 {
        return Err(RpcError::field(format!("{field}.u"), "is missing: it needs one row at least"));
    }
    Ok((plant, rows(&inputs, model.dimensions().input())))
}

fn rows(inputs: &Inputs, width: usize) -> DMatrix<f64> {
    DMatrix::from_fn(inputs.count(), width, |k, i| inputs.get(k)[i])
}

/// A state of the right lengths.
fn state(field: &str, state: v1::State, model: &Model) -> Result<State, RpcError> {
    let d = model.dimensions();
    let v = if state.v.is_empty() { vec![0.0; d.prescribed] } else { state.v };
    checks::check_numbers(&format!("{field}.q"), &state.q, d.coordinates())?;
    checks::check_numbers(&format!("{field}.p"), &state.p, d.dynamic)?;
    checks::check_numbers(&format!("{field}.v"), &v, d.prescribed)?;
    let multipliers = vec![0.0; d.constraints];
    Ok(State { step: state.step, q: state.q, p: state.p, v, multipliers })
}

/// Refuses a search that would need too much memory, or whose result no client would take: A, B, two
/// gains, the motion and what is as long seven times, for Newton's method whole linearizations, and the
/// derivatives of projected momenta.
fn check_memory(
    hub: &Hub,
    model: &Model,
    steps: usize,
    cost: &v1::TrajectoryCost,
    uses_newton: bool,
) -> Result<usize, RpcError> {
    let d = model.dimensions();
    let (nx, nu) = (d.state(), d.input());
    let result = (steps + 1).saturating_mul(nx).saturating_add(steps.saturating_mul(nu));
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    LimitExceeded::check(name, limit, "numbers in the trajectory found", result)?;
    let linearizations = if uses_newton { 2 * states::linearization_numbers(d) } else { 0 };
    let momentum = weights::momentum_in("cost.weights", cost.weights.as_ref())?;
    let is_projected = momentum == Momentum::Projected && d.constraints > 0;
    let projections = if is_projected { d.dynamic * nx } else { 0 };
    let of_step = nx * nx + 3 * nx * nu + linearizations + projections + 8 * (nx + nu);
    let of_stage = nx * nx + nu * nu + nx * nu + nx + nu;
    let numbers = (steps + 1).saturating_mul(of_step).saturating_add(cost.stages.len() * of_stage);
    let (name, limit) = ("trajectory_numbers", hub.limits.trajectory_numbers);
    LimitExceeded::check(name, limit, "numbers in the search's matrices", numbers)?;
    Ok(numbers)
}

fn trajectory_cost(
    cost: v1::TrajectoryCost,
    steps: usize,
    model: &Model,
) -> Result<TrajectoryCost, RpcError> {
    let d = model.dimensions();
    let x = cost.x.ok_or_else(|| RpcError::field("cost.x", "is missing"))?;
    let x = matrices::matrix_of("cost.x", &x, Some(steps + 1), d.state())?;
    let u = match cost.u {
        Some(u) => matrices::matrix_of("cost.u", &u, Some(steps), d.input())?,
        None => DMatrix::zeros(steps, d.input()),
    };
    let fields = WeightFields { weights: "cost.weights", stages: "cost.stages", are_convex: false };
    let momentum = weights::momentum_in(fields.weights, cost.weights.as_ref())?;
    let weights = weights::trajectory_weights(fields, cost.weights, cost.stages, steps, model)?;
    Ok(TrajectoryCost { x, u, weights, momentum })
}

fn bounds(given: v1::TrajectoryBounds, model: &Model) -> Result<Bounds, RpcError> {
    let list = |list: &str, given: Vec<v1::Bound>, names: &[String]| {
        if given.len() > names.len() {
            let problem = format!("has {} entries; there are {}", given.len(), names.len());
            return Err(RpcError::field(format!("bounds.{list}"), problem));
        }
        let bound = |(i, bound): (usize, v1::Bound)| {
            let (index, ..) = states::bound(&format!("bounds.{list}[{i}]"), &bound, names)?;
            Ok(Bound { index, min: bound.min, max: bound.max })
        };
        given.into_iter().enumerate().map(bound).collect::<Result<Vec<_>, RpcError>>()
    };
    let states = states::state_names(model);
    let mut bounds = Bounds {
        states: list("state", given.state, &states)?,
        inputs: list("input", given.input, &states::input_names(model))?,
        final_state: list("final_state", given.final_state, &states)?,
    };
    if given.model_limits {
        let (dynamic, prescribed) = model.coordinates().split_at(model.dimensions().dynamic);
        let inputs = model.scene().inputs.iter().map(|input| input.limits);
        add_limits(&mut bounds.states, dynamic.iter().map(|c| c.limits));
        add_limits(&mut bounds.inputs, inputs.chain(prescribed.iter().map(|c| c.limits)));
    }
    Ok(bounds)
}

/// Adds the limits of entries that have no bound yet.
fn add_limits(bounds: &mut Vec<Bound>, limits: impl Iterator<Item = Option<[f64; 2]>>) {
    let known: BTreeSet<usize> = bounds.iter().map(|bound| bound.index).collect();
    let limits = limits.enumerate().filter(|(index, _)| !known.contains(index));
    bounds.extend(limits.filter_map(|(index, limits)| {
        let [min, max] = limits?;
        Some(Bound { index, min: Some(min), max: Some(max) })
    }));
}

fn free_initial(given: v1::FreeInitialState, model: &Model) -> Result<FreeInitialState, RpcError> {
    let names = states::state_names(model);
    if given.entries.len() > names.len() {
        let problem = format!("has {} entries; there are {}", given.entries.len(), names.len());
        return Err(RpcError::field("free_initial.entries", problem));
    }
    let index = |(i, entry): (usize, &String)| {
        names.iter().position(|name| name == entry).ok_or_else(|| {
            let entry = UnknownName::among(entry, &names);
            let problem = format!("there is no state entry {entry}");
            RpcError::field(format!("free_initial.entries[{i}]"), problem)
        })
    };
    let entries = given.entries.iter().enumerate().map(index).collect::<Result<_, RpcError>>()?;
    let weight = |given| weights::weight("free_initial.weight", Some(given), names.len());
    Ok(FreeInitialState { entries, weight: given.weight.map(weight).transpose()? })
}

/// The options, and every how many iterations a checkpoint is wanted.
fn given_options(
    hub: &Hub,
    given: Option<v1::OptimizationOptions>,
    model: &Model,
) -> Result<(Options, u32), RpcError> {
    let given = given.unwrap_or_default();
    let defaults = Options::default();
    let or = |value: f64, default: f64| if value == 0.0 { default } else { value };
    let count = |value: u32, default: u32| if value == 0 { default } else { value };
    let options = Options {
        method: method("options.method", given.method)?.unwrap_or_default(),
        first_method: method("options.first_method", given.first_method)?,
        first_iterations: given.first_iterations,
        max_iterations: count(given.max_iterations, defaults.max_iterations),
        tolerance: (given.tolerance != 0.0).then_some(given.tolerance),
        alpha: or(given.alpha, defaults.alpha),
        beta: or(given.beta, defaults.beta),
        max_backtracks: count(given.max_backtracks, defaults.max_backtracks),
        near_last_step: given.near_last_step,
        projection: match given.projection {
            None => None,
            weights => Some(weights::state_weights_in("options.projection", weights, model)?),
        },
        bound_tolerance: or(given.bound_tolerance, defaults.bound_tolerance),
    };
    let (name, limit) = ("optimization_iterations", hub.limits.optimization_iterations);
    LimitExceeded::check(name, limit, "iterations", options.max_iterations as usize)?;
    let (name, limit) = ("optimization_backtracks", hub.limits.optimization_backtracks);
    LimitExceeded::check(name, limit, "shortenings of a step", options.max_backtracks as usize)?;
    Ok((options, given.checkpoint_every))
}

fn method(field: &str, method: i32) -> Result<Option<Method>, RpcError> {
    match v1::DescentMethod::try_from(method) {
        Ok(v1::DescentMethod::Unspecified) => Ok(None),
        Ok(v1::DescentMethod::Steepest) => Ok(Some(Method::Steepest)),
        Ok(v1::DescentMethod::QuasiNewton) => Ok(Some(Method::QuasiNewton)),
        Ok(v1::DescentMethod::Newton) => Ok(Some(Method::Newton)),
        Err(_) => Err(RpcError::field(field, format!("{method} is no such method"))),
    }
}

fn method_message(method: Method) -> v1::DescentMethod {
    match method {
        Method::Steepest => v1::DescentMethod::Steepest,
        Method::QuasiNewton => v1::DescentMethod::QuasiNewton,
        Method::Newton => v1::DescentMethod::Newton,
    }
}
