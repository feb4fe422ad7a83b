//! The core of a session: the plant and all that has a say in its steps.

use std::sync::Arc;

use plantd_models::{
    Initial, InitialError, Linearization, Model, Plant, Settings, State, StepError, StepReport,
};
use plantd_proto::v1;

use super::tap::Tap;
use crate::channels::Channels;
use crate::convert;
use crate::feedback::Feedback;
use crate::frame::{Published, Timing};
use crate::parameters::Parameters;
use crate::ring::Ring;

/// A plant with what its steps need. One owner at a time: whoever holds the session's lock, or the loop
/// that runs the plant.
pub struct Core {
    pub(crate) plant: Plant,
    /// Input of the last step; before the first one, the input that holds the plant.
    pub(crate) input: Vec<f64>,
    /// Report of the last step.
    pub(crate) report: StepReport,
    pub(crate) feedback: Option<Box<Feedback>>,
    pub(crate) channels: Option<Box<Channels>>,
    /// Faults injected so far.
    pub(crate) faults: u64,
    /// What the driver asked for in the last step; empty when it sent nothing.
    driver_input: Vec<f64>,
    /// Room for an input that is not the driver's alone.
    applied: Vec<f64>,
    /// It was in force in the last step.
    has_applied: bool,
    /// When the last step was taken.
    pub(crate) timing: Timing,
    /// Where each step is written, as long as somebody reads it.
    pub(crate) ring: Option<Arc<Ring>>,
    /// Where the recorder learns what happens between steps.
    pub(super) tap: Option<Arc<Tap>>,
    /// Numbers of the scene that were changed.
    pub(crate) parameters: Arc<Parameters>,
    /// Counts the changes of parameters and time step.
    pub(crate) generation: u64,
    /// Counts the computations of laws.
    pub(crate) revision: u64,
}

/// A model with settings, and which of a plant's it is: the number goes up with each change.
#[derive(Clone)]
pub struct Mechanics {
    /// The model.
    pub model: Arc<Model>,
    /// The settings.
    pub settings: Settings,
    /// Number of changes that led to them.
    pub generation: u64,
}

impl Core {
    pub(crate) fn new(plant: Plant) -> Self {
        let mut input = vec![0.0; plant.model().dimensions().input()];
        plant.hold_input(&mut input);
        Self {
            plant,
            driver_input: input.clone(),
            applied: input.clone(),
            input,
            timing: Timing::default(),
            ring: None,
            tap: None,
            has_applied: false,
            report: StepReport::default(),
            feedback: None,
            channels: None,
            faults: 0,
            parameters: Arc::default(),
            generation: 0,
            revision: 0,
        }
    }

    /// Takes one step, and linearizes it when asked to: the only place where a plant moves, whoever
    /// drives it. A failed step changes nothing. Allocates nothing, takes no lock.
    pub(crate) fn step(
        &mut self,
        driver: &[f64],
        linearization: Option<&mut Linearization>,
    ) -> Result<StepReport, StepError> {
        let has_say = match &mut self.feedback {
            None => false,
            Some(feedback) => feedback.input(&self.plant, driver, &mut self.applied)?,
        };
        let has_say = match &mut self.channels {
            None => has_say,
            Some(channels) => {
                let (expected, actual) = (self.applied.len(), driver.len());
                if !has_say {
                    if actual != expected {
                        return Err(StepError::Dimension { expected, actual });
                    }
                    self.applied.copy_from_slice(driver);
                }
                channels.actuate(&self.plant, &mut self.applied) || has_say
            }
        };
        let u = if has_say { &self.applied[..] } else { driver };
        let advance = |plant: &mut Plant| match linearization {
            None => plant.step(u),
            Some(out) => plant.step_and_linearize(u, out),
        };
        let report = match &self.channels {
            None => advance(&mut self.plant)?,
            Some(channels) => channels.advance(&mut self.plant, advance)?,
        };
        self.has_applied = has_say;
        self.input.copy_from_slice(u);
        // The law of a feedback does without a driver's input: then there is none.
        self.driver_input.clear();
        self.driver_input.extend_from_slice(driver);
        self.report = report;
        if let Some(channels) = &mut self.channels {
            channels.measure(&mut self.plant, &self.input);
        }
        Ok(report)
    }

    /// Writes the last step into the ring, if somebody reads it.
    pub(crate) fn write_ring(&self) {
        if let Some(ring) = &self.ring {
            ring.write(self.published().record());
        }
    }

    /// The plant.
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// What the output channels deliver, if there are any.
    pub fn outputs(&self) -> Option<v1::Outputs> {
        let published = self.published();
        convert::outputs(published.outputs, published.lost)
    }

    /// Report of the last step.
    pub fn report(&self) -> &StepReport {
        &self.report
    }

    /// Input of the last step, when somebody besides the driver had a say in it.
    pub fn applied_input(&self) -> Option<&[f64]> {
        self.has_applied.then_some(&self.input)
    }

    pub(crate) fn state(&self) -> (State, f64) {
        (self.plant.state(), self.plant.time_s())
    }

    pub(crate) fn mechanics(&self) -> Mechanics {
        let (model, settings) = (Arc::clone(self.plant.model()), *self.plant.settings());
        Mechanics { model, settings, generation: self.generation }
    }

    pub(crate) fn published(&self) -> Published<'_> {
        Published {
            step: self.plant.step_index(),
            time_s: self.plant.time_s(),
            q: self.plant.q(),
            p: self.plant.p(),
            v: self.plant.v(),
            multipliers: self.plant.multipliers(),
            input: &self.input,
            driver_input: &self.driver_input,
            outputs: self.channels.as_ref().map_or(&[], |channels| channels.output()),
            lost: self.channels.as_ref().map_or(&[], |channels| channels.lost()),
            report: self.report,
            generation: self.generation,
            time_step_s: self.plant.settings().time_step_s,
            model_digest: self.plant.model().digest(),
            timing: Timing { flags: self.timing.flags | self.pushed(), ..self.timing },
        }
    }

    /// The flag of a last step that was pushed.
    fn pushed(&self) -> u64 {
        let is_pushed = self.channels.as_ref().is_some_and(|channels| channels.pushes());
        if is_pushed { Timing::PUSHED } else { 0 }
    }

    /// Puts a copy of the plant in its place that is in another state.
    pub(crate) fn replace_plant(&mut self, plant: Plant) -> Plant {
        plant.hold_input(&mut self.input);
        self.has_applied = false;
        self.report = StepReport::default();
        let former = std::mem::replace(&mut self.plant, plant);
        if let Some(channels) = &mut self.channels {
            channels.begin(&mut self.plant, &self.input);
        }
        former
    }

    /// Puts a plant of changed parameters or another time step in its place: state and count of steps
    /// stay, time goes on. The plant that was there comes back.
    pub(crate) fn change_plant(
        &mut self,
        mut plant: Plant,
        parameters: Arc<Parameters>,
    ) -> Result<Plant, InitialError> {
        let (State { step, q, p, v, .. }, time_s) = self.state();
        plant.initialize(&Initial::Momentum { q, p, v })?;
        plant.set_step_index(step);
        plant.set_time_s(time_s);
        self.parameters = parameters;
        self.generation += 1;
        Ok(std::mem::replace(&mut self.plant, plant))
    }
}
