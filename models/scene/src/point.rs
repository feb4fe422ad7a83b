//! A point of a frame, and the values that a scene need not write.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub(crate) fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

pub(crate) fn is_zero3(v: &[f64; 3]) -> bool {
    *v == [0.0; 3]
}

pub(crate) fn is_false(x: &bool) -> bool {
    !*x
}

/// A point fixed in a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Frame name, or `world`.
    pub frame: String,
    /// Position in the frame, m.
    #[serde(default, skip_serializing_if = "is_zero3")]
    pub at: [f64; 3],
}

pub(crate) fn one() -> f64 {
    1.0
}
