//! What can go wrong, with the details that the server sends.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use plantd_proto::v1;
use tonic::Code;
use tonic_types::StatusExt as _;

/// Result of everything that talks to a server.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a call did not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The address is neither `http://host:port` nor `unix:/path`.
    #[error(
        "`{address}` is not an address: {problem}; write http://host:port, https://host:port or unix:/path"
    )]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// The client's token, certificate, key or CA cannot be used.
    #[error("`{what}` cannot be used: {problem}")]
    Credentials {
        /// Which of them.
        what: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// There is no server at the address.
    #[error("cannot connect to {address}: {problem}")]
    Connect {
        /// Where.
        address: String,
        /// Why not.
        problem: ConnectProblem,
    },
    /// The call was refused or failed, or a stream ended with an error.
    #[error("{0}")]
    Rpc(Box<Refusal>),
    /// One step of a [`Driver`](crate::Driver) was refused or failed. The plant is where it was
    /// and the driver goes on.
    #[error("step not taken: {0}")]
    Step(Box<Refusal>),
    /// The server came back with an earlier state than it had shown: the steps in between are lost. The driver
    /// goes on from there.
    #[error("the plant was rolled back: step {from} had been reached, the server is at step {to}")]
    RolledBack {
        /// The last step that was seen.
        from: u64,
        /// The step at which the plant is.
        to: u64,
    },
    /// Somebody else has stepped the plant while its driver was away. The driver goes on from there.
    #[error("the plant was at step {from} when its driver lost it, and is at step {to}")]
    SteppedByOthers {
        /// The last step that was seen.
        from: u64,
        /// The step at which the plant is.
        to: u64,
    },
    /// The server ended a stream that should have gone on.
    #[error("the server closed the stream")]
    StreamClosed,
    /// A feedback law was asked about a state of another plant.
    #[error("the state has {actual} entries; the gain is for {expected}")]
    StateLength {
        /// Entries that the law's references have.
        expected: usize,
        /// Entries of the state.
        actual: usize,
    },
    /// A gain was computed for a plant of another model.
    #[error("the gain is for model `{expected}`, the plant is one of `{actual}`")]
    GainModel {
        /// Model of the gain.
        expected: String,
        /// Model of the plant.
        actual: String,
    },
    /// A gain was computed for a plant of another time step.
    #[error("the gain is for time step {expected} s, that of the plant is {actual} s")]
    GainTimeStep {
        /// Time step of the gain, s.
        expected: f64,
        /// Time step of the plant, s.
        actual: f64,
    },
    /// A feedback law was asked about a step whose gain the server no longer sends.
    #[error("the plant has left step {step} behind: its gains begin at step {first}")]
    GainPassed {
        /// The step.
        step: u64,
        /// The first step that has a gain.
        first: u64,
    },
    /// Gains from which no feedback law can be made.
    #[error("these gains make no schedule: {0}")]
    Gains(&'static str),
    /// A recording's file cannot be read, or is damaged.
    #[error("recording {}: {problem}", .path.display())]
    Recording {
        /// File.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The server sent something that the contract does not allow: versions do not fit.
    #[error("unexpected answer from the server: {0}")]
    Protocol(&'static str),
}

/// Why there is no connection, and what helps.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConnectProblem {
    /// The host is there, the port is closed.
    #[error(
        "connection refused: no server listens there; is plantd running, and is this its port?"
    )]
    Refused,
    /// There is no file at the socket's path.
    #[error("there is no such socket; plantd makes it when it starts, with `--unix` and this path")]
    NoSocket,
    /// The file at the socket's path is something else.
    #[error("there is a file of that name, but it is no socket")]
    NotASocket,
    /// The socket was left behind.
    #[error("connection refused: the server of this socket has ended; start it again")]
    DeadSocket,
    /// The socket is not for this user.
    #[error(
        "permission denied: to write to the socket you have to be its owner or in its group, unless the \
         server's `unix_mode` says otherwise"
    )]
    Denied,
    /// The name of the host is unknown.
    #[error(
        "there is no host of that name; is it spelt right? A number such as 127.0.0.1 will do too"
    )]
    UnknownHost,
    /// Nothing came back.
    #[error(
        "no answer within {} s; is the host right and running, and does a firewall keep the port closed?",
        .0.as_secs_f64()
    )]
    TimedOut(std::time::Duration),
    /// There is a server, but it says nothing.
    #[error(
        "somebody accepts the connection, but does not answer within {} s: it is no plantd, or has no \
         room for more connections (its limit `connections`)",
        .0.as_secs_f64()
    )]
    Silent(std::time::Duration),
    /// The client does not trust who issued the server's certificate.
    #[error(
        "this client refuses the server: its certificate was issued by nobody that the client trusts; is \
         `ca` the server's CA?"
    )]
    UnknownAuthority,
    /// The server's certificate is another host's.
    #[error(
        "this client refuses the server: its certificate is not for the host in the address; write the name \
         that it is for"
    )]
    WrongName,
    /// There is something else wrong with the server's certificate.
    #[error("this client refuses the server's certificate: {0}")]
    BadCertificate(String),
    /// The server wants to see a certificate.
    #[error(
        "the server refuses this client: it lets in only those with a certificate; give `cert` and `key`"
    )]
    CertificateNeeded,
    /// The server does not like the client's certificate.
    #[error(
        "the server refuses this client's certificate ({0}): is it in date, and did a CA issue it that the \
         server trusts?"
    )]
    CertificateRefused(String),
    /// There is no TLS at the other end.
    #[error("what answers there does not speak TLS: write http:// in place of https://")]
    NoTls,
    /// There is a server, of something else.
    #[error(
        "what answers there does not speak gRPC without TLS ({0}); is this the port of plantd's gRPC, and \
         not that of its metrics or of another server? One with TLS is at https://"
    )]
    NotGrpc(String),
    /// Something else.
    #[error("{0}")]
    Other(String),
}

impl Error {
    /// What the server said, if it was the server that refused.
    pub fn refusal(&self) -> Option<&Refusal> {
        match self {
            Self::Rpc(refusal) | Self::Step(refusal) => Some(refusal),
            _ => None,
        }
    }

    /// The gRPC code, if the server refused.
    pub fn code(&self) -> Option<Code> {
        self.refusal().map(|refusal| refusal.code)
    }

    /// The upper-case reason such as `LEASE_HELD`, or the empty string if there is none.
    pub fn reason(&self) -> &str {
        self.refusal().map_or("", |refusal| &refusal.reason)
    }

    /// The address of the server to which the plant has gone, if that is why this one refused.
    pub fn elsewhere(&self) -> Option<&str> {
        let refusal = self.refusal().filter(|refusal| refusal.reason == "PLANT_ELSEWHERE")?;
        refusal.metadata.get("address").map(String::as_str)
    }

    /// What is wrong with the request, each with its path; empty if it was not the request.
    pub fn violations(&self) -> &[Violation] {
        self.refusal().map_or(&[], |refusal| &refusal.violations)
    }
}

impl From<tonic::Status> for Error {
    fn from(status: tonic::Status) -> Self {
        Self::Rpc(Box::new(Refusal::from(&status)))
    }
}

/// The server's `no`: a gRPC status with its `google.rpc` details.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// gRPC code.
    pub code: Code,
    /// A sentence that names the culprit.
    pub message: String,
    /// Upper-case reason (`google.rpc.ErrorInfo`), or empty.
    pub reason: String,
    /// What is wrong with the request (`google.rpc.BadRequest`).
    pub violations: Vec<Violation>,
    /// What else belongs to the reason, such as the `address` of `PLANT_ELSEWHERE`.
    pub metadata: BTreeMap<String, String>,
}

/// One thing that is wrong with a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Violation {
    /// Path of the field, for example `frames[3].body.mass` in a scene.
    pub field: String,
    /// What is wrong with it.
    pub description: String,
}

impl From<&tonic::Status> for Refusal {
    fn from(status: &tonic::Status) -> Self {
        let details = status.get_error_details();
        let violations = details.bad_request().map_or_else(Vec::new, |request| {
            let violation = |v: &tonic_types::FieldViolation| Violation {
                field: v.field.clone(),
                description: v.description.clone(),
            };
            request.field_violations.iter().map(violation).collect()
        });
        Self {
            code: status.code(),
            message: status.message().to_owned(),
            reason: details.error_info().map_or_else(String::new, |info| info.reason.clone()),
            violations,
            metadata: details.error_info().into_iter().flat_map(|i| i.metadata.clone()).collect(),
        }
    }
}

impl From<v1::Failure> for Refusal {
    fn from(failure: v1::Failure) -> Self {
        Self {
            code: Code::from_i32(failure.code),
            message: failure.message,
            reason: failure.reason,
            violations: Vec::new(),
            metadata: BTreeMap::new(),
        }
    }
}

impl Refusal {
    /// The code as the gRPC specification spells it, for example `NOT_FOUND`.
    pub fn code_name(&self) -> &'static str {
        plantd_proto::code_name(self.code)
    }
}

/// `NOT_FOUND (PLANT_NOT_FOUND): there is no plant ...`, then one indented line per violation that
/// the message does not already carry.
impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.code_name())?;
        if !self.reason.is_empty() {
            write!(f, " ({})", self.reason)?;
        }
        write!(f, ": {}", self.message)?;
        for violation in &self.violations {
            if !self.message.contains(&violation.description) {
                write!(f, "\n  {}: {}", violation.field, violation.description)?;
            }
        }
        Ok(())
    }
}

/// The innermost error, which is the one that a person can act on ("connection refused").
pub(crate) fn root_cause<'a>(
    error: &'a (dyn std::error::Error + 'static),
) -> &'a (dyn std::error::Error + 'static) {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause
}

#[cfg(test)]
mod tests {
    use tonic_types::{ErrorDetails, StatusExt as _};

    use super::*;

    #[test]
    fn details_of_a_status_are_kept_and_printed() {
        let mut details = ErrorDetails::new();
        details
            .set_error_info("SCENE_INVALID", "plantd", std::collections::HashMap::new())
            .add_bad_request_violation("frames[3].body.mass", "must not be negative");
        let status = tonic::Status::with_error_details(Code::InvalidArgument, "1 error", details);
        let error = Error::from(status);
        assert_eq!(error.code(), Some(Code::InvalidArgument));
        assert_eq!(error.reason(), "SCENE_INVALID");
        assert_eq!(error.violations()[0].field, "frames[3].body.mass");
        assert_eq!(
            error.to_string(),
            "INVALID_ARGUMENT (SCENE_INVALID): 1 error\n  frames[3].body.mass: must not be negative"
        );
    }

    #[test]
    fn a_status_without_details_is_still_readable() {
        let error = Error::from(tonic::Status::not_found("there is no plant `a`"));
        assert_eq!(error.to_string(), "NOT_FOUND: there is no plant `a`");
        assert!(error.reason().is_empty() && error.violations().is_empty());
    }
}
