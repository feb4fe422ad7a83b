//! Files of the door, in TOML, which administrators change while the server runs.

use std::fs;
use std::path::{Path, PathBuf};

use plantd_models::scene::line_of;
use serde::de::DeserializeOwned;

/// Longest file, bytes.
const BYTES_MAX: u64 = 16 << 20;

/// Why a file is not used.
#[derive(Debug, thiserror::Error)]
#[error("file of {what} `{path}`: {problem}")]
pub struct FileError {
    /// What should be in it.
    pub what: &'static str,
    /// Path.
    pub path: PathBuf,
    /// What is wrong.
    pub problem: String,
}

/// What a file says; if it says nothing of that kind, what is wrong and where.
pub(super) fn read<T: DeserializeOwned>(path: &Path) -> Result<T, String> {
    let bytes = fs::metadata(path).map_err(|error| error.to_string())?.len();
    if bytes > BYTES_MAX {
        return Err(format!("it has {bytes} bytes"));
    }
    let text = fs::read_to_string(path).map_err(|error| error.to_string())?;
    // An error of the parser would show what is in the file, which is nothing that opens a door.
    toml::from_str(&text).map_err(|error: toml::de::Error| {
        let line = line_of(&text, error.span().map_or(0, |span| span.start));
        format!("line {line}: {}", error.message())
    })
}
