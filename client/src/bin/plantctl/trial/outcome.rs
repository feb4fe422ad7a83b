//! What came of a case.

use std::time::Duration;

use plantd_expect::{Curve, Verdict};

/// What came of a case.
pub(crate) struct Outcome {
    pub(crate) case: String,
    pub(crate) seed: u64,
    pub(crate) verdicts: Vec<Verdict>,
    /// Why the run ended before its time.
    pub(crate) ended: Option<String>,
    /// Why the case could not be run or judged.
    pub(crate) error: Option<String>,
    pub(crate) time_s: Vec<f64>,
    pub(crate) plots: Vec<Curve>,
    /// What the controller has written.
    pub(crate) output: String,
    pub(crate) elapsed: Duration,
    pub(crate) steps: u64,
}

/// The result of a case, in order of gravity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Status {
    Passed,
    Failed,
    /// It could not be run or judged.
    Error,
}

impl Outcome {
    pub(crate) fn status(&self) -> Status {
        let is_broken = |verdict: &Verdict| verdict.broken.is_some();
        match self {
            Self { error: Some(_), .. } => Status::Error,
            Self { ended: Some(_), .. } => Status::Failed,
            _ if self.verdicts.iter().any(is_broken) => Status::Failed,
            _ => Status::Passed,
        }
    }

    /// What went wrong, a line for each.
    pub(crate) fn problems(&self) -> Vec<String> {
        let broken = self.verdicts.iter().filter(|verdict| verdict.broken.is_some());
        let broken = broken.map(|verdict| format!("{}: {}", verdict.expectation, verdict.message));
        self.error.iter().chain(&self.ended).cloned().chain(broken).collect()
    }
}
