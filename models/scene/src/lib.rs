//! Scenes: the declarative description of a mechanism, in TOML or JSON.
//!
//! All quantities are SI; angles are radians. Unknown keys are errors, and every error of a
//! scene is reported at once, with its path: [`Scene::validate`].

pub mod builtin;
mod forces;
mod inputs;
mod limits;
mod linear_term;
mod number_or_name;
mod point;
mod rotation;
mod scene;
mod signals;
mod text;
mod time_function;
mod validate;
mod visuals;
mod words;

pub use crate::forces::{Component, Force, ScaledInput};
pub use crate::inputs::{Input, InputTerm};
pub use crate::limits::{
    MAX_ARMATURE_TERMS, MAX_CONSTRAINTS, MAX_COORDINATES, MAX_COUPLING_TERMS, MAX_FILE_BYTES,
    MAX_FORCES, MAX_FRAMES, MAX_INPUTS, MAX_KNOTS, MAX_LINEAR_TERMS, MAX_NAME_BYTES,
    MAX_OPERATING_POINTS, MAX_PATH_POINTS, MAX_POWER, MAX_SIGNAL_POINTS, MAX_SIGNALS, MAX_SPRINGS,
    MAX_TEXT_BYTES, MAX_VISUALS,
};
pub use crate::linear_term::LinearTerm;
pub use crate::point::Point;
pub use crate::rotation::Rotation;
pub use crate::scene::{
    Armature, Axis, Body, Constraint, Coordinate, CoordinateKind, CouplingTerm, Frame, Joint,
    Length, Motion, OperatingPoint, Plane, Problem, Scene, SceneError, Spring,
};
pub use crate::signals::{Interpolation, Signal};
pub use crate::time_function::TimeFunction;
pub use crate::visuals::{Shape, Visual};
pub use crate::words::{UnknownName, in_plain_words, line_of};
pub use plantd_math::spline::Knot;
