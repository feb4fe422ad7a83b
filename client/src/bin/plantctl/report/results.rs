//! What a run of suites came to.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::trial::outcome::{Outcome, Status};
use crate::trial::prepared::PreparedScenario;

/// A scenario with what came of its cases.
pub(crate) struct ScenarioResult {
    pub(crate) prepared: PreparedScenario,
    pub(crate) outcomes: Vec<Outcome>,
}

/// A file that could not be run at all.
pub(crate) struct UnusableFile {
    pub(crate) file: PathBuf,
    pub(crate) error: String,
}

/// What a run of suites came to.
pub(crate) struct Report {
    pub(crate) tested: Vec<ScenarioResult>,
    pub(crate) unusable: Vec<UnusableFile>,
}

/// Where the words of a command that replays a case come from.
pub(crate) struct Replay<'a> {
    pub(crate) address: Option<&'a str>,
    pub(crate) plantd: Option<&'a Path>,
}

impl Replay<'_> {
    pub(crate) fn command(&self, prepared: &PreparedScenario, outcome: &Outcome) -> String {
        let mut command = "plantctl".to_owned();
        let mut flag = |name: &str, value: &str| {
            let _ = write!(command, " {name} {}", quoted(value));
        };
        if let Some(address) = self.address {
            flag("--address", address);
        }
        flag("test", &prepared.file.to_string_lossy());
        if let Some(plantd) = self.plantd {
            flag("--plantd", &plantd.to_string_lossy());
        }
        flag("--seed", &outcome.seed.to_string());
        if !outcome.case.is_empty() {
            flag("--case", &outcome.case);
        }
        command
    }
}

/// A word as a shell reads it.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,@%+".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

impl Report {
    pub(crate) fn outcomes(&self) -> impl Iterator<Item = &Outcome> {
        self.tested.iter().flat_map(|tested| &tested.outcomes)
    }

    pub(crate) fn count(&self, status: Status) -> usize {
        let cases = self.outcomes().filter(|outcome| outcome.status() == status).count();
        if status == Status::Error { cases + self.unusable.len() } else { cases }
    }

    pub(crate) fn status(&self) -> Status {
        let all = [Status::Error, Status::Failed];
        all.into_iter().find(|&status| self.count(status) > 0).unwrap_or(Status::Passed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_survives_a_shell() {
        for word in ["plain-1", "two words", "it's", "$HOME", "", "a[b]"] {
            let echo = format!("printf %s {}", quoted(word));
            let output = std::process::Command::new("sh").args(["-c", &echo]).output().unwrap();
            assert_eq!(String::from_utf8(output.stdout).unwrap(), word);
        }
    }
}
