//! Results as JUnit XML, which continuous integration shows.

use std::fmt::Write as _;

use crate::output::markup::escaped;
use crate::report::results::{Replay, Report};
use crate::trial::outcome::Status;

/// A document: a suite for each file, a test case for each case.
pub(crate) fn document(report: &Report, replay: &Replay<'_>) -> String {
    let mut xml =
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites name=\"plantctl test\">\n"
            .to_owned();
    for tested in &report.tested {
        let name = escaped(&tested.prepared.name);
        let count = |status| tested.outcomes.iter().filter(|o| o.status() == status).count();
        let (failures, errors) = (count(Status::Failed), count(Status::Error));
        let tests = tested.outcomes.len();
        let time: f64 = tested.outcomes.iter().map(|o| o.elapsed.as_secs_f64()).sum();
        let _ = writeln!(
            xml,
            "  <testsuite name=\"{name}\" tests=\"{tests}\" failures=\"{failures}\" \
             errors=\"{errors}\" time=\"{time:.3}\">"
        );
        for outcome in &tested.outcomes {
            let case = if outcome.case.is_empty() { "case" } else { &outcome.case };
            let (case, time) = (escaped(case), outcome.elapsed.as_secs_f64());
            let _ = write!(
                xml,
                "    <testcase classname=\"{name}\" name=\"{case}\" time=\"{time:.3}\""
            );
            if outcome.status() == Status::Passed {
                xml.push_str("/>\n");
                continue;
            }
            let tag = if outcome.status() == Status::Error { "error" } else { "failure" };
            let problems = outcome.problems();
            let first = escaped(problems.first().map_or("", String::as_str));
            let again = replay.command(&tested.prepared, outcome);
            let body = format!("{}\nseed {}; again: {again}", problems.join("\n"), outcome.seed);
            let _ = writeln!(xml, ">\n      <{tag} message=\"{first}\">{}</{tag}>", escaped(&body));
            if !outcome.output.is_empty() {
                let _ =
                    writeln!(xml, "      <system-out>{}</system-out>", escaped(&outcome.output));
            }
            xml.push_str("    </testcase>\n");
        }
        xml.push_str("  </testsuite>\n");
    }
    for unusable in &report.unusable {
        let name = escaped(&unusable.file.to_string_lossy());
        let error = escaped(&unusable.error);
        let _ = writeln!(
            xml,
            "  <testsuite name=\"{name}\" tests=\"1\" failures=\"0\" errors=\"1\">\n    \
             <testcase classname=\"{name}\" name=\"case\">\n      <error message=\"{error}\"/>\n    \
             </testcase>\n  </testsuite>"
        );
    }
    xml.push_str("</testsuites>\n");
    xml
}
