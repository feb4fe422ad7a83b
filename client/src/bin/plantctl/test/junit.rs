//! Results as JUnit XML, which continuous integration shows.

use std::fmt::Write as _;

use super::run::Status;
use super::{Replay, Report, faults};

/// A document: a suite for each file, a test case for each case.
pub(super) fn document(report: &Report, replay: &Replay<'_>) -> String {
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
            let faults = faults(outcome);
            let first = escaped(faults.first().map_or("", String::as_str));
            let again = replay.command(&tested.prepared, outcome);
            let body = format!("{}\nseed {}; again: {again}", faults.join("\n"), outcome.seed);
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

/// Text for XML and HTML, without the characters that XML does not allow.
pub(super) fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\n' | '\t' => escaped.push(c),
            '\r' => {}
            c if c < ' ' || matches!(c, '\u{fffe}' | '\u{ffff}') => escaped.push('\u{fffd}'),
            c => escaped.push(c),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_in_a_text_is_taken_for_markup() {
        assert_eq!(
            escaped("|a| < \"b\" & c\u{1b}[0m\n"),
            "|a| &lt; &quot;b&quot; &amp; c\u{fffd}[0m\n"
        );
    }
}
