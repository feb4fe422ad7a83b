//! `top`: what the plants of a server are doing, again and again.

use std::collections::HashMap;
use std::io::{IsTerminal as _, Write as _};
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use plantd_client::{Client, v1};
use serde_json::{Value, json};

use crate::output::page::{Cell, Table, table};
use crate::server::context::Context;

/// Cursor to the corner, and the screen empty.
const CLEAR: &str = "\x1b[H\x1b[2J";

/// Shows plants with their rates, drivers and lateness, until Ctrl-C.
#[derive(Debug, Args)]
pub(crate) struct Top {
    /// Time between two looks, s.
    #[arg(long, default_value_t = 1.0, value_parser = interval)]
    interval: f64,
    /// End after this many looks.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

fn interval(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "is not a number of seconds".to_owned())?;
    match (0.1..=3600.0).contains(&seconds) {
        true => Ok(seconds),
        false => Err("must be from 0.1 to 3600 seconds".to_owned()),
    }
}

/// A plant at a look.
struct Row {
    plant: v1::PlantInfo,
    /// Steps a second since the last look, once there was one.
    rate: Option<f64>,
    /// Of plants in a loop of their own.
    timing: Option<v1::GetTimingResponse>,
}

impl Top {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let is_screen = std::io::stdout().is_terminal() && context.output.is_for_people();
        let mut last: HashMap<String, (Instant, u64)> = HashMap::new();
        let mut ticks = tokio::time::interval(Duration::from_secs_f64(self.interval));
        let mut looks = 0;
        while self.count.is_none_or(|count| looks < count) {
            tokio::select! {
                _ = ticks.tick() => {}
                _ = tokio::signal::ctrl_c() => break,
            }
            let rows = look(&client, &mut last).await?;
            if is_screen {
                // Not by way of what takes colours away: this is no colour.
                std::io::stdout().write_all(CLEAR.as_bytes())?;
            }
            context.output.print(|| as_json(&rows), || as_table(&rows))?;
            looks += 1;
        }
        Ok(())
    }
}

async fn look(client: &Client, last: &mut HashMap<String, (Instant, u64)>) -> Result<Vec<Row>> {
    let plants = client.list_plants().await?;
    let now = Instant::now();
    let mut rows = Vec::with_capacity(plants.len());
    let mut seen = HashMap::with_capacity(plants.len());
    for plant in plants {
        let step = plant.state.as_ref().map_or(0, |state| state.step);
        let rate = last.get(&plant.id).map(|(then, before)| {
            step.saturating_sub(*before) as f64 / now.duration_since(*then).as_secs_f64()
        });
        seen.insert(plant.id.clone(), (now, step));
        let timing = match pace(&plant) {
            // A plant that was deleted since the list was made has no timing any more.
            v1::Pace::Paced | v1::Pace::Free => client.timing(plant.id.clone(), false).await.ok(),
            v1::Pace::Lockstep | v1::Pace::Unspecified => None,
        };
        rows.push(Row { plant, rate, timing });
    }
    *last = seen;
    Ok(rows)
}

fn pace(plant: &v1::PlantInfo) -> v1::Pace {
    let settings = plant.run.as_ref().and_then(|run| run.settings.as_ref());
    settings.map_or(v1::Pace::Unspecified, |settings| settings.pace())
}

/// How a plant is being run, in a word or two.
fn doing(plant: &v1::PlantInfo) -> String {
    let run = plant.run.as_ref();
    let stopped = run.and_then(|run| run.stopped_by.as_ref());
    match (pace(plant), run.is_some_and(|run| run.running)) {
        _ if stopped.is_some() => "stopped".to_owned(),
        (_, false) => "paused".to_owned(),
        (v1::Pace::Paced, true) => "paced".to_owned(),
        (v1::Pace::Free, true) => "free".to_owned(),
        (v1::Pace::Lockstep | v1::Pace::Unspecified, true) => "lockstep".to_owned(),
    }
}

fn late_us(row: &Row) -> Option<(f64, f64)> {
    let lateness = row.timing.as_ref()?.lateness.as_ref().filter(|times| times.count > 0)?;
    Some((lateness.p50_ns as f64 * 1e-3, lateness.p99_ns as f64 * 1e-3))
}

fn as_table(rows: &[Row]) -> Table {
    let cells = |row: &Row| {
        let plant = &row.plant;
        let state = plant.state.as_ref();
        let or_none = |text: Option<String>| Cell::from(text.unwrap_or_else(|| "-".to_owned()));
        let late = late_us(row);
        vec![
            plant.id.as_str().into(),
            plant.model.as_str().into(),
            doing(plant).into(),
            if plant.driver.is_empty() { "-" } else { plant.driver.as_str() }.into(),
            state.map_or(0.0, |state| state.time_s).into(),
            or_none(row.rate.map(|rate| format!("{rate:.0}"))),
            or_none(late.map(|(p50, _)| format!("{p50:.1}"))),
            or_none(late.map(|(_, p99)| format!("{p99:.1}"))),
            or_none(row.timing.as_ref().map(|timing| timing.overruns.to_string())),
        ]
    };
    let head =
        ["plant", "model", "run", "driver", "time/s", "steps/s", "late/us", "p99", "overruns"];
    table(&head, rows.iter().map(cells))
}

fn as_json(rows: &[Row]) -> Value {
    let plant = |row: &Row| {
        let state = row.plant.state.as_ref();
        json!({
            "id": row.plant.id,
            "model": row.plant.model,
            "run": doing(&row.plant),
            "driver": row.plant.driver,
            "step": state.map_or(0, |state| state.step),
            "time_s": state.map_or(0.0, |state| state.time_s),
            "steps_per_s": row.rate,
            "lateness_p50_us": late_us(row).map(|(p50, _)| p50),
            "lateness_p99_us": late_us(row).map(|(_, p99)| p99),
            "overruns": row.timing.as_ref().map(|timing| timing.overruns),
        })
    };
    json!({ "plants": rows.iter().map(plant).collect::<Vec<_>>() })
}
