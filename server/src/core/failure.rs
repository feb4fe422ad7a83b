//! Names of the failures of steps, for clients and metrics alike.

use plantd_models::StepError;

/// The reason of a failed step, as in `google.rpc.ErrorInfo`.
pub fn step_error_reason(error: &StepError) -> &'static str {
    match error {
        StepError::Dimension { .. } => "INPUT_DIMENSION",
        StepError::InputNotFinite { .. } => "INPUT_NOT_FINITE",
        StepError::NotConverged { .. } => "NOT_CONVERGED",
        StepError::NotFinite { .. } => "MOTION_NOT_FINITE",
        StepError::TooFast { .. } => "TOO_FAST",
        StepError::Singular { .. } => "SINGULAR",
        StepError::SingularConstraints { .. } => "SINGULAR_CONSTRAINTS",
        StepError::InconsistentConstraints { .. } => "INCONSISTENT_CONSTRAINTS",
        StepError::TooManySteps { .. } => "TOO_MANY_STEPS",
    }
}
