//! Shapes that show a frame. They have no effect on motion, and are kept with the model.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::point::is_zero3;
use crate::rotation::Rotation;

/// A shape, placed in a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Visual {
    /// Shape; its own origin is its centre, but that of a mesh is the file's.
    pub shape: Shape,
    /// The shape's origin in the frame, m.
    #[serde(default, skip_serializing_if = "is_zero3")]
    pub translation: [f64; 3],
    /// The shape's axes in the frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<Rotation>,
    /// Red, green, blue and opacity, from 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color: Option<[f64; 4]>,
}

/// A shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Shape {
    /// A box.
    Box {
        /// Full edge lengths along x, y and z, m.
        size: [f64; 3],
    },
    /// A sphere.
    Sphere {
        /// m.
        radius: f64,
    },
    /// A cylinder along z with a half sphere on each end.
    Capsule {
        /// m.
        radius: f64,
        /// Of the cylinder alone, m.
        length: f64,
    },
    /// A cylinder along z.
    Cylinder {
        /// m.
        radius: f64,
        /// m.
        length: f64,
    },
    /// An ellipsoid.
    Ellipsoid {
        /// Semi-axes along x, y and z, m.
        radii: [f64; 3],
    },
    /// A mesh in a file, which nobody but the viewer reads.
    Mesh {
        /// Path or URI.
        file: String,
        /// Factors along x, y and z.
        #[serde(default = "unit", skip_serializing_if = "is_unit")]
        scale: [f64; 3],
    },
}

fn unit() -> [f64; 3] {
    [1.0; 3]
}

fn is_unit(scale: &[f64; 3]) -> bool {
    *scale == unit()
}
