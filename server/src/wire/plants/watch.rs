//! The stream of `PlantService.Watch`.
//!
//! The stream asks for the next frame when the transport has taken the last message, so a slow reader
//! loses frames at the plant, where they are counted, and never holds more than its queue. What is computed
//! for a watcher is so on a worker (`computed.rs`).

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use plantd_control::{Momentum, Weights};
use plantd_proto::v1;
use tokio::time::Instant;

use crate::core::limits::LimitExceeded;
use crate::core::publish::frame::{Frame, record_words};
use crate::core::publish::subscription::Subscription;
use crate::core::room::Reservation;
use crate::core::session::shared::Session;
use crate::wire::answers::{Answers, Messages};
use crate::wire::message::report::report_message;
use crate::wire::message::{states, weights};
use crate::wire::plants::computed::{Computer, Wanted};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Opens the stream.
pub(crate) fn stream(
    hub: &Arc<Hub>,
    request: v1::WatchRequest,
) -> Result<Answers<v1::WatchResponse>, RpcError> {
    let session = hub.session(&request.id)?;
    let wanted = Wanted::new(&request.fields)?;
    let mask = Mask::new(&request.coordinates, &session)?;
    if wanted.needs_linearization() {
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
    let pace = Pace::new(request.at_most_hz, queue)?;
    // The one frame that every watcher has is covered by the limit of watchers.
    let numbers = (queue - 1).saturating_mul(record_words(session.model().dimensions()));
    let room = hub.tenants.current().rooms.watch_numbers.reserve(numbers)?;
    let mut subscription = session.subscribe(every, queue, hub.limits.watchers_per_plant)?;
    if pace.period.is_some() {
        subscription.pass_over();
    }
    let watcher = Watcher {
        session: Arc::clone(&session),
        subscription,
        _room: room,
        hub: Arc::clone(hub),
        wanted,
        mask,
        weights,
        computer: None,
        pace,
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
    computer: Option<Box<Computer>>,
    pace: Pace,
}

/// Longest time between two messages, s.
const PERIOD_MAX_S: f64 = 86_400.0;

/// When the next message may be sent.
struct Pace {
    /// None without a bound.
    period: Option<Duration>,
    /// From when on; none for the first message.
    next: Option<Instant>,
}

impl Pace {
    fn new(at_most_hz: f64, queue: usize) -> Result<Self, RpcError> {
        if !(at_most_hz >= 0.0 && at_most_hz.is_finite()) {
            let problem = format!("is {at_most_hz}; a number of 0 or more is needed");
            return Err(RpcError::field("at_most_hz", problem));
        }
        if at_most_hz > 0.0 && queue > 1 {
            let problem = "keeps states back that `at_most_hz` passes over: give one of them";
            return Err(RpcError::field("queue", problem));
        }
        let period_s = (at_most_hz > 0.0).then(|| at_most_hz.recip().min(PERIOD_MAX_S));
        Ok(Self { period: period_s.map(Duration::from_secs_f64), next: None })
    }

    /// A message is sent.
    fn restart(&mut self) {
        self.next = self.period.map(|period| Instant::now() + period);
    }
}

/// The latest frame, when the pace lets it through. What comes meanwhile is passed over, and not lost.
async fn paced<'a>(subscription: &'a mut Subscription, pace: &mut Pace) -> (&'a Frame, u64) {
    if let Some(next) = pace.next {
        tokio::time::sleep_until(next).await;
    }
    let taken = subscription.next().await;
    pace.restart();
    taken
}

impl Messages for Watcher {
    type Message = v1::WatchResponse;

    async fn next(&mut self) -> Result<v1::WatchResponse, RpcError> {
        let session = Arc::clone(&self.session);
        let (frame, dropped) = tokio::select! {
            biased;
            () = self.hub.ending.cancelled() => return Err(RpcError::shutting_down()),
            () = session.closed() => return Err(RpcError::closed(&session)),
            next = paced(&mut self.subscription, &mut self.pace) => next,
        };
        let mut response = v1::WatchResponse {
            dropped,
            step: frame.state.step,
            generation: frame.generation,
            ..Default::default()
        };
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
        if !self.wanted.needs_computer() {
            return Ok(response);
        }
        let (frame, wanted) = (frame.clone(), self.wanted);
        let (computer, weights) = (self.computer.take(), self.weights.clone());
        let numbers_max = self.hub.limits.reply_numbers;
        let job = move |_: &_| {
            let mut computer = match computer {
                Some(computer) if computer.generation() == frame.generation => computer,
                _ => Box::new(Computer::new(session, numbers_max)),
            };
            computer.fill(&mut response, &frame, wanted, weights.as_deref());
            Ok((computer, response))
        };
        let (computer, response) = self.hub.workers.resume(job).await?;
        self.computer = Some(computer);
        Ok(response)
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
