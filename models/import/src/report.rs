//! What became of a file.

use std::collections::BTreeMap;
use std::fmt;

use plantd_models::{Model, Scene, SceneError};

/// A robot that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Import {
    /// The scene.
    pub scene: Scene,
    /// What became of the file.
    pub report: Report,
}

impl Import {
    /// Whether the scene compiles: that every coordinate has inertia, for one.
    ///
    /// # Errors
    ///
    /// Everything that is wrong with the scene, with paths into it.
    pub fn check(&self) -> Result<(), SceneError> {
        Model::compile(&self.scene).map(|_| ())
    }
}

/// What became of everything in a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// What was taken exactly: kinds of things and how many of them.
    pub exact: BTreeMap<&'static str, usize>,
    /// What was not: contacts, warnings, approximations, then what has no effect, each in the order of the file.
    pub notes: Vec<Note>,
    /// Notes beyond the first thousand.
    pub left_out: usize,
    /// Names that a scene spells otherwise.
    pub names: Vec<Name>,
}

/// How something was treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// What says what touches what. Nothing touches anything: contacts are not simulated.
    Contact,
    /// Left out although it may change the motion: what the format does not have, and, where the user says so,
    /// what is refused otherwise.
    Warning,
    /// Taken, but not to the letter.
    Approximated,
    /// Left out; it does not change the motion.
    NoEffect,
}

impl Kind {
    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Contact => "contact",
            Self::Warning => "warning",
            Self::Approximated => "approximated",
            Self::NoEffect => "no effect",
        }
    }
}

/// Something that was not taken exactly.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    /// How it was treated.
    pub kind: Kind,
    /// File of the first of them; empty for the text that was given.
    pub file: String,
    /// Its line, from 1.
    pub line: u32,
    /// Column in characters, from 1.
    pub column: u32,
    /// What, and how, in a sentence.
    pub message: String,
    /// How many there are.
    pub count: usize,
}

/// A name that a scene spells otherwise.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Name {
    /// `frame`, `coordinate` or `scene`.
    pub of: &'static str,
    /// In the file.
    pub from: String,
    /// In the scene.
    pub to: String,
}

/// A file's name before a line.
fn prefix(file: &str) -> String {
    if file.is_empty() { String::new() } else { format!("{file}:") }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, file, line, column, message, count } = self;
        write!(f, "{}{line}:{column}: {}: {message}", prefix(file), kind.name())?;
        if *count > 1 { write!(f, " (× {count})") } else { Ok(()) }
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} `{}` is named `{}`", self.of, self.from, self.to)
    }
}

impl fmt::Display for Report {
    /// One line for each entry.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for note in &self.notes {
            writeln!(f, "{note}")?;
        }
        if self.left_out > 0 {
            writeln!(f, "and {} notes more", self.left_out)?;
        }
        for name in &self.names {
            writeln!(f, "{name}")?;
        }
        let exact: Vec<_> = self.exact.iter().map(|(what, n)| format!("{n} × {what}")).collect();
        writeln!(f, "exact: {}", exact.join(", "))
    }
}

/// One error of a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{line}:{column}: {message}", prefix(file))]
pub struct Problem {
    /// File that the text includes; empty for the text itself.
    pub file: String,
    /// Line, from 1.
    pub line: u32,
    /// Column in characters, from 1.
    pub column: u32,
    /// What is wrong, and what is allowed.
    pub message: String,
}

/// All errors of a file; of very many the first hundred.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
pub struct ImportError {
    /// In the order of the file; at least one.
    pub problems: Vec<Problem>,
}

/// Problems that are told at most.
pub(crate) const PROBLEMS_MAX: usize = 100;
