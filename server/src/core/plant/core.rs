//! The core of a session: the plant and all that has a say in its steps.

use std::sync::Arc;

use plantd_models::parameters::Parameters;
use plantd_models::{
    Initial, InitialError, Linearization, Plant, Settings, Spare, State, StepError, StepReport,
};

use crate::core::channels::pipeline::{ChannelMemory, Channels};
use crate::core::channels::timeline::{Base, Timeline};
use crate::core::feedback::active::Feedback;
use crate::core::plant::error::DriveError;
use crate::core::plant::event::{EventKind, Events};
use crate::core::plant::last_step::LastStep;
use crate::core::plant::mark::{Mark, MarkReason};
use crate::core::plant::records::Records;
use crate::core::plant::view::{Mechanics, PlantSnapshot, View};
use crate::core::plant::watchdog::{Guard, Protection, Safety, Trip, WatchdogAction};
use crate::core::publish::frame::{Frame, Published, Timing};

/// A plant with what its steps need. One owner at a time: whoever holds the session's lock, or the loop
/// that runs the plant.
pub struct Core {
    pub(crate) plant: Plant,
    pub(crate) last: LastStep,
    /// Room for an input that is not the driver's alone.
    applied: Vec<f64>,
    /// Room for the velocity of a state that is shown.
    velocity: Vec<f64>,
    pub(crate) feedback: Option<Box<Feedback>>,
    /// Counts the computations of laws.
    pub(crate) revision: u64,
    pub(crate) channels: Option<Box<Channels>>,
    /// Faults injected so far.
    pub(crate) faults: u64,
    pub(crate) changed: Changed,
    pub(crate) records: Records,
    /// What happens besides.
    events: Arc<Events>,
    protection: Protection,
    pub(crate) own_loop: OwnLoop,
}

/// The numbers of the scene that were changed.
#[derive(Default)]
pub(crate) struct Changed {
    pub(crate) parameters: Arc<Parameters>,
    /// Counts the changes of parameters and time step.
    pub(crate) generation: u64,
}

/// What a core knows of the plant's own loop.
#[derive(Default)]
pub(crate) struct OwnLoop {
    /// The core is in it.
    pub(crate) has_core: bool,
    /// The last input is one with which it goes on.
    pub(crate) keeps_input: bool,
}

impl Core {
    pub(crate) fn new(plant: Plant, events: Arc<Events>) -> Self {
        let last = LastStep::none(&plant);
        Self {
            velocity: vec![0.0; plant.q().len()],
            plant,
            applied: last.input.clone(),
            last,
            feedback: None,
            revision: 0,
            channels: None,
            faults: 0,
            changed: Changed::default(),
            records: Records::default(),
            events,
            protection: Protection::default(),
            own_loop: OwnLoop::default(),
        }
    }

    /// Takes one step, and linearizes it when asked to: the only place where a plant moves, whoever
    /// drives it. A failed step changes nothing. Allocates nothing, takes no lock.
    pub(crate) fn step(
        &mut self,
        driver: &[f64],
        linearization: Option<&mut Linearization>,
    ) -> Result<StepReport, DriveError> {
        self.step_pushed(driver, &[], linearization)
    }

    /// Takes a step after an impulse, one entry for each of the momentum or none, is added to it.
    pub(crate) fn step_pushed(
        &mut self,
        driver: &[f64],
        impulse: &[f64],
        linearization: Option<&mut Linearization>,
    ) -> Result<StepReport, DriveError> {
        if let Some(trip) = self.protection.frozen {
            return Err(DriveError::Frozen(trip));
        }
        if let Some(channels) = &mut self.channels
            && let Some(parameters) = channels.change_on_schedule(&mut self.plant)
        {
            self.note_changed(parameters);
        }
        if let Some(guard) = &mut self.protection.guard {
            guard.begin(&self.plant);
        }
        let mut has_say = match &mut self.feedback {
            None => false,
            Some(feedback) => feedback.input(&self.plant, driver, &mut self.applied)?,
        };
        self.last.impulse.clear();
        self.last.impulse.extend_from_slice(impulse);
        if let Some(channels) = &mut self.channels {
            if !has_say {
                let (expected, actual) = (self.applied.len(), driver.len());
                if actual != expected {
                    return Err(StepError::Dimension { expected, actual }.into());
                }
                self.applied.copy_from_slice(driver);
            }
            has_say |= channels.actuate(&self.plant, &mut self.applied, &mut self.last.impulse);
        }
        let u = if has_say { &self.applied[..] } else { driver };
        let advance = |plant: &mut Plant| match linearization {
            None => plant.step(u),
            Some(out) => plant.step_and_linearize(u, out),
        };
        // What is zero does not even touch the sign of a zero.
        if self.last.impulse.iter().all(|impulse| *impulse == 0.0) {
            self.last.impulse.clear();
        }
        let report = match &self.last.impulse[..] {
            [] => advance(&mut self.plant)?,
            impulse => self.plant.with_impulse(impulse, advance)?,
        };
        self.last.has_applied = has_say;
        self.last.input.copy_from_slice(u);
        // The law of a feedback does without a driver's input: then there is none.
        self.last.driver_input.clear();
        self.last.driver_input.extend_from_slice(driver);
        self.last.report = report;
        if let Some(channels) = &mut self.channels {
            channels.measure(&mut self.plant, &self.last.input);
            for (id, step, began) in channels.changes(self.plant.step_index()) {
                let kind = if began { EventKind::FaultBegan } else { EventKind::FaultEnded };
                self.events.note(kind, step, id, 0.0);
            }
        }
        self.last.timing = Timing::default();
        if let Some(guard) = &mut self.protection.guard
            && let Some(trip) = guard.check(&mut self.plant)
        {
            self.act_on(trip);
        }
        Ok(report)
    }

    /// A bound was left: what can be done here is done, the rest is the driver's to find in `trip`.
    fn act_on(&mut self, trip: Trip) {
        self.protection.trip = Some(trip);
        self.note(EventKind::Watchdog, trip.dog.quantity.code(), trip.value);
        match trip.dog.action {
            WatchdogAction::Freeze => self.protection.frozen = Some(trip),
            WatchdogAction::Reset => {
                self.go_home();
            }
            WatchdogAction::Disconnect => {}
        }
    }

    /// Puts the plant into the state that it was created in. False when it cannot: nothing has changed.
    /// Allocates nothing.
    pub(crate) fn go_home(&mut self) -> bool {
        let Some(home) = self.protection.guard.as_ref().and_then(|guard| guard.home.as_deref())
        else {
            return false;
        };
        let is_home = self.plant.go_on_from(home).is_ok();
        if is_home {
            self.plant.hold_input(&mut self.last.input);
            self.last.timing = Timing::default();
            if let Some(channels) = &mut self.channels {
                channels.begin(&mut self.plant, &self.last.input);
            }
            self.mark(MarkReason::Reset);
            self.note(EventKind::StateSet, 0, 0.0);
        }
        is_home
    }

    /// What happens when a step fails in the plant's own loop.
    pub(crate) fn on_step_failure(&self) -> Option<WatchdogAction> {
        self.protection.guard.as_ref().and_then(|guard| guard.safety.on_step_failure)
    }

    /// What protects the plant from now on; `home` is a plant in the state to which a reset returns.
    pub(crate) fn protect(
        &mut self,
        safety: Safety,
        home: Option<Box<Plant>>,
    ) -> Option<Box<Guard>> {
        self.release();
        let is_needed = !safety.watchdogs.is_empty() || safety.on_step_failure.is_some();
        let guard = is_needed.then(|| Box::new(Guard::new(safety, &self.plant, home)));
        std::mem::replace(&mut self.protection.guard, guard)
    }

    /// Lets a plant stand still because of its watchdog of that index, which found a value at a step.
    pub(crate) fn freeze(&mut self, watchdog: usize, value: f64, step: u64) {
        let dogs = self.protection.guard.as_ref().map(|guard| &guard.safety.watchdogs);
        let dog = dogs.and_then(|dogs| dogs.get(watchdog)).copied();
        self.protection.frozen = dog.map(|dog| Trip { watchdog, dog, value, step });
    }

    /// Lets a plant go on that stands still because of a watchdog.
    pub(crate) fn release(&mut self) {
        self.protection.frozen = None;
        self.protection.trip = None;
    }

    /// The bound that was left in the last step.
    pub(crate) fn take_trip(&mut self) -> Option<Trip> {
        self.protection.trip.take()
    }

    /// Notes that something has happened.
    pub(crate) fn note(&self, kind: EventKind, index: u64, value: f64) {
        self.events.note(kind, self.plant.step_index(), index, value);
    }

    /// Notes that a step was refused or has failed.
    pub(crate) fn note_failure(&self, error: &StepError) {
        let residual = match error {
            StepError::NotConverged { residual, .. } => *residual,
            _ => 0.0,
        };
        self.note(EventKind::StepFailed, 0, residual);
    }

    /// The mechanics without what faults change.
    pub(crate) fn base(&self) -> Base {
        let timeline = self.channels.as_ref().and_then(|channels| channels.timeline.as_ref());
        timeline.map(|timeline| timeline.base().clone()).unwrap_or_else(|| Base {
            model: Arc::clone(self.plant.model()),
            parameters: Arc::clone(&self.changed.parameters),
            settings: *self.plant.settings(),
        })
    }

    /// The input with which the plant's own loop begins, and whether it is a driver's.
    pub(crate) fn first_input(&self) -> (Vec<f64>, bool) {
        if self.own_loop.keeps_input && self.last.driver_input.len() == self.last.input.len() {
            return (self.last.driver_input.clone(), true);
        }
        let mut held = self.last.input.clone();
        self.plant.hold_input(&mut held);
        (held, false)
    }

    /// Notes that a fault has changed parameters. The feedback stays as it is.
    fn note_changed(&mut self, parameters: Arc<Parameters>) {
        let former = self.changed.generation;
        self.changed.parameters = parameters;
        self.changed.generation += 1;
        if let Some(feedback) = self.feedback.as_mut().filter(|f| f.generation == former) {
            feedback.generation = self.changed.generation;
        }
    }

    /// Plants that can be in force: the first is the one without changes that faults make.
    pub(crate) fn copy_plants(&self) -> Vec<Spare> {
        let timeline = self.channels.as_ref().and_then(|channels| channels.timeline.as_ref());
        timeline.map_or_else(
            || vec![self.plant.clone().into()],
            |timeline| timeline.copies(&self.plant),
        )
    }

    /// Gives the plants of changed parameters their places: `timeline` knows the changes of the faults that
    /// are there. Without one the changes end at once.
    pub(crate) fn install(&mut self, mut timeline: Option<Box<Timeline>>) -> Option<Box<Timeline>> {
        let channels = self.channels.as_mut()?;
        let mut former = channels.timeline.take();
        let is_none = former.is_none() && timeline.is_none();
        let mut reason = MarkReason::Checkpoint;
        match (&mut timeline, &mut former) {
            (Some(timeline), _) => timeline.adopt(&mut self.plant, channels.sites_mut()),
            (None, Some(former)) => {
                if former.ask(0, &mut self.plant, channels.sites_mut())
                    && let Some(parameters) = former.parameters()
                {
                    self.note_changed(parameters);
                    reason = MarkReason::Parameters;
                }
            }
            (None, None) => {}
        }
        self.channels.as_mut()?.timeline = timeline;
        if !is_none {
            self.mark(reason);
        }
        former
    }

    /// Everything that the plant needs to go on bit for bit.
    pub(crate) fn snapshot(&mut self) -> PlantSnapshot {
        let channels = self.channels.as_mut().map(|channels| channels.memory());
        PlantSnapshot { plant: self.plant.snapshot(), channels }
    }

    /// Writes the last step into the ring, if somebody reads it.
    pub(crate) fn write_ring(&mut self) {
        if let Some(ring) = self.records.ring.clone() {
            ring.write(self.published().record());
        }
    }

    /// The plant.
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// Report of the last step.
    pub fn report(&self) -> &StepReport {
        &self.last.report
    }

    /// Input of the last step, when somebody besides the driver had a say in it.
    pub fn applied_input(&self) -> Option<&[f64]> {
        self.last.has_applied.then_some(&self.last.input)
    }

    /// The watchdog that keeps the plant from moving.
    pub(crate) fn frozen(&self) -> Option<Trip> {
        self.protection.frozen
    }

    /// The plant as it is, to be shown.
    pub(crate) fn view(&mut self) -> View {
        View {
            frame: self.frame(),
            settings: *self.plant.settings(),
            feedback: self.feedback.as_ref().map(|feedback| feedback.info()),
            parameters: Arc::clone(&self.changed.parameters),
            safety: self
                .protection
                .guard
                .as_ref()
                .map(|guard| guard.safety.clone())
                .unwrap_or_default(),
            frozen: self.protection.frozen,
        }
    }

    /// The plant as it is, with its last step.
    pub(crate) fn frame(&mut self) -> Frame {
        let mut frame = Frame::default();
        self.write_frame(&mut frame);
        frame
    }

    /// The same into memory that is allocated at the first call only.
    pub fn write_frame(&mut self, frame: &mut Frame) {
        frame.copy_from(&self.published());
    }

    pub(crate) fn mechanics(&self) -> Mechanics {
        let (model, settings) = (Arc::clone(self.plant.model()), *self.plant.settings());
        Mechanics { model, settings, generation: self.changed.generation }
    }

    /// What the output channels deliver, and for each of them 1 where it stands for a lost number, else 0.
    pub(crate) fn outputs(&self) -> (&[f64], &[f64]) {
        self.channels.as_ref().map_or((&[], &[]), |channels| (channels.output(), channels.lost()))
    }

    /// The plant as it is, with its last step. Finds the velocity, which costs part of a step; allocates
    /// nothing.
    pub(crate) fn published(&mut self) -> Published<'_> {
        self.plant.write_velocity(&mut self.velocity);
        let (outputs, lost) = self.outputs();
        Published {
            step: self.plant.step_index(),
            time_s: self.plant.time_s(),
            q: self.plant.q(),
            p: self.plant.p(),
            v: self.plant.v(),
            multipliers: self.plant.multipliers(),
            velocity: &self.velocity,
            input: &self.last.input,
            driver_input: &self.last.driver_input,
            impulse: &self.last.impulse,
            outputs,
            lost,
            report: self.last.report,
            generation: self.changed.generation,
            time_step_s: self.plant.settings().time_step_s,
            model_digest: self.plant.model().digest(),
            timing: self.last.timing,
        }
    }

    /// Whether channels and faults are those in which this was under way; if not, what is another one.
    pub(crate) fn check(&self, memory: &ChannelMemory) -> Result<(), &'static str> {
        match &self.channels {
            Some(channels) => channels.check(memory),
            None if !memory.faults.is_empty() => Err("set of faults"),
            None if !memory.numbers.is_empty() => Err("set of channels"),
            None => Ok(()),
        }
    }

    /// Puts a copy of the plant in its place that is in another state, and what was under way there in its
    /// channels, as far as it is known.
    pub(crate) fn replace_plant(&mut self, plant: Plant, memory: Option<&ChannelMemory>) -> Spare {
        self.last.forget(&plant);
        self.release();
        let mut former = Spare::from(std::mem::replace(&mut self.plant, plant));
        if let Some(channels) = &mut self.channels
            && let Some(mut timeline) = channels.timeline.take()
        {
            let is_new = timeline.follow(&self.plant, &mut former, channels.sites_mut());
            let parameters = timeline.parameters().filter(|_| is_new);
            channels.timeline = Some(timeline);
            if let Some(parameters) = parameters {
                self.note_changed(parameters);
            }
        }
        if let Some(channels) = &mut self.channels {
            channels.begin(&mut self.plant, &self.last.input);
            if let Some(memory) = memory {
                channels.recall(memory);
            }
        }
        self.note(EventKind::StateSet, 0, 0.0);
        former
    }

    /// Puts a plant of changed parameters or another time step in its place: state and count of steps
    /// stay, time goes on. The plant that was there comes back.
    pub(crate) fn change_plant(
        &mut self,
        spare: Spare,
        settings: Settings,
        parameters: Arc<Parameters>,
    ) -> Result<Plant, InitialError> {
        let plant = if settings == *self.plant.settings() {
            spare.go_on_from(&self.plant)?
        } else {
            let State { step, q, p, v, .. } = self.plant.state();
            let time_s = self.plant.time_s();
            let mut plant = spare.start(&Initial::Momentum { q, p, v })?;
            plant.set_step_index(step);
            plant.set_time_s(time_s);
            plant
        };
        self.changed.parameters = parameters;
        self.changed.generation += 1;
        let former = std::mem::replace(&mut self.plant, plant);
        self.note(EventKind::ParametersSet, 0, self.plant.settings().time_step_s);
        Ok(former)
    }

    /// Tells the recorder, if there is one, what happens between two steps.
    pub(crate) fn mark(&self, reason: MarkReason) {
        if let Some(tap) = &self.records.tap {
            tap.push(self.marked(tap.ring.written(), reason));
        }
    }

    /// The plant as it is, before the ring's record of that number.
    pub(crate) fn marked(&self, at: u64, reason: MarkReason) -> Mark {
        let timeline = self.channels.as_ref().and_then(|channels| channels.timeline.as_ref());
        Mark {
            at,
            reason,
            snapshot: self.plant.snapshot(),
            step: self.plant.step_index(),
            time_s: self.plant.time_s(),
            time_step_s: self.plant.settings().time_step_s,
            model: Arc::clone(self.plant.model()),
            parameters: Arc::clone(&self.changed.parameters),
            announced: timeline.map(|timeline| timeline.announced()).unwrap_or_default(),
        }
    }
}
