//! Functions of time that drive inputs and prescribed coordinates.

use plantd_math::spline::Knot;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::point::{is_false, is_zero};

/// A function of time `t`, seconds since the plant was initialised.
///
/// On an input it adds to what the driver sends, evaluated at the middle of each step. On a
/// prescribed coordinate it replaces what the driver sends, evaluated at the end of each step, and
/// its value at `t = 0` is the coordinate's initial value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Signal {
    /// `value`.
    Constant {
        /// Input or prescribed coordinate.
        drives: String,
        /// Value.
        value: f64,
    },
    /// `offset + amplitude · sin(2π frequency t + phase)`.
    Sinusoid {
        /// Input or prescribed coordinate.
        drives: String,
        /// Amplitude.
        amplitude: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Phase, rad.
        #[serde(default, skip_serializing_if = "is_zero")]
        phase_rad: f64,
        /// Mean.
        #[serde(default, skip_serializing_if = "is_zero")]
        offset: f64,
    },
    /// `offset + amplitude · sin φ(t)`, whose frequency `dφ/dt / 2π` rises linearly from `start_hz`
    /// to `end_hz` within `duration_s` and stays there.
    Chirp {
        /// Input or prescribed coordinate.
        drives: String,
        /// Amplitude.
        amplitude: f64,
        /// Frequency at `t = 0`, Hz.
        start_hz: f64,
        /// Frequency from `duration_s` on, Hz.
        end_hz: f64,
        /// Duration of the sweep, s.
        duration_s: f64,
        /// Mean.
        #[serde(default, skip_serializing_if = "is_zero")]
        offset: f64,
    },
    /// A smooth curve through knots; before the first and after the last knot the signal stays.
    Spline {
        /// Input or prescribed coordinate.
        drives: String,
        /// Values over time, s.
        knots: Vec<Knot>,
    },
    /// Values at given times; before the first and after the last time the signal stays.
    Table {
        /// Input or prescribed coordinate.
        drives: String,
        /// Times, s, strictly increasing.
        times_s: Vec<f64>,
        /// Values, one for each time.
        values: Vec<f64>,
        /// Between two times.
        #[serde(default)]
        interpolation: Interpolation,
        /// From the last time on the table starts again: the last time is the first of the next round.
        #[serde(default, skip_serializing_if = "is_false")]
        repeat: bool,
    },
}

/// How a table continues between two times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// The earlier value holds.
    #[default]
    Hold,
    /// Straight from value to value.
    Linear,
}

impl Signal {
    /// Name of the input or prescribed coordinate.
    pub fn drives(&self) -> &str {
        match self {
            Self::Constant { drives, .. }
            | Self::Sinusoid { drives, .. }
            | Self::Chirp { drives, .. }
            | Self::Spline { drives, .. }
            | Self::Table { drives, .. } => drives,
        }
    }

    /// Numbers that it stores.
    pub fn points(&self) -> usize {
        match self {
            Self::Spline { knots, .. } => knots.len(),
            Self::Table { times_s, values, .. } => times_s.len().max(values.len()),
            _ => 0,
        }
    }
}
