//! What a scenario expects.

use std::fmt;

use schemars::JsonSchema;
use serde::Deserialize;

use crate::expression::Expression;
use crate::samples::Samples;

/// One expectation. What is not a number never meets one.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Expectation {
    /// From `by_s` on the signal stays within `within` of `to`.
    Settles(Settles),
    /// Between `from_s` and `until_s` the signal goes past `to`, seen from its value at `from_s`, by less
    /// than `limit`, or by less than `percent` of the way. If it begins at `to`, both sides count.
    OvershootBelow(OvershootBelow),
    /// Between `from_s` and `until_s` the signal is never outside its bounds: `low` and `high`, or
    /// `within` of `to`.
    StaysInside(StaysInside),
    /// Between `from_s` and `until_s` the signal is never above `limit`.
    NeverExceeds(NeverExceeds),
    /// At some time up to `by_s`, or the end, the signal is inside its bounds.
    Eventually(Eventually),
    /// At the last sample the signal is within `within` of `to`.
    Final(Final),
    /// The root of the mean square of the signal between `from_s` and `until_s` is less than `limit`.
    RmsBelow(RmsBelow),
    /// Fewer deadlines than `limit` were missed; for paced plants.
    DeadlineMissesBelow(Count),
    /// No step was refused or failed. `true` is the only value.
    NoFailures(bool),
}

/// A signal stays near a value from a time on.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Settles {
    pub(crate) signal: Expression,
    pub(crate) to: Expression,
    pub(crate) within: Expression,
    pub(crate) by_s: f64,
}

/// A signal goes past a value by little.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OvershootBelow {
    pub(crate) signal: Expression,
    pub(crate) to: Expression,
    pub(crate) limit: Option<f64>,
    pub(crate) percent: Option<f64>,
    #[serde(default)]
    pub(crate) from_s: f64,
    pub(crate) until_s: Option<f64>,
}

/// A signal is never outside its bounds.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StaysInside {
    pub(crate) signal: Expression,
    low: Option<Expression>,
    high: Option<Expression>,
    to: Option<Expression>,
    within: Option<Expression>,
    #[serde(default)]
    pub(crate) from_s: f64,
    pub(crate) until_s: Option<f64>,
}

/// A signal is never above a limit.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NeverExceeds {
    pub(crate) signal: Expression,
    pub(crate) limit: Expression,
    #[serde(default)]
    pub(crate) from_s: f64,
    pub(crate) until_s: Option<f64>,
}

/// A signal is inside its bounds at some time.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Eventually {
    pub(crate) signal: Expression,
    low: Option<Expression>,
    high: Option<Expression>,
    to: Option<Expression>,
    within: Option<Expression>,
    #[serde(default)]
    pub(crate) from_s: f64,
    pub(crate) by_s: Option<f64>,
}

/// A signal ends near a value.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Final {
    pub(crate) signal: Expression,
    pub(crate) to: Expression,
    pub(crate) within: Expression,
}

/// A signal is small in the mean.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RmsBelow {
    pub(crate) signal: Expression,
    pub(crate) limit: f64,
    #[serde(default)]
    pub(crate) from_s: f64,
    pub(crate) until_s: Option<f64>,
}

/// There are fewer than so many.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Count {
    pub(crate) limit: u64,
}

/// Bounds as a file gives them.
pub(crate) struct Bounds<'a> {
    pub(crate) low: Option<&'a Expression>,
    pub(crate) high: Option<&'a Expression>,
    pub(crate) to: Option<&'a Expression>,
    pub(crate) within: Option<&'a Expression>,
}

impl<'a> Bounds<'a> {
    pub(crate) fn near(to: &'a Expression, within: &'a Expression) -> Self {
        Self { low: None, high: None, to: Some(to), within: Some(within) }
    }

    fn check(&self) -> Result<(), String> {
        match (self.low.or(self.high), self.to, self.within) {
            (Some(_), None, None) | (None, Some(_), Some(_)) => Ok(()),
            _ => Err("give `low` or `high` or both, or else `to` and `within`".to_owned()),
        }
    }

    pub(crate) fn values(&self, samples: &Samples) -> Result<(Vec<f64>, Vec<f64>), String> {
        let of = |bound: Option<&Expression>, none: f64| match bound {
            Some(expression) => expression.values(samples),
            None => Ok(vec![none; samples.count()]),
        };
        let Some(to) = self.to else {
            return Ok((of(self.low, f64::NEG_INFINITY)?, of(self.high, f64::INFINITY)?));
        };
        let (to, within) = (to.values(samples)?, of(self.within, f64::NAN)?);
        let pairs = || to.iter().zip(&within);
        Ok((pairs().map(|(to, w)| to - w).collect(), pairs().map(|(to, w)| to + w).collect()))
    }

    fn words(&self) -> String {
        match (self.to, self.within, self.low, self.high) {
            (Some(to), Some(within), ..) => format!("within {within} of {to}"),
            (.., Some(low), Some(high)) => format!("between {low} and {high}"),
            (.., Some(low), None) => format!("at least {low}"),
            (.., None, Some(high)) => format!("at most {high}"),
            _ => String::new(),
        }
    }
}

impl StaysInside {
    pub(crate) fn bounds(&self) -> Bounds<'_> {
        let Self { low, high, to, within, .. } = self;
        Bounds { low: low.as_ref(), high: high.as_ref(), to: to.as_ref(), within: within.as_ref() }
    }
}

impl Eventually {
    pub(crate) fn bounds(&self) -> Bounds<'_> {
        let Self { low, high, to, within, .. } = self;
        Bounds { low: low.as_ref(), high: high.as_ref(), to: to.as_ref(), within: within.as_ref() }
    }
}

/// "from 1 s until 2 s", or as much of it as is given.
fn span(from_s: f64, until_s: Option<f64>) -> String {
    let from = if from_s > 0.0 { format!(" from {from_s} s") } else { String::new() };
    from + &until_s.map_or(String::new(), |until_s| format!(" until {until_s} s"))
}

impl fmt::Display for Expectation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Settles(Settles { signal, to, within, by_s }) => {
                write!(f, "{signal} settles within {within} of {to} by {by_s} s")
            }
            Self::OvershootBelow(e) => {
                let most = match (e.limit, e.percent) {
                    (Some(limit), _) => limit.to_string(),
                    (_, percent) => format!("{} %", percent.unwrap_or_default()),
                };
                let span = span(e.from_s, e.until_s);
                write!(f, "{} overshoots {} by less than {most}{span}", e.signal, e.to)
            }
            Self::StaysInside(e) => {
                let span = span(e.from_s, e.until_s);
                write!(f, "{} stays {}{span}", e.signal, e.bounds().words())
            }
            Self::NeverExceeds(e) => {
                write!(f, "{} never exceeds {}{}", e.signal, e.limit, span(e.from_s, e.until_s))
            }
            Self::Eventually(e) => {
                let by = e.by_s.map_or(String::new(), |by_s| format!(" by {by_s} s"));
                let from = span(e.from_s, None);
                write!(f, "{} is eventually {}{from}{by}", e.signal, e.bounds().words())
            }
            Self::Final(Final { signal, to, within }) => {
                write!(f, "{signal} ends within {within} of {to}")
            }
            Self::RmsBelow(e) => {
                write!(f, "rms of {} below {}{}", e.signal, e.limit, span(e.from_s, e.until_s))
            }
            Self::DeadlineMissesBelow(Count { limit }) => {
                write!(f, "deadline misses below {limit}")
            }
            Self::NoFailures(_) => write!(f, "no failures"),
        }
    }
}

impl Expectation {
    /// Name of its key.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Settles(_) => "settles",
            Self::OvershootBelow(_) => "overshoot_below",
            Self::StaysInside(_) => "stays_inside",
            Self::NeverExceeds(_) => "never_exceeds",
            Self::Eventually(_) => "eventually",
            Self::Final(_) => "final",
            Self::RmsBelow(_) => "rms_below",
            Self::DeadlineMissesBelow(_) => "deadline_misses_below",
            Self::NoFailures(_) => "no_failures",
        }
    }

    /// Refuses what no run could be judged by.
    pub fn check(&self, duration_s: f64) -> Result<(), String> {
        let inside = |key: &str, time_s: f64| match time_s >= 0.0 && time_s <= duration_s {
            true => Ok(()),
            false => Err(format!("{key} is {time_s}; it must lie between 0 and the duration")),
        };
        let window = |from_s: f64, key: &str, until_s: Option<f64>| {
            inside("from_s", from_s)?;
            let until_s = until_s.unwrap_or(duration_s);
            inside(key, until_s)?;
            if from_s > until_s {
                return Err(format!("from_s is later than {key}"));
            }
            Ok(())
        };
        match self {
            Self::Settles(e) => inside("by_s", e.by_s),
            Self::OvershootBelow(e) => {
                if e.limit.is_some() == e.percent.is_some() {
                    return Err("give either `limit` or `percent`".to_owned());
                }
                window(e.from_s, "until_s", e.until_s)
            }
            Self::StaysInside(e) => {
                e.bounds().check()?;
                window(e.from_s, "until_s", e.until_s)
            }
            Self::NeverExceeds(e) => window(e.from_s, "until_s", e.until_s),
            Self::Eventually(e) => {
                e.bounds().check()?;
                window(e.from_s, "by_s", e.by_s)
            }
            Self::RmsBelow(e) => window(e.from_s, "until_s", e.until_s),
            Self::NoFailures(false) => Err("`true` is the only value".to_owned()),
            Self::Final(_) | Self::DeadlineMissesBelow(_) | Self::NoFailures(true) => Ok(()),
        }
    }

    /// All its expressions.
    pub fn expressions(&self) -> Vec<&Expression> {
        let optional = match self {
            Self::Settles(e) => vec![Some(&e.signal), Some(&e.to), Some(&e.within)],
            Self::OvershootBelow(e) => vec![Some(&e.signal), Some(&e.to)],
            Self::StaysInside(e) => {
                let b = e.bounds();
                vec![Some(&e.signal), b.low, b.high, b.to, b.within]
            }
            Self::NeverExceeds(e) => vec![Some(&e.signal), Some(&e.limit)],
            Self::Eventually(e) => {
                let b = e.bounds();
                vec![Some(&e.signal), b.low, b.high, b.to, b.within]
            }
            Self::Final(e) => vec![Some(&e.signal), Some(&e.to), Some(&e.within)],
            Self::RmsBelow(e) => vec![Some(&e.signal)],
            Self::DeadlineMissesBelow(_) | Self::NoFailures(_) => Vec::new(),
        };
        optional.into_iter().flatten().collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn expectation(text: &str) -> Expectation {
        #[derive(Deserialize)]
        struct File {
            expect: Expectation,
        }
        toml::from_str::<File>(&format!("[expect]\n{text}")).unwrap().expect
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        for (text, part) in [
            ("no_failures = false", "only value"),
            ("settles = { signal = 'x', to = 1, within = 1, by_s = 6 }", "by_s is 6"),
            ("stays_inside = { signal = 'x' }", "give `low`"),
            ("stays_inside = { signal = 'x', low = 1, to = 1, within = 1 }", "give `low`"),
            ("eventually = { signal = 'x', to = 1 }", "give `low`"),
            ("overshoot_below = { signal = 'x', to = 1 }", "either `limit` or `percent`"),
            ("rms_below = { signal = 'x', limit = 1, from_s = 3, until_s = 2 }", "from_s is later"),
            ("never_exceeds = { signal = 'x', limit = 1, from_s = -1 }", "from_s is -1"),
        ] {
            let error = expectation(text).check(5.0).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn an_expectation_reads_as_a_sentence() {
        for (text, words) in [
            (
                "settles = { signal = '|x|', to = 'pi', within = 0.5, by_s = 4.0 }",
                "|x| settles within 0.5 of pi by 4 s",
            ),
            (
                "overshoot_below = { signal = 'x', to = 1, percent = 20, from_s = 2 }",
                "x overshoots 1 by less than 20 % from 2 s",
            ),
            ("stays_inside = { signal = 'x', low = 0, high = 2 }", "x stays between 0 and 2"),
            (
                "eventually = { signal = 'x', high = 2, by_s = 3 }",
                "x is eventually at most 2 by 3 s",
            ),
            ("deadline_misses_below = { limit = 2 }", "deadline misses below 2"),
        ] {
            assert_eq!(expectation(text).to_string(), words);
        }
    }
}
