//! `replay`: the steps of a recording, taken again and compared.

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use plantd_client::{Client, Error, MatrixExt as _, RecordingEntry, RecordingReader, v1};
use serde_json::{Value, json};

use crate::contract::names;
use crate::output::failure::FAILED;
use crate::server::context::Context;
use crate::server::own::OwnServer;

/// Most numbers in the answer to one call, and most steps.
const REPLY_NUMBERS: usize = 200_000;
const STEPS_PER_CALL: usize = 1000;

/// Takes the steps of a recording again and compares them, bit for bit.
///
/// The server that it starts for this has no other plants; with an address, the one there is used. The
/// exit code is 1 when a step differs, and when no step could be compared.
#[derive(Debug, Args)]
pub(crate) struct Replay {
    /// Recording.
    file: PathBuf,
}

impl Replay {
    pub(crate) async fn run(self, context: &Context) -> Result<ExitCode> {
        let mut recording = RecordingReader::open(self.file)?;
        let (server, address) = match &context.address {
            Some(address) => (None, address.clone()),
            None => {
                let server = OwnServer::start(None).await?;
                let address = server.address().to_owned();
                (Some(server), address)
            }
        };
        let client = context.connect_to(&address).await?;
        let outcome = replay_on(&client, &mut recording).await;
        if let Some(server) = server {
            server.stop().await;
        }
        let outcome = outcome?;
        context.output.print(|| outcome.to_json(), || outcome.to_text())?;
        let is_good = outcome.difference.is_none() && outcome.steps > 0;
        Ok(if is_good { ExitCode::SUCCESS } else { ExitCode::from(FAILED) })
    }
}

async fn replay_on(client: &Client, recording: &mut RecordingReader) -> Result<Outcome> {
    let id = format!("replay-{}-{}", std::process::id(), nanoseconds());
    let mut twin = Twin::create(client, &id, recording.plant()).await?;
    let outcome = twin.follow(recording).await;
    // The names are random and the server may be somebody else's: nothing is to stay there.
    let tidied = twin.delete().await;
    let outcome = outcome?;
    tidied?;
    Ok(outcome)
}

fn nanoseconds() -> u32 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |now| now.subsec_nanos())
}

/// Deviation a replay has found.
#[derive(Debug, Default)]
struct Outcome {
    /// Steps that were compared.
    steps: u64,
    /// Recorded steps that could not be.
    skipped: u64,
    /// Steps that the recording has lost.
    lost: u64,
    /// The file ends in the middle.
    is_cut: bool,
    difference: Option<Difference>,
}

/// Where the plant went another way.
#[derive(Debug)]
struct Difference {
    /// Step of the plant.
    step: u64,
    /// How it went another way.
    deviation: Deviation,
}

#[derive(Debug)]
enum Deviation {
    /// A number.
    Number { entry: String, recorded: f64, replayed: f64 },
    /// The step failed.
    Failure(String),
    /// All that shows is equal, but not what the plant keeps between steps.
    Snapshot,
}

impl Outcome {
    fn to_json(&self) -> Value {
        let difference = self.difference.as_ref().map(|difference| {
            let step = difference.step;
            match &difference.deviation {
                Deviation::Number { entry, recorded, replayed } => json!({
                    "step": step,
                    "entry": entry,
                    "recorded": recorded,
                    "recorded_bits": format!("{:016x}", recorded.to_bits()),
                    "replayed": replayed,
                    "replayed_bits": format!("{:016x}", replayed.to_bits()),
                }),
                Deviation::Failure(message) => json!({ "step": step, "failure": message }),
                Deviation::Snapshot => json!({ "step": step, "entry": "snapshot" }),
            }
        });
        json!({
            "steps": self.steps,
            "identical": self.difference.is_none(),
            "not_compared": self.skipped,
            "lost": self.lost,
            "cut_short": self.is_cut,
            "difference": difference,
        })
    }

    fn to_text(&self) -> String {
        let mut text = String::new();
        let steps = self.steps;
        let _ = match &self.difference {
            None => writeln!(text, "{steps} steps, identical"),
            Some(Difference { step, deviation }) => match deviation {
                Deviation::Number { entry, recorded, replayed } => writeln!(
                    text,
                    "step {step} differs in {entry}, after {steps} identical steps\n  \
                     recorded  {:016x}  {recorded:e}\n  replayed  {:016x}  {replayed:e}",
                    recorded.to_bits(),
                    replayed.to_bits(),
                ),
                Deviation::Failure(message) => {
                    writeln!(text, "step {step} fails, after {steps} identical steps: {message}")
                }
                Deviation::Snapshot => writeln!(
                    text,
                    "the snapshot after step {step} differs, after {steps} identical steps"
                ),
            },
        };
        if self.lost > 0 {
            let _ = writeln!(text, "{} steps were lost when they were recorded", self.lost);
        }
        if self.skipped > 0 {
            let _ = writeln!(
                text,
                "{} recorded steps were not compared: steps were lost before them",
                self.skipped
            );
        }
        if self.is_cut {
            text.push_str("the file ends in the middle: its writer did not come to the end\n");
        }
        text
    }
}

/// The plant that takes the recorded steps again.
struct Twin<'a> {
    client: &'a Client,
    id: String,
    names: Vec<String>,
    width: usize,
    batch_max: usize,
    parameters: BTreeMap<String, f64>,
    time_step_s: f64,
    /// Recorded steps that are still to be taken.
    batch: Vec<v1::StepRecord>,
    outcome: Outcome,
}

impl<'a> Twin<'a> {
    async fn create(client: &'a Client, id: &str, record: &v1::PlantRecord) -> Result<Self> {
        let missing = || Error::Protocol("a recording without a plant and its model");
        let plant = record.plant.as_ref().ok_or_else(missing)?;
        let model = record.model.as_ref().ok_or_else(missing)?;
        let of = || format!("a plant recorded by plantd {}", record.version);
        let request = v1::CreateModelRequest {
            name: id.to_owned(),
            scene: model.scene_toml.clone(),
            format: v1::SceneFormat::Toml.into(),
            replace: false,
            files: HashMap::default(),
        };
        client.create_model_as(request).await.with_context(of)?;
        let snapshot = v1::initial_state::Form::Snapshot(record.snapshot.clone());
        let request = v1::CreatePlantRequest {
            id: id.to_owned(),
            model: id.to_owned(),
            settings: plant.settings,
            initial: Some(v1::InitialState { form: Some(snapshot) }),
            ..Default::default()
        };
        if let Err(error) = client.create_plant(request).await {
            client.delete_model(id).await?;
            return Err(error).with_context(of);
        }
        let names = names::recorded(model);
        let batch_max = (REPLY_NUMBERS / names.len().max(1)).clamp(1, STEPS_PER_CALL);
        Ok(Self {
            client,
            id: id.to_owned(),
            width: names::input(model).len(),
            names,
            batch_max,
            parameters: plant.parameters.iter().map(|p| (p.path.clone(), p.value)).collect(),
            time_step_s: plant.settings.map_or(0.0, |settings| settings.time_step_s),
            batch: Vec::new(),
            outcome: Outcome::default(),
        })
    }

    async fn delete(&self) -> Result<()> {
        self.client.delete_plant(&self.id).await?;
        Ok(self.client.delete_model(&self.id).await?)
    }

    /// Takes the recorded steps until one differs.
    async fn follow(&mut self, recording: &mut RecordingReader) -> Result<Outcome> {
        let mut is_lost = false;
        while self.outcome.difference.is_none() {
            // Deviation is damaged shows as a step that differs, if there is one.
            let entry = match recording.next_entry() {
                Ok(entry) => entry,
                Err(error) => {
                    self.take_steps().await?;
                    if self.outcome.difference.is_some() {
                        break;
                    }
                    return Err(error.into());
                }
            };
            match entry {
                None => {
                    self.take_steps().await?;
                    break;
                }
                Some(RecordingEntry::Step(_)) if is_lost => self.outcome.skipped += 1,
                Some(RecordingEntry::Step(step)) => {
                    self.batch.push(*step);
                    if self.batch.len() >= self.batch_max {
                        self.take_steps().await?;
                    }
                }
                Some(RecordingEntry::Event(_) | RecordingEntry::Energy { .. }) => {}
                Some(RecordingEntry::Mark(mark)) => {
                    self.take_steps().await?;
                    if self.outcome.difference.is_none() {
                        is_lost = self.take_mark(mark, is_lost).await?;
                    }
                }
            }
        }
        self.outcome.is_cut = recording.is_cut();
        Ok(std::mem::take(&mut self.outcome))
    }

    async fn take_steps(&mut self) -> Result<()> {
        let batch = std::mem::take(&mut self.batch);
        if batch.is_empty() {
            return Ok(());
        }
        let before = self.client.snapshot(&self.id).await?;
        if self.take(&batch).await?.is_ok() {
            return Ok(());
        }
        // A step failed, which may come of one that went another way before: one at a time they show.
        self.client.restore(&self.id, before).await?;
        for step in &batch {
            if let Err(failure) = self.take(std::slice::from_ref(step)).await? {
                let step = step.state.as_ref().map_or(0, |state| state.step);
                let deviation = Deviation::Failure(failure);
                self.outcome.difference = Some(Difference { step, deviation });
            }
            if self.outcome.difference.is_some() {
                break;
            }
        }
        Ok(())
    }

    /// Takes steps and compares them. The inner error is that of a step that failed.
    async fn take(&mut self, steps: &[v1::StepRecord]) -> Result<Result<(), String>> {
        let rows: Vec<_> = steps.iter().map(|step| step.u.clone()).collect();
        let width = self.width;
        ensure!(rows.iter().all(|row| row.len() == width), "an input without {width} entries");
        let (u, hold) = match width {
            // A matrix without columns has no rows that could be counted.
            0 => (None, rows.len() as u32),
            _ => (Some(v1::Matrix::from_rows(&rows)), 0),
        };
        let impulses = impulses(steps)?;
        let request = v1::StepRequest { id: self.id.clone(), u, hold, all_states: true, impulses };
        let replayed = match self.client.step(request).await {
            Ok(answer) => answer.states,
            Err(Error::Rpc(refusal)) => return Ok(Err(refusal.to_string())),
            Err(error) => return Err(error.into()),
        };
        for (step, replayed) in steps.iter().zip(&replayed) {
            let recorded = step.state.clone().unwrap_or_default();
            if let Some(deviation) = self.difference(&recorded, replayed) {
                self.outcome.difference = Some(Difference { step: recorded.step, deviation });
                break;
            }
            self.outcome.steps += 1;
        }
        Ok(Ok(()))
    }

    fn difference(&self, recorded: &v1::State, replayed: &v1::State) -> Option<Deviation> {
        let number = |entry: &str, recorded: f64, replayed: f64| {
            let entry = entry.to_owned();
            (recorded.to_bits() != replayed.to_bits()).then_some(Deviation::Number {
                entry,
                recorded,
                replayed,
            })
        };
        number("step", recorded.step as f64, replayed.step as f64)
            .or_else(|| number("time_s", recorded.time_s, replayed.time_s))
            .or_else(|| {
                let (a, b) = (names::recorded_numbers(recorded), names::recorded_numbers(replayed));
                let length = number("the number of entries", a.len() as f64, b.len() as f64);
                let entry = |(i, (a, b)): (usize, (&f64, &f64))| {
                    number(self.names.get(i).map_or("?", String::as_str), *a, *b)
                };
                length.or_else(|| a.iter().zip(&b).enumerate().find_map(entry))
            })
    }

    /// Goes on from a mark. True when the steps after it cannot be taken again.
    async fn take_mark(&mut self, mark: v1::MarkRecord, is_lost: bool) -> Result<bool> {
        self.outcome.lost += mark.lost;
        let has_snapshot = !mark.snapshot.is_empty();
        if !has_snapshot && (is_lost || mark.reason() != v1::MarkReason::Parameters) {
            return Ok(true);
        }
        let changes: Vec<_> = mark
            .parameters
            .iter()
            .filter(|p| {
                self.parameters.get(&p.path).map(|v| v.to_bits()) != Some(p.value.to_bits())
            })
            .cloned()
            .collect();
        let is_time_step_new = mark.time_step_s.to_bits() != self.time_step_s.to_bits();
        if !changes.is_empty() || is_time_step_new {
            self.parameters.extend(changes.iter().map(|p| (p.path.clone(), p.value)));
            self.time_step_s = mark.time_step_s;
            let request = v1::SetParametersRequest {
                id: self.id.clone(),
                parameters: changes,
                time_step_s: if is_time_step_new { mark.time_step_s } else { 0.0 },
            };
            self.client.set_parameters(request).await?;
        }
        if !has_snapshot {
            return Ok(false);
        }
        let goes_on = !is_lost && mark.lost == 0 && mark.reason() != v1::MarkReason::Reset;
        if goes_on && self.client.snapshot(&self.id).await? != mark.snapshot {
            let deviation = Deviation::Snapshot;
            self.outcome.difference = Some(Difference { step: mark.step, deviation });
        }
        self.client.restore(&self.id, mark.snapshot).await?;
        Ok(false)
    }
}

/// Deviation pushed the plant before steps; none if nothing did.
fn impulses(steps: &[v1::StepRecord]) -> Result<Option<v1::Matrix>> {
    let width = steps.iter().map(|step| step.impulse.len()).max().unwrap_or(0);
    if width == 0 {
        return Ok(None);
    }
    let row = |step: &v1::StepRecord| match step.impulse.len() {
        0 => Ok(vec![0.0; width]),
        n if n == width => Ok(step.impulse.clone()),
        n => anyhow::bail!("an impulse of {n} entries beside one of {width}"),
    };
    let rows = steps.iter().map(row).collect::<Result<Vec<_>>>()?;
    Ok(Some(v1::Matrix::from_rows(&rows)))
}
