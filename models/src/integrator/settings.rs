//! How a plant is stepped: what its maker chooses.

use crate::model::mechanism::Model;

/// Most substeps in a control period.
pub const SUBSTEPS_MAX: u32 = 256;
/// Most often that a period is halved.
pub const HALVINGS_MAX: u32 = 8;
/// Most steps in a period; it is not halved beyond that.
pub(crate) const STEPS_MAX: usize = 8192;

/// How a plant is stepped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Control period `h`, s: what a controller sees as one step; finite and greater than zero.
    pub time_step_s: f64,
    /// Order of accuracy in `h`: 2 is the midpoint rule; 4, 6, 8, 12 and 16 are Gauss collocation.
    pub order: u32,
    /// Steps of the method in a control period, 1 to [`SUBSTEPS_MAX`]. The input is held; prescribed
    /// coordinates move at a constant rate.
    pub substeps: u32,
    /// How often a period that cannot be solved is halved, up to [`HALVINGS_MAX`].
    pub halvings: u32,
    /// Where the solver stops.
    pub precision: Precision,
    /// How forces are split between the ends of a step.
    pub force_split: ForceSplit,
    /// Corrections before a step is given up.
    pub max_iterations: u32,
    /// A reciprocal condition estimate below this is an error; greater than zero.
    pub singular_below: f64,
}

impl Settings {
    /// The model's time step, order 2 in one step that may be halved 8 times, exact, symmetric split, 40
    /// iterations, singular below 1e-14.
    pub fn new(model: &Model) -> Self {
        Self {
            time_step_s: model.scene().time_step_s,
            order: 2,
            substeps: 1,
            halvings: HALVINGS_MAX,
            precision: Precision::default(),
            force_split: ForceSplit::default(),
            max_iterations: 40,
            singular_below: 1e-14,
        }
    }
}

/// Where the solver of a step stops.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// At round-off: energy and momenta do not drift.
    #[default]
    Exact,
    /// At about eleven digits of the increment, which saves an evaluation or so; what conservation laws
    /// hold then drifts with time.
    Fast,
    /// At about seven digits: for errors of 1e-6 and more, by long steps of high order.
    Coarse,
}

/// How the force impulse of a step is split into `F⁻` and `F⁺`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ForceSplit {
    /// `F⁻ = F⁺ = ½ h f`: second order.
    #[default]
    Symmetric,
    /// `F⁻ = h f`, `F⁺ = 0`, as in the paper: first order with forcing.
    Paper,
}

impl ForceSplit {
    /// Weight `a` of `F⁻`: `F⁻ = a h f`, `F⁺ = (1 − a) h f`.
    pub(crate) fn at_start(self) -> f64 {
        match self {
            Self::Symmetric => 0.5,
            Self::Paper => 1.0,
        }
    }
}
