//! How a command fails: exit codes, and errors as JSON.

use plantd_client::{Error, Refusal};
use serde_json::{Value, json};

/// The server refused, a stream broke, or a file could not be read or written.
pub(crate) const FAILED: u8 = 1;
/// What was asked for makes no sense; clap's code for it.
pub(crate) const WRONG_USAGE: u8 = 2;
/// There is no server at the address.
pub(crate) const NO_SERVER: u8 = 3;
/// A search ended before it converged; what it found is there.
pub(crate) const STOPPED_EARLY: u8 = 4;

/// A search that ended before it converged.
#[derive(Debug, thiserror::Error)]
#[error("the search stopped before it converged: {refusal}\n{help}")]
pub(crate) struct SearchStopped {
    /// Why it stopped.
    pub(crate) refusal: Refusal,
    /// What helps.
    pub(crate) help: String,
}

/// A result that has no table.
#[derive(Debug, thiserror::Error)]
#[error(
    "there is no table to print as comma-separated values; `--output table` and `json` print it"
)]
pub(crate) struct NoTable;

/// The exit code of an error.
pub(crate) fn code(error: &anyhow::Error) -> u8 {
    match error.downcast_ref::<Error>() {
        Some(Error::Address { .. }) => WRONG_USAGE,
        Some(Error::Connect { .. }) => NO_SERVER,
        _ if error.is::<SearchStopped>() => STOPPED_EARLY,
        _ if error.is::<NoTable>() => WRONG_USAGE,
        _ => FAILED,
    }
}

/// An error as JSON.
pub(crate) fn as_json(error: &anyhow::Error) -> Value {
    let stopped = error.downcast_ref::<SearchStopped>().map(|stopped| &stopped.refusal);
    let refusal = error.downcast_ref::<Error>().and_then(Error::refusal).or(stopped);
    let Some(refusal) = refusal else {
        return json!({ "error": { "message": format!("{error:#}") } });
    };
    let violations: Vec<Value> = refusal
        .violations
        .iter()
        .map(|v| json!({ "field": v.field, "description": v.description }))
        .collect();
    json!({ "error": {
        "code": refusal.code_name(),
        "reason": refusal.reason,
        "message": refusal.message,
        "violations": violations,
    } })
}

/// Whether whoever reads the output has gone.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error
        .downcast_ref::<std::io::Error>()
        .is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}
