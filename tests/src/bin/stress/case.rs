//! Cases, and what they find.

use std::fmt::Write as _;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::Result;
use plantd_models::Plant;
use rustix::time::{ClockId, clock_gettime};

use crate::derivatives;

/// How the cases are run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Setup {
    pub(crate) long: bool,
    pub(crate) seed: u64,
}

impl Setup {
    /// What the short form and the long form take.
    pub(crate) fn pick<T>(&self, short: T, long: T) -> T {
        if self.long { long } else { short }
    }
}

/// What a case does.
type Run = Box<dyn Fn(&Setup, &mut Finding) -> Result<()>>;

/// Something that the integrator must survive.
pub(crate) struct Case {
    pub(crate) name: String,
    /// What it must satisfy.
    pub(crate) criterion: String,
    known_limit: Option<&'static str>,
    run: Run,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    Pass,
    Fail,
    KnownLimit,
}

/// A case that was run.
pub(crate) struct Outcome {
    pub(crate) name: String,
    pub(crate) criterion: String,
    pub(crate) verdict: Verdict,
    pub(crate) finding: Finding,
    pub(crate) cpu_s: f64,
}

/// Points of a plot.
#[derive(Debug)]
pub(crate) struct Line {
    pub(crate) plot: &'static str,
    pub(crate) name: String,
    pub(crate) points: Vec<(f64, f64)>,
}

/// What a case found: numbers beside their bounds.
#[derive(Debug, Default)]
pub(crate) struct Finding {
    /// Numbers, each with its bound.
    pub(crate) text: String,
    failed: bool,
    pub(crate) lines: Vec<Line>,
    /// Order and substeps, where they are not 2 and 1.
    pub(crate) method: Option<(u32, u32)>,
    /// Largest error of a linearization, and what differences resolve there; relative.
    pub(crate) derivatives: Option<derivatives::Error>,
}

impl Finding {
    /// Adds to the text.
    pub(crate) fn note(&mut self, what: impl AsRef<str>) {
        let separator = if self.text.is_empty() { "" } else { "; " };
        let _ = write!(self.text, "{separator}{}", what.as_ref());
    }

    /// `value` must not exceed `bound`; a NaN does.
    pub(crate) fn at_most(&mut self, what: &str, value: f64, bound: f64) {
        let holds = value <= bound;
        self.note(format!("{what} {value:.1e} {} {bound:.1e}", if holds { "≤" } else { ">" }));
        self.failed |= !holds;
    }

    /// Something that must be so.
    pub(crate) fn must(&mut self, holds: bool, otherwise: impl FnOnce() -> String) {
        if !holds {
            self.note(otherwise());
            self.failed = true;
        }
    }

    /// Takes over what one of many found; its text only if it failed.
    pub(crate) fn absorb(&mut self, name: &str, other: Self) {
        if other.failed {
            self.note(format!("{name}: {}", other.text));
            self.failed = true;
        }
        self.worse(other.derivatives);
    }

    fn worse(&mut self, error: Option<derivatives::Error>) {
        let ratio = |error: Option<derivatives::Error>| error.map_or(0.0, |error| error.ratio());
        if !(ratio(error) <= ratio(self.derivatives)) {
            self.derivatives = error;
        }
    }

    /// The linearization of a step from here must be within what differences resolve.
    pub(crate) fn linearization(&mut self, plant: &Plant, u: &[f64], seed: u64) {
        match derivatives::check(plant, u, seed) {
            Ok(error) => {
                self.must(error.is_resolved(), || {
                    let derivatives::Error { found, resolved, by, of } = error;
                    format!("∂{of}/∂{by} is off by {found:.1e}, {resolved:.1e} is resolved")
                });
                self.worse(Some(error));
            }
            Err(error) => self.must(false, || format!("no linearization: {error:#}")),
        }
    }
}

impl Case {
    pub(crate) fn new(
        name: impl Into<String>,
        criterion: impl Into<String>,
        run: impl Fn(&Setup, &mut Finding) -> Result<()> + 'static,
    ) -> Self {
        let (name, criterion) = (name.into(), criterion.into());
        Self { name, criterion, known_limit: None, run: Box::new(run) }
    }

    /// A failure is known, with its reason, if there is one.
    pub(crate) fn known_limit(self, reason: Option<&'static str>) -> Self {
        Self { known_limit: reason, ..self }
    }

    pub(crate) fn run(self, setup: &Setup) -> Outcome {
        let start = cpu_s();
        let mut finding = Finding::default();
        let run = AssertUnwindSafe(|| (self.run)(setup, &mut finding));
        match catch_unwind(run) {
            Ok(Ok(())) => {}
            Ok(Err(error)) => finding.must(false, || format!("{error:#}")),
            Err(_) => finding.must(false, || "panicked".to_owned()),
        }
        let verdict = match (finding.failed, self.known_limit) {
            (false, _) => Verdict::Pass,
            (true, None) => Verdict::Fail,
            (true, Some(reason)) => {
                finding.note(reason);
                Verdict::KnownLimit
            }
        };
        let (name, criterion) = (self.name, self.criterion);
        Outcome { name, criterion, verdict, finding, cpu_s: cpu_s() - start }
    }
}

impl Verdict {
    pub(crate) fn text(self) -> &'static str {
        match self {
            Self::Pass => "PASS",
            Self::Fail => "FAIL",
            Self::KnownLimit => "known limit",
        }
    }
}

impl Outcome {
    /// The verdict in one line.
    pub(crate) fn line(&self) -> String {
        let derivatives = match self.finding.derivatives {
            Some(error) => format!("; A, B within {:.0e} of {:.0e}", error.found, error.resolved),
            None => String::new(),
        };
        let (verdict, text) = (self.verdict.text(), &self.finding.text);
        format!("{verdict}: {text}{derivatives} ({:.1} s)", self.cpu_s)
    }
}

/// CPU time of this process, s.
fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
