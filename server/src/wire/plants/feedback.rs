//! `PlantService.SetParameters`, `SetFeedback`, `ClearFeedback` and `WatchGains`.
//!
//! Laws are computed on workers, away from the control path, and put in force between two steps. When
//! a plant's parameters or time step change, a task computes its law anew until it belongs to the
//! latest ones.

use std::sync::Arc;

use plantd_control::Values;
use plantd_models::{Initial, Model};
use plantd_proto::v1;
use tokio::sync::watch::Receiver;
use v1::point::Source;
use v1::set_feedback_request::Reference as Form;

use crate::core::connection::Connection;
use crate::core::feedback::active::{Feedback, FeedbackInfo, GuardBound, InForce, Mode};
use crate::core::feedback::law::{Law, Stage};
use crate::core::feedback::regulator::{Constraints, Memory, Reference, RegulatorError, Spec};
use crate::core::inputs::Inputs;
use crate::core::limits::LimitExceeded;
use crate::core::origin::Origin;
use crate::core::plant::view::Mechanics;
use crate::core::session::life::Use;
use crate::core::session::shared::Session;
use crate::core::workers::pool::{Abandoned, WorkError};
use crate::wire::answers::{Answers, Messages};
use crate::wire::message::plant_info::{failure_message, feedback_info};
use crate::wire::message::weights::{self, WeightFields};
use crate::wire::message::{checks, matrices, start, states};
use crate::wire::shared::hub::{Hub, TrajectoryPermit};
use crate::wire::status::RpcError;

/// Answers a SetParameters call.
pub(crate) async fn set_parameters(
    hub: &Arc<Hub>,
    request: v1::SetParametersRequest,
) -> Result<v1::SetParametersResponse, RpcError> {
    let session = hub.session(&request.id)?;
    let time_step_s = match request.time_step_s {
        0.0 => None,
        time_step_s if time_step_s.is_finite() && time_step_s > 0.0 => Some(time_step_s),
        _ => return Err(RpcError::field("time_step_s", "must be finite and greater than zero")),
    };
    if request.parameters.is_empty() && time_step_s.is_none() {
        return Err(RpcError::field("parameters", "and `time_step_s` are both missing"));
    }
    let limit = hub.limits.parameters;
    let count = request.parameters.len();
    LimitExceeded::check("parameters", limit, "numbers of the scene to change", count)?;
    let changes: Vec<_> = request.parameters.into_iter().map(|p| (p.path, p.value)).collect();
    let job = {
        let (hub, session) = (Arc::clone(hub), Arc::clone(&session));
        move |_: &_| {
            let is_outdated = session.change_parameters(&changes, time_step_s, &hub.limits)?;
            Ok((is_outdated, hub.plant_info(&session)))
        }
    };
    let (is_outdated, plant) = hub.attendants.run(job).await?;
    if is_outdated {
        recompute(Arc::clone(hub), session);
    }
    Ok(v1::SetParametersResponse { plant: Some(plant) })
}

/// Starts to compute the law of a plant's feedback anew, unless somebody is at it.
fn recompute(hub: Arc<Hub>, session: Arc<Session>) {
    // The work is the owner's, whoever has changed the plant.
    let connection = Connection::server(session.owner());
    tokio::spawn(connection.work(async move {
        // A change that comes while the task ends finds it ended, or is found by it.
        while outdated(&hub, &session).await.is_some() && session.begin_recomputing() {
            let work = async {
                while let Some((spec, mechanics)) = outdated(&hub, &session).await {
                    let outcome = solve_again(&hub, &spec, mechanics.clone()).await;
                    let session = Arc::clone(&session);
                    let renew = move |_: &_| {
                        session.renew_feedback(&spec, mechanics.generation, outcome);
                        Ok(())
                    };
                    let _ = hub.attendants.resume(renew).await;
                }
            };
            tokio::select! {
                () = hub.ending.cancelled() => return,
                () = session.closed() => return,
                () = work => {}
            }
            session.end_recomputing();
        }
    }));
}

async fn outdated(hub: &Hub, session: &Arc<Session>) -> Option<(Arc<Spec>, Mechanics)> {
    let session = Arc::clone(session);
    hub.attendants.resume(move |_| Ok(session.outdated_feedback())).await.ok().flatten()
}

async fn solve_again(
    hub: &Arc<Hub>,
    spec: &Arc<Spec>,
    mechanics: Mechanics,
) -> Result<Law, RegulatorError> {
    let _permit = match spec.reference {
        Reference::Trajectory { .. } => {
            let permit = Arc::clone(&hub.trajectory_solves).acquire_owned().await;
            // It is never closed.
            Some(permit.map_err(|_| WorkError::Cancelled)?)
        }
        _ => None,
    };
    let (solver, spec) = (Arc::clone(hub), Arc::clone(spec));
    let job = move |abandoned: &Abandoned| solve(&solver, &spec, &mechanics, abandoned);
    hub.workers.workers().resume(job).await
}

fn solve(
    hub: &Hub,
    spec: &Spec,
    mechanics: &Mechanics,
    abandoned: &Abandoned,
) -> Result<Law, RegulatorError> {
    let Mechanics { model, settings, .. } = mechanics;
    let room = &hub.tenants.current().rooms.feedback_numbers;
    spec.solve(model, *settings, &hub.limits, room, abandoned)
}

/// Answers a SetFeedback call.
pub(crate) async fn set_feedback(
    hub: &Arc<Hub>,
    request: v1::SetFeedbackRequest,
) -> Result<v1::SetFeedbackResponse, RpcError> {
    let session = hub.session(&request.id)?;
    let permit = permit(hub, &request)?;
    let job = {
        let (hub, session) = (Arc::clone(hub), Arc::clone(&session));
        move |abandoned: &Abandoned| put(&hub, &session, request, permit, abandoned)
    };
    let (info, is_outdated) = hub.workers.run(job).await?;
    if is_outdated {
        recompute(Arc::clone(hub), session);
    }
    Ok(v1::SetFeedbackResponse { feedback: Some(feedback_info(info)) })
}

/// Puts a feedback in force on a plant that does not change meanwhile. Solves for it: call it on a worker.
pub(crate) fn install(
    hub: &Hub,
    session: &Arc<Session>,
    request: v1::SetFeedbackRequest,
    abandoned: &Abandoned,
) -> Result<(), RpcError> {
    let permit = permit(hub, &request)?;
    put(hub, session, request, permit, abandoned).map(|_| ())
}

/// Room for a regulator along a trajectory.
fn permit(
    hub: &Hub,
    request: &v1::SetFeedbackRequest,
) -> Result<Option<TrajectoryPermit>, RpcError> {
    match request.reference {
        Some(Form::Trajectory(_)) => hub.trajectory_permit().map(Some),
        _ => Ok(None),
    }
}

/// Solves for a feedback and puts it in force. True when it is outdated by now.
fn put(
    hub: &Hub,
    session: &Arc<Session>,
    request: v1::SetFeedbackRequest,
    mut permit: Option<TrajectoryPermit>,
    abandoned: &Abandoned,
) -> Result<(FeedbackInfo, bool), RpcError> {
    let mode = mode(request.mode)?;
    let guard = guard(&request.guard, mode, session.model())?;
    let first_step = request.first_step;
    let mechanics = session.mechanics();
    let is_trajectory = matches!(request.reference, Some(Form::Trajectory(_)));
    if first_step.is_some() && !is_trajectory {
        return Err(RpcError::field("first_step", "is for trajectories only"));
    }
    if !request.stages.is_empty() && !is_trajectory {
        return Err(RpcError::field("stages", "are for trajectories only"));
    }
    let given = is_trajectory.then(|| Arc::new(request.clone()) as Origin);
    let constraints = Constraints::new(request.constraints)?;
    let reference = reference(hub, request.reference, session.model_name(), &mechanics)?;
    let model = &mechanics.model;
    let momentum = weights::momentum_in("weights", request.weights.as_ref())?;
    let (weights, trajectory_weights) = match &reference {
        Reference::Gain(_) => (None, None),
        Reference::Trajectory { inputs, .. } => {
            let (steps, stages) = (inputs.count(), request.stages);
            let (count, values) = (stages.len(), Values::Drop);
            let memory = Memory { steps, stages: count, momentum, values };
            let numbers = memory.check(&hub.limits, model)?;
            permit.iter_mut().try_for_each(|permit| permit.hold(numbers))?;
            let (fields, weights) = (WeightFields::default(), request.weights);
            let all = weights::trajectory_weights(fields, weights, stages, steps, model)?;
            (None, Some(all))
        }
        _ => (Some(weights::weights(request.weights, model)?), None),
    };
    let time_step_s = mechanics.settings.time_step_s;
    let spec = Arc::new(Spec {
        reference,
        weights,
        trajectory_weights,
        momentum,
        constraints,
        time_step_s,
        given,
    });
    let law = solve(hub, &spec, &mechanics, abandoned)?;
    if session.is_closed() {
        return Err(RpcError::closed(session));
    }
    let feedback = Box::new(Feedback::new(spec, law, mode, guard));
    Ok(session.set_feedback(feedback, mechanics.generation, first_step))
}

fn mode(mode: i32) -> Result<Mode, RpcError> {
    match v1::FeedbackMode::try_from(mode) {
        Ok(v1::FeedbackMode::Unspecified | v1::FeedbackMode::WatchOnly) => Ok(Mode::WatchOnly),
        Ok(v1::FeedbackMode::Replace) => Ok(Mode::Replace),
        Ok(v1::FeedbackMode::Add) => Ok(Mode::Add),
        Ok(v1::FeedbackMode::Guard) => Ok(Mode::Guard),
        Err(_) => Err(RpcError::field("mode", format!("{mode} is no such mode"))),
    }
}

fn guard(bounds: &[v1::Bound], mode: Mode, model: &Model) -> Result<Vec<GuardBound>, RpcError> {
    match (mode, bounds.is_empty()) {
        (Mode::Guard, true) => {
            return Err(RpcError::field("guard", "is missing: the mode needs it"));
        }
        (Mode::Guard, false) | (_, true) => {}
        (_, false) => return Err(RpcError::field("guard", "is for FEEDBACK_MODE_GUARD only")),
    }
    let names = states::state_names(model);
    if bounds.len() > names.len() {
        let problem = format!("has {} entries; the state has {}", bounds.len(), names.len());
        return Err(RpcError::field("guard", problem));
    }
    let bound = |(i, bound): (usize, &v1::Bound)| {
        let (index, min, max) = states::bound(&format!("guard[{i}]"), bound, &names)?;
        Ok(GuardBound { index, name: bound.entry.clone(), min, max })
    };
    bounds.iter().enumerate().map(bound).collect()
}

fn reference(
    hub: &Hub,
    form: Option<Form>,
    model_name: &str,
    mechanics: &Mechanics,
) -> Result<Reference, RpcError> {
    let (model, settings) = (&mechanics.model, mechanics.settings);
    let d = model.dimensions();
    let momentum = |state: &v1::State| {
        let v = if state.v.is_empty() { vec![0.0; d.prescribed] } else { state.v.clone() };
        Initial::Momentum { q: state.q.clone(), p: state.p.clone(), v }
    };
    match form {
        None => Err(RpcError::field(
            "reference",
            "is missing: `point`, `trajectory` or `gain` is needed",
        )),
        Some(Form::Point(v1::Point { source: Some(Source::Plant(id)) })) => {
            let (plant, u) = hub.session(&id)?.copy_plant_and_input();
            let names = |model: &Model| -> Vec<String> {
                model.coordinates().iter().map(|c| c.name.clone()).collect()
            };
            if plant.model().dimensions() != d || names(plant.model()) != names(model) {
                let problem = format!("plant `{id}` has other coordinates or inputs");
                return Err(RpcError::field("point.plant", problem));
            }
            let (q, p, v) = (plant.q().to_vec(), plant.p().to_vec(), plant.v().to_vec());
            Ok(Reference::Point { start: Initial::Momentum { q, p, v }, u })
        }
        Some(Form::Point(v1::Point { source: Some(Source::OperatingPoint(name)) })) => {
            Ok(Reference::OperatingPoint(name))
        }
        Some(Form::Point(point)) => {
            // Checks the lengths and the constraints.
            let (plant, u) = start::point(Some(point), model, settings)?;
            let (q, p, v) = (plant.q().to_vec(), plant.p().to_vec(), plant.v().to_vec());
            Ok(Reference::Point { start: Initial::Momentum { q, p, v }, u })
        }
        Some(Form::Trajectory(trajectory)) => {
            let start = trajectory.initial.as_ref().map_or(Initial::Scene, momentum);
            let inputs = Inputs::along("trajectory.u", trajectory.u, d.input(), &hub.limits)?;
            Ok(Reference::Trajectory { start, inputs })
        }
        Some(Form::Gain(gain)) => {
            check_origin(&gain, model_name, settings.time_step_s)?;
            Ok(Reference::Gain(stage(gain, model)?))
        }
    }
}

/// Refuses a gain that says that it was computed for another model or time step.
fn check_origin(gain: &v1::Gain, model: &str, time_step_s: f64) -> Result<(), RpcError> {
    let hint = "clear the field to apply it all the same";
    if !gain.model.is_empty() && gain.model != model {
        let problem = format!("is `{}`; the plant is made from `{model}`; {hint}", gain.model);
        return Err(RpcError::field("gain.model", problem));
    }
    if gain.time_step_s != 0.0 && gain.time_step_s != time_step_s {
        let given = gain.time_step_s;
        let problem = format!("is {given} s; the plant's time step is {time_step_s} s; {hint}");
        return Err(RpcError::field("gain.time_step_s", problem));
    }
    Ok(())
}

fn stage(gain: v1::Gain, model: &Model) -> Result<Stage, RpcError> {
    let d = model.dimensions();
    let k = gain.k.ok_or_else(|| RpcError::field("gain.k", "is missing"))?;
    matrices::matrix_of("gain.k", &k, Some(d.input()), d.state())?;
    checks::check_numbers("gain.x_reference", &gain.x_reference, d.state())?;
    checks::check_numbers("gain.u_reference", &gain.u_reference, d.input())?;
    if !gain.feedforward.is_empty() {
        checks::check_numbers("gain.feedforward", &gain.feedforward, d.input())?;
    }
    let rotations = states::rotations(model);
    if gain.rotations != rotations {
        let problem = format!("are {:?}; those of the model are {rotations:?}", gain.rotations);
        return Err(RpcError::field("gain.rotations", problem));
    }
    Ok(Stage { k: k.data, x: gain.x_reference, u: gain.u_reference, feedforward: gain.feedforward })
}

/// Answers a ClearFeedback call. A plant without feedback stays as it is.
pub(crate) fn clear_feedback(hub: &Hub, id: &str) -> Result<v1::ClearFeedbackResponse, RpcError> {
    hub.session(id)?.clear_feedback();
    Ok(v1::ClearFeedbackResponse {})
}

/// Opens a WatchGains stream.
pub(crate) fn watch_gains(
    hub: &Arc<Hub>,
    id: &str,
) -> Result<Answers<v1::WatchGainsResponse>, RpcError> {
    let session = hub.session(id)?;
    let in_force = session.watch_gains(hub.limits.watchers_per_plant)?;
    if in_force.borrow().is_none() {
        return Err(RpcError::no_feedback(id));
    }
    let watcher = Watcher {
        hub: Arc::clone(hub),
        rotations: states::rotations(session.model()),
        _in_use: session.life().in_use(),
        session,
        in_force,
        revision: 0,
        next: 0,
        dropped: 0,
        failure_of: None,
    };
    Ok(watcher.into_answers())
}

impl InForce {
    /// The `index`-th message; `rotations` are those of the model.
    pub fn gain(&self, index: usize, rotations: &[u32]) -> v1::Gain {
        let rotations = rotations.to_vec();
        let step = match self.law.end {
            Some(_) => self.first_step.saturating_add(index as u64),
            None => self.since_step,
        };
        let Some(stage) = self.law.stages.get(index) else {
            let x_reference = self.law.end.clone().unwrap_or_default();
            return v1::Gain { step, x_reference, rotations, ..Default::default() };
        };
        let (rows, cols) = (stage.u.len() as u32, stage.x.len() as u32);
        v1::Gain {
            step,
            k: Some(v1::Matrix { rows, cols, data: stage.k.clone() }),
            x_reference: stage.x.clone(),
            u_reference: stage.u.clone(),
            rotations,
            feedforward: stage.feedforward.clone(),
            ..Default::default()
        }
    }
}

struct Watcher {
    hub: Arc<Hub>,
    session: Arc<Session>,
    rotations: Vec<u32>,
    in_force: Receiver<Option<InForce>>,
    /// Revision that is being sent.
    revision: u64,
    /// Its message that comes next.
    next: usize,
    dropped: u64,
    /// Parameters for which a failure was told.
    failure_of: Option<u64>,
    _in_use: Use,
}

impl Messages for Watcher {
    type Message = v1::WatchGainsResponse;

    async fn next(&mut self) -> Result<v1::WatchGainsResponse, RpcError> {
        loop {
            if self.hub.ending.is_cancelled() {
                return Err(RpcError::shutting_down());
            }
            if self.session.is_closed() {
                return Err(RpcError::closed(&self.session));
            }
            if let Some(response) = self.ready().await? {
                return Ok(response);
            }
            tokio::select! {
                () = self.hub.ending.cancelled() => {}
                () = self.session.closed() => {}
                changed = self.in_force.changed() => {
                    // The session has the sender, and this has the session.
                    changed.map_err(|_| RpcError::closed(&self.session))?;
                }
            }
        }
    }
}

impl Watcher {
    /// A message that is to be sent now.
    async fn ready(&mut self) -> Result<Option<v1::WatchGainsResponse>, RpcError> {
        let present = self.in_force.borrow_and_update().clone();
        let present = present.ok_or_else(|| RpcError::no_feedback(self.session.id()))?;
        if present.revision != self.revision {
            if self.revision > 0 {
                self.dropped += present.revision - self.revision - 1;
            }
            self.revision = present.revision;
            let session = Arc::clone(&self.session);
            let step = self.hub.attendants.resume(move |_| Ok(session.step_index())).await?;
            self.next = present.first(step);
            self.failure_of = None;
        }
        let failure_of = present.failure.as_ref().map(|(generation, _)| *generation);
        let gain = if self.next < present.count() {
            let gain = present.gain(self.next, &self.rotations);
            self.next += 1;
            Some(gain)
        } else if failure_of.is_some() && failure_of != self.failure_of {
            // About a point the gain in force is said again.
            present.law.end.is_none().then(|| present.gain(0, &self.rotations))
        } else {
            return Ok(None);
        };
        self.failure_of = failure_of;
        Ok(Some(v1::WatchGainsResponse {
            gain,
            revision: self.revision,
            dropped: self.dropped,
            failure: present.failure.map(|(_, failure)| failure_message(failure)),
            first_step: if present.law.end.is_some() { present.first_step } else { 0 },
            horizon: present.law.horizon() as u32,
        }))
    }
}
