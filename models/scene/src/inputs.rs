//! Inputs: numbers that the driver sends, and what they act on.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::point::{Point, one};

/// A number `u` that the driver sends: generalized forces on dynamic coordinates, a force along a
/// path, or a component of forces that name it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Name.
    pub name: String,
    /// Coordinate on which it acts with the force `gain · u`; at most one of `coordinate`, `terms` and
    /// `points` is given, and none only if a force uses the input.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coordinate: Option<String>,
    /// Coordinates on which it acts with the forces `gain_i · u`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub terms: Vec<InputTerm>,
    /// Two or more points of a path of length `L` along which it acts: `f_i = gain · u · ∂L/∂q_i`, so
    /// that a positive force lengthens the path.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<Point>,
    /// Factor of the force on the coordinate or along the path.
    #[serde(default = "one")]
    pub gain: f64,
    /// Least and greatest `u`; they inform clients, and the plant takes any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<[f64; 2]>,
}

impl Default for Input {
    fn default() -> Self {
        Self {
            name: String::new(),
            coordinate: None,
            terms: Vec::new(),
            points: Vec::new(),
            gain: one(),
            limits: None,
        }
    }
}

/// A coordinate on which an input acts, and how much.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct InputTerm {
    /// Coordinate; dynamic.
    pub coordinate: String,
    /// Factor of the force on it; not zero.
    #[serde(default = "one")]
    pub gain: f64,
}
