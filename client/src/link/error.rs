//! What can go wrong on the shared-memory link.

use std::time::Duration;

use plantd_proto::link::{Code, DomainError, Header, Holder};

/// Why a driver could not connect or step.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The shared-memory domain cannot be used, or the plant has no open link in it.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// Somebody else drives the plant.
    #[error("the plant is driven by {by}")]
    LeaseHeld {
        /// Who.
        by: LeaseHolder,
    },
    /// No answer in time; the server's process is alive. A step may still be taken.
    #[error("no answer from the server within {after:?}")]
    Timeout {
        /// How long it was waited.
        after: Duration,
    },
    /// The server's process is no more.
    #[error("the server (process {pid}) is gone")]
    ServerGone {
        /// Its process id.
        pid: u32,
    },
    /// Another server, or another opening of the link, answers in place of the one connected to.
    #[error("the server has restarted, or has reopened the link")]
    ServerRestarted,
    /// The server has closed the link.
    #[error("the server has closed the link{}", if *.is_deleted { ": the plant was deleted" } else { "" })]
    Closed {
        /// The plant was deleted.
        is_deleted: bool,
    },
    /// The server has taken the lease back.
    #[error("the server has taken the lease back")]
    LeaseLost,
    /// The input has the wrong length. The plant is as it was.
    #[error("the input has {actual} entries; {expected} are needed")]
    Dimension {
        /// Needed entries, ni + nk.
        expected: usize,
        /// Entries given.
        actual: usize,
    },
    /// An input was lost or came twice. The plant is as it was; the next step goes on.
    #[error("an input was lost on the way; number {expected} was expected")]
    Sequence {
        /// Number of the input that the server expected.
        expected: u64,
    },
    /// The step failed. The plant is as it was; the next step goes on.
    #[error(transparent)]
    Step(#[from] StepFailure),
    /// The server refused a message for a reason that a driver of this version never causes.
    #[error("the server refused a message (code {code})")]
    Refused {
        /// The code in the header.
        code: u32,
    },
}

/// Why a step failed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum StepFailure {
    /// An entry of the input is NaN or infinite.
    #[error("input {index} is {value}")]
    InputNotFinite {
        /// Which entry.
        index: usize,
        /// Its value.
        value: f64,
    },
    /// The solver did not reach the round-off level.
    #[error(
        "no convergence after {iterations} iterations: residual is {residual:e} times round-off"
    )]
    NotConverged {
        /// Residual evaluations.
        iterations: u32,
        /// Residual in units of its own round-off.
        residual: f64,
    },
    /// The iteration left the finite numbers.
    #[error("the motion left the finite numbers after {iterations} iterations")]
    NotFinite {
        /// Residual evaluations.
        iterations: u32,
    },
    /// The Newton matrix is singular.
    #[error(
        "singular Newton matrix at coordinate {coordinate} (pivot {pivot:e} of the largest entry)"
    )]
    Singular {
        /// Index of the coordinate.
        coordinate: usize,
        /// Pivot relative to the largest entry.
        pivot: f64,
    },
    /// A joint turned by more than half a turn.
    #[error(
        "coordinate {coordinate} turned by {increment:.3} rad in one step; the step is too large for the motion"
    )]
    TooFast {
        /// Index of the coordinate.
        coordinate: usize,
        /// Its increment, rad.
        increment: f64,
    },
    /// Constraint equations lost their independence.
    #[error(
        "singular constraints: {count}, the first is equation {constraint} (reciprocal condition {reciprocal_condition:e})"
    )]
    SingularConstraints {
        /// Index of the first equation concerned.
        constraint: usize,
        /// How many are concerned.
        count: usize,
        /// Reciprocal condition.
        reciprocal_condition: f64,
    },
    /// Constraint equations contradict each other.
    #[error(
        "{count} constraints, the first of them equation {constraint}, contradict each other by {violation:e}"
    )]
    InconsistentConstraints {
        /// Index of the first equation concerned.
        constraint: usize,
        /// How many are concerned.
        count: usize,
        /// Largest violation.
        violation: f64,
    },
    /// A watchdog holds the plant.
    #[error(
        "watchdog {watchdog} holds the plant: {quantity} is {value}, beyond the bound {bound}; Run lets it go \
         on, Reset and Restore put it elsewhere, SetSafety sets other bounds"
    )]
    Watchdog {
        /// Index of the watchdog.
        watchdog: usize,
        /// What it looks at.
        quantity: Guarded,
        /// Value of that.
        value: f64,
        /// Bound that it left.
        bound: f64,
    },
}

/// What a watchdog looks at. The link has no room for names: they are in the order of the plant's model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guarded {
    /// A coordinate.
    Coordinate(usize),
    /// The mean velocity of a coordinate over the last step.
    Velocity(usize),
    /// The force of a constraint equation.
    Force(usize),
    /// Kinetic and potential energy.
    Energy,
    /// The server does not tell.
    Unknown,
}

impl Guarded {
    /// What `detail_b` of the failure says.
    fn from_number(number: u64) -> Self {
        let Some(code) = number.checked_sub(1) else { return Self::Unknown };
        let index = (code & u64::from(u32::MAX)) as usize;
        match code >> 32 {
            0 => Self::Coordinate(index),
            1 => Self::Velocity(index),
            2 => Self::Force(index),
            3 => Self::Energy,
            _ => Self::Unknown,
        }
    }
}

impl std::fmt::Display for Guarded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Coordinate(index) => write!(f, "coordinate {index}"),
            Self::Velocity(index) => write!(f, "the velocity of coordinate {index}"),
            Self::Force(index) => write!(f, "the force of constraint equation {index}"),
            Self::Energy => f.write_str("the energy"),
            Self::Unknown => f.write_str("its quantity"),
        }
    }
}

/// Who drives a plant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeaseHolder {
    /// A call of `Step` that is under way.
    Step,
    /// A `Drive` stream.
    Drive,
    /// A driver over shared memory.
    Link {
        /// Its process id.
        pid: u32,
    },
    /// A kind of driver that this version does not know.
    Unknown,
}

impl std::fmt::Display for LeaseHolder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Step => f.write_str("a call of Step"),
            Self::Drive => f.write_str("a Drive stream"),
            Self::Link { pid } => write!(f, "process {pid} over shared memory"),
            Self::Unknown => f.write_str("somebody else"),
        }
    }
}

/// The error that a failure message speaks of.
pub(crate) fn from_failure(answer: &Header) -> LinkError {
    let (a, b) = (answer.detail_a as usize, answer.detail_b as usize);
    let (value, iterations) = (answer.detail_value, answer.iterations);
    let step = match Code::from_number(answer.code) {
        Some(Code::InputNotFinite) => StepFailure::InputNotFinite { index: a, value },
        Some(Code::NotConverged) => {
            StepFailure::NotConverged { iterations, residual: answer.residual }
        }
        Some(Code::NotFinite) => StepFailure::NotFinite { iterations },
        Some(Code::Singular) => StepFailure::Singular { coordinate: a, pivot: value },
        Some(Code::TooFast) => StepFailure::TooFast { coordinate: a, increment: value },
        Some(Code::SingularConstraints) => StepFailure::SingularConstraints {
            constraint: a,
            count: b,
            reciprocal_condition: value,
        },
        Some(Code::InconsistentConstraints) => {
            StepFailure::InconsistentConstraints { constraint: a, count: b, violation: value }
        }
        Some(Code::Watchdog) => StepFailure::Watchdog {
            watchdog: a,
            quantity: Guarded::from_number(answer.detail_b),
            value,
            bound: answer.residual,
        },
        Some(Code::Dimension) => return LinkError::Dimension { expected: a, actual: b },
        Some(Code::Sequence) => return LinkError::Sequence { expected: answer.detail_a },
        Some(Code::LeaseHeld) => return LinkError::LeaseHeld { by: holder(answer) },
        Some(Code::NotAttached) => return LinkError::LeaseLost,
        Some(Code::PlantDeleted) => return LinkError::Closed { is_deleted: true },
        Some(Code::LinkClosed) => return LinkError::Closed { is_deleted: false },
        Some(Code::Layout | Code::Kind) | None => {
            return LinkError::Refused { code: answer.code };
        }
    };
    LinkError::Step(step)
}

fn holder(answer: &Header) -> LeaseHolder {
    match u32::try_from(answer.detail_a).ok().and_then(Holder::from_number) {
        Some(Holder::Step) => LeaseHolder::Step,
        Some(Holder::Drive) => LeaseHolder::Drive,
        Some(Holder::Link) => LeaseHolder::Link { pid: answer.detail_b as u32 },
        None => LeaseHolder::Unknown,
    }
}
