//! The last step of a plant.

use plantd_models::{Plant, StepReport};

use crate::core::publish::frame::Timing;

/// What a plant's last step was taken with, and what came of it.
pub(crate) struct LastStep {
    /// Its input; before the first step, the input that holds the plant.
    pub(crate) input: Vec<f64>,
    /// Somebody besides the driver had a say in the input.
    pub(crate) has_applied: bool,
    /// What the driver asked for; empty when it sent nothing.
    pub(crate) driver_input: Vec<f64>,
    /// What was added to the momentum before it; empty for nothing.
    pub(crate) impulse: Vec<f64>,
    pub(crate) report: StepReport,
    /// When it was taken.
    pub(crate) timing: Timing,
}

impl LastStep {
    /// No step was taken yet.
    pub(crate) fn none(plant: &Plant) -> Self {
        let mut input = vec![0.0; plant.model().dimensions().input()];
        plant.hold_input(&mut input);
        Self {
            driver_input: input.clone(),
            input,
            has_applied: false,
            impulse: Vec::with_capacity(plant.p().len()),
            report: StepReport::default(),
            timing: Timing::default(),
        }
    }

    /// The plant was put into another state: there is no step that led to it.
    pub(crate) fn forget(&mut self, plant: &Plant) {
        plant.hold_input(&mut self.input);
        self.has_applied = false;
        self.impulse.clear();
        self.report = StepReport::default();
        self.timing = Timing::default();
    }
}
