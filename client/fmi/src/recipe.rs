//! What is chosen when an FMU is made, beside the scene.

use plantd_models::{ForceSplit, Model, Precision, Settings};
use serde::{Deserialize, Serialize};

/// How the plant of an FMU is stepped and where it starts; what is not given is as [`Settings::new`] and
/// the scene have it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Recipe {
    /// Operating point at which it starts, with its input.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) at: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    time_step_s: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    order: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    substeps: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    halvings: Option<u32>,
    /// Stop the solver at eleven digits.
    #[serde(default)]
    fast: bool,
    /// Stop it at seven digits.
    #[serde(default)]
    coarse: bool,
    /// All forces at the start of a step, as in the paper.
    #[serde(default)]
    paper: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    max_iterations: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    singular_below: Option<f64>,
}

impl Recipe {
    pub(crate) fn settings(&self, model: &Model) -> Settings {
        let usual = Settings::new(model);
        Settings {
            time_step_s: self.time_step_s.unwrap_or(usual.time_step_s),
            order: self.order.unwrap_or(usual.order),
            substeps: self.substeps.unwrap_or(usual.substeps),
            halvings: self.halvings.unwrap_or(usual.halvings),
            precision: match self {
                Self { coarse: true, .. } => Precision::Coarse,
                Self { fast: true, .. } => Precision::Fast,
                _ => Precision::Exact,
            },
            force_split: if self.paper { ForceSplit::Paper } else { ForceSplit::Symmetric },
            max_iterations: self.max_iterations.unwrap_or(usual.max_iterations),
            singular_below: self.singular_below.unwrap_or(usual.singular_below),
        }
    }
}
