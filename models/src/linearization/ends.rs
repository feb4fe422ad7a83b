//! What stands around the derivatives of the increment and of the momentum: how inputs act in a step, and how its
//! ends turn.

use crate::lagrangian::turning::Turning;
use crate::model::mechanism::Model;

/// What a unit input gives to the residual and to `p[k+1]` of a dynamic coordinate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InputImpulse {
    pub(crate) input: usize,
    pub(crate) coordinate: usize,
    pub(crate) residual: f64,
    pub(crate) momentum: f64,
}

/// How inputs act in a step, and how its ends turn.
#[derive(Clone, Debug)]
pub(crate) struct Ends {
    pub(crate) time_step_s: f64,
    /// The weight of `F⁻`.
    pub(crate) at_start: f64,
    /// In the order of [`Model::input_pattern`].
    pub(crate) inputs: Vec<InputImpulse>,
    /// Prescribed coordinates that signals drive, as columns of `B`.
    pub(crate) replaced: Vec<usize>,
    /// How ball joints turn in the step.
    pub(crate) turnings: Vec<Turning>,
}

impl Ends {
    pub(crate) fn new(model: &Model) -> Self {
        let impulse =
            |(coordinate, input)| InputImpulse { input, coordinate, residual: 0.0, momentum: 0.0 };
        Self {
            time_step_s: model.scene().time_step_s,
            at_start: 0.5,
            inputs: model.input_pattern().map(impulse).collect(),
            replaced: model.replaced_inputs().collect(),
            turnings: Vec::with_capacity(model.orientations.len()),
        }
    }
}
