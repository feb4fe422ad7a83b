//! How a plant is being run.

use std::sync::{Arc, Mutex, OnceLock};

use tokio::sync::watch;

use crate::core::limits::LimitExceeded;
use crate::core::realtime::live::Live;
use crate::core::realtime::runner::StoppedBy;
use crate::core::realtime::settings::{Pace, RunSettings};
use crate::core::session::gate::Gate;

/// Why a plant is not run as it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The plant was deleted.
    #[error("plant `{plant}` was deleted")]
    Deleted {
        /// Its id.
        plant: String,
    },
    /// The system gave no thread for its loop.
    #[error("no thread for plants that run: {0}")]
    NoLoop(std::io::Error),
    /// As many plants run by themselves as may.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
}

/// How a plant is being run, in short.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RunStatus {
    /// Who decides when it takes a step.
    pub pace: Pace,
    /// It may take steps.
    pub is_running: bool,
    /// Number of the call of `Session::run` since which it is run so.
    pub run: u64,
    /// Number of the last lease that a watchdog has taken away.
    pub revoked: u64,
}

/// How a plant is being run.
#[derive(Clone, Debug, Default)]
pub struct Run {
    /// How.
    pub settings: RunSettings,
    /// It may take steps.
    pub is_running: bool,
    /// Why it stands still although nobody has paused it.
    pub stopped_by: Option<StoppedBy>,
    /// Counts the calls of `Session::run`.
    pub number: u64,
}

/// How the plant of a session is run, and who may change that.
pub(super) struct RunControl {
    /// How it is run; never held while a loop is waited for.
    pub(super) present: Mutex<Run>,
    /// Held by whoever changes it.
    pub(super) changing: Mutex<()>,
    /// How it is run, in short, for those who wait for changes.
    pub(super) status: watch::Sender<RunStatus>,
    /// When the driver of a plant in lockstep may step.
    pub(super) gate: Gate,
    /// Made when the plant runs by itself for the first time.
    pub(super) live: OnceLock<Arc<Live>>,
}

impl Default for RunControl {
    /// In lockstep.
    fn default() -> Self {
        Self {
            present: Mutex::new(Run { is_running: true, ..Run::default() }),
            changing: Mutex::default(),
            status: watch::Sender::new(RunStatus { is_running: true, ..RunStatus::default() }),
            gate: Gate::default(),
            live: OnceLock::new(),
        }
    }
}
