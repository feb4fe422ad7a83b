//! Errors of the mechanics, of regulators, filters and searches, as errors for clients.

use plantd_control::optimize::{OptimizeError, Stuck};
use plantd_control::reference::ReferenceError;
use plantd_control::{AnalysisError, KalmanError, NoiseError, RiccatiError, WeightsError};
use plantd_models::{
    ChoiceError, ContinuousError, InitialError, SettleError, SnapshotError, StepError, TooLarge,
};
use tonic::Code;

use crate::core::failure::step_error_reason;
use crate::wire::status::RpcError;

impl RpcError {
    /// The fault of a refused state that stands in `field` of the request.
    pub fn from_initial(error: InitialError, field: &str) -> Self {
        let message = error.to_string();
        match error {
            InitialError::Dimension { name, .. } => Self::field(format!("{field}.{name}"), message),
            InitialError::NotFinite { name, index, .. } => {
                Self::field(format!("{field}.{name}[{index}]"), message)
            }
            InitialError::Unknown { .. } => Self::field(field, message),
            InitialError::OffConstraint { constraint, .. }
            | InitialError::SceneIsGuess { constraint, .. } => {
                Self::field_because("OFF_CONSTRAINT", field, message).with("constraint", constraint)
            }
            InitialError::Degenerate { constraint, .. } => {
                Self::field_because("DEGENERATE", field, message).with("constraint", constraint)
            }
            InitialError::Projection { constraint, .. } => {
                Self::field_because("PROJECTION_FAILED", field, message)
                    .with("constraint", constraint)
            }
            InitialError::Settle(error) => Self::from_settle(error, field),
            InitialError::Settings { name, .. } | InitialError::OutOfRange { name, .. } => {
                Self::field(format!("settings.{name}"), message)
            }
            InitialError::Order { .. } => Self::field("settings.order", message),
        }
    }
}

impl RpcError {
    /// The fault of a guess that did not settle, in `field` of the request.
    pub fn from_settle(error: SettleError, field: &str) -> Self {
        let message = error.to_string();
        match error {
            SettleError::Dimension { name, .. } => Self::field(format!("{field}.{name}"), message),
            SettleError::NotFinite { name, index, .. } => {
                Self::field(format!("{field}.{name}[{index}]"), message)
            }
            SettleError::Unknown { .. } => Self::field(format!("{field}.hold"), message),
            SettleError::Constraints { constraint, .. } => {
                Self::field_because("NOT_SETTLED", field, message).with("constraint", constraint)
            }
            SettleError::Unbounded { .. } | SettleError::NotConverged { .. } => {
                Self::field_because("NOT_SETTLED", field, message)
            }
        }
    }
}

impl From<ChoiceError> for RpcError {
    fn from(error: ChoiceError) -> Self {
        let (field, message) = ("settings.tolerance", error.to_string());
        match error {
            ChoiceError::Tolerance(_) => Self::field(field, message),
            ChoiceError::Initial(error) => Self::from_initial(error, "initial"),
            ChoiceError::Step { period, error } => {
                Self::precondition(step_error_reason(&error), "initial", message)
                    .with("step", period)
            }
            ChoiceError::Cancelled => Self::cancelled(),
            ChoiceError::OutOfReach { .. } | ChoiceError::TooLong => {
                Self::field_because("TOLERANCE_OUT_OF_REACH", field, message)
            }
        }
    }
}

impl From<SnapshotError> for RpcError {
    fn from(error: SnapshotError) -> Self {
        let reason = match error {
            SnapshotError::Malformed(_) => "INVALID_SNAPSHOT",
            SnapshotError::Mismatch(_) => "SNAPSHOT_MISMATCH",
        };
        Self::field_because(reason, "snapshot", error.to_string())
    }
}

impl From<StepError> for RpcError {
    fn from(error: StepError) -> Self {
        let reason = step_error_reason(&error);
        let message = error.to_string();
        match error {
            StepError::Dimension { .. } => Self::field_because(reason, "u", message),
            StepError::InputNotFinite { index, .. } => {
                Self::field_because(reason, format!("u[{index}]"), message)
            }
            StepError::NotConverged { .. }
            | StepError::NotFinite { .. }
            | StepError::TooFast { .. }
            | StepError::TooManySteps { .. }
            | StepError::Singular { .. } => Self::precondition(reason, "step", message),
            StepError::SingularConstraints { constraints, .. }
            | StepError::InconsistentConstraints { constraints, .. } => {
                Self::precondition(reason, "step", message)
                    .with("constraints", constraints.join(", "))
            }
        }
    }
}

impl RpcError {
    /// The fault of weights that stand in the field `weights` of the request, and those of steps in
    /// `stages`.
    pub fn from_weights(error: WeightsError, weights: &str, stages: &str) -> Self {
        let weight = error.weight();
        let field = match error.step() {
            Some(step) => format!("{stages}[{step}].{weight}"),
            None => format!("{weights}.{weight}"),
        };
        Self::field_because("INVALID_WEIGHT", field, error.to_string())
    }
}

impl From<WeightsError> for RpcError {
    fn from(error: WeightsError) -> Self {
        Self::from_weights(error, "weights", "stages")
    }
}

impl From<RiccatiError> for RpcError {
    fn from(error: RiccatiError) -> Self {
        let reason = match error {
            RiccatiError::NotStabilisable { .. } => "NOT_STABILISABLE",
            RiccatiError::NotDetectable { .. } => "NOT_DETECTABLE",
            RiccatiError::NotConverged { .. } => "RICCATI_NOT_CONVERGED",
            RiccatiError::NotConvex { .. } => "NOT_CONVEX",
            RiccatiError::Overflow { .. } | RiccatiError::NotFinite { .. } => "RICCATI_OVERFLOW",
            RiccatiError::Eigenvalues { .. } => "EIGENVALUES_NOT_FOUND",
            // The server made the matrices, so a misfit among them is its own mistake.
            RiccatiError::Dimension { .. } | RiccatiError::TangentCount { .. } => {
                return Self::internal(error.to_string());
            }
            RiccatiError::StageCount { .. } => {
                return Self::field_because("INVALID_WEIGHT", "stages", error.to_string());
            }
        };
        Self::precondition(reason, "regulator", error.to_string())
    }
}

impl From<NoiseError> for RpcError {
    fn from(error: NoiseError) -> Self {
        let field = match error.covariance() {
            "initial_covariance" => "initial_covariance".to_owned(),
            covariance => format!("noise.{covariance}"),
        };
        Self::field_because("INVALID_COVARIANCE", field, error.to_string())
    }
}

impl From<KalmanError> for RpcError {
    fn from(error: KalmanError) -> Self {
        let message = error.to_string();
        match error {
            KalmanError::Noise(error) => error.into(),
            KalmanError::NotDetectable { .. } => {
                Self::precondition("NOT_DETECTABLE", "filter", message)
            }
            KalmanError::NotExcited { .. } => Self::precondition("NOT_EXCITED", "filter", message),
            KalmanError::Riccati(error) => error.into(),
            // The server made the lists, so a misfit among them is its own mistake.
            KalmanError::Count { .. } => Self::internal(message),
        }
    }
}

impl From<OptimizeError> for RpcError {
    fn from(error: OptimizeError) -> Self {
        let message = error.to_string();
        match error {
            OptimizeError::NoSteps => Self::field("guess.u", message),
            OptimizeError::Dimension { .. } | OptimizeError::NotFinite { .. } => {
                Self::field("cost", message)
            }
            OptimizeError::Weights(error) => {
                Self::from_weights(error, "cost.weights", "cost.stages")
            }
            OptimizeError::Stages { .. } => Self::field("cost.stages", message),
            OptimizeError::Option { name, .. } => Self::field(format!("options.{name}"), message),
            OptimizeError::Bound { list, position, .. } => {
                let list = match list {
                    "states" => "state",
                    "inputs" => "input",
                    other => other,
                };
                Self::field(format!("bounds.{list}[{position}]"), message)
            }
            OptimizeError::FreeEntry { .. } => Self::field("free_initial.entries", message),
            OptimizeError::Initial(error) => Self::from_initial(error, "guess.initial"),
            OptimizeError::Guess { step, ref error } => {
                Self::precondition(step_error_reason(error), "guess", message).with("step", step)
            }
            OptimizeError::Cost { .. } => Self::precondition("MOTION_NOT_FINITE", "guess", message),
            OptimizeError::Linearization { step, ref error } => {
                let reason = step_error_reason(error);
                Self::precondition(reason, "trajectory", message).with("step", step)
            }
            OptimizeError::Projection { step } => {
                let subject = "options.projection";
                Self::precondition("RICCATI_OVERFLOW", subject, message).with("step", step)
            }
            OptimizeError::Checkpoint { .. } => Self::field("resume", message),
            OptimizeError::Cancelled => Self::cancelled(),
            // The server asks for no iteration after the last.
            OptimizeError::Finished => Self::internal(message),
        }
    }
}

impl From<Stuck> for RpcError {
    fn from(stuck: Stuck) -> Self {
        let reason = match stuck {
            Stuck::MaxIterations { .. } => "MAX_ITERATIONS",
            Stuck::NoDescent { .. } => "NO_DESCENT",
            Stuck::NotConvex { .. } | Stuck::WeightsNotConvex { .. } => "NOT_CONVEX",
            Stuck::BoundsNotMet(_) => "BOUNDS_NOT_MET",
        };
        Self::precondition(reason, "search", stuck.to_string())
    }
}

impl From<ReferenceError> for RpcError {
    fn from(error: ReferenceError) -> Self {
        let message = error.to_string();
        match error {
            ReferenceError::Dimension { what, .. } => Self::field(what, message),
            ReferenceError::Method => Self::field("settings.order", message),
            ReferenceError::TooShort { .. } => Self::field("q", message),
            ReferenceError::NotFinite { what, .. } => Self::field(what, message),
            ReferenceError::Linearization { step, ref error }
            | ReferenceError::Step { step, ref error } => {
                Self::precondition(step_error_reason(error), "q", message).with("step", step)
            }
            ReferenceError::Weights(error) => Self::from_weights(error, "projection", "stages"),
            ReferenceError::Regulator(error) => error.into(),
            ReferenceError::Initial(error) => Self::from_initial(error, "q"),
        }
    }
}

impl From<TooLarge> for RpcError {
    fn from(error: TooLarge) -> Self {
        Self::new(Code::ResourceExhausted, "LIMIT_EXCEEDED", error.to_string())
            .with("actual", error.entries)
    }
}

impl From<ContinuousError> for RpcError {
    fn from(error: ContinuousError) -> Self {
        let message = error.to_string();
        match error {
            ContinuousError::Dimension { name, .. } => Self::field(name, message),
            ContinuousError::NotFinite { name, index, .. } => {
                Self::field(format!("{name}[{index}]"), message)
            }
            ContinuousError::Overflow => Self::precondition("MOTION_NOT_FINITE", "q", message),
            ContinuousError::SingularMass { coordinate, .. } => {
                Self::precondition("SINGULAR", "q", message).with("coordinate", coordinate)
            }
            ContinuousError::SingularConstraints { constraint, .. } => {
                Self::precondition("SINGULAR_CONSTRAINTS", "q", message)
                    .with("constraints", constraint)
            }
            ContinuousError::TooLarge { entries } => {
                Self::new(Code::ResourceExhausted, "LIMIT_EXCEEDED", message)
                    .with("actual", entries)
            }
        }
    }
}

impl From<AnalysisError> for RpcError {
    fn from(error: AnalysisError) -> Self {
        let message = error.to_string();
        match error {
            AnalysisError::Pole { frequency_hz, .. } => {
                Self::precondition("POLE", "frequencies_hz", message)
                    .with("frequency_hz", frequency_hz)
            }
            AnalysisError::Frequency { .. } => Self::field("frequencies_hz", message),
            AnalysisError::Eigenvalues { .. } => {
                Self::precondition("EIGENVALUES_NOT_FOUND", "modes", message)
            }
            AnalysisError::NotFinite { .. } => {
                Self::precondition("MOTION_NOT_FINITE", "linearization", message)
            }
            // The server made the matrices, so a misfit among them is its own mistake.
            AnalysisError::Dimension { .. } => Self::internal(message),
        }
    }
}
