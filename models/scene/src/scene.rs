//! A scene: what is at its top, frames and bodies, springs and constraints.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use plantd_math::spline::Knot;

use crate::forces::Force;
use crate::inputs::Input;
use crate::linear_term::LinearTerm;
use crate::number_or_name::{NumberOrName, field, number_or_name};
use crate::point::{Point, is_false, is_zero, is_zero3};
use crate::rotation::Rotation;
use crate::signals::Signal;
use crate::visuals::Visual;

/// A mechanism: a tree of frames with joints and bodies, what acts on it, and what constrains it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Version of the scene format; 1.
    pub format: u32,
    /// Name: lower-case letters, digits and hyphens.
    pub name: String,
    /// One sentence for people.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// Suggested time step, seconds.
    #[serde(default = "default_time_step")]
    pub time_step_s: f64,
    /// Acceleration of gravity, world axes, m/s²; must be given, zero as well.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(required)]
    pub gravity: Option<[f64; 3]>,
    /// Damping of every dynamic coordinate that does not set its own, N·s/m or N·m·s/rad.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub damping: f64,
    /// The frames. A parent may come before or after its children.
    pub frames: Vec<Frame>,
    /// Settings of coordinates. Prescribed coordinates must be listed here and keep this order;
    /// dynamic ones only if they need a setting: their order is that of the frames, depth first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub coordinates: Vec<Coordinate>,
    /// Inertias of what moves with sums of coordinates.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub armatures: Vec<Armature>,
    /// Springs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub springs: Vec<Spring>,
    /// Force inputs, in the order of the input vector.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<Input>,
    /// Forces other than springs, damping and those of inputs on coordinates.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub forces: Vec<Force>,
    /// Functions of time that drive inputs and prescribed coordinates.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<Signal>,
    /// Holonomic constraints.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub constraints: Vec<Constraint>,
    /// Named configurations to hold, linearize or regulate about.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub operating_points: Vec<OperatingPoint>,
}

fn default_time_step() -> f64 {
    0.01
}

/// A frame, placed in its parent; its joint moves it away from there.
///
/// `pose = parent pose * translation * rotation * joint(coordinate)`
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Frame {
    /// Name, unique in the scene; `world` is taken.
    pub name: String,
    /// Name of the parent frame.
    #[serde(default = "world", skip_serializing_if = "is_world")]
    pub parent: String,
    /// Origin in the parent's axes, m.
    #[serde(default, skip_serializing_if = "is_zero3")]
    pub translation: [f64; 3],
    /// Orientation in the parent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<Rotation>,
    /// Joint; none means: fixed in the parent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint: Option<Joint>,
    /// Rigid body fixed in the frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<Body>,
    /// Shapes that show the frame; they have no effect on motion.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub visuals: Vec<Visual>,
}

fn world() -> String {
    "world".to_owned()
}
fn is_world(name: &str) -> bool {
    name == "world"
}

/// A joint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Joint {
    /// No motion.
    Fixed {},
    /// Turns about an axis through the frame's origin; positive by the right hand.
    Revolute {
        /// Axis in the frame; need not have unit length.
        axis: [f64; 3],
        /// Coordinate, rad; the frame's name if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
    /// Slides along an axis.
    Prismatic {
        /// Axis in the frame; need not have unit length.
        axis: [f64; 3],
        /// Coordinate, m; the frame's name if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
    /// Turns about an axis through the frame's origin and slides along it at once.
    Screw {
        /// Axis in the frame; need not have unit length.
        axis: [f64; 3],
        /// Advance, m/rad; negative for a left-handed thread.
        pitch: f64,
        /// Coordinate, rad; the frame's name if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
    /// Turns about two axes through the frame's origin, one after the other (Cardan joint): the first
    /// is fixed in the parent, the second is carried by the first.
    Universal {
        /// Axes in the frame, not parallel.
        axes: [[f64; 3]; 2],
        /// Stem of the coordinates `<stem>_1`, `<stem>_2`, rad; the frame's name if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
    /// Turns freely about the frame's origin: an orientation in SO(3), without singularities.
    ///
    /// Its coordinates are the components of the rotation vector (axis times angle, at most half a
    /// turn), its velocities and momenta those in the frame's own axes.
    Ball {
        /// Stem of the coordinates `<stem>_rx`, `<stem>_ry`, `<stem>_rz`, rad; the frame's name if not
        /// given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
    /// Moves freely: three slides along the axes of the frame at zero, then a ball joint.
    Free {
        /// Stem of the coordinates `<stem>_x`, `<stem>_y`, `<stem>_z`, m, and `<stem>_rx`,
        /// `<stem>_ry`, `<stem>_rz`, rad; the frame's name if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
    },
}

/// One degree of freedom of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// Turns about an axis.
    Revolute([f64; 3]),
    /// Slides along an axis.
    Prismatic([f64; 3]),
    /// Turns about an axis and advances along it, m/rad.
    Screw([f64; 3], f64),
    /// Component 0, 1 or 2 of an orientation.
    Ball(usize),
}

impl Motion {
    /// Whether its coordinate is an angle, rad.
    pub fn is_angle(&self) -> bool {
        !matches!(self, Self::Prismatic(_))
    }
}

/// A rigid body.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Mass, kg; zero is allowed where there is inertia elsewhere.
    pub mass: f64,
    /// Centre of mass in the frame, m.
    #[serde(default, skip_serializing_if = "is_zero3")]
    pub center_of_mass: [f64; 3],
    /// Inertia about the centre of mass in the frame's axes,
    /// `[ixx, iyy, izz]` or `[ixx, iyy, izz, ixy, ixz, iyz]`, kg·m². None means a point mass.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inertia: Vec<f64>,
    /// Takes principal moments that no body has (`a + b < c`), with a warning.
    #[serde(default, skip_serializing_if = "is_false")]
    pub any_inertia: bool,
}

/// Settings of a coordinate.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Coordinate {
    /// Name.
    pub name: String,
    /// Dynamic or prescribed.
    #[serde(default)]
    pub kind: CoordinateKind,
    /// Value in the initial configuration, m or rad.
    #[serde(default)]
    pub initial: f64,
    /// Damping, N·s/m or N·m·s/rad; not given means the scene's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub damping: Option<f64>,
    /// Inertia of what turns or slides with the coordinate alone, such as a geared rotor:
    /// `T += ½ armature v²` with the coordinate's velocity `v`; kg for a slide, kg·m² for an angle.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub armature: f64,
    /// Lower and upper limit, m or rad; they inform clients, and a `stop` enforces them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<[f64; 2]>,
}

/// Who moves a coordinate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CoordinateKind {
    /// The dynamics.
    #[default]
    Dynamic,
    /// The input, position by position. May drive a joint, lengths of constraints, or both.
    Prescribed,
}

/// Inertia of what turns or slides with a sum of coordinates, such as a rotor behind a differential:
/// `T += ½ armature (Σ coefficient_i v_i)²`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Armature {
    /// One or more terms, each of another dynamic coordinate.
    pub terms: Vec<LinearTerm>,
    /// kg or kg·m², as the coefficients make it.
    pub armature: f64,
}

/// A spring.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Spring {
    /// `V = ½ stiffness (|a − b| − rest_length)²`.
    TwoPoint {
        /// One end.
        a: Point,
        /// Other end.
        b: Point,
        /// N/m.
        stiffness: f64,
        /// m.
        #[serde(default)]
        rest_length: f64,
    },
    /// `V = ½ stiffness (q − rest)²`.
    Coordinate {
        /// Coordinate.
        coordinate: String,
        /// N/m or N·m/rad.
        stiffness: f64,
        /// m or rad.
        #[serde(default)]
        rest: f64,
    },
    /// Generalized force `spline(q)` on a coordinate: `V = −∫ spline dq`, zero at the first knot.
    Spline {
        /// Coordinate.
        coordinate: String,
        /// Force over position, N over m or N·m over rad.
        knots: Vec<Knot>,
    },
    /// `V = ½ stiffness (length − rest_length)²` with the length of a path from point to point: an
    /// elastic cord through eyes, a tape measure.
    Path {
        /// Two or more points, in the order of the path.
        points: Vec<Point>,
        /// N/m.
        stiffness: f64,
        /// m.
        #[serde(default)]
        rest_length: f64,
    },
    /// `V = ½ stiffness (Σ coefficient_i q_i − rest)²` with a sum of coordinates.
    LinearSpring {
        /// One or more terms, each of another coordinate.
        terms: Vec<LinearTerm>,
        /// N/m or N·m/rad, as the coefficients make it.
        stiffness: f64,
        /// m or rad, as the coefficients make it.
        #[serde(default)]
        rest: f64,
    },
    /// `V = ½ stiffness |φ|²` with the rotation vector `φ` by which a ball joint, or the rotation of a free
    /// joint, is turned from where the spring is at rest, the shorter way round.
    Orientation {
        /// Frame that has the joint.
        frame: String,
        /// N·m/rad.
        stiffness: f64,
        /// The joint's rotation at which it is at rest; none if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rest: Option<Rotation>,
    },
    /// A one-sided spring and damper where a coordinate, or the length of a path, leaves its range:
    /// `f = −stiffness · F(x) − damping · w(x) · dx/dt` at a depth `x` beyond it, with `F' = w`, and `w`
    /// rising smoothly from 0 at the range's end to 1 at the depth `transition`.
    Stop {
        /// Coordinate; or else `points`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        coordinate: Option<String>,
        /// Two or more points of a path whose length is limited, in the order of the path.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        points: Vec<Point>,
        /// Where it does nothing, m or rad; the `limits` of the coordinate if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        range: Option<[f64; 2]>,
        /// N/m or N·m/rad.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        stiffness: Option<f64>,
        /// N·s/m or N·m·s/rad; 0 if not given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        damping: Option<f64>,
        /// Depth from which stiffness and damping are whole, m or rad; a hundredth of the range if
        /// neither it nor `settling_depth` is given.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        transition: Option<f64>,
        /// In place of `transition`, with `settling_time_s`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        settling_depth: Option<f64>,
        /// In place of `stiffness` and `damping`: time in which a coordinate that is held at the stop
        /// comes to rest, s.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        settling_time_s: Option<f64>,
    },
}

impl Spring {
    /// Points of frames between which it acts.
    pub fn points(&self) -> Vec<&Point> {
        match self {
            Self::TwoPoint { a, b, .. } => vec![a, b],
            Self::Path { points, .. } | Self::Stop { points, .. } => points.iter().collect(),
            Self::Coordinate { .. }
            | Self::Spline { .. }
            | Self::LinearSpring { .. }
            | Self::Orientation { .. } => Vec::new(),
        }
    }
}

/// A holonomic constraint `h(q) = 0`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Constraint {
    /// `h = |a − b|² − length²`.
    Distance {
        /// Name, unique among constraints.
        name: String,
        /// One end.
        a: Point,
        /// Other end.
        b: Point,
        /// Length.
        #[serde(deserialize_with = "length")]
        length: Length,
    },
    /// `h = (a − b)·e` for each listed world axis `e`.
    PointToPoint {
        /// Name, unique among constraints.
        name: String,
        /// One point.
        a: Point,
        /// Other point.
        b: Point,
        /// One to three different axes.
        axes: Vec<Axis>,
    },
    /// `h = n·(a − b)` with the normal `n` and point `a` of a plane and a point `b`.
    PointOnPlane {
        /// Name, unique among constraints.
        name: String,
        /// The plane.
        plane: Plane,
        /// The point.
        point: Point,
    },
    /// Two frames keep the same orientation: `h = (y_a·z_b, z_a·x_b, x_a·y_b)` with their axes.
    Orientation {
        /// Name, unique among constraints.
        name: String,
        /// One frame, or `world`.
        a: String,
        /// Other frame.
        b: String,
    },
    /// Two frames coincide: `h = (o_a − o_b)·(x_a, y_a, z_a)` with their origins, and as
    /// `orientation`.
    Weld {
        /// Name, unique among constraints.
        name: String,
        /// One frame, or `world`.
        a: String,
        /// Other frame.
        b: String,
    },
    /// `h = Σ_j Σ_k coefficients_jk q_j^k + constant`, powers `k` from 1.
    Coupling {
        /// Name, unique among constraints.
        name: String,
        /// One or more terms, each of another coordinate.
        terms: Vec<CouplingTerm>,
        /// m or rad, as the coefficients make it.
        #[serde(default)]
        constant: f64,
    },
    /// `h = Σ |d_s| − length` over the segments `d_s` of a path from point to point: a rope over
    /// pulleys, a tape measure.
    PathLength {
        /// Name, unique among constraints.
        name: String,
        /// Two or more points, in the order of the path.
        points: Vec<Point>,
        /// Length.
        #[serde(deserialize_with = "length")]
        length: Length,
    },
}

/// A plane fixed in a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Plane {
    /// Frame name, or `world`.
    pub frame: String,
    /// A point of the plane in the frame, m.
    #[serde(default, skip_serializing_if = "is_zero3")]
    pub at: [f64; 3],
    /// Normal in the frame. Its length scales `h` and, inversely, the multiplier.
    pub normal: [f64; 3],
}

/// A polynomial of one coordinate in a coupling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CouplingTerm {
    /// Coordinate, dynamic or prescribed.
    pub coordinate: String,
    /// Factors of `q`, `q²`, `q³` and so on.
    pub coefficients: Vec<f64>,
}

/// Length of a distance or of a path.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum Length {
    /// Fixed, m; greater than zero.
    Fixed(f64),
    /// Name of a prescribed coordinate.
    Coordinate(String),
}

impl NumberOrName for Length {
    const NUMBER: fn(f64) -> Self = Self::Fixed;
    const NAME: fn(String) -> Self = Self::Coordinate;
    const ALLOWED: &'static str = "a number of metres or the name of a prescribed coordinate";
}

impl<'de> Deserialize<'de> for Length {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        number_or_name(deserializer)
    }
}

fn length<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Length, D::Error> {
    field("length", deserializer)
}

/// A world axis.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// x.
    X,
    /// y.
    Y,
    /// z.
    Z,
}

/// A named configuration, held at rest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OperatingPoint {
    /// Name.
    pub name: String,
    /// Coordinates that differ from the initial configuration.
    #[serde(default)]
    pub coordinates: std::collections::BTreeMap<String, f64>,
    /// Inputs that are not zero.
    #[serde(default, skip_serializing_if = "std::collections::BTreeMap::is_empty")]
    pub inputs: std::collections::BTreeMap<String, f64>,
}

/// One error of a scene.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{path}{}{message}", if path.is_empty() { "" } else { ": " })]
pub struct Problem {
    /// Where, for example `frames[3].body.mass`.
    pub path: String,
    /// What is wrong.
    pub message: String,
}

/// All errors of a scene.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
pub struct SceneError {
    /// At least one.
    pub problems: Vec<Problem>,
}

impl Frame {
    /// What its joint can do, one entry for each coordinate, with the coordinate's name.
    pub fn motions(&self) -> Vec<(String, Motion)> {
        const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let stem = |name: &Option<String>| name.as_ref().unwrap_or(&self.name).clone();
        let named = |name: &Option<String>, motions: &[(&str, Motion)]| {
            motions.iter().map(|(suffix, m)| (stem(name) + suffix, *m)).collect()
        };
        let turns = [("_rx", Motion::Ball(0)), ("_ry", Motion::Ball(1)), ("_rz", Motion::Ball(2))];
        match &self.joint {
            None | Some(Joint::Fixed {}) => Vec::new(),
            Some(Joint::Revolute { axis, coordinate }) => {
                vec![(stem(coordinate), Motion::Revolute(*axis))]
            }
            Some(Joint::Prismatic { axis, coordinate }) => {
                vec![(stem(coordinate), Motion::Prismatic(*axis))]
            }
            Some(Joint::Screw { axis, pitch, coordinate }) => {
                vec![(stem(coordinate), Motion::Screw(*axis, *pitch))]
            }
            Some(Joint::Universal { axes: [first, second], coordinate }) => named(
                coordinate,
                &[("_1", Motion::Revolute(*first)), ("_2", Motion::Revolute(*second))],
            ),
            Some(Joint::Ball { coordinate }) => named(coordinate, &turns),
            Some(Joint::Free { coordinate }) => {
                let [x, y, z] = AXES.map(Motion::Prismatic);
                let slides = [("_x", x), ("_y", y), ("_z", z)];
                named(coordinate, &[slides, turns].concat())
            }
        }
    }
}

impl Constraint {
    /// Name.
    pub fn name(&self) -> &str {
        match self {
            Self::Distance { name, .. }
            | Self::PointToPoint { name, .. }
            | Self::PointOnPlane { name, .. }
            | Self::Orientation { name, .. }
            | Self::Weld { name, .. }
            | Self::Coupling { name, .. }
            | Self::PathLength { name, .. } => name,
        }
    }
    /// Number of its equations.
    pub fn equations(&self) -> usize {
        match self {
            Self::Distance { .. }
            | Self::PointOnPlane { .. }
            | Self::Coupling { .. }
            | Self::PathLength { .. } => 1,
            Self::PointToPoint { axes, .. } => axes.len(),
            Self::Orientation { .. } => 3,
            Self::Weld { .. } => 6,
        }
    }
    /// Frames of its points, axes and planes; a frame may come more than once.
    pub fn frames(&self) -> Vec<&str> {
        match self {
            Self::Distance { a, b, .. } | Self::PointToPoint { a, b, .. } => {
                vec![&a.frame, &b.frame]
            }
            Self::PointOnPlane { plane, point, .. } => vec![&plane.frame, &point.frame],
            Self::Orientation { a, b, .. } | Self::Weld { a, b, .. } => vec![a, b],
            Self::Coupling { .. } => Vec::new(),
            Self::PathLength { points, .. } => {
                points.iter().map(|point| point.frame.as_str()).collect()
            }
        }
    }
    /// Name of the prescribed coordinate that is its length, if any.
    pub fn length_coordinate(&self) -> Option<&str> {
        match self {
            Self::Distance { length: Length::Coordinate(name), .. }
            | Self::PathLength { length: Length::Coordinate(name), .. } => Some(name),
            _ => None,
        }
    }
}
