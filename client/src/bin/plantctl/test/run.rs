//! Runs one case: makes the plant, lets it be driven, and collects what is seen of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

use anyhow::{Context as _, Result, bail, ensure};
use plantd_client::{
    Answers, Client, Error, MatrixExt as _, StateExt as _, diagonal, operating_point, v1,
};
use tokio::time::{Instant, sleep_until, timeout_at};

use super::controller::{Assignment, Controller as Process};
use super::expect::{Curve, Facts, Verdict};
use super::expression::Expression;
use super::samples::{Columns, Sample, Samples};
use super::scenario::{Case, Controller, Event, Inputs, Lqr, Pace, Plant, Reference, Scenario};
use crate::{json, optimize};

/// Part of a time step by which a time may miss a step and still mean it.
const STEP_ROUNDING: f64 = 1e-6;
/// Samples that may wait to be read.
const WATCH_QUEUE: u32 = 2048;
/// Steps that a driver in lockstep is let take before they have all been seen.
const STEPS_AHEAD: u64 = WATCH_QUEUE as u64 / 2;
/// Refused steps that are kept.
const FAILURES_MAX: usize = 1000;
/// How often a plant that nobody steps is looked at.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// How often it is looked whether a driver has come.
const DRIVER_PERIOD: Duration = Duration::from_millis(2);

/// Where cases run.
pub(crate) struct Place {
    pub(crate) client: Client,
    pub(crate) address: String,
    pub(crate) link_root: Option<PathBuf>,
    /// Plants that are to be deleted.
    pub(crate) plants: Mutex<BTreeSet<String>>,
}

/// A scenario with all that its cases share.
pub(crate) struct Prepared {
    pub(crate) file: PathBuf,
    pub(crate) name: String,
    pub(crate) scenario: Scenario,
    model: v1::Model,
    columns: Columns,
    reference: Option<Motion>,
    channels: Option<v1::Channels>,
    faults: Vec<Vec<v1::FaultSpec>>,
    /// Rows of inputs, as far as they are given; the last one holds on.
    inputs: Vec<Vec<Option<f64>>>,
    policy: Option<v1::InputPolicy>,
    uses_energy: bool,
    steps: u64,
}

/// A reference: one state and input, or those of every step.
struct Motion {
    x: Vec<Vec<f64>>,
    u: Vec<Vec<f64>>,
    trajectory: Option<v1::Trajectory>,
}

impl Motion {
    /// State at a step, and the input of the step that leads there.
    fn at(&self, step: u64) -> (&[f64], &[f64]) {
        let row = |rows: &'_ [Vec<f64>], k: u64| {
            let k = usize::try_from(k).unwrap_or(usize::MAX);
            rows.len().checked_sub(1).map(|last| k.min(last))
        };
        let x = row(&self.x, step).map_or(&[][..], |k| &self.x[k]);
        let u = row(&self.u, step.saturating_sub(1)).map_or(&[][..], |k| &self.u[k]);
        (x, u)
    }
}

/// What came of a case.
pub(crate) struct Outcome {
    pub(crate) case: String,
    pub(crate) seed: u64,
    pub(crate) verdicts: Vec<Verdict>,
    /// Why the run ended before its time.
    pub(crate) ended: Option<String>,
    /// Why the case could not be run or judged.
    pub(crate) error: Option<String>,
    pub(crate) time_s: Vec<f64>,
    pub(crate) plots: Vec<Curve>,
    /// What the controller has written.
    pub(crate) output: String,
    pub(crate) elapsed: Duration,
    pub(crate) steps: u64,
}

/// The result of a case, in order of gravity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Status {
    Passed,
    Failed,
    /// It could not be run or judged.
    Error,
}

impl Outcome {
    pub(crate) fn status(&self) -> Status {
        let is_broken = |verdict: &Verdict| verdict.broken.is_some();
        match self {
            Self { error: Some(_), .. } => Status::Error,
            Self { ended: Some(_), .. } => Status::Failed,
            _ if self.verdicts.iter().any(is_broken) => Status::Failed,
            _ => Status::Passed,
        }
    }
}

/// A run as it goes on.
struct Run<'a> {
    place: &'a Place,
    prepared: &'a Prepared,
    deadline: Instant,
    time_step_s: f64,
    samples: Samples,
    facts: Facts,
    /// What sensors deliver at the start.
    y: Vec<f64>,
    last_step: u64,
    /// Step up to which the plant may go.
    until: u64,
    lost: u64,
    ended: Option<String>,
    output: String,
}

impl Prepared {
    /// Makes the model known to the server and reads what the scenario refers to.
    pub(crate) async fn new(place: &Place, file: PathBuf, scenario: Scenario) -> Result<Self> {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let name = scenario.name.clone().unwrap_or(stem);
        let folder = file.parent().unwrap_or(Path::new(""));
        let model = model(&place.client, &scenario.plant, folder).await?;
        let time_step_s = scenario.plant.time_step_s.unwrap_or(model.time_step_s);
        let steps = scenario.steps(time_step_s)?;
        let reference = match &scenario.reference {
            None => None,
            Some(reference) => Some(motion(place, &scenario, &model, reference, folder).await?),
        };
        let all = || scenario.expect.iter().flat_map(|e| e.expressions()).chain(&scenario.plot);
        let uses_energy = all().any(Expression::uses_energy);
        let channels = match scenario.channels.is_empty() {
            true => None,
            false => Some(message("Channels", &scenario.channels).context("channels")?),
        };
        let outputs = channels.as_ref().map(outputs).unwrap_or_default();
        let columns = Columns::new(&model, &outputs, reference.is_some(), uses_energy);
        let nothing = columns.empty();
        for (i, expectation) in scenario.expect.iter().enumerate() {
            for expression in expectation.expressions() {
                let known = expression.values(&nothing).map_err(anyhow::Error::msg);
                known.with_context(|| format!("expect[{i}].{}", expectation.key()))?;
            }
        }
        for (i, expression) in scenario.plot.iter().enumerate() {
            let known = expression.values(&nothing).map_err(anyhow::Error::msg);
            known.with_context(|| format!("plot[{i}]"))?;
        }
        let faults = scenario.events.iter().enumerate().map(|(i, event)| {
            faults(event, &model, time_step_s).with_context(|| format!("events[{i}]"))
        });
        let mut faults: Vec<_> = faults.collect::<Result<_>>()?;
        let mut inputs = Vec::new();
        match &scenario.controller {
            Controller::Inputs(given) if scenario.is_stepped() => {
                inputs = rows(given, &model, folder)?;
            }
            Controller::Inputs(Inputs { constant, .. }) => {
                // Nobody drives a plant that runs by itself: the forces act from the beginning.
                let event = Event { inputs: constant.clone(), ..Event::default() };
                let forces = self::faults(&event, &model, time_step_s);
                faults.push(forces.context("controller.inputs.constant")?);
            }
            _ => {}
        }
        let policy = match scenario.input_policy.is_empty() {
            true => None,
            false => Some(message("InputPolicy", &scenario.input_policy).context("input_policy")?),
        };
        Ok(Self {
            file,
            name,
            scenario,
            model,
            columns,
            reference,
            channels,
            faults,
            inputs,
            policy,
            uses_energy,
            steps,
        })
    }

    fn folder(&self) -> &Path {
        // The current folder has no name.
        self.file.parent().filter(|path| *path != Path::new("")).unwrap_or(Path::new("."))
    }

    /// Runs a case and judges it.
    pub(crate) async fn run(&self, place: &Place, case: &Case, plant: &str) -> Outcome {
        let start = Instant::now();
        let deadline = start + Duration::from_secs_f64(self.scenario.timeout_s);
        let mut run = Run {
            place,
            prepared: self,
            deadline,
            time_step_s: 0.0,
            samples: self.columns.empty(),
            facts: Facts::default(),
            y: Vec::new(),
            last_step: 0,
            until: 0,
            lost: 0,
            ended: None,
            output: String::new(),
        };
        lock(&place.plants).insert(plant.to_owned());
        let done = run.drive(case, plant).await;
        // It may never have been made, or be gone.
        let _ = place.client.delete_plant(plant).await;
        lock(&place.plants).remove(plant);
        let Run { samples, facts, ended, output, last_step, .. } = run;
        let mut outcome = Outcome {
            case: case.name.clone(),
            seed: self.scenario.seed,
            verdicts: Vec::new(),
            ended,
            error: done.err().map(|error| format!("{error:#}")),
            time_s: samples.time_s().to_vec(),
            plots: Vec::new(),
            output,
            elapsed: start.elapsed(),
            steps: last_step,
        };
        // Of what was never seen there is nothing to judge.
        let is_unseen = outcome.error.is_some() && samples.len() == 0;
        for expectation in self.scenario.expect.iter().filter(|_| !is_unseen) {
            match expectation.judge(&samples, &facts) {
                Ok(verdict) => outcome.verdicts.push(verdict),
                Err(error) => outcome.error = outcome.error.or(Some(error)),
            }
        }
        for expression in &self.scenario.plot {
            let Ok(values) = expression.values(&samples) else { continue };
            outcome.plots.push(Curve {
                name: expression.to_string(),
                low: vec![f64::NEG_INFINITY; values.len()],
                high: vec![f64::INFINITY; values.len()],
                values,
                from_s: 0.0,
                until_s: f64::INFINITY,
            });
        }
        outcome
    }
}

impl Run<'_> {
    async fn drive(&mut self, case: &Case, plant: &str) -> Result<()> {
        let scenario = &self.prepared.scenario;
        let mut state = self.create(case, plant).await?;
        state.step = 0;
        if scenario.is_stepped() {
            return self.step(plant, state).await;
        }
        let messages = self.watch(plant).await?;
        let mut events = None;
        if scenario.pace == Pace::Lockstep {
            events = Some(self.place.client.watch_events(plant, None).await?);
            self.let_run(plant, 0).await?;
        }
        let mut process = match &scenario.controller {
            Controller::Command(command) => {
                let told = Assignment {
                    address: &self.place.address,
                    plant,
                    link_root: self.place.link_root.as_deref(),
                    seed: case.seed,
                    steps: self.prepared.steps,
                    duration_s: scenario.duration_s,
                };
                Some(Process::start(command, self.prepared.folder(), &told)?)
            }
            _ => None,
        };
        let seen = self.follow(plant, messages, events.as_mut(), process.as_mut()).await;
        if let Some(process) = process {
            self.output = process.stop().await;
        }
        seen?;
        if let Some(events) = events {
            self.hear_out(plant, events).await?;
        }
        if scenario.pace == Pace::Paced {
            let timing = self.place.client.timing(plant, false).await?;
            self.facts.deadline_misses = Some(timing.overruns);
        }
        self.check_lost(scenario.may_lose_samples)
    }

    /// Makes the plant as the case wants it, and returns its state.
    async fn create(&mut self, case: &Case, id: &str) -> Result<v1::State> {
        let client = &self.place.client;
        let Prepared { scenario, model, reference, .. } = self.prepared;
        let initial = &scenario.plant.initial;
        let open_link = match &scenario.controller {
            Controller::Command(command) => command.link,
            Controller::External(external) => external.link,
            Controller::Inputs(_) | Controller::Lqr(_) => false,
        };
        let form = initial.at.clone().map(v1::initial_state::Form::OperatingPoint);
        let request = v1::CreatePlantRequest {
            id: id.to_owned(),
            model: model.name.clone(),
            settings: Some(settings(&scenario.plant)),
            initial: form.map(|form| v1::InitialState { form: Some(form) }),
            open_link,
        };
        let plant = client.create_plant(request).await.context("plant")?;
        self.time_step_s = plant.settings.as_ref().map_or(0.0, |settings| settings.time_step_s);
        let mut state = plant.state.context("a plant without a state")?;
        if let (Controller::Lqr(lqr), Some(reference)) = (&scenario.controller, reference) {
            let request = feedback(client, scenario, model, reference, lqr, id).await;
            client
                .set_feedback(request.context("controller.lqr")?)
                .await
                .context("controller.lqr")?;
        }
        self.change(id, &case.parameters).await.context("plant.parameters")?;
        if !(case.q.is_empty() && case.v.is_empty() && case.p.is_empty()) {
            let form = changed(&state, model, case, initial.project).context("plant.initial")?;
            let initial = Some(v1::InitialState { form: Some(form) });
            let request = v1::ResetRequest { id: id.to_owned(), initial };
            state = client.reset_to(request).await.context("plant.initial")?;
        }
        if let Some(channels) = &self.prepared.channels {
            let seed = if channels.seed == 0 { case.seed } else { channels.seed };
            let channels = v1::Channels { seed, ..channels.clone() };
            self.y = client.set_channels(id, channels).await.context("channels")?.y;
        }
        for (i, faults) in self.prepared.faults.iter().enumerate() {
            for fault in faults {
                let injected = client.inject_fault(id, fault.clone()).await;
                injected.with_context(|| format!("events[{i}]"))?;
            }
        }
        Ok(state)
    }

    async fn change(&self, id: &str, parameters: &BTreeMap<String, f64>) -> Result<()> {
        if parameters.is_empty() {
            return Ok(());
        }
        let parameter =
            |(path, value): (&String, &f64)| v1::Parameter { path: path.clone(), value: *value };
        let request = v1::SetParametersRequest {
            id: id.to_owned(),
            parameters: parameters.iter().map(parameter).collect(),
            ..Default::default()
        };
        self.place.client.set_parameters(request).await?;
        Ok(())
    }

    /// Drives the plant with the built-in controller.
    async fn step(&mut self, id: &str, initial: v1::State) -> Result<()> {
        let Prepared { scenario, model, inputs, uses_energy, steps, .. } = self.prepared;
        let client = &self.place.client;
        // Without other inputs: no forces, and prescribed coordinates stay.
        let dynamic = initial.p.len();
        let mut rest = vec![0.0; model.inputs.len()];
        rest.extend_from_slice(&initial.q[dynamic..]);
        let mut driver = client.drive(id).await?;
        let mut energy = self.energy(id).await?;
        let y = std::mem::take(&mut self.y);
        self.push(&initial, &rest, &y, energy.as_ref());
        let start = Instant::now();
        for k in 0..*steps {
            if let Some(speed) = scenario.speed {
                let elapsed = Duration::from_secs_f64(k as f64 * self.time_step_s / speed);
                sleep_until(self.deadline.min(start + elapsed)).await;
            }
            for event in &scenario.events {
                if begins(event, self.time_step_s) == k {
                    self.change(id, &event.parameters).await.context("events")?;
                }
            }
            let row = usize::try_from(k).unwrap_or(usize::MAX);
            let mut u = rest.clone();
            for (u, given) in
                u.iter_mut().zip(inputs.get(row).or(inputs.last()).into_iter().flatten())
            {
                *u = given.unwrap_or(*u);
            }
            let step = match timeout_at(self.deadline, driver.step(&u)).await {
                Err(_) => return self.time_out(),
                Ok(Ok(step)) => step,
                Ok(Err(Error::Step(refusal))) => {
                    let time_s = k as f64 * self.time_step_s;
                    self.facts.failures.push((time_s, refusal.to_string()));
                    self.ended = Some(format!("step {} was not taken: {refusal}", k + 1));
                    return Ok(());
                }
                Ok(Err(error)) => return Err(error.into()),
            };
            let state = step.state.context("a step without a state")?;
            if *uses_energy {
                energy = self.energy(id).await?;
            }
            let u = if step.u.is_empty() { &u } else { &step.u };
            let y = step.outputs.as_ref().map_or(&[][..], |outputs| &outputs.y);
            self.push(&state, u, y, energy.as_ref());
        }
        driver.close().await?;
        Ok(())
    }

    async fn energy(&self, id: &str) -> Result<Option<v1::Energy>> {
        match self.prepared.uses_energy {
            true => Ok(self.place.client.get_plant(id).await?.energy),
            false => Ok(None),
        }
    }

    async fn watch(&self, id: &str) -> Result<Answers<v1::WatchResponse>> {
        let mut fields = vec![v1::WatchField::State.into(), v1::WatchField::Input.into()];
        if self.prepared.channels.is_some() {
            fields.push(v1::WatchField::Outputs.into());
        }
        if self.prepared.uses_energy {
            fields.push(v1::WatchField::Energy.into());
        }
        let queue = WATCH_QUEUE;
        let request = v1::WatchRequest { id: id.to_owned(), fields, queue, ..Default::default() };
        Ok(self.place.client.watch(request).await?)
    }

    /// Lets the plant go on from `step`: to the next change of parameters or to the end, and in lockstep
    /// no further than what can wait to be seen.
    async fn let_run(&mut self, id: &str, step: u64) -> Result<()> {
        let Prepared { scenario, policy, steps, .. } = self.prepared;
        let mut until = *steps;
        for event in scenario.events.iter().filter(|event| !event.parameters.is_empty()) {
            match begins(event, self.time_step_s) {
                begin if begin == step => {
                    self.change(id, &event.parameters).await.context("events")?
                }
                begin if begin > step => until = until.min(begin),
                _ => {}
            }
        }
        let pace = match scenario.pace {
            Pace::Lockstep => v1::Pace::Lockstep,
            Pace::Paced => v1::Pace::Paced,
        };
        if scenario.pace == Pace::Lockstep {
            until = until.min(step + STEPS_AHEAD);
        }
        let settings = v1::RunSettings {
            pace: pace.into(),
            speed: scenario.speed.unwrap_or(0.0),
            input: policy.clone(),
        };
        let steps = until - step;
        let request = v1::RunRequest { id: id.to_owned(), settings: Some(settings), steps };
        self.place.client.run(request).await?;
        self.until = until;
        Ok(())
    }

    /// Watches a plant that is driven by somebody else, or runs by itself, until it has taken all its
    /// steps.
    async fn follow(
        &mut self,
        id: &str,
        mut messages: Answers<v1::WatchResponse>,
        mut events: Option<&mut Answers<v1::WatchEventsResponse>>,
        mut process: Option<&mut Process>,
    ) -> Result<()> {
        let Prepared { scenario, steps, .. } = self.prepared;
        let has_driver =
            matches!(scenario.controller, Controller::Command(_) | Controller::External(_));
        let is_paced = scenario.pace == Pace::Paced;
        let mut is_begun = !is_paced;
        let mut goal = *steps;
        let mut stopped = None;
        let mut look = tokio::time::interval(LOOK_PERIOD);
        if is_paced && !has_driver {
            self.let_run(id, 0).await?;
            is_begun = true;
        } else if is_paced {
            look = tokio::time::interval(DRIVER_PERIOD);
        }
        loop {
            let ends = async {
                match process.as_mut() {
                    Some(process) if stopped.is_none() => process.wait().await,
                    _ => std::future::pending().await,
                }
            };
            let event = async {
                match events.as_mut() {
                    Some(events) => events.next().await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                message = messages.next() => {
                    let message = message?.context("the server closed the stream of states")?;
                    self.see(&message)?;
                }
                event = event => {
                    self.hear(event?)?;
                }
                status = ends => {
                    goal = goal.min(self.plant_step(id).await?.1);
                    stopped = Some(format!("the controller ended: {}", status?));
                }
                _ = look.tick(), if is_paced && stopped.is_none() => {
                    let (plant, step) = self.plant_step(id).await?;
                    if !is_begun && !plant.driver.is_empty() {
                        // The plant runs from here, with its driver.
                        self.let_run(id, 0).await?;
                        is_begun = true;
                        look = tokio::time::interval(LOOK_PERIOD);
                    }
                    if let Some(failure) = plant.run.and_then(|run| run.stopped_by) {
                        let time_s = step as f64 * self.time_step_s;
                        self.facts.failures.push((time_s, failure.message.clone()));
                        goal = goal.min(step);
                        stopped = Some(failure.message);
                    }
                }
                () = sleep_until(self.deadline) => return self.time_out(),
            }
            if self.ended.is_some() {
                return Ok(());
            }
            if self.samples.len() > 0 && self.last_step >= goal {
                break;
            }
            if is_begun && stopped.is_none() && self.last_step >= self.until {
                ensure!(
                    self.last_step == self.until || !self.changes_at(self.until),
                    "the controller does not wait for changes of parameters: it calls Step"
                );
                self.let_run(id, self.last_step).await?;
            }
        }
        if let Some(reason) = stopped.filter(|_| self.last_step < *steps) {
            self.ended = Some(format!("step {} of {steps}: {reason}", self.last_step));
        }
        Ok(())
    }

    /// Takes an event of a plant in lockstep; true when it was paused.
    fn hear(&mut self, message: Option<v1::WatchEventsResponse>) -> Result<bool> {
        let event = message.and_then(|message| message.event);
        let event = event.context("the server closed the stream of events")?;
        if event.kind() == v1::EventKind::StepFailed && self.facts.failures.len() < FAILURES_MAX {
            let time_s = event.step as f64 * self.time_step_s;
            let what = format!("the driver's input for step {} was refused", event.step + 1);
            self.facts.failures.push((time_s, what));
        }
        Ok(event.kind() == v1::EventKind::Paused)
    }

    /// Takes the events that are still on their way.
    async fn hear_out(
        &mut self,
        id: &str,
        mut events: Answers<v1::WatchEventsResponse>,
    ) -> Result<()> {
        // The last one.
        self.place.client.pause(id).await?;
        while !self.hear(events.next().await?)? {}
        Ok(())
    }

    /// Whether parameters change at a step.
    fn changes_at(&self, step: u64) -> bool {
        let is_it =
            |event: &Event| !event.parameters.is_empty() && begins(event, self.time_step_s) == step;
        self.prepared.scenario.events.iter().any(is_it)
    }

    /// The plant and its step.
    async fn plant_step(&self, id: &str) -> Result<(v1::PlantInfo, u64)> {
        let plant = self.place.client.get_plant(id).await?.plant.context("no plant")?;
        let step = plant.state.as_ref().map_or(0, |state| state.step);
        Ok((plant, step))
    }

    /// Takes a message of the watch.
    fn see(&mut self, message: &v1::WatchResponse) -> Result<()> {
        let state = message.state.as_ref().context("a message without a state")?;
        let is_first = self.samples.len() == 0;
        if !is_first && state.step < self.last_step {
            self.ended = Some(format!("somebody put the plant back after step {}", self.last_step));
            return Ok(());
        }
        if !is_first && state.step == self.last_step {
            return Ok(());
        }
        let expected = if is_first { 0 } else { self.last_step + 1 };
        self.lost +=
            state.step.min(self.prepared.steps + 1) - expected.min(self.prepared.steps + 1);
        if state.step > self.prepared.steps {
            self.last_step = self.prepared.steps;
            return Ok(());
        }
        let mut u = message.u.clone();
        if is_first && u.is_empty() {
            u = vec![0.0; self.prepared.model.inputs.len()];
            u.extend_from_slice(&state.q[state.p.len()..]);
        }
        let y = message.outputs.as_ref().map_or(&[][..], |outputs| &outputs.y);
        self.push(state, &u, y, message.energy.as_ref());
        Ok(())
    }

    fn push(&mut self, state: &v1::State, u: &[f64], y: &[f64], energy: Option<&v1::Energy>) {
        let reference = self.prepared.reference.as_ref().map(|motion| motion.at(state.step));
        let sample = Sample { state, time_step_s: self.time_step_s, u, y, energy, reference };
        self.prepared.columns.push(&mut self.samples, sample);
        self.last_step = state.step;
    }

    fn time_out(&mut self) -> Result<()> {
        let (step, of) = (self.last_step, self.prepared.steps);
        let limit = self.prepared.scenario.timeout_s;
        self.ended = Some(match step {
            0 => format!("no step was taken in {limit} s"),
            _ => format!("step {step} of {of} when {limit} s were over"),
        });
        Ok(())
    }

    fn check_lost(&self, may_lose: bool) -> Result<()> {
        ensure!(
            may_lose || self.lost == 0,
            "{} of {} samples were lost; `may_lose_samples` judges those that were seen",
            self.lost,
            self.prepared.steps + 1
        );
        Ok(())
    }
}

/// The model: one of the server's, or made from the scene.
async fn model(client: &Client, plant: &Plant, folder: &Path) -> Result<v1::Model> {
    let Some(scene) = &plant.scene else {
        let name = plant.model.clone().unwrap_or_default();
        return client.get_model(name).await.context("plant.model");
    };
    let path = folder.join(scene);
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("plant.scene: cannot read {}", path.display()))?;
    // The same scene has the same name, whoever uploads it and how often.
    let digest = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    let name = format!("test-{digest:016x}");
    let request = v1::CreateModelRequest { name: name.clone(), scene: text, ..Default::default() };
    match client.create_model_as(request).await {
        Err(error) if error.code() == Some(plantd_client::Code::AlreadyExists) => {
            client.get_model(name).await.context("plant.scene")
        }
        answer => answer.with_context(|| format!("plant.scene: {}", path.display())),
    }
}

fn settings(plant: &Plant) -> v1::PlantSettings {
    let split = if plant.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
    let precision = if plant.fast { v1::Precision::Fast } else { v1::Precision::Unspecified };
    v1::PlantSettings {
        time_step_s: plant.time_step_s.unwrap_or(0.0),
        force_split: split.into(),
        order: plant.order.unwrap_or(0),
        substeps: plant.substeps.unwrap_or(0),
        halvings: plant.halvings,
        precision: precision.into(),
        ..Default::default()
    }
}

/// Step with which an event begins.
fn begins(event: &Event, time_step_s: f64) -> u64 {
    (event.at_s / time_step_s - STEP_ROUNDING).ceil().max(0.0) as u64
}

/// A message of the contract from its fields as the file has them.
fn message<M: prost::Message + Default>(name: &str, fields: &toml::Table) -> Result<M> {
    json::read(name, &serde_json::to_string(fields)?)
}

/// Names of the numbers that output channels deliver.
fn outputs(channels: &v1::Channels) -> Vec<String> {
    use v1::output_channel::Source;
    let names = |output: &v1::OutputChannel| {
        let suffixes: &[&str] = match output.source {
            Some(Source::Position(_)) => &[".x", ".y", ".z"],
            Some(Source::Orientation(_)) => &[".rx", ".ry", ".rz"],
            _ => &[""],
        };
        suffixes.iter().map(|suffix| format!("{}{suffix}", output.name)).collect::<Vec<_>>()
    };
    channels.outputs.iter().flat_map(names).collect()
}

/// What an event lets go wrong.
fn faults(event: &Event, model: &v1::Model, time_step_s: f64) -> Result<Vec<v1::FaultSpec>> {
    use v1::fault_spec::{Kind, Start, Target};
    let mut faults = Vec::new();
    for (name, value) in &event.inputs {
        ensure!(model.inputs.contains(name), "inputs: {}", no_input(name, model));
        faults.push(v1::FaultSpec {
            target: Some(Target::Input(name.clone())),
            kind: Some(Kind::Offset(v1::Offset { value: *value })),
            ..Default::default()
        });
    }
    if !event.fault.is_empty() {
        faults.push(message("FaultSpec", &event.fault).context("fault")?);
    }
    for fault in &mut faults {
        fault.start = Some(Start::StartStep(begins(event, time_step_s)));
        fault.duration_s = event.for_s.unwrap_or(0.0);
    }
    Ok(faults)
}

/// The reference, state by state.
async fn motion(
    place: &Place,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &Reference,
    folder: &Path,
) -> Result<Motion> {
    match reference {
        Reference::At(point) => {
            let request = v1::LinearizeRequest {
                model: model.name.clone(),
                settings: Some(settings(&scenario.plant)),
                point: Some(operating_point(point)),
            };
            let answer = place.client.linearize(request).await.context("reference.at")?;
            let x = answer.state.context("a linearization without a state")?.x();
            Ok(Motion { x: vec![x], u: vec![answer.u], trajectory: None })
        }
        Reference::Trajectory(file) => {
            let result =
                optimize::read_result(&folder.join(file)).context("reference.trajectory")?;
            let trajectory = result.checkpoint.and_then(|checkpoint| checkpoint.trajectory);
            let trajectory =
                trajectory.context("reference.trajectory: no trajectory in the file")?;
            let x = result.x.context("reference.trajectory: no states in the file")?;
            let rows =
                |matrix: &v1::Matrix| matrix.rows_iter().map(<[f64]>::to_vec).collect::<Vec<_>>();
            let u = trajectory.u.as_ref().map(rows).unwrap_or_default();
            let entries = 2 * model.coordinates.len();
            ensure!(
                x.cols as usize == entries,
                "reference.trajectory: states of {} entries; the model has {entries}",
                x.cols
            );
            Ok(Motion { x: rows(&x), u, trajectory: Some(trajectory) })
        }
    }
}

/// The regulator about the reference.
async fn feedback(
    client: &Client,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &Motion,
    lqr: &Lqr,
    id: &str,
) -> Result<v1::SetFeedbackRequest> {
    use v1::set_feedback_request::Reference as Form;
    let states = 2 * model.coordinates.len();
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed).count();
    let weight = |values: &[f64], count: usize| match values {
        [value] => diagonal(vec![*value; count]),
        values => diagonal(values),
    };
    let weights = plantd_client::weights(
        weight(&lqr.q, states),
        weight(&lqr.r, model.inputs.len() + prescribed),
    );
    let form = match (&reference.trajectory, &scenario.reference) {
        (Some(trajectory), _) => Form::Trajectory(trajectory.clone()),
        (None, Some(Reference::At(point))) if lqr.adapts => Form::Point(operating_point(point)),
        (None, Some(Reference::At(point))) => {
            let request = v1::SolveLqrRequest {
                model: model.name.clone(),
                settings: Some(settings(&scenario.plant)),
                point: Some(operating_point(point)),
                weights: Some(weights.clone()),
                ..Default::default()
            };
            let gain = client.solve_lqr(request).await?.gain;
            Form::Gain(gain.context("an LQR without a gain")?)
        }
        _ => bail!("there is no reference"),
    };
    Ok(v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(form),
        weights: Some(weights),
        mode: v1::FeedbackMode::Replace.into(),
        ..Default::default()
    })
}

/// The initial state with the case's entries.
fn changed(
    state: &v1::State,
    model: &v1::Model,
    case: &Case,
    project: bool,
) -> Result<v1::initial_state::Form> {
    use v1::initial_state::{Form, Momentum, Projection, Velocity};
    let all: Vec<_> = model.coordinates.iter().map(|c| c.name.as_str()).collect();
    let dynamic = &all[..state.p.len()];
    let set = |key: &str, values: &mut [f64], names: &[&str], given: &BTreeMap<String, f64>| {
        for (name, value) in given {
            let Some(i) = names.iter().position(|n| n == name) else {
                bail!("{key}: there is no coordinate `{name}`; there are {}", names.join(", "));
            };
            values[i] = *value;
        }
        Ok(())
    };
    let mut q = state.q.clone();
    set("q", &mut q, &all, &case.q)?;
    if project {
        return Ok(Form::Projection(Projection { q, hold: case.q.keys().cloned().collect() }));
    }
    if !case.p.is_empty() {
        let mut p = state.p.clone();
        set("p", &mut p, dynamic, &case.p)?;
        return Ok(Form::Momentum(Momentum { q, p, v: state.v.clone() }));
    }
    let mut v = vec![0.0; all.len()];
    set("v", &mut v, &all, &case.v)?;
    Ok(Form::Velocity(Velocity { q, v }))
}

/// Inputs step by step, as far as they are given.
fn rows(inputs: &Inputs, model: &v1::Model, folder: &Path) -> Result<Vec<Vec<Option<f64>>>> {
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed).map(|c| &c.name);
    let names: Vec<_> = model.inputs.iter().chain(prescribed).collect();
    let index = |key: &str, name: &str| {
        let index = names.iter().position(|n| *n == name);
        index.with_context(|| format!("controller.inputs.{key}: {}", no_input(name, model)))
    };
    let mut constant = vec![None; names.len()];
    for (name, value) in &inputs.constant {
        constant[index("constant", name)?] = Some(*value);
    }
    let Some(table) = &inputs.table else { return Ok(vec![constant]) };
    let path = folder.join(table);
    let key = || format!("controller.inputs.table: {}", path.display());
    let text = std::fs::read_to_string(&path).with_context(key)?;
    let head = text.lines().next().unwrap_or_default();
    let columns: Vec<_> =
        head.split(',').map(|name| index("table", name.trim())).collect::<Result<_>>()?;
    let matrix = optimize::table(&text).with_context(key)?;
    ensure!(matrix.rows > 0, "{}: a row is needed", key());
    ensure!(matrix.cols as usize == columns.len(), "{}: the head has other columns", key());
    let row = |values: &[f64]| {
        let mut u = constant.clone();
        columns.iter().zip(values).for_each(|(&i, value)| u[i] = Some(*value));
        u
    };
    Ok(matrix.rows_iter().map(row).collect())
}

fn no_input(name: &str, model: &v1::Model) -> String {
    format!("there is no input `{name}`; there are {}", model.inputs.join(", "))
}

/// The outcome of a case as JSON.
pub(crate) fn summary(prepared: &Prepared, outcome: &Outcome, replay: &str) -> serde_json::Value {
    let verdict = |verdict: &Verdict| {
        serde_json::json!({
            "expectation": verdict.expectation,
            "passed": verdict.broken.is_none(),
            "message": verdict.message,
            "time_s": verdict.broken.and_then(|broken| broken.time_s),
            "value": verdict.broken.and_then(|broken| broken.value),
        })
    };
    serde_json::json!({
        "scenario": prepared.name,
        "file": prepared.file,
        "case": outcome.case,
        "status": format!("{:?}", outcome.status()).to_lowercase(),
        "expectations": outcome.verdicts.iter().map(verdict).collect::<Vec<_>>(),
        "ended": outcome.ended,
        "error": outcome.error,
        "steps": outcome.steps,
        "elapsed_s": outcome.elapsed.as_secs_f64(),
        "seed": outcome.seed,
        "replay": replay,
        "output": outcome.output,
    })
}

pub(crate) fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
