//! Results on standard output: a line, or an object of JSON, for each case.

use std::fmt::Write as _;

use anyhow::Result;
use serde_json::json;

use crate::output::page::{Cell, Page, Table, table};
use crate::output::printer::{GOOD, Output, WRONG};
use crate::report::results::{Report, UnusableFile};
use crate::trial::outcome::{Outcome, Status};
use crate::trial::prepared::PreparedScenario;
use plantd_expect::Verdict;

/// A case by the name of its scenario and its own.
pub(crate) fn title(scenario: &str, case: &str) -> String {
    if case.is_empty() { scenario.to_owned() } else { format!("{scenario} [{case}]") }
}

/// Prints what came of a case.
pub(crate) fn print_case(
    output: &Output,
    prepared: &PreparedScenario,
    outcome: &Outcome,
    replay: &str,
) -> Result<()> {
    output.print(
        || json(prepared, outcome, replay),
        || {
            let mut page = Page::from(text(prepared, outcome, replay));
            page.data(row(prepared, outcome));
            page
        },
    )
}

/// What came of a case, as a row.
fn row(prepared: &PreparedScenario, outcome: &Outcome) -> Table {
    let cells = vec![
        prepared.name.as_str().into(),
        outcome.case.as_str().into(),
        format!("{:?}", outcome.status()).to_lowercase().into(),
        outcome.steps.into(),
        outcome.elapsed.as_secs_f64().into(),
        Cell::from(outcome.problems().join("; ")),
    ];
    table(&["scenario", "case", "status", "steps", "elapsed_s", "problems"], [cells])
}

/// A line for a case, and what went wrong in it.
fn text(prepared: &PreparedScenario, outcome: &Outcome, replay: &str) -> String {
    let (style, word) = match outcome.status() {
        Status::Passed => (GOOD, "pass "),
        Status::Failed => (WRONG, "FAIL "),
        Status::Error => (WRONG, "ERROR"),
    };
    let name = title(&prepared.name, &outcome.case);
    let elapsed = outcome.elapsed.as_secs_f64();
    let mut text =
        format!("{style}{word}{style:#}  {name}  {} steps, {elapsed:.2} s\n", outcome.steps);
    if outcome.status() == Status::Passed {
        return text;
    }
    for line in outcome.problems() {
        let _ = writeln!(text, "       {line}");
    }
    let _ = writeln!(text, "       seed {}; again: {replay}", outcome.seed);
    if !outcome.output.is_empty() {
        let _ = writeln!(text, "       the controller wrote:");
        for line in outcome.output.lines() {
            let _ = writeln!(text, "       | {line}");
        }
    }
    text
}

/// The outcome of a case as JSON.
fn json(prepared: &PreparedScenario, outcome: &Outcome, replay: &str) -> serde_json::Value {
    let verdict = |verdict: &Verdict| {
        json!({
            "expectation": verdict.expectation,
            "passed": verdict.broken.is_none(),
            "message": verdict.message,
            "time_s": verdict.broken.and_then(|broken| broken.time_s),
            "value": verdict.broken.and_then(|broken| broken.value),
        })
    };
    json!({
        "scenario": prepared.name,
        "file": prepared.file,
        "case": outcome.case,
        "status": format!("{:?}", outcome.status()).to_lowercase(),
        "expectations": outcome.verdicts.iter().map(verdict).collect::<Vec<_>>(),
        "ended": outcome.ended,
        "error": outcome.error,
        "steps": outcome.steps,
        "elapsed_s": outcome.elapsed.as_secs_f64(),
        "seed": outcome.seed,
        "replay": replay,
        "output": outcome.output,
    })
}

/// Prints the files that could not be run.
pub(crate) fn print_unusable(output: &Output, unusable: &[UnusableFile]) -> Result<()> {
    for UnusableFile { file, error } in unusable {
        output.print(
            || json!({ "file": file, "status": "error", "error": error }),
            || {
                let mut page = Page::from(format!("{WRONG}ERROR{WRONG:#}  {error}\n"));
                let row = vec![file.display().to_string(), error.clone()];
                page.data(table(&["file", "error"], [row]));
                page
            },
        )?;
    }
    Ok(())
}

/// Prints how many cases passed.
pub(crate) fn print_summary(output: &Output, report: &Report) -> Result<()> {
    let [passed, failed, errors] =
        [Status::Passed, Status::Failed, Status::Error].map(|status| report.count(status));
    output.print(
        || json!({ "passed": passed, "failed": failed, "errors": errors }),
        || format!("{passed} passed, {failed} failed, {errors} not run\n"),
    )
}
