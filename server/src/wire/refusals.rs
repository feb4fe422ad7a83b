//! Errors of the core as errors that go to a client: codes, reasons and fields stand here, and nowhere in
//! the core.

use plantd_models::parameters::ChangeError;
use tonic::Code;

use crate::core::catalog::CatalogError;
use crate::core::channels::timeline::TimelineError;
use crate::core::feedback::regulator::RegulatorError;
use crate::core::realtime::runner::StoppedBy;
use crate::core::session::run::RunError;
use crate::core::session::shared::Session;
use crate::core::workers::pool::WorkError;
use crate::wire::status::RpcError;

impl From<ChangeError> for RpcError {
    fn from(error: ChangeError) -> Self {
        match error {
            ChangeError::Path { index, problem } => {
                Self::field(format!("parameters[{index}].path"), problem)
            }
            ChangeError::Scene(error) => error.into(),
            ChangeError::Structure(problem) => Self::field("parameters", problem),
        }
    }
}

impl From<CatalogError> for RpcError {
    fn from(error: CatalogError) -> Self {
        let problem = error.to_string();
        match error {
            CatalogError::NotFound { name } => Self::model_not_found(&name.name, &problem),
            CatalogError::Exists { name } => Self::model_exists(&name),
            CatalogError::Builtin { name } | CatalogError::BuiltinFile { name } => {
                Self::precondition("BUILTIN_MODEL", format!("model:{name}"), problem)
            }
            CatalogError::FileName(error) => Self::field("file", error.to_string()),
            CatalogError::Limit(error) => error.into(),
            CatalogError::Broken { .. } => Self::internal(problem),
        }
    }
}

impl From<WorkError> for RpcError {
    fn from(error: WorkError) -> Self {
        match error {
            WorkError::Cancelled => Self::cancelled(),
            WorkError::Limit(error) => error.into(),
            WorkError::BrokeOff => Self::internal(error.to_string()),
        }
    }
}

impl From<TimelineError> for RpcError {
    fn from(error: TimelineError) -> Self {
        let problem = error.to_string();
        match error {
            TimelineError::Change(ChangeError::Path { index, problem }) => {
                Self::field(format!("fault.parameters.parameters[{index}].path"), problem)
            }
            TimelineError::Change(error) => error.into(),
            TimelineError::Limit(error) => error.into(),
            TimelineError::Plant(error) => Self::from_initial(error, "fault.parameters"),
            TimelineError::TooManyBlinking => Self::field("fault.parameters", problem),
        }
    }
}

impl From<RegulatorError> for RpcError {
    fn from(error: RegulatorError) -> Self {
        let message = error.to_string();
        match error {
            RegulatorError::Step { error, steps_taken: None } => error.into(),
            RegulatorError::Step { error, steps_taken: Some(steps) } => {
                Self::from(error).with("steps_taken", steps)
            }
            RegulatorError::Moves { coordinate, distance, .. } => {
                Self::precondition("NOT_AN_EQUILIBRIUM", "point", message)
                    .with("coordinate", coordinate)
                    .with("drift", distance)
            }
            RegulatorError::Initial { field, error } => Self::from_initial(error, field),
            RegulatorError::TimeStepChanged { .. } => {
                Self::precondition("TIME_STEP_CHANGED", "trajectory", message)
            }
            RegulatorError::NoWeights => Self::field("weights", message),
            RegulatorError::Weights(error) => error.into(),
            RegulatorError::Riccati(error) => error.into(),
            RegulatorError::Limit(error) => error.into(),
            RegulatorError::Work(error) => error.into(),
        }
    }
}

impl From<RunError> for RpcError {
    fn from(error: RunError) -> Self {
        let message = error.to_string();
        match error {
            RunError::Deleted { plant } => Self::plant_deleted(&plant),
            RunError::NoLoop(_) => Self::new(Code::Unavailable, "LOOP_FAILED", message),
            RunError::Limit(error) => error.into(),
        }
    }
}

impl RpcError {
    /// The error that says why a plant stands still.
    pub fn from_stopped(why: StoppedBy, session: &Session) -> Self {
        match why {
            StoppedBy::Drive(error) => Self::from_drive(error, session),
            StoppedBy::InputLost => Self::input_lost(session.id()),
        }
    }
}
