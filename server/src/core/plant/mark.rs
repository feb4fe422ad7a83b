//! Marks of what happens to a plant between two steps, for its recorder.

use std::sync::Arc;

use plantd_models::{Model, Snapshot};

use crate::core::channels::timeline::Announced;
use crate::core::parameters::Parameters;

/// Why there is a mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MarkReason {
    /// It was asked for, or is due.
    Checkpoint,
    /// The plant was put into another state.
    Reset,
    /// Its parameters or its time step were changed.
    Parameters,
}

/// The plant as it is between two steps.
pub(crate) struct Mark {
    /// Number of the ring's record that comes next.
    pub(crate) at: u64,
    pub(crate) reason: MarkReason,
    pub(crate) snapshot: Snapshot,
    pub(crate) step: u64,
    pub(crate) time_s: f64,
    pub(crate) time_step_s: f64,
    pub(crate) model: Arc<Model>,
    pub(crate) parameters: Arc<Parameters>,
    /// Changes of parameters by faults that may come.
    pub(crate) announced: Announced,
}
