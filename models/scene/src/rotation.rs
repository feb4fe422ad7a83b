//! Rotations of frames and of shapes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// An orientation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Rotation {
    /// Unit quaternion `[w, x, y, z]`; normalised if it is within 1e-6 of unit length.
    Quaternion([f64; 4]),
    /// Rotation matrix, rows.
    Matrix([[f64; 3]; 3]),
    /// Roll, pitch, yaw about the fixed x, y, z axes: `Rz(yaw) Ry(pitch) Rx(roll)`, rad.
    Rpy([f64; 3]),
}
