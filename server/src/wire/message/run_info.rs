//! How a plant is run, what protects it and what has happened to it, as messages.

use plantd_models::Model;
use plantd_proto::v1;

use crate::core::driver::DriverKind;
use crate::core::plant::event::{Event, EventKind};
use crate::core::plant::watchdog::{Quantity, Safety, Trip, Watchdog, WatchdogAction};
use crate::core::realtime::clock::utc_ns;
use crate::core::realtime::input::InputAction;
use crate::core::realtime::settings::{Pace, RunSettings};
use crate::core::session::shared::Session;
use crate::wire::status::RpcError;

/// How a plant is being run.
pub(crate) fn run_info(session: &Session) -> v1::RunInfo {
    let (run, steps_left) = session.run_info();
    let RunSettings { pace, speed, input } = run.settings;
    let (action, ramp_s) = match input.action {
        InputAction::Hold => (v1::InputAction::Hold, 0.0),
        InputAction::Safe => (v1::InputAction::Safe, 0.0),
        InputAction::Ramp { duration_s } => (v1::InputAction::Ramp, duration_s),
        InputAction::Stop => (v1::InputAction::Stop, 0.0),
    };
    let policy = v1::InputPolicy {
        timeout_s: input.timeout_s,
        action: action.into(),
        ramp_s,
        safe: input.safe,
        latch: input.latch,
    };
    let (pace, input) = match pace {
        Pace::Lockstep => (v1::Pace::Lockstep, None),
        Pace::Paced => (v1::Pace::Paced, Some(policy)),
        Pace::Free => (v1::Pace::Free, Some(policy)),
    };
    v1::RunInfo {
        settings: Some(v1::RunSettings { pace: pace.into(), speed, input }),
        running: run.is_running,
        steps_left,
        stopped_by: run.stopped_by.map(|why| RpcError::from_stopped(why, session).into()),
    }
}

/// What protects a plant; none if nothing does.
pub(crate) fn safety_info(
    safety: &Safety,
    frozen: Option<Trip>,
    model: &Model,
) -> Option<v1::SafetyInfo> {
    if safety.watchdogs.is_empty() && safety.on_step_failure.is_none() {
        return None;
    }
    let action = |action: WatchdogAction| match action {
        WatchdogAction::Freeze => v1::WatchdogAction::Freeze.into(),
        WatchdogAction::Reset => v1::WatchdogAction::Reset.into(),
        WatchdogAction::Disconnect => v1::WatchdogAction::Disconnect.into(),
    };
    let watchdog = |dog: &Watchdog| v1::Watchdog {
        quantity: Quantity::name(dog.quantity.code(), model),
        min: dog.min.is_finite().then_some(dog.min),
        max: dog.max.is_finite().then_some(dog.max),
        action: action(dog.action),
    };
    let trip = |trip: Trip| v1::WatchdogTrip {
        watchdog: trip.watchdog as u32,
        value: trip.value,
        step: trip.step,
    };
    Some(v1::SafetyInfo {
        watchdogs: safety.watchdogs.iter().map(watchdog).collect(),
        on_step_failure: safety.on_step_failure.map_or(0, action),
        frozen: frozen.map(trip),
    })
}

/// An event with names.
pub(crate) fn event_message(number: u64, event: &Event, model: &Model) -> v1::Event {
    let (subject, value) = match event.kind {
        EventKind::DriverAttached | EventKind::DriverLeft => {
            let driver = DriverKind::from_code(event.index as u8);
            (driver.map_or("", DriverKind::as_str).to_owned(), event.value)
        }
        EventKind::Watchdog => (Quantity::name(event.index, model), event.value),
        EventKind::FaultBegan | EventKind::FaultEnded => (String::new(), event.index as f64),
        _ => (String::new(), event.value),
    };
    v1::Event {
        number,
        // 0 means that nothing was given.
        kind: event.kind as i32 + 1,
        step: event.step,
        subject,
        value,
        monotonic_ns: event.at_ns,
        utc_ns: utc_ns(event.at_ns),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_of_events_have_the_numbers_of_the_contract() {
        for (kind, expected) in [
            (EventKind::Started, v1::EventKind::Started),
            (EventKind::Slipped, v1::EventKind::Slipped),
            (EventKind::Watchdog, v1::EventKind::Watchdog),
            (EventKind::FaultEnded, v1::EventKind::FaultEnded),
            (EventKind::Overran, v1::EventKind::Overran),
        ] {
            assert_eq!(kind as i32 + 1, expected as i32);
        }
    }
}
