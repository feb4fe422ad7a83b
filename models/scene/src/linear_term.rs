//! Sums of coordinates.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A coordinate and its factor in a sum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LinearTerm {
    /// Coordinate, dynamic or prescribed.
    pub coordinate: String,
    /// Factor; not zero.
    pub coefficient: f64,
}
