//! The stream of `PlantService.Watch`.
//!
//! The stream asks for the next frame when the transport has taken the last message, so a slow reader
//! loses frames at the plant, where they are counted, and never holds more than its queue. Energies,
//! linearizations and gains are computed on a worker, from a plant of the watcher's own.

use std::collections::HashSet;
use std::sync::Arc;

use plantd_models::control::{Momentum, Weights};
use plantd_models::{Initial, Linearization, Plant, StepError};
use plantd_proto::v1;
use v1::WatchField;

use crate::core::feedback::regulator::{self, Constraints};
use crate::core::limits::LimitExceeded;
use crate::core::publish::frame::{Frame, record_words};
use crate::core::publish::subscription::Subscription;
use crate::core::room::Reservation;
use crate::core::session::shared::Session;
use crate::wire::answers::{Answers, Messages};
use crate::wire::message::report::report_message;
use crate::wire::message::{matrices, states, weights};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// What a watcher has asked for.
#[derive(Clone, Copy, Debug, Default)]
struct Wanted {
    state: bool,
    report: bool,
    energy: bool,
    linearization: bool,
    gain: bool,
    input: bool,
    outputs: bool,
    timing: bool,
}

impl Wanted {
    fn new(fields: &[i32]) -> Result<Self, RpcError> {
        let mut wanted = Self::default();
        for (index, field) in fields.iter().enumerate() {
            match WatchField::try_from(*field) {
                Ok(WatchField::State) => wanted.state = true,
                Ok(WatchField::Report) => wanted.report = true,
                Ok(WatchField::Energy) => wanted.energy = true,
                Ok(WatchField::Linearization) => wanted.linearization = true,
                Ok(WatchField::Gain) => wanted.gain = true,
                Ok(WatchField::Input) => wanted.input = true,
                Ok(WatchField::Outputs) => wanted.outputs = true,
                Ok(WatchField::Timing) => wanted.timing = true,
                Ok(WatchField::Unspecified) | Err(_) => {
                    let problem = format!("{field} is nothing to watch");
                    return Err(RpcError::field(format!("fields[{index}]"), problem));
                }
            }
        }
        if fields.is_empty() {
            return Err(RpcError::field("fields", "are missing: at least one is needed"));
        }
        Ok(wanted)
    }

    fn needs_analysis(self) -> bool {
        self.energy || self.linearization || self.gain
    }
}

/// Opens the stream.
pub(crate) fn stream(
    hub: &Arc<Hub>,
    request: v1::WatchRequest,
) -> Result<Answers<v1::WatchResponse>, RpcError> {
    let session = hub.session(&request.id)?;
    let wanted = Wanted::new(&request.fields)?;
    let mask = Mask::new(&request.coordinates, &session)?;
    if wanted.linearization || wanted.gain {
        let numbers = states::linearization_numbers(session.model().dimensions());
        let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
        LimitExceeded::check(name, limit, "numbers in a linearization", numbers)?;
    }
    let weights = match wanted.gain {
        true => {
            let momentum = weights::momentum_in("weights", request.weights.as_ref())?;
            Some(Arc::new((weights::weights(request.weights, session.model())?, momentum)))
        }
        false => None,
    };
    let every = u64::from(request.every.max(1));
    let queue = request.queue.max(1) as usize;
    // The one frame that every watcher has is covered by the limit of watchers.
    let numbers = (queue - 1).saturating_mul(record_words(session.model().dimensions()));
    let room = hub.watch_room.reserve(numbers)?;
    let watcher = Watcher {
        session: Arc::clone(&session),
        subscription: session.subscribe(every, queue, hub.limits.watchers_per_plant)?,
        _room: room,
        hub: Arc::clone(hub),
        wanted,
        mask,
        weights,
        analysis: None,
    };
    Ok(watcher.into_answers())
}

struct Watcher {
    hub: Arc<Hub>,
    session: Arc<Session>,
    subscription: Subscription,
    _room: Reservation,
    wanted: Wanted,
    mask: Option<Mask>,
    weights: Option<Arc<(Weights, Momentum)>>,
    analysis: Option<Box<Analysis>>,
}

impl Messages for Watcher {
    type Message = v1::WatchResponse;

    async fn next(&mut self) -> Result<v1::WatchResponse, RpcError> {
        let session = Arc::clone(&self.session);
        let (frame, dropped) = tokio::select! {
            biased;
            () = self.hub.ending.cancelled() => return Err(RpcError::shutting_down()),
            () = session.closed() => return Err(RpcError::plant_deleted(session.id())),
            next = self.subscription.next() => next,
        };
        let mut response =
            v1::WatchResponse { dropped, step: frame.state.step, ..Default::default() };
        response.clocks = Some(states::clocks(frame.time_s, frame.timing.ended_ns));
        if self.wanted.timing {
            response.timing = states::step_timing(&frame.timing);
        }
        if self.wanted.report {
            response.report = Some(report_message(&frame.report));
        }
        if self.wanted.state {
            let mut state = states::shown(&frame.published());
            if let Some(mask) = &self.mask {
                mask.apply(&mut state);
            }
            response.state = Some(state);
        }
        if self.wanted.input {
            response.u.clone_from(&frame.input);
        }
        if self.wanted.outputs {
            response.outputs = states::outputs(&frame.outputs, &frame.lost);
        }
        if !self.wanted.needs_analysis() {
            return Ok(response);
        }
        let (frame, wanted) = (frame.clone(), self.wanted);
        let (analysis, weights) = (self.analysis.take(), self.weights.clone());
        let job = move |_: &_| {
            let mut analysis = match analysis {
                Some(analysis) if analysis.generation == frame.generation => analysis,
                _ => Box::new(Analysis::new(&session)),
            };
            analysis.fill(&mut response, &frame, wanted, weights.as_deref());
            Ok((analysis, response))
        };
        let (analysis, response) = self.hub.workers.resume(job).await?;
        self.analysis = Some(analysis);
        Ok(response)
    }
}

/// A watcher's own plant, on which it computes.
struct Analysis {
    plant: Plant,
    /// Number of changes that led to its parameters.
    generation: u64,
    linearization: Linearization,
}

impl Analysis {
    fn new(session: &Session) -> Self {
        let (plant, generation) = session.copy_plant_and_generation();
        Self { plant, generation, linearization: Linearization::new(session.model()) }
    }

    /// Computes what is wanted; what fails is reported in the message.
    fn fill(
        &mut self,
        response: &mut v1::WatchResponse,
        frame: &Frame,
        wanted: Wanted,
        weights: Option<&(Weights, Momentum)>,
    ) {
        if let Err(fault) = self.try_fill(response, frame, wanted, weights) {
            response.failure = Some(fault.into());
        }
    }

    fn try_fill(
        &mut self,
        response: &mut v1::WatchResponse,
        frame: &Frame,
        wanted: Wanted,
        weights: Option<&(Weights, Momentum)>,
    ) -> Result<(), RpcError> {
        let state = &frame.state;
        let momentum =
            Initial::Momentum { q: state.q.clone(), p: state.p.clone(), v: state.v.clone() };
        self.plant.initialize(&momentum).map_err(|error| RpcError::from_initial(error, "state"))?;
        self.plant.set_step_index(state.step);
        self.plant.set_time_s(frame.time_s);
        if wanted.energy {
            response.energy = Some(states::energy(self.plant.energy()));
        }
        if wanted.linearization || wanted.gain {
            self.linearize(&frame.input)?;
        }
        if wanted.linearization {
            response.linearization = Some(states::linearization(state.step, &self.linearization));
        }
        if let Some((weights, momentum)) = weights {
            let space = Constraints::Manifold;
            let (plant, linearization) = (&mut self.plant, &self.linearization);
            let regulator = regulator::at_state(plant, linearization, weights, *momentum, space)?;
            response.gain = Some(v1::Gain {
                step: state.step,
                k: Some(matrices::matrix(&regulator.gain)),
                x_reference: state.x(),
                u_reference: frame.input.clone(),
                rotations: states::rotations(self.plant.model()),
                ..Default::default()
            });
        }
        Ok(())
    }

    fn linearize(&mut self, input: &[f64]) -> Result<(), StepError> {
        self.plant.linearize(input, &mut self.linearization)?;
        Ok(())
    }
}

/// The coordinates that a watcher wants, as indices into `q` and the velocity, `p` and `v`.
struct Mask {
    q: Vec<usize>,
    p: Vec<usize>,
    v: Vec<usize>,
}

impl Mask {
    /// None means all.
    fn new(names: &[String], session: &Session) -> Result<Option<Self>, RpcError> {
        if names.is_empty() {
            return Ok(None);
        }
        let model = session.model();
        for (index, name) in names.iter().enumerate() {
            if model.coordinate_index(name).is_none() {
                let field = format!("coordinates[{index}]");
                return Err(states::no_coordinate(field, name, model));
            }
        }
        let names: HashSet<&str> = names.iter().map(String::as_str).collect();
        let coordinates = model.coordinates().iter().enumerate();
        let q: Vec<usize> = coordinates
            .filter(|(_, coordinate)| names.contains(coordinate.name.as_str()))
            .map(|(index, _)| index)
            .collect();
        let dynamic = model.dimensions().dynamic;
        let (p, v) = q.iter().partition::<Vec<usize>, _>(|index| **index < dynamic);
        let v = v.into_iter().map(|index| index - dynamic).collect();
        Ok(Some(Self { q, p, v }))
    }

    fn apply(&self, state: &mut v1::State) {
        fn pick(vector: &mut Vec<f64>, indices: &[usize]) {
            *vector = indices.iter().map(|index| vector[*index]).collect();
        }
        pick(&mut state.q, &self.q);
        pick(&mut state.p, &self.p);
        pick(&mut state.v, &self.v);
        pick(&mut state.velocity, &self.q);
    }
}
