//! A text of expectations, without the scenario around it.

use serde::Deserialize;

use crate::expectation::Expectation;
use crate::expression::Expression;
use crate::samples::Samples;

/// Why a text is no list of expectations.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListError(String);

impl std::fmt::Display for ListError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for ListError {}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    expect: Vec<Expectation>,
}

/// Reads tables `[[expect]]` as scenarios have them, of a run of so many seconds; in which there are the signals of
/// `nothing`, if they are known.
///
/// # Errors
/// What is no such table, what no run could be judged by, and signals that there are not; by place and name.
pub fn expectations(
    text: &str,
    duration_s: f64,
    nothing: Option<&Samples>,
) -> Result<Vec<Expectation>, ListError> {
    let refused = |place: String, problem: String| ListError(format!("{place}: {problem}"));
    let read = toml::Deserializer::parse(text).map_err(|error| ListError(error.to_string()))?;
    let File { expect } = serde_path_to_error::deserialize(read)
        .map_err(|error| refused(error.path().to_string(), error.inner().message().to_owned()))?;
    for (i, expectation) in expect.iter().enumerate() {
        let known = |expression: &Expression| match nothing {
            Some(nothing) => expression.values(nothing).map(drop),
            None => Ok(()),
        };
        expectation
            .check(duration_s)
            .and_then(|()| expectation.expressions().into_iter().try_for_each(known))
            .map_err(|problem| refused(format!("expect[{i}].{}", expectation.key()), problem))?;
    }
    Ok(expect)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_wrong_is_named_by_its_place() {
        let mut nothing = Samples::default();
        nothing.put("q(theta)", Vec::new());
        let read = |text: &str| expectations(text, 2.0, Some(&nothing));
        let good = "[[expect]]\nnever_exceeds = { signal = \"|theta|\", limit = 1.0 }\n";
        assert_eq!(read(good).unwrap().len(), 1);
        assert!(read("").unwrap().is_empty());
        for (text, parts) in [
            (
                "[[expect]]\nnever_exceeds = { signal = \"phi\", limit = 1.0 }",
                ["expect[0]", "`phi`"],
            ),
            (
                "[[expect]]\nsettles = { signal = \"theta\", to = 0, within = 1, by_s = 3 }",
                ["by_s", "3"],
            ),
            ("[[expect]]\nnever_exceed = 1", ["expect[0]", "never_exceed"]),
            ("[[expects]]\nno_failures = true", ["expects", "expect"]),
            ("expect = 1", ["expect", "1"]),
            ("[[expect", ["", ""]),
        ] {
            let problem = read(text).unwrap_err().to_string();
            assert!(parts.iter().all(|part| problem.contains(part)), "{text}: {problem}");
        }
    }
}
