//! Results on standard output, as text or as JSON.

use std::io::Write as _;

use anyhow::Result;
use serde_json::{Value, json};

use crate::contract::json;

/// Where results go.
#[derive(Clone, Copy)]
pub(crate) struct Output {
    pub(crate) json: bool,
}

impl Output {
    /// Prints a result, flushed, so that a reader of a stream gets it at once.
    pub(crate) fn print(
        self,
        json: impl FnOnce() -> Value,
        text: impl FnOnce() -> String,
    ) -> Result<()> {
        let mut out = std::io::stdout().lock();
        if self.json {
            writeln!(out, "{}", json())?;
        } else {
            out.write_all(text().as_bytes())?;
        }
        Ok(out.flush()?)
    }

    /// Prints a message of the contract; `name` is its name there.
    pub(crate) fn message(
        self,
        name: &str,
        message: &impl prost::Message,
        text: impl FnOnce() -> String,
    ) -> Result<()> {
        self.print(|| json::message(name, message), text)
    }

    /// Says on standard error that there was nothing to do.
    pub(crate) fn nothing_to_do(self, message: &str) {
        if self.json {
            eprintln!("{}", json!({ "note": { "message": message } }));
        } else {
            eprintln!("plantctl: nothing to do: {message}");
        }
    }

    /// Confirms what has no result of its own; people see that it went well by the silence.
    pub(crate) fn done(self, json: Value) -> Result<()> {
        self.print(|| json, String::new)
    }
}
