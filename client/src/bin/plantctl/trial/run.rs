//! Runs one case: makes the plant, lets it be driven, and collects what is seen of it.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use plantd_client::{Answers, Error, v1};
use tokio::time::{Instant, sleep_until, timeout_at};

use crate::scenario::columns::Sample;
use crate::scenario::file::{Case, Controller, Event, Pace};
use crate::trial::outcome::Outcome;
use crate::trial::prepared::{PreparedScenario, feedback, first_step, initial_state, settings};
use crate::trial::process::{Assignment, Process};
use crate::trial::server::TestServer;
use plantd_expect::Samples;
use plantd_expect::{Curve, Facts, judge};

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

/// A run as it goes on.
struct Run<'a> {
    server: &'a TestServer,
    prepared: &'a PreparedScenario,
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

/// Runs a case and judges it.
pub(crate) async fn run_case(
    server: &TestServer,
    prepared: &PreparedScenario,
    case: &Case,
    plant: &str,
) -> Outcome {
    let start = Instant::now();
    let deadline = start + Duration::from_secs_f64(prepared.scenario.timeout_s);
    let mut run = Run {
        server,
        prepared,
        deadline,
        time_step_s: 0.0,
        samples: prepared.columns.empty(),
        facts: Facts::default(),
        y: Vec::new(),
        last_step: 0,
        until: 0,
        lost: 0,
        ended: None,
        output: String::new(),
    };
    server.plants().insert(plant.to_owned());
    let done = run.drive(case, plant).await;
    // It may never have been made, or be gone.
    let _ = server.client.delete_plant(plant).await;
    server.plants().remove(plant);
    let Run { samples, facts, ended, output, last_step, .. } = run;
    let mut outcome = Outcome {
        case: case.name.clone(),
        seed: prepared.scenario.seed,
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
    let is_unseen = outcome.error.is_some() && samples.count() == 0;
    for expectation in prepared.scenario.expect.iter().filter(|_| !is_unseen) {
        match judge(expectation, &samples, &facts) {
            Ok(verdict) => outcome.verdicts.push(verdict),
            Err(error) => outcome.error = outcome.error.or(Some(error)),
        }
    }
    let curves = prepared.scenario.plot.iter().map(|signal| Curve::unbounded(signal, &samples));
    outcome.plots.extend(curves.flatten());
    outcome
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
            events = Some(self.server.client.watch_events(plant, None).await?);
            self.let_run(plant, 0).await?;
        }
        let mut process = match &scenario.controller {
            Controller::Command(command) => {
                let told = Assignment {
                    address: &self.server.address,
                    plant,
                    link_root: self.server.link_root.as_deref(),
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
            let timing = self.server.client.timing(plant, false).await?;
            self.facts.deadline_misses = Some(timing.overruns);
        }
        self.check_lost(scenario.may_lose_samples)
    }

    /// Makes the plant as the case wants it, and returns its state.
    async fn create(&mut self, case: &Case, id: &str) -> Result<v1::State> {
        let client = &self.server.client;
        let PreparedScenario { scenario, model, reference, .. } = self.prepared;
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
            ..Default::default()
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
            let form =
                initial_state(&state, model, case, initial.project).context("plant.initial")?;
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
        self.server.client.set_parameters(request).await?;
        Ok(())
    }

    /// Drives the plant with the built-in controller.
    async fn step(&mut self, id: &str, initial: v1::State) -> Result<()> {
        let PreparedScenario { scenario, model, inputs, uses_energy, steps, .. } = self.prepared;
        let client = &self.server.client;
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
                if first_step(event, self.time_step_s) == k {
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
            true => Ok(self.server.client.get_plant(id).await?.energy),
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
        Ok(self.server.client.watch(request).await?)
    }

    /// Lets the plant go on from `step`: to the next change of parameters or to the end, and in lockstep
    /// no further than what can wait to be seen.
    async fn let_run(&mut self, id: &str, step: u64) -> Result<()> {
        let PreparedScenario { scenario, policy, steps, .. } = self.prepared;
        let mut until = *steps;
        for event in scenario.events.iter().filter(|event| !event.parameters.is_empty()) {
            match first_step(event, self.time_step_s) {
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
        let request =
            v1::RunRequest { id: id.to_owned(), settings: Some(settings), steps, wait: false };
        self.server.client.run(request).await?;
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
        let PreparedScenario { scenario, steps, .. } = self.prepared;
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
            if self.samples.count() > 0 && self.last_step >= goal {
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
            let what = format!("step {} was refused or failed", event.step + 1);
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
        self.server.client.pause(id).await?;
        while !self.hear(events.next().await?)? {}
        Ok(())
    }

    /// Whether parameters change at a step.
    fn changes_at(&self, step: u64) -> bool {
        let is_it = |event: &Event| {
            !event.parameters.is_empty() && first_step(event, self.time_step_s) == step
        };
        self.prepared.scenario.events.iter().any(is_it)
    }

    /// The plant and its step.
    async fn plant_step(&self, id: &str) -> Result<(v1::PlantInfo, u64)> {
        let plant = self.server.client.get_plant(id).await?.plant.context("no plant")?;
        let step = plant.state.as_ref().map_or(0, |state| state.step);
        Ok((plant, step))
    }

    /// Takes a message of the watch.
    fn see(&mut self, message: &v1::WatchResponse) -> Result<()> {
        let state = message.state.as_ref().context("a message without a state")?;
        let is_first = self.samples.count() == 0;
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
