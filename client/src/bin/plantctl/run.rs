//! Plants that run by themselves: `run`, `pause`, `guard`, `timing` and `events`.

use std::fmt::Write as _;

use anyhow::Result;
use clap::ValueEnum;
use plantd_client::{Client, Error, v1};
use serde_json::json;

use crate::args::{Numbers, numbers};
use crate::commands::{Output, plant};
use crate::{json, text};

/// Arguments of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct RunArgs {
    /// Plant.
    pub(crate) id: String,
    /// Who decides when it takes a step; as before if not given.
    #[arg(long, value_enum)]
    pub(crate) pace: Option<Pace>,
    /// Seconds of the plant's clock in a second of the wall clock.
    #[arg(long, requires = "pace")]
    pub(crate) speed: Option<f64>,
    /// Pause again after this many steps.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) steps: Option<u64>,
    /// Wait until the plant stands still again: the steps are taken, or something has stopped it.
    #[arg(long)]
    pub(crate) wait: bool,
    /// How long an input is valid, seconds on the plant's clock; for ever if not given.
    #[arg(long, value_name = "SECONDS", requires = "pace")]
    pub(crate) timeout: Option<f64>,
    /// What to do without a valid input.
    #[arg(long, value_enum, requires = "pace")]
    pub(crate) action: Option<InputAction>,
    /// Duration of a ramp, seconds on the plant's clock.
    #[arg(long, value_name = "SECONDS", requires = "action")]
    pub(crate) ramp: Option<f64>,
    /// The safe input, comma-separated.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true, requires = "pace")]
    pub(crate) safe: Option<Numbers>,
    /// Once the safe input acts, it acts until `run` is called again.
    #[arg(long, requires = "pace")]
    pub(crate) latch: bool,
}

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Pace {
    /// The driver, one step for each input.
    Lockstep,
    /// The wall clock.
    Paced,
    /// Nobody: as fast as possible.
    Free,
}

/// What to do without a valid input.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum InputAction {
    /// The last input acts on.
    Hold,
    /// The safe input acts at once.
    Safe,
    /// The safe input acts after a ramp.
    Ramp,
    /// The plant stands still.
    Stop,
}

/// A watchdog.
#[derive(Clone, Debug)]
pub(crate) struct WatchdogArg(pub(crate) v1::Watchdog);

/// `run`.
pub(crate) async fn run(client: &Client, output: Output, args: RunArgs) -> Result<()> {
    let RunArgs { id, pace, speed, steps, wait, timeout, action, ramp, safe, latch } = args;
    let pace = pace.map(|pace| match pace {
        Pace::Lockstep => v1::Pace::Lockstep,
        Pace::Paced => v1::Pace::Paced,
        Pace::Free => v1::Pace::Free,
    });
    let action = action.map(|action| match action {
        InputAction::Hold => v1::InputAction::Hold,
        InputAction::Safe => v1::InputAction::Safe,
        InputAction::Ramp => v1::InputAction::Ramp,
        InputAction::Stop => v1::InputAction::Stop,
    });
    let has_policy = action.is_some() || timeout.is_some() || safe.is_some() || latch;
    let policy = has_policy.then(|| v1::InputPolicy {
        timeout_s: timeout.unwrap_or(0.0),
        action: action.unwrap_or_default().into(),
        ramp_s: ramp.unwrap_or(0.0),
        safe: safe.map(|numbers| numbers.0).unwrap_or_default(),
        latch,
    });
    // Without a pace the settings stay as they are.
    let settings = pace.map(|pace| v1::RunSettings {
        pace: pace.into(),
        speed: speed.unwrap_or(0.0),
        input: policy,
    });
    if settings.is_none() && steps.is_none() {
        say_if_it_runs(client, output, &id).await?;
    }
    let request = v1::RunRequest { id, settings, steps: steps.unwrap_or(0), wait };
    let run = client.run(request).await?;
    output.print(|| json::message("RunInfo", &run), String::new)?;
    match run.stopped_by {
        Some(failure) if wait => Err(Error::Rpc(Box::new(failure.into())).into()),
        _ => Ok(()),
    }
}

/// `run` without more lets a plant go on that stands still; any other stays as it is.
async fn say_if_it_runs(client: &Client, output: Output, id: &str) -> Result<()> {
    let plant = plant(client, id).await?;
    let run = plant.run.unwrap_or_default();
    let is_frozen = plant.safety.is_some_and(|safety| safety.frozen.is_some());
    if !run.running || is_frozen || run.steps_left > 0 {
        return Ok(());
    }
    output.nothing_to_do(&match run.settings.unwrap_or_default().pace() {
        v1::Pace::Unspecified | v1::Pace::Lockstep => format!(
            "plant `{id}` is in lockstep, one step for each input of its driver; with `--pace paced` it \
             runs by itself"
        ),
        v1::Pace::Paced | v1::Pace::Free => format!("plant `{id}` runs already"),
    });
    Ok(())
}

/// `pause`.
pub(crate) async fn pause(client: &Client, output: Output, id: String) -> Result<()> {
    let run = plant(client, &id).await?.run.unwrap_or_default();
    if !run.running {
        output.nothing_to_do(&match run.stopped_by {
            Some(failure) => format!("plant `{id}` stands still already: {}", failure.message),
            None => format!("plant `{id}` is paused already"),
        });
    }
    let paused = client.pause(id).await?;
    let as_text = || paused.state.as_ref().map(text::state).unwrap_or_default();
    Ok(output.print(|| json::message("PauseResponse", &paused), as_text)?)
}

/// `guard`.
pub(crate) async fn guard(
    client: &Client,
    output: Output,
    id: String,
    watchdogs: Vec<WatchdogArg>,
) -> Result<()> {
    let watchdogs: Vec<v1::Watchdog> = watchdogs.into_iter().map(|dog| dog.0).collect();
    let count = watchdogs.len();
    if count == 0 && plant(client, &id).await?.safety.is_none() {
        output.nothing_to_do(&format!("nothing protects plant `{id}`"));
    }
    let request = v1::SetSafetyRequest { id: id.clone(), watchdogs, on_step_failure: 0 };
    client.set_safety(request).await?;
    Ok(output.done(json!({ "guarded": { "plant": id, "watchdogs": count } }))?)
}

/// A watchdog on the command line: `theta<1.5`, `v(x)>-2`, `energy<10:reset`.
pub(crate) fn watchdog(given: &str) -> Result<WatchdogArg, String> {
    let (bound, action) = given.rsplit_once(':').unwrap_or((given, "freeze"));
    let action = match action {
        "freeze" => v1::WatchdogAction::Freeze,
        "reset" => v1::WatchdogAction::Reset,
        "disconnect" => v1::WatchdogAction::Disconnect,
        other => return Err(format!("`{other}` is none of freeze, reset and disconnect")),
    };
    let at = bound.find(['<', '>']).ok_or("a quantity, `<` or `>`, and a number are needed")?;
    let (quantity, rest) = bound.split_at(at);
    let value: f64 =
        rest[1..].trim().parse().map_err(|_| format!("`{}` is no number", &rest[1..]))?;
    let is_max = rest.starts_with('<');
    Ok(WatchdogArg(v1::Watchdog {
        quantity: quantity.trim().to_owned(),
        min: (!is_max).then_some(value),
        max: is_max.then_some(value),
        action: action.into(),
    }))
}

/// `timing`.
pub(crate) async fn timing(client: &Client, output: Output, id: String, clear: bool) -> Result<()> {
    let timing = client.timing(id, clear).await?;
    Ok(output.print(|| json::message("GetTimingResponse", &timing), || timing_text(&timing))?)
}

fn timing_text(timing: &v1::GetTimingResponse) -> String {
    let mut text = format!(
        "{:12} {:>10} {:>10} {:>10} {:>10} {:>10}\n",
        "us", "mean", "p50", "p99", "p99.9", "max"
    );
    for (name, times) in [
        ("lateness", &timing.lateness),
        ("step", &timing.step),
        ("input age", &timing.input_age),
        ("round trip", &timing.round_trip),
    ] {
        let Some(times) = times.as_ref().filter(|times| times.count > 0) else { continue };
        let us = |time_ns: u64| time_ns as f64 * 1e-3;
        let _ = writeln!(
            text,
            "{name:12} {:10.1} {:10.1} {:10.1} {:10.1} {:10.1}",
            us(times.mean_ns),
            us(times.p50_ns),
            us(times.p99_ns),
            us(times.p999_ns),
            us(times.max_ns)
        );
    }
    let _ = writeln!(
        text,
        "{} steps, {} overruns, {} slips, {} late inputs, {} safe inputs, {} unused inputs",
        timing.steps,
        timing.overruns,
        timing.slips,
        timing.late_inputs,
        timing.safe_inputs,
        timing.unused_inputs
    );
    text
}

/// `events`.
pub(crate) async fn events(
    client: &Client,
    output: Output,
    id: String,
    since: Option<u64>,
    count: Option<u64>,
) -> Result<()> {
    let mut events = client.watch_events(id, since).await?;
    let mut left = count.unwrap_or(u64::MAX);
    while left > 0
        && let Some(message) = events.next().await?
    {
        let as_text = || message.event.as_ref().map(event_text).unwrap_or_default();
        output.print(|| json::message("WatchEventsResponse", &message), as_text)?;
        left -= 1;
    }
    Ok(())
}

fn event_text(event: &v1::Event) -> String {
    let kind = event.kind().as_str_name().trim_start_matches("EVENT_KIND_").to_lowercase();
    let kind = kind.replace('_', " ");
    format!("{:6}  step {:8}  {kind} {} {}\n", event.number, event.step, event.subject, event.value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn watchdogs_are_read() {
        let dog = watchdog("v(x) > -2.5:reset").unwrap().0;
        assert_eq!((dog.quantity.as_str(), dog.min, dog.max), ("v(x)", Some(-2.5), None));
        assert_eq!(dog.action(), v1::WatchdogAction::Reset);
        let dog = watchdog("energy<10").unwrap().0;
        assert_eq!(
            (dog.min, dog.max, dog.action()),
            (None, Some(10.0), v1::WatchdogAction::Freeze)
        );
        for wrong in ["theta", "theta<", "theta<1:stop", "theta=1"] {
            assert!(watchdog(wrong).is_err(), "{wrong}");
        }
    }
}
