//! Why a call was refused.

use plantd_models::parameters::ChangeError;
use plantd_models::{InitialError, SnapshotError, StepError};

use crate::types::Status;

/// Why a call was refused. The instance is as it was.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FmuError {
    #[error("must not be called {0}")]
    Phase(&'static str),
    #[error("there is no variable with the value reference {0}")]
    NoVariable(u32),
    #[error("`{0}` cannot be set")]
    NotSettable(String),
    #[error("`{0}` can be set until the initialization mode ends")]
    TooLate(String),
    #[error("`{name}` is to become {value}")]
    NotFinite { name: String, value: f64 },
    #[error("there are {given} {what}; {needed} are needed")]
    Count { what: &'static str, given: usize, needed: usize },
    #[error("{0} is a null pointer")]
    Null(&'static str),
    #[error("{0} is not UTF-8")]
    NotUtf8(&'static str),
    #[error("the instance is at {at_s} s, not at {given_s} s")]
    OtherTime { at_s: f64, given_s: f64 },
    #[error("a communication step of {given_s} s is no multiple of the time step, {time_step_s} s")]
    StepSize { given_s: f64, time_step_s: f64 },
    #[error("the step ends at {end_s} s, after the stop time, {stop_s} s")]
    BeyondStop { end_s: f64, stop_s: f64 },
    #[error("start time {start_s} s and stop time {stop_s} s are no interval of time")]
    Times { start_s: f64, stop_s: f64 },
    #[error("the step from {at_s} s cannot be taken: {source}")]
    Step { at_s: f64, source: StepError },
    #[error("cannot be linearized here: {0}")]
    Linearize(StepError),
    #[error("parameters cannot be taken over: {0}")]
    Parameters(#[from] ChangeError),
    #[error("cannot start there: {0}")]
    Initial(#[from] InitialError),
    #[error("the state does not fit the changed parameters: {0}")]
    Change(InitialError),
    #[error("{0}")]
    Snapshot(#[from] SnapshotError),
    #[error("not a state of this FMU: {0}")]
    NotAState(&'static str),
    #[error("there is no state with that handle")]
    NoState,
    #[error("the derivative of `{unknown}` by `{known}` is not provided")]
    NoDerivative { unknown: String, known: String },
    #[error("there is no log category `{0}`")]
    NoCategory(String),
    #[error("this FMU has no {0}")]
    Absent(&'static str),
    #[error("the instance was lost in an earlier call")]
    Lost,
}

impl FmuError {
    pub(crate) fn status(&self) -> Status {
        match self {
            Self::Step { .. } => Status::Discard,
            Self::Lost => Status::Fatal,
            _ => Status::Error,
        }
    }
}
