//! Forces that do not come from a potential, and that are not the damping of a coordinate.

use schemars::JsonSchema;
use serde::de::MapAccess;
use serde::de::value::MapAccessDeserializer;
use serde::{Deserialize, Deserializer, Serialize};

use crate::linear_term::LinearTerm;
use crate::number_or_name::{NumberOrName, field, number_or_name};
use crate::point::{Point, is_zero, is_zero3, one};

/// A force. Forces act on dynamic coordinates; velocities include those of prescribed ones.
///
/// Components of wrenches are numbers, N and N·m, names of inputs, or inputs with a gain.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Force {
    /// A wrench in the axes of a frame, at its origin: it turns with the frame.
    BodyWrench {
        /// Frame on which it acts.
        frame: String,
        /// Force, frame axes, N.
        #[serde(default, deserialize_with = "force", skip_serializing_if = "are_zero")]
        force: [Component; 3],
        /// Torque about the frame's origin, frame axes, N·m.
        #[serde(default, deserialize_with = "torque", skip_serializing_if = "are_zero")]
        torque: [Component; 3],
    },
    /// A wrench in world axes, about the world's origin: its line of action stays in the world.
    SpatialWrench {
        /// Frame on which it acts.
        frame: String,
        /// Force, world axes, N.
        #[serde(default, deserialize_with = "force", skip_serializing_if = "are_zero")]
        force: [Component; 3],
        /// Torque about the world's origin, world axes, N·m.
        #[serde(default, deserialize_with = "torque", skip_serializing_if = "are_zero")]
        torque: [Component; 3],
    },
    /// A wrench in world axes, at the origin of a frame: it moves with the frame and does not turn.
    HybridWrench {
        /// Frame on which it acts.
        frame: String,
        /// Force, world axes, N.
        #[serde(default, deserialize_with = "force", skip_serializing_if = "are_zero")]
        force: [Component; 3],
        /// Torque about the frame's origin, world axes, N·m.
        #[serde(default, deserialize_with = "torque", skip_serializing_if = "are_zero")]
        torque: [Component; 3],
    },
    /// `F = gain · u · axis` at a point of a frame, along an axis of that frame.
    Thruster {
        /// Frame on which it acts.
        frame: String,
        /// Where, in the frame, m.
        #[serde(default, skip_serializing_if = "is_zero3")]
        at: [f64; 3],
        /// Direction in the frame; need not have unit length.
        axis: [f64; 3],
        /// Input `u`.
        input: String,
        /// Newtons per unit of the input.
        #[serde(default = "one")]
        gain: f64,
    },
    /// `F = −damping · dl/dt` along the line between two points, `l = |a − b|`.
    TwoPointDamper {
        /// One end.
        a: Point,
        /// Other end.
        b: Point,
        /// N·s/m.
        damping: f64,
    },
    /// `F = −coefficient · |v| v` at a point of a frame, `v` its velocity in the world.
    Drag {
        /// Frame on which it acts.
        frame: String,
        /// Where, in the frame, m.
        #[serde(default, skip_serializing_if = "is_zero3")]
        at: [f64; 3],
        /// N·s²/m².
        coefficient: f64,
    },
    /// `f = −(coefficient + cubic · |v|) |v| v` on a coordinate of velocity `v`.
    CoordinateDrag {
        /// Coordinate.
        coordinate: String,
        /// N·s²/m² or N·m·s²/rad².
        #[serde(default, skip_serializing_if = "is_zero")]
        coefficient: f64,
        /// N·s³/m³ or N·m·s³/rad³.
        #[serde(default, skip_serializing_if = "is_zero")]
        cubic: f64,
    },
    /// `f_i = −damping · u · coefficient_i · Σ coefficient_j v_j` on the coordinates of a sum, `u` an input, or 1.
    LinearDamper {
        /// One or more terms, each of another coordinate.
        terms: Vec<LinearTerm>,
        /// N·s/m or N·m·s/rad, as the coefficients make it.
        damping: f64,
        /// Input that it is multiplied by.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        input: Option<String>,
    },
    /// `F = −damping · dL/dt` along a path of length `L` from point to point.
    PathDamper {
        /// Two or more points, in the order of the path.
        points: Vec<Point>,
        /// N·s/m.
        damping: f64,
    },
    /// `f_i = c_i (gain · u − stiffness · s − damping · ds/dt + constant)` with a sum of coordinates
    /// `s = Σ c_i q_i`. A position servo has `gain = stiffness`; a velocity servo has `stiffness = 0` and
    /// `gain = damping`.
    Servo {
        /// Coordinate `s`; or else `terms`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
        /// Terms of `s`, each of another coordinate.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        terms: Vec<LinearTerm>,
        /// Input `u`.
        input: String,
        /// Force for `u = 1`, N or N·m.
        #[serde(default = "one")]
        gain: f64,
        /// N/m or N·m/rad.
        #[serde(default, skip_serializing_if = "is_zero")]
        stiffness: f64,
        /// N·s/m or N·m·s/rad.
        #[serde(default, skip_serializing_if = "is_zero")]
        damping: f64,
        /// N or N·m.
        #[serde(default, skip_serializing_if = "is_zero")]
        constant: f64,
    },
    /// `f = −force · tanh(v / velocity)` on a coordinate of velocity `v`, on a sum of coordinates or along a
    /// path: dry friction without a jump.
    Friction {
        /// Coordinate; or else `terms` or `points`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
        /// Terms of a sum, each of another coordinate: `f_i = −coefficient_i · force · tanh(ṡ / velocity)` with
        /// `ṡ = Σ coefficient_j v_j`.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        terms: Vec<LinearTerm>,
        /// Two or more points of a path, in its order: it resists a change of the length.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        points: Vec<Point>,
        /// Friction of sliding, N or N·m.
        force: f64,
        /// Velocity at which 76 % of it are reached, m/s or rad/s.
        velocity: f64,
    },
}

/// A component of a wrench.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum Component {
    /// Constant.
    Constant(f64),
    /// Name of an input.
    Input(String),
    /// An input with a gain.
    Scaled(ScaledInput),
}

/// An input and its factor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScaledInput {
    /// Input.
    pub input: String,
    /// Force or torque for an input of 1, N or N·m; not zero.
    pub gain: f64,
}

impl Component {
    /// Its constant part.
    pub fn constant(&self) -> f64 {
        if let Self::Constant(value) = self { *value } else { 0.0 }
    }

    /// The input that it follows, and its factor.
    pub fn input(&self) -> Option<(&str, f64)> {
        match self {
            Self::Constant(_) => None,
            Self::Input(name) => Some((name, 1.0)),
            Self::Scaled(ScaledInput { input, gain }) => Some((input, *gain)),
        }
    }
}

impl NumberOrName for Component {
    const NUMBER: fn(f64) -> Self = Self::Constant;
    const NAME: fn(String) -> Self = Self::Input;
    const ALLOWED: &'static str = "a number, the name of an input, or a table of input and gain";

    fn table<'de, A: MapAccess<'de>>(table: A) -> Result<Self, A::Error> {
        ScaledInput::deserialize(MapAccessDeserializer::new(table)).map(Self::Scaled)
    }
}

impl<'de> Deserialize<'de> for Component {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        number_or_name(deserializer)
    }
}

fn force<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[Component; 3], D::Error> {
    field("force", deserializer)
}

fn torque<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[Component; 3], D::Error> {
    field("torque", deserializer)
}

impl Default for Component {
    fn default() -> Self {
        Self::Constant(0.0)
    }
}

fn are_zero(components: &[Component; 3]) -> bool {
    components.iter().all(|c| *c == Component::default())
}

impl Force {
    /// Points of frames on which it acts.
    pub fn points(&self) -> Vec<Point> {
        let of = |frame: &str, at: [f64; 3]| vec![Point { frame: frame.to_owned(), at }];
        match self {
            Self::BodyWrench { frame, .. }
            | Self::SpatialWrench { frame, .. }
            | Self::HybridWrench { frame, .. } => of(frame, [0.0; 3]),
            Self::Thruster { frame, at, .. } | Self::Drag { frame, at, .. } => of(frame, *at),
            Self::TwoPointDamper { a, b, .. } => vec![a.clone(), b.clone()],
            Self::PathDamper { points, .. } | Self::Friction { points, .. } => points.clone(),
            Self::CoordinateDrag { .. } | Self::LinearDamper { .. } | Self::Servo { .. } => {
                Vec::new()
            }
        }
    }

    /// Names of the inputs that it follows.
    pub fn inputs(&self) -> impl Iterator<Item = &str> {
        let (components, alone) = match self {
            Self::BodyWrench { force, torque, .. }
            | Self::SpatialWrench { force, torque, .. }
            | Self::HybridWrench { force, torque, .. } => (Some(force.iter().chain(torque)), None),
            Self::Thruster { input, .. } | Self::Servo { input, .. } => {
                (None, Some(input.as_str()))
            }
            Self::LinearDamper { input, .. } => (None, input.as_deref()),
            _ => (None, None),
        };
        let components = components.into_iter().flatten();
        components.filter_map(|component| Some(component.input()?.0)).chain(alone)
    }
}
