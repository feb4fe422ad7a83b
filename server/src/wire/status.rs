//! The one place where errors become statuses.
//!
//! Every error status carries `google.rpc.ErrorInfo` with domain `plantd` and one of the reasons
//! below; failures inside a stream carry the same code and reason in `plantd.v1.Failure`.
//!
//! | code | reason | further details | when |
//! | --- | --- | --- | --- |
//! | INVALID_ARGUMENT | `INVALID_FIELD` | BadRequest | a field is missing, malformed, of wrong size, not finite, or names an unknown coordinate or operating point |
//! | INVALID_ARGUMENT | `INVALID_SCENE` | BadRequest, one entry per error of the scene while they fit a trailer | a scene does not compile |
//! | INVALID_ARGUMENT | `INPUT_DIMENSION`, `INPUT_NOT_FINITE` | BadRequest | the input of a step |
//! | INVALID_ARGUMENT | `OFF_CONSTRAINT`, `DEGENERATE`, `PROJECTION_FAILED` | BadRequest | an initial configuration cannot satisfy the constraints |
//! | INVALID_ARGUMENT | `TOLERANCE_OUT_OF_REACH` | BadRequest | no order and substeps reach the tolerance of a plant |
//! | INVALID_ARGUMENT | `NOT_SETTLED` | BadRequest | no equilibrium was found from a guess |
//! | INVALID_ARGUMENT | `INVALID_SNAPSHOT`, `SNAPSHOT_MISMATCH` | BadRequest | damaged, or of another model or other settings |
//! | INVALID_ARGUMENT | `INVALID_WEIGHT` | BadRequest | a weight has the wrong size or definiteness |
//! | INVALID_ARGUMENT | `INVALID_COVARIANCE` | BadRequest | a covariance of noise has the wrong size or definiteness |
//! | INVALID_ARGUMENT | `PROTOCOL` | | a Drive stream does not begin with `open`, or opens twice; or the bytes of a long message are none that the method takes |
//! | NOT_FOUND | `MODEL_NOT_FOUND`, `PLANT_NOT_FOUND`, `PLANT_DELETED`, `FAULT_NOT_FOUND`, `RECORDING_NOT_FOUND` | ResourceInfo | no such thing, or deleted meanwhile |
//! | ALREADY_EXISTS | `MODEL_EXISTS`, `PLANT_EXISTS`, `RECORDING_EXISTS` | ResourceInfo | the name is taken |
//! | FAILED_PRECONDITION | `PLANT_ELSEWHERE` | PreconditionFailure; metadata `address` | the plant has gone to the server at that address |
//! | FAILED_PRECONDITION | `MOVED_ON` | PreconditionFailure; metadata `step` | the plant is not at the step at which it was to be deleted |
//! | FAILED_PRECONDITION | `OTHER_BUILD` | PreconditionFailure; metadata `record`, `server` | a record is of another build, whose motions have other bits |
//! | FAILED_PRECONDITION | `LEASE_HELD` | PreconditionFailure; metadata `driver` | somebody else drives the plant |
//! | FAILED_PRECONDITION | `LEASE_LOST` | PreconditionFailure | the lease that a driver wants to go on with has ended |
//! | FAILED_PRECONDITION | `RUNNING`, `PAUSED` | PreconditionFailure | the plant runs by itself, or is paused |
//! | FAILED_PRECONDITION | `WATCHDOG`, `INPUT_LOST` | PreconditionFailure; metadata of `WATCHDOG`: `quantity`, `value`, `bound`, `step` | the plant stands still because it left bounds, or had no valid input |
//! | ABORTED | `LEASE_REVOKED` | | a watchdog has taken the lease away, or its driver goes on with it in another stream |
//! | UNAVAILABLE | `LOOP_FAILED` | | the system gave no thread for plants that run |
//! | FAILED_PRECONDITION | `BUILTIN_MODEL` | PreconditionFailure | built-in models cannot be deleted |
//! | FAILED_PRECONDITION | `NOT_CONVERGED`, `MOTION_NOT_FINITE`, `TOO_FAST`, `SINGULAR`, `SINGULAR_CONSTRAINTS`, `INCONSISTENT_CONSTRAINTS` | PreconditionFailure; metadata `steps_taken`, `constraints` | the step has no solution; the plant stays at the last good state |
//! | FAILED_PRECONDITION | `TOO_MANY_STEPS` | PreconditionFailure | second derivatives of a period of so many substeps take too much memory |
//! | FAILED_PRECONDITION | `NOT_AN_EQUILIBRIUM` | PreconditionFailure; metadata `drift`, `coordinate` | the point of an infinite-horizon regulator moves |
//! | FAILED_PRECONDITION | `NOT_STABILISABLE`, `NOT_DETECTABLE`, `NOT_CONVEX`, `RICCATI_NOT_CONVERGED`, `RICCATI_OVERFLOW`, `EIGENVALUES_NOT_FOUND` | PreconditionFailure | there is no such regulator |
//! | FAILED_PRECONDITION | `NOT_EXCITED` | PreconditionFailure | a filter would stop listening: no process noise reaches a mode that does not decay |
//! | FAILED_PRECONDITION | `MAX_ITERATIONS`, `NO_DESCENT`, `NOT_CONVEX`, `BOUNDS_NOT_MET` | in the result of an optimisation | the search got stuck |
//! | FAILED_PRECONDITION | `INFEASIBLE_REFERENCE` | PreconditionFailure; metadata `unexplained_acceleration`, `unexplained_coordinate`, `unexplained_step`, `constraint_violation`, `constraint_violation_step` | a reference is no motion of the plant, and `strict` was asked for |
//! | FAILED_PRECONDITION | `NO_FEEDBACK` | PreconditionFailure | the plant has no feedback whose gains could be watched |
//! | FAILED_PRECONDITION | `PARAMETERS_SCHEDULED` | PreconditionFailure | faults of the plant change its parameters: clear them first |
//! | FAILED_PRECONDITION | `START_PASSED` | PreconditionFailure; metadata `start_step`, `step` | a fault was to begin at a step that the plant has left behind |
//! | FAILED_PRECONDITION | `TIME_STEP_CHANGED` | PreconditionFailure | the trajectory of a feedback was given for another time step: set a new one |
//! | FAILED_PRECONDITION | `POLE` | PreconditionFailure; metadata `frequency_hz` | the frequency response is infinite |
//! | FAILED_PRECONDITION | `LINK_DISABLED` | PreconditionFailure | the server runs without shared memory |
//! | FAILED_PRECONDITION | `RECORDINGS_DISABLED` | PreconditionFailure | the server has no directory for recordings |
//! | FAILED_PRECONDITION | `RECORDING_ACTIVE` | PreconditionFailure | the plant is being recorded, or the recording is in progress |
//! | PERMISSION_DENIED | `FOREIGN_HOST`, `FOREIGN_ORIGIN` | | with HTTP status 403: the request comes from a page of a stranger, see [`crate::wire::names`] |
//! | UNAUTHENTICATED | `NO_CREDENTIALS`, `TOKEN_UNKNOWN`, `CERTIFICATE_UNKNOWN`, `USER_UNKNOWN` | | the server wants to know who calls, and does not |
//! | UNAUTHENTICATED | `GATEWAY_HEADER` | | a gateway speaks for somebody, in a header that cannot be used |
//! | UNAUTHENTICATED | `CREDENTIALS_EXPIRED`, `CREDENTIALS_REVOKED` | | token or certificate are not in force any more; open streams end so |
//! | PERMISSION_DENIED | `ROLE` | | the caller is known, and may not do this, see [`crate::wire::edge::auth`] |
//! | RESOURCE_EXHAUSTED | `LIMIT_EXCEEDED` | QuotaFailure; metadata `limit`, `value`, `actual` | a limit of the server, see [`crate::core::limits`], or `tenant.NAME`, one of the caller's tenant |
//! | UNAVAILABLE | `SHUTTING_DOWN` | | the server ends; try again |
//! | UNAVAILABLE | `LINK_FAILED` | | shared memory could not be set up |
//! | UNAVAILABLE | `RECORDING_FAILED` | | a recording's file could not be read or written |
//! | CANCELLED | `CANCELLED` | | the caller has gone away |
//! | INTERNAL | `INTERNAL` | | a defect of the server |

use std::collections::HashMap;

use plantd_models::SceneError;
use plantd_models::scene::UnknownName;
use plantd_proto::v1;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::core::limits::LimitExceeded;
use crate::core::plant::error::DriveError;
use crate::core::plant::watchdog::{Quantity, Trip};
use crate::core::session::lease::LeaseHeld;
use crate::core::session::shared::Session;

/// Longest text of one message, name or description, bytes. Statuses travel in trailers, of which
/// clients accept about 8 KiB.
const MAX_TEXT_BYTES: usize = 400;
/// Longest text of all errors of a scene together, bytes.
const MAX_PROBLEM_BYTES: usize = 3000;

/// The domain of every `google.rpc.ErrorInfo`.
pub const ERROR_DOMAIN: &str = "plantd";

/// An error on its way to a client.
#[derive(Clone, Debug)]
pub struct RpcError {
    code: Code,
    reason: &'static str,
    message: String,
    // Boxed: most results are good, and should not be moved about with room for this.
    extra: Box<Extra>,
}

#[derive(Clone, Debug)]
struct Extra {
    metadata: HashMap<String, String>,
    details: ErrorDetails,
}

impl RpcError {
    /// A fault without further details.
    pub fn new(code: Code, reason: &'static str, message: impl Into<String>) -> Self {
        Self {
            code,
            reason,
            message: shortened(message),
            extra: Box::new(Extra { metadata: HashMap::new(), details: ErrorDetails::new() }),
        }
    }

    /// A bad field of the request.
    pub fn field(field: impl Into<String>, description: impl Into<String>) -> Self {
        Self::field_because("INVALID_FIELD", field, description)
    }

    pub(super) fn field_because(
        reason: &'static str,
        field: impl Into<String>,
        description: impl Into<String>,
    ) -> Self {
        let (field, description) = (shortened(field), shortened(description));
        let mut fault = Self::new(Code::InvalidArgument, reason, format!("{field}: {description}"));
        fault.extra.details.add_bad_request_violation(field, description);
        fault
    }

    /// There is no such model.
    pub fn model_not_found(name: &str, message: &str) -> Self {
        Self::resource_because(Code::NotFound, "MODEL_NOT_FOUND", "model", name, message)
    }

    /// The plant has no such fault.
    pub fn fault_not_found(id: u64) -> Self {
        let (reason, sentence) = ("FAULT_NOT_FOUND", "there is no fault");
        Self::resource(Code::NotFound, reason, "fault", &id.to_string(), sentence)
    }

    /// There is no such plant.
    pub fn plant_not_found(id: &UnknownName) -> Self {
        let message = format!("there is no plant {id}");
        Self::resource_because(Code::NotFound, "PLANT_NOT_FOUND", "plant", &id.name, &message)
    }

    /// The plant was closed while it was used: it goes on elsewhere, or was deleted.
    pub fn closed(session: &Session) -> Self {
        match session.moved_to() {
            Some(address) => Self::plant_elsewhere(session.id(), address),
            None => Self::plant_deleted(session.id()),
        }
    }

    /// The plant has gone to another server.
    pub fn plant_elsewhere(id: &str, address: &str) -> Self {
        let id = shortened(id);
        let message = format!("plant `{id}` is on another server now, {address}");
        Self::precondition("PLANT_ELSEWHERE", id, message).with("address", address)
    }

    /// The server is about to end.
    pub fn draining(name: &str) -> Self {
        let message = format!("server `{name}` is about to end and takes nothing new: ask another");
        Self::new(Code::Unavailable, "DRAINING", message)
    }

    /// The plant was deleted while it was used.
    pub fn plant_deleted(id: &str) -> Self {
        Self::resource(Code::NotFound, "PLANT_DELETED", "plant", id, "deleted meanwhile: plant")
    }

    /// A model's name is taken.
    pub fn model_exists(name: &str) -> Self {
        Self::resource(
            Code::AlreadyExists,
            "MODEL_EXISTS",
            "model",
            name,
            "there already is a model",
        )
    }

    /// A plant's id is taken.
    pub fn plant_exists(id: &str) -> Self {
        Self::resource(Code::AlreadyExists, "PLANT_EXISTS", "plant", id, "there already is a plant")
    }

    /// The store that servers share does not answer, or not as it should.
    pub fn store_failed(error: &dyn std::fmt::Display) -> Self {
        Self::new(Code::Unavailable, "STORE_FAILED", format!("the object store: {error}"))
    }

    /// There is no such recording.
    pub fn recording_not_found(name: &str) -> Self {
        let (reason, sentence) = ("RECORDING_NOT_FOUND", "there is no recording");
        Self::resource(Code::NotFound, reason, "recording", name, sentence)
    }

    /// A recording's name is taken.
    pub fn recording_exists(name: &str) -> Self {
        let (reason, sentence) = ("RECORDING_EXISTS", "there already is a recording");
        Self::resource(Code::AlreadyExists, reason, "recording", name, sentence)
    }

    /// A recording is in progress.
    pub fn recording_active(subject: String) -> Self {
        let message = "a recording is in progress: end it first";
        Self::precondition("RECORDING_ACTIVE", subject, message)
    }

    fn resource(
        code: Code,
        reason: &'static str,
        kind: &'static str,
        name: &str,
        sentence: &'static str,
    ) -> Self {
        Self::resource_because(
            code,
            reason,
            kind,
            name,
            &format!("{sentence} `{}`", shortened(name)),
        )
    }

    fn resource_because(
        code: Code,
        reason: &'static str,
        kind: &'static str,
        name: &str,
        message: &str,
    ) -> Self {
        let (name, message) = (shortened(name), shortened(message));
        let mut fault = Self::new(code, reason, message.clone());
        fault.extra.details.set_resource_info(kind, name, "", message);
        fault
    }

    /// Something is not in the state that the call needs.
    pub fn precondition(
        reason: &'static str,
        subject: impl Into<String>,
        message: impl Into<String>,
    ) -> Self {
        let message = shortened(message);
        let mut fault = Self::new(Code::FailedPrecondition, reason, message.clone());
        let subject = shortened(subject);
        fault.extra.details.add_precondition_failure_violation(reason, subject, message);
        fault
    }

    /// The plant has no feedback.
    pub fn no_feedback(id: &str) -> Self {
        let message = format!("plant `{id}` has no feedback; SetFeedback gives it one");
        Self::precondition("NO_FEEDBACK", format!("plant:{id}"), message)
    }

    /// Faults change the parameters of the plant.
    pub fn parameters_scheduled(id: &str) -> Self {
        let message = format!("faults of plant `{id}` change its parameters; ClearFault ends them");
        Self::precondition("PARAMETERS_SCHEDULED", format!("plant:{id}"), message)
    }

    /// A fault was to begin before the step at which the plant is.
    pub fn start_passed(start: u64, step: u64) -> Self {
        let message = format!(
            "the fault was to begin at step {start}, and the plant is at step {step}: give a later start, \
             or none to begin with the next step, or reset the plant first"
        );
        Self::precondition("START_PASSED", "fault.start", message)
            .with("start_step", start)
            .with("step", step)
    }

    /// The server ends.
    pub fn shutting_down() -> Self {
        Self::new(Code::Unavailable, "SHUTTING_DOWN", "the server is shutting down")
    }

    /// Nobody waits for the result.
    pub fn cancelled() -> Self {
        Self::new(Code::Cancelled, "CANCELLED", "the caller has gone away")
    }

    /// A defect of the server.
    pub fn internal(message: impl Into<String>) -> Self {
        Self::new(Code::Internal, "INTERNAL", message)
    }

    /// Adds an entry to the metadata of `ErrorInfo`.
    pub fn with(mut self, key: &str, value: impl ToString) -> Self {
        self.extra.metadata.insert(key.to_owned(), shortened(value.to_string()));
        self
    }

    /// The reason.
    pub fn reason(&self) -> &'static str {
        self.reason
    }

    /// What is wrong, in words.
    pub fn message(&self) -> &str {
        &self.message
    }

    /// What `with` has added under a name.
    pub fn detail(&self, name: &str) -> Option<&str> {
        self.extra.metadata.get(name).map(String::as_str)
    }
}

/// The text, cut to [`MAX_TEXT_BYTES`].
fn shortened(text: impl Into<String>) -> String {
    let mut text = text.into();
    if text.len() > MAX_TEXT_BYTES {
        text.truncate(text.floor_char_boundary(MAX_TEXT_BYTES - 3));
        text.push_str("...");
    }
    text
}

impl From<RpcError> for Status {
    fn from(fault: RpcError) -> Self {
        let Extra { metadata, mut details } = *fault.extra;
        details.set_error_info(fault.reason, ERROR_DOMAIN, metadata);
        Self::with_error_details(fault.code, fault.message, details)
    }
}

impl From<RpcError> for v1::Failure {
    fn from(fault: RpcError) -> Self {
        Self { code: fault.code as i32, message: fault.message, reason: fault.reason.to_owned() }
    }
}

impl From<SceneError> for RpcError {
    fn from(error: SceneError) -> Self {
        let count = error.problems.len();
        let first = error
            .problems
            .first()
            .map(|problem| format!("{}: {}", problem.path, problem.message))
            .unwrap_or_default();
        let message = match count {
            0 | 1 => format!("the scene has an error: {first}"),
            _ => format!("the scene has {count} errors; the first: {first}"),
        };
        let mut fault = Self::new(Code::InvalidArgument, "INVALID_SCENE", message);
        let mut bytes = 0;
        for (index, problem) in error.problems.into_iter().enumerate() {
            let (path, message) = (shortened(problem.path), shortened(problem.message));
            bytes += path.len() + message.len();
            if bytes > MAX_PROBLEM_BYTES && index > 0 {
                let rest = format!("{} more; ValidateScene lists all", count - index);
                fault.extra.details.add_bad_request_violation("...", rest);
                break;
            }
            fault.extra.details.add_bad_request_violation(path, message);
        }
        fault
    }
}

impl From<LimitExceeded> for RpcError {
    fn from(error: LimitExceeded) -> Self {
        let mut fault = Self::new(Code::ResourceExhausted, "LIMIT_EXCEEDED", error.to_string())
            .with("limit", error.name)
            .with("value", error.limit)
            .with("actual", error.actual);
        fault
            .extra
            .details
            .add_quota_failure_violation(format!("limit:{}", error.name), error.to_string());
        fault
    }
}

impl From<LeaseHeld> for RpcError {
    fn from(error: LeaseHeld) -> Self {
        Self::precondition("LEASE_HELD", "plant", error.to_string())
            .with("driver", error.by.as_str())
    }
}

impl RpcError {
    /// The fault of a lease's operation on a plant.
    pub fn from_drive(error: DriveError, session: &Session) -> Self {
        let id = session.id();
        match error {
            DriveError::Closed => Self::closed(session),
            DriveError::Step(error) => error.into(),
            DriveError::Running => Self::running(id),
            DriveError::Paused | DriveError::NotDue(_) => {
                Self::precondition("PAUSED", id, format!("plant `{id}` is paused"))
            }
            DriveError::Frozen(trip) => Self::watchdog(session, &trip),
            DriveError::Revoked => {
                let why = format!(
                    "the lease of plant `{id}` was taken away, by a watchdog or by its own driver"
                );
                Self::new(Code::Aborted, "LEASE_REVOKED", why)
            }
        }
    }

    /// The plant takes its steps in a loop of its own.
    pub fn running(id: &str) -> Self {
        let why = format!("plant `{id}` runs by itself: pause it first");
        Self::precondition("RUNNING", id, why)
    }

    /// A watchdog has stopped the plant.
    pub fn watchdog(session: &Session, trip: &Trip) -> Self {
        let (id, Trip { watchdog, value, step, .. }) = (session.id(), *trip);
        let quantity = Quantity::name(trip.dog.quantity.code(), session.model());
        let (bound, relation) =
            (trip.bound(), if value < trip.dog.min { "below" } else { "above" });
        let why = format!(
            "watchdog {watchdog} has stopped plant `{id}` at step {step}: {quantity} is {value}, {relation} \
             its bound {bound}; Run lets it go on from there, Reset and Restore put it elsewhere, SetSafety \
             sets other bounds"
        );
        Self::precondition("WATCHDOG", id, why)
            .with("quantity", quantity)
            .with("value", value)
            .with("bound", bound)
            .with("step", step)
    }

    /// The plant was to stop without a valid input.
    pub fn input_lost(id: &str) -> Self {
        let why = format!("plant `{id}` has no valid input, and was to stop then");
        Self::precondition("INPUT_LOST", id, why)
    }
}

#[cfg(test)]
mod tests {
    use plantd_models::{Problem, StepError};
    use tonic_types::StatusExt as _;

    use super::*;

    #[test]
    fn every_problem_of_a_scene_is_a_violation() {
        let problem = |path: &str| Problem { path: path.to_owned(), message: "bad".to_owned() };
        let error =
            SceneError { problems: vec![problem("frames[0].body.mass"), problem("gravity")] };
        let status = Status::from(RpcError::from(error));
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = status.get_error_details();
        let fields: Vec<_> = details
            .bad_request()
            .unwrap()
            .field_violations
            .iter()
            .map(|violation| violation.field.as_str())
            .collect();
        assert_eq!(fields, ["frames[0].body.mass", "gravity"]);
        let info = details.error_info().unwrap();
        assert_eq!((info.reason.as_str(), info.domain.as_str()), ("INVALID_SCENE", "plantd"));
    }

    #[test]
    fn statuses_stay_small_whatever_the_request_says() {
        let problem = |i| Problem { path: format!("frames[{i}]"), message: "x".repeat(1000) };
        let faults = [
            RpcError::from(SceneError { problems: (0..5000).map(problem).collect() }),
            RpcError::model_not_found(&"ü".repeat(1_000_000), &"ü".repeat(1_000_000)),
            RpcError::field("f".repeat(100_000), "d".repeat(100_000)),
        ];
        for fault in faults {
            let status = Status::from(fault);
            assert!(status.message().len() + status.details().len() < 5500);
        }
        let problems = (0..5000).map(problem).collect();
        let details = Status::from(RpcError::from(SceneError { problems })).get_error_details();
        let last = details.bad_request().unwrap().field_violations.last().unwrap().clone();
        assert_eq!(last.description, "4993 more; ValidateScene lists all");
    }

    #[test]
    fn a_limit_names_itself_and_its_value() {
        let error = LimitExceeded::check("plants", 2, "plants", 3).unwrap_err();
        let status = Status::from(RpcError::from(error));
        assert_eq!(status.code(), Code::ResourceExhausted);
        let details = status.get_error_details();
        assert_eq!(details.error_info().unwrap().metadata["limit"], "plants");
        assert_eq!(details.quota_failure().unwrap().violations.len(), 1);
    }

    #[test]
    fn failures_in_a_stream_carry_the_same_code_and_reason() {
        let failure = v1::Failure::from(RpcError::from(StepError::NotFinite { iterations: 3 }));
        assert_eq!(failure.code, Code::FailedPrecondition as i32);
        assert_eq!(failure.reason, "MOTION_NOT_FINITE");
    }
}
