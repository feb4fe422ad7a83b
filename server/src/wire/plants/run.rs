//! How plants are run in time: `Run`, `Pause`, `SetSafety`, `GetTiming` and `WatchEvents`.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use plantd_models::Model;
use plantd_proto::v1;

use crate::core::metrics::counts::TimingCounts;
use crate::core::metrics::histogram::{Histogram, Summary};
use crate::core::plant::event::{Event, EventReader};
use crate::core::plant::watchdog::{self, Safety, Watchdog, WatchdogAction};
use crate::core::realtime::input::{InputAction, InputPolicy};
use crate::core::realtime::settings::{Pace, RunSettings};
use crate::core::session::life::Use;
use crate::core::session::shared::Session;
use crate::wire::answers::{Answers, Messages};
use crate::wire::message::run_info::{event_message, run_info};
use crate::wire::message::states;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Speeds that can be asked for.
const SPEED_MIN: f64 = 1e-3;
const SPEED_MAX: f64 = 1e4;
/// Longest time of an input policy, s.
const TIME_MAX_S: f64 = 1e6;
/// Most watchdogs of a plant.
const WATCHDOGS_MAX: usize = 256;
/// How often a watcher of events looks for new ones.
const EVENTS_PERIOD: Duration = Duration::from_millis(10);

/// Answers a Run call, with the call's number among those of its plant. Blocks for as long as a step
/// takes: call it on a worker.
pub(crate) fn run(hub: &Hub, request: v1::RunRequest) -> Result<(u64, v1::RunResponse), RpcError> {
    let session = hub.session(&request.id)?;
    let settings = request.settings.map(|settings| run_settings(settings, session.model()));
    let number = session.run(settings.transpose()?, request.steps, hub.limits.running_plants)?;
    Ok((number, v1::RunResponse { run: Some(run_info(&session)) }))
}

/// Runs a plant, and answers after the steps that were asked for if that is wanted.
pub(crate) async fn run_and_wait(
    hub: &Arc<Hub>,
    request: v1::RunRequest,
) -> Result<v1::RunResponse, RpcError> {
    let (session, wait) = (hub.session(&request.id)?, request.wait);
    let starter = Arc::clone(hub);
    let (number, response) = hub.attendants.run(move |_| run(&starter, request)).await?;
    if !wait {
        return Ok(response);
    }
    let _in_use = session.life().in_use();
    let mut status = session.run_status();
    tokio::select! {
        biased;
        () = hub.ending.cancelled() => return Err(RpcError::shutting_down()),
        () = session.closed() => return Err(RpcError::closed(&session)),
        _ = status.wait_for(|now| now.run != number || !now.is_running) => {}
    }
    Ok(v1::RunResponse { run: Some(run_info(&session)) })
}

/// Answers a Pause call. Blocks for as long as a step takes: call it on a worker.
pub(crate) fn pause(hub: &Hub, id: &str) -> Result<v1::PauseResponse, RpcError> {
    let session = hub.session(id)?;
    session.pause();
    let state = session.with_core(|core| states::shown(&core.published()));
    Ok(v1::PauseResponse { run: Some(run_info(&session)), state: Some(state) })
}

fn run_settings(settings: v1::RunSettings, model: &Model) -> Result<RunSettings, RpcError> {
    let field =
        |name: &str, problem: String| Err(RpcError::field(format!("settings.{name}"), problem));
    let pace = match v1::Pace::try_from(settings.pace) {
        Ok(v1::Pace::Unspecified | v1::Pace::Lockstep) => Pace::Lockstep,
        Ok(v1::Pace::Paced) => Pace::Paced,
        Ok(v1::Pace::Free) => Pace::Free,
        Err(_) => return field("pace", format!("{} is no pace", settings.pace)),
    };
    let given = settings.speed;
    if given != 0.0 && !(SPEED_MIN..=SPEED_MAX).contains(&given) {
        let problem = format!("is {given}; it must lie between {SPEED_MIN} and {SPEED_MAX}");
        return field("speed", problem);
    }
    let speed = match pace {
        Pace::Lockstep => given,
        Pace::Paced if given == 0.0 => 1.0,
        Pace::Paced => given,
        Pace::Free if given != 0.0 => {
            return field("speed", "is for plants that follow a clock".to_owned());
        }
        Pace::Free => 0.0,
    };
    let Some(policy) = settings.input else {
        return Ok(RunSettings { pace, speed, input: InputPolicy::default() });
    };
    if pace == Pace::Lockstep {
        return field("input", "is for plants that do not wait for their driver".to_owned());
    }
    Ok(RunSettings { pace, speed, input: input_policy(policy, model)? })
}

fn input_policy(policy: v1::InputPolicy, model: &Model) -> Result<InputPolicy, RpcError> {
    let v1::InputPolicy { timeout_s, action, ramp_s, safe, latch } = policy;
    for (name, time_s) in [("timeout_s", timeout_s), ("ramp_s", ramp_s)] {
        if !(0.0..=TIME_MAX_S).contains(&time_s) {
            let problem = format!("is {time_s}; it must lie between 0 and {TIME_MAX_S}");
            return Err(RpcError::field(format!("settings.input.{name}"), problem));
        }
    }
    let action = match v1::InputAction::try_from(action) {
        Ok(v1::InputAction::Unspecified | v1::InputAction::Hold) => InputAction::Hold,
        Ok(v1::InputAction::Safe) => InputAction::Safe,
        Ok(v1::InputAction::Ramp) => InputAction::Ramp { duration_s: ramp_s },
        Ok(v1::InputAction::Stop) => InputAction::Stop,
        Err(_) => {
            return Err(RpcError::field("settings.input.action", format!("{action} is no action")));
        }
    };
    if !safe.is_empty() {
        model.check_input(&safe).map_err(|error| {
            RpcError::field("settings.input.safe", format!("is no input: {error}"))
        })?;
    }
    Ok(InputPolicy { timeout_s, action, safe, latch })
}

/// Answers a SetSafety call. Copies a plant: call it on a worker.
pub(crate) fn set_safety(
    hub: &Hub,
    request: v1::SetSafetyRequest,
) -> Result<v1::SetSafetyResponse, RpcError> {
    let v1::SetSafetyRequest { id, watchdogs, on_step_failure } = request;
    protect(hub.session(&id)?.as_ref(), watchdogs, on_step_failure)?;
    Ok(v1::SetSafetyResponse {})
}

/// Sets what protects a plant.
pub(crate) fn protect(
    session: &Session,
    watchdogs: Vec<v1::Watchdog>,
    on_step_failure: i32,
) -> Result<(), RpcError> {
    if watchdogs.len() > WATCHDOGS_MAX {
        let problem = format!("are {}; at most {WATCHDOGS_MAX}", watchdogs.len());
        return Err(RpcError::field("watchdogs", problem));
    }
    let watchdogs = watchdogs.into_iter().enumerate();
    let watchdogs = watchdogs.map(|(index, dog)| watchdog(index, dog, session.model()));
    let on_step_failure = match on_step_failure {
        0 => None,
        action => Some(watchdog_action("on_step_failure", action)?),
    };
    let safety = Safety { watchdogs: watchdogs.collect::<Result<_, _>>()?, on_step_failure };
    session.set_safety(safety).map_err(|error| RpcError::from_initial(error, "watchdogs"))
}

fn watchdog(index: usize, dog: v1::Watchdog, model: &Model) -> Result<Watchdog, RpcError> {
    let field = |name: &str| format!("watchdogs[{index}].{name}");
    let Some(quantity) = watchdog::quantity(model, &dog.quantity) else {
        let problem = format!(
            "`{}` is no coordinate, `v(coordinate)`, `force(constraint)` or `energy`",
            dog.quantity
        );
        return Err(RpcError::field(field("quantity"), problem));
    };
    if dog.min.is_none() && dog.max.is_none() {
        return Err(RpcError::field(field("min"), "and `max` are both missing"));
    }
    let (min, max) = (dog.min.unwrap_or(f64::NEG_INFINITY), dog.max.unwrap_or(f64::INFINITY));
    if !(min <= max) {
        return Err(RpcError::field(field("min"), format!("is {min}, which is not below {max}")));
    }
    Ok(Watchdog { quantity, min, max, action: watchdog_action(&field("action"), dog.action)? })
}

fn watchdog_action(field: &str, action: i32) -> Result<WatchdogAction, RpcError> {
    match v1::WatchdogAction::try_from(action) {
        Ok(v1::WatchdogAction::Unspecified | v1::WatchdogAction::Freeze) => {
            Ok(WatchdogAction::Freeze)
        }
        Ok(v1::WatchdogAction::Reset) => Ok(WatchdogAction::Reset),
        Ok(v1::WatchdogAction::Disconnect) => Ok(WatchdogAction::Disconnect),
        Err(_) => Err(RpcError::field(field, format!("{action} is no action"))),
    }
}

/// Answers a GetTiming call.
pub(crate) fn get_timing(
    hub: &Hub,
    request: &v1::GetTimingRequest,
) -> Result<v1::GetTimingResponse, RpcError> {
    let session = hub.session(&request.id)?;
    let counts = &session.live().counts;
    let response = timing(counts);
    if request.clear {
        hub.check_may_drive()?;
        counts.clear();
    }
    Ok(response)
}

fn timing(counts: &TimingCounts) -> v1::GetTimingResponse {
    let summary = |histogram: &Histogram| {
        let Summary { count, mean_ns, p50_ns, p99_ns, p999_ns, max_ns } = histogram.summary();
        Some(v1::TimeSummary { count, mean_ns, p50_ns, p99_ns, p999_ns, max_ns })
    };
    let used = counts.used_inputs.load(Ordering::Relaxed);
    v1::GetTimingResponse {
        lateness: summary(&counts.lateness),
        step: summary(&counts.step),
        input_age: summary(&counts.input_age),
        round_trip: summary(&counts.round_trip),
        steps: counts.steps.load(Ordering::Relaxed),
        overruns: counts.overruns.load(Ordering::Relaxed),
        slips: counts.slips.load(Ordering::Relaxed),
        late_inputs: counts.late_inputs.load(Ordering::Relaxed),
        safe_inputs: counts.safe_inputs.load(Ordering::Relaxed),
        unused_inputs: counts.inputs.load(Ordering::Relaxed).saturating_sub(used),
    }
}

/// Opens the stream of a WatchEvents call.
pub(crate) fn watch_events(
    hub: &Arc<Hub>,
    request: &v1::WatchEventsRequest,
) -> Result<Answers<v1::WatchEventsResponse>, RpcError> {
    let session = hub.session(&request.id)?;
    let place = session.events().watch(hub.limits.watchers_per_plant)?;
    let from = request.since.unwrap_or_else(|| session.events().next_number());
    let reader = session.events().reader(from);
    let (hub, waiting) = (Arc::clone(hub), VecDeque::new());
    let _in_use = session.life().in_use();
    Ok(EventWatcher { hub, session, reader, waiting, _place: place, _in_use }.into_answers())
}

struct EventWatcher {
    hub: Arc<Hub>,
    session: Arc<Session>,
    reader: EventReader,
    /// Events that were read together.
    waiting: VecDeque<(u64, Event)>,
    _place: Arc<()>,
    _in_use: Use,
}

impl Messages for EventWatcher {
    type Message = v1::WatchEventsResponse;

    async fn next(&mut self) -> Result<v1::WatchEventsResponse, RpcError> {
        loop {
            let reader = &mut self.reader;
            self.waiting.extend(std::iter::from_fn(|| reader.read_next()));
            if let Some((number, event)) = self.waiting.pop_front() {
                let event = Some(event_message(number, &event, self.session.model()));
                return Ok(v1::WatchEventsResponse { event, dropped: self.reader.lost() });
            }
            tokio::select! {
                biased;
                () = self.hub.ending.cancelled() => return Err(RpcError::shutting_down()),
                () = self.session.closed() => return Err(RpcError::closed(&self.session)),
                () = tokio::time::sleep(EVENTS_PERIOD) => {}
            }
        }
    }
}
