//! Codes and messages of what went wrong.

use std::ffi::{CStr, CString};

use plantd_client::link::{LinkError, StepFailure};

/// What a call came to, `enum plantd_status`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub enum Status {
    Ok = 0,
    Argument = 1,
    NotOpen = 2,
    LeaseHeld = 3,
    Timeout = 4,
    ServerGone = 5,
    ServerRestarted = 6,
    Closed = 7,
    LeaseLost = 8,
    Dimension = 9,
    Sequence = 10,
    InputNotFinite = 11,
    StepFailed = 12,
    Watchdog = 13,
    Refused = 14,
    Thread = 15,
    Panic = 16,
}

impl Status {
    pub(crate) fn name(number: i32) -> &'static CStr {
        const NAMES: [&CStr; 17] = [
            c"OK",
            c"ARGUMENT",
            c"NOT_OPEN",
            c"LEASE_HELD",
            c"TIMEOUT",
            c"SERVER_GONE",
            c"SERVER_RESTARTED",
            c"CLOSED",
            c"LEASE_LOST",
            c"DIMENSION",
            c"SEQUENCE",
            c"INPUT_NOT_FINITE",
            c"STEP_FAILED",
            c"WATCHDOG",
            c"REFUSED",
            c"THREAD",
            c"PANIC",
        ];
        usize::try_from(number).ok().and_then(|index| NAMES.get(index)).unwrap_or(&c"UNKNOWN")
    }
}

/// Why a call failed.
pub(crate) enum Failure {
    Argument(&'static str),
    Thread,
    Panic,
    Link(LinkError),
}

impl From<LinkError> for Failure {
    fn from(error: LinkError) -> Self {
        Self::Link(error)
    }
}

impl Failure {
    pub(crate) fn status(&self) -> Status {
        match self {
            Self::Argument(_) => Status::Argument,
            Self::Thread => Status::Thread,
            Self::Panic => Status::Panic,
            Self::Link(error) => match error {
                LinkError::Domain(_) => Status::NotOpen,
                LinkError::LeaseHeld { .. } => Status::LeaseHeld,
                LinkError::Timeout { .. } => Status::Timeout,
                LinkError::ServerGone { .. } => Status::ServerGone,
                LinkError::ServerRestarted => Status::ServerRestarted,
                LinkError::Closed { .. } => Status::Closed,
                LinkError::LeaseLost => Status::LeaseLost,
                LinkError::Dimension { .. } => Status::Dimension,
                LinkError::Sequence { .. } => Status::Sequence,
                LinkError::Step(StepFailure::InputNotFinite { .. }) => Status::InputNotFinite,
                LinkError::Step(StepFailure::Watchdog { .. }) => Status::Watchdog,
                LinkError::Step(_) => Status::StepFailed,
                LinkError::Refused { .. } => Status::Refused,
            },
        }
    }

    pub(crate) fn message(&self) -> CString {
        let message = match self {
            Self::Argument(what) => (*what).to_owned(),
            Self::Thread => "the link belongs to the thread that has opened it".to_owned(),
            Self::Panic => "the library has panicked; close the link".to_owned(),
            Self::Link(error) => error.to_string(),
        };
        CString::new(message.replace('\0', " ")).unwrap_or_default()
    }
}
