//! What a scenario expects, and whether it came true. Nothing but arithmetic on samples.

use std::fmt;

use schemars::JsonSchema;
use serde::Deserialize;

use super::expression::Expression;
use super::samples::Samples;

/// Times closer than this are the same, s.
const TIME_ROUNDING_S: f64 = 1e-9;

/// One expectation. What is not a number never meets one.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Expectation {
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

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Settles {
    signal: Expression,
    to: Expression,
    within: Expression,
    by_s: f64,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct OvershootBelow {
    signal: Expression,
    to: Expression,
    limit: Option<f64>,
    percent: Option<f64>,
    #[serde(default)]
    from_s: f64,
    until_s: Option<f64>,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct StaysInside {
    signal: Expression,
    low: Option<Expression>,
    high: Option<Expression>,
    to: Option<Expression>,
    within: Option<Expression>,
    #[serde(default)]
    from_s: f64,
    until_s: Option<f64>,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct NeverExceeds {
    signal: Expression,
    limit: Expression,
    #[serde(default)]
    from_s: f64,
    until_s: Option<f64>,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Eventually {
    signal: Expression,
    low: Option<Expression>,
    high: Option<Expression>,
    to: Option<Expression>,
    within: Option<Expression>,
    #[serde(default)]
    from_s: f64,
    by_s: Option<f64>,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Final {
    signal: Expression,
    to: Expression,
    within: Expression,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RmsBelow {
    signal: Expression,
    limit: f64,
    #[serde(default)]
    from_s: f64,
    until_s: Option<f64>,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Count {
    limit: u64,
}

/// What happened beside the signals.
#[derive(Clone, Debug, Default)]
pub(crate) struct Facts {
    /// Steps that were refused or failed: time and reason.
    pub(crate) failures: Vec<(f64, String)>,
    /// Deadlines missed; only of a paced plant.
    pub(crate) deadline_misses: Option<u64>,
}

/// Whether an expectation came true, and why not.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Verdict {
    /// The expectation, in words.
    pub(crate) expectation: String,
    /// None: it came true.
    pub(crate) broken: Option<Break>,
    /// In words: how near it came, or what broke it.
    pub(crate) message: String,
    /// What to plot; none for expectations without a signal.
    pub(crate) curve: Option<Curve>,
}

/// Where an expectation broke.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Break {
    /// Time, s; none if it is no single time.
    pub(crate) time_s: Option<f64>,
    /// Value of the signal then.
    pub(crate) value: Option<f64>,
}

/// A signal with its bounds and the time in which they hold.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Curve {
    pub(crate) name: String,
    pub(crate) values: Vec<f64>,
    /// Entries that are infinite are no bounds.
    pub(crate) low: Vec<f64>,
    pub(crate) high: Vec<f64>,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
}

impl Curve {
    fn is_inside(&self, k: usize) -> bool {
        self.low[k] <= self.values[k] && self.values[k] <= self.high[k]
    }

    /// How far the value is out of its bounds; 0 inside.
    fn distance(&self, k: usize) -> f64 {
        // `max` would lose what is not a number.
        let (below, above) = (self.low[k] - self.values[k], self.values[k] - self.high[k]);
        if self.is_inside(k) {
            0.0
        } else if below > above {
            below
        } else {
            above
        }
    }

    /// Indices of the samples in the time that counts.
    fn window(&self, time_s: &[f64]) -> Vec<usize> {
        let counts =
            |t: f64| t >= self.from_s - TIME_ROUNDING_S && t <= self.until_s + TIME_ROUNDING_S;
        (0..time_s.len()).filter(|&k| counts(time_s[k])).collect()
    }
}

/// Bounds as a file gives them.
struct Bounds<'a> {
    low: Option<&'a Expression>,
    high: Option<&'a Expression>,
    to: Option<&'a Expression>,
    within: Option<&'a Expression>,
}

impl<'a> Bounds<'a> {
    fn near(to: &'a Expression, within: &'a Expression) -> Self {
        Self { low: None, high: None, to: Some(to), within: Some(within) }
    }

    fn check(&self) -> Result<(), String> {
        match (self.low.or(self.high), self.to, self.within) {
            (Some(_), None, None) | (None, Some(_), Some(_)) => Ok(()),
            _ => Err("give `low` or `high` or both, or else `to` and `within`".to_owned()),
        }
    }

    fn values(&self, samples: &Samples) -> Result<(Vec<f64>, Vec<f64>), String> {
        let of = |bound: Option<&Expression>, none: f64| match bound {
            Some(expression) => expression.values(samples),
            None => Ok(vec![none; samples.len()]),
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
    fn bounds(&self) -> Bounds<'_> {
        let Self { low, high, to, within, .. } = self;
        Bounds { low: low.as_ref(), high: high.as_ref(), to: to.as_ref(), within: within.as_ref() }
    }
}

impl Eventually {
    fn bounds(&self) -> Bounds<'_> {
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

/// A number for people: four significant digits where more would only be noise.
pub(crate) fn short(x: f64) -> String {
    if !x.is_finite() {
        return x.to_string();
    }
    let magnitude = x.abs();
    if magnitude != 0.0 && !(1e-3..1e6).contains(&magnitude) {
        return format!("{x:.3e}");
    }
    let text = format!("{x:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

impl Expectation {
    /// Name of its key.
    pub(crate) fn key(&self) -> &'static str {
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
    pub(crate) fn check(&self, duration_s: f64) -> Result<(), String> {
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
    pub(crate) fn expressions(&self) -> Vec<&Expression> {
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

    /// Judges a run.
    ///
    /// # Errors
    /// A signal that there is not, by name.
    pub(crate) fn judge(&self, samples: &Samples, facts: &Facts) -> Result<Verdict, String> {
        let time_s = samples.time_s();
        let end_s = time_s.last().copied().unwrap_or(0.0);
        let curve =
            |signal: &Expression, bounds: &Bounds<'_>, from_s: f64, until_s: Option<f64>| {
                let (low, high) = bounds.values(samples)?;
                let until_s = until_s.unwrap_or(f64::INFINITY);
                let (name, values) = (signal.to_string(), signal.values(samples)?);
                Ok::<_, String>(Curve { name, values, low, high, from_s, until_s })
            };
        Ok(match self {
            Self::Settles(e) => {
                let bounds = Bounds::near(&e.to, &e.within);
                self.settled(curve(&e.signal, &bounds, e.by_s, None)?, time_s)
            }
            Self::OvershootBelow(e) => self.overshoot(e, samples)?,
            Self::StaysInside(e) => {
                self.inside(curve(&e.signal, &e.bounds(), e.from_s, e.until_s)?, time_s)
            }
            Self::NeverExceeds(e) => {
                let bounds = Bounds { low: None, high: Some(&e.limit), to: None, within: None };
                self.inside(curve(&e.signal, &bounds, e.from_s, e.until_s)?, time_s)
            }
            Self::Eventually(e) => {
                self.eventually(curve(&e.signal, &e.bounds(), e.from_s, e.by_s)?, time_s)
            }
            Self::Final(e) => {
                let bounds = Bounds::near(&e.to, &e.within);
                self.inside(curve(&e.signal, &bounds, end_s, None)?, time_s)
            }
            Self::RmsBelow(e) => {
                let none = Bounds { low: None, high: None, to: None, within: None };
                let curve = curve(&e.signal, &none, e.from_s, e.until_s)?;
                self.rms(e.limit, curve, time_s)
            }
            Self::DeadlineMissesBelow(Count { limit }) => match facts.deadline_misses {
                None => self.broken("the plant was not paced", None, None, None),
                Some(misses) if misses < *limit => self.met(format!("{misses} missed"), None),
                Some(misses) => self.broken(format!("{misses} missed"), None, None, None),
            },
            Self::NoFailures(_) => match facts.failures.first() {
                None => self.met("none".to_owned(), None),
                Some((at_s, reason)) => {
                    let message = format!("at {} s: {reason}", short(*at_s));
                    self.broken(message, Some(*at_s), None, None)
                }
            },
        })
    }

    fn met(&self, message: String, curve: Option<Curve>) -> Verdict {
        Verdict { expectation: self.to_string(), broken: None, message, curve }
    }

    fn broken(
        &self,
        message: impl Into<String>,
        time_s: Option<f64>,
        value: Option<f64>,
        curve: Option<Curve>,
    ) -> Verdict {
        let broken = Some(Break { time_s, value });
        Verdict { expectation: self.to_string(), broken, message: message.into(), curve }
    }

    fn unseen(&self, curve: Curve) -> Verdict {
        self.broken("the run has no sample in that time", None, None, Some(curve))
    }

    /// Out of bounds at sample `k`.
    fn outside(&self, curve: Curve, time_s: &[f64], k: usize) -> Verdict {
        let (t, value) = (time_s[k], curve.values[k]);
        let (low, high) = (curve.low[k], curve.high[k]);
        let message = match (value < low, value > high) {
            (true, _) => format!("at {} s it is {}, below {}", short(t), short(value), short(low)),
            (_, true) => format!("at {} s it is {}, above {}", short(t), short(value), short(high)),
            _ => format!(
                "at {} s it is {}, not between {} and {}",
                short(t),
                short(value),
                short(low),
                short(high)
            ),
        };
        self.broken(message, Some(t), Some(value), Some(curve))
    }

    fn inside(&self, curve: Curve, time_s: &[f64]) -> Verdict {
        let window = curve.window(time_s);
        if window.is_empty() {
            return self.unseen(curve);
        }
        if let Some(&k) = window.iter().find(|&&k| !curve.is_inside(k)) {
            return self.outside(curve, time_s, k);
        }
        let values = || window.iter().map(|&k| curve.values[k]);
        let low = values().fold(f64::INFINITY, f64::min);
        let high = values().fold(f64::NEG_INFINITY, f64::max);
        let message = match window.len() {
            1 => format!("is {}", short(low)),
            _ => format!("between {} and {}", short(low), short(high)),
        };
        self.met(message, Some(curve))
    }

    fn settled(&self, curve: Curve, time_s: &[f64]) -> Verdict {
        let window = curve.window(time_s);
        if window.is_empty() {
            return self.unseen(curve);
        }
        if let Some(&k) = window.iter().find(|&&k| !curve.is_inside(k)) {
            return self.outside(curve, time_s, k);
        }
        let last_outside = (0..time_s.len()).rev().find(|&k| !curve.is_inside(k));
        let since_s = time_s[last_outside.map_or(0, |k| k + 1)];
        self.met(format!("settled at {} s", short(since_s)), Some(curve))
    }

    fn overshoot(&self, e: &OvershootBelow, samples: &Samples) -> Result<Verdict, String> {
        let time_s = samples.time_s();
        let (values, to) = (e.signal.values(samples)?, e.to.values(samples)?);
        let until_s = e.until_s.unwrap_or(f64::INFINITY);
        let unbounded = |x: f64| vec![x; values.len()];
        let mut curve = Curve {
            name: e.signal.to_string(),
            low: unbounded(f64::NEG_INFINITY),
            high: unbounded(f64::INFINITY),
            values,
            from_s: e.from_s,
            until_s,
        };
        let window = curve.window(time_s);
        let Some(&first) = window.first() else { return Ok(self.unseen(curve)) };
        let way = to[first] - curve.values[first];
        let limit = e.limit.unwrap_or_else(|| e.percent.unwrap_or(f64::NAN) / 100.0 * way.abs());
        let past = |k: usize| match way {
            way if way > 0.0 => curve.values[k] - to[k],
            way if way < 0.0 => to[k] - curve.values[k],
            _ => (curve.values[k] - to[k]).abs(),
        };
        let broken = window.iter().copied().find(|&k| !(past(k) < limit));
        let most = window.iter().map(|&k| past(k)).fold(0.0, f64::max);
        let by = broken.map(past);
        if !(way < 0.0) {
            curve.high = to.iter().map(|to| to + limit).collect();
        }
        if !(way > 0.0) {
            curve.low = to.iter().map(|to| to - limit).collect();
        }
        let (Some(k), Some(by)) = (broken, by) else {
            return Ok(self.met(format!("by {}", short(most)), Some(curve)));
        };
        let (t, value) = (time_s[k], curve.values[k]);
        let message = format!("at {} s it is {}, past it by {}", short(t), short(value), short(by));
        Ok(self.broken(message, Some(t), Some(value), Some(curve)))
    }

    fn eventually(&self, curve: Curve, time_s: &[f64]) -> Verdict {
        let window = curve.window(time_s);
        if let Some(&k) = window.iter().find(|&&k| curve.is_inside(k)) {
            return self.met(format!("at {} s", short(time_s[k])), Some(curve));
        }
        let nearest = window.iter().copied().filter(|&k| !curve.distance(k).is_nan());
        let nearest = nearest.min_by(|&a, &b| curve.distance(a).total_cmp(&curve.distance(b)));
        let Some(k) = nearest else { return self.unseen(curve) };
        let (t, value) = (time_s[k], curve.values[k]);
        let message = format!("nearest at {} s, where it is {}", short(t), short(value));
        self.broken(message, Some(t), Some(value), Some(curve))
    }

    fn rms(&self, limit: f64, curve: Curve, time_s: &[f64]) -> Verdict {
        let window = curve.window(time_s);
        if window.is_empty() {
            return self.unseen(curve);
        }
        let squares = window.iter().map(|&k| curve.values[k] * curve.values[k]).sum::<f64>();
        let rms = (squares / window.len() as f64).sqrt();
        let message = format!("it is {}", short(rms));
        match rms < limit {
            true => self.met(message, Some(curve)),
            false => self.broken(message, None, Some(rms), Some(curve)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_1_SQRT_2, PI};

    use super::*;

    /// `x = 1 - exp(-t) cos(4 t)`, `line = t`, `tone = sin(2 pi t)`, over 5 s at 1 kHz.
    fn samples() -> Samples {
        let time_s: Vec<f64> = (0..=5000).map(|k| f64::from(k) * 1e-3).collect();
        let mut samples = Samples::default();
        let column = |f: fn(f64) -> f64| time_s.iter().map(|t| f(*t)).collect();
        samples.put("q(x)", column(|t| 1.0 - (-t).exp() * (4.0 * t).cos()));
        samples.put("q(line)", column(|t| t));
        samples.put("q(tone)", column(|t| (2.0 * PI * t).sin()));
        samples.put("q(hole)", column(|t| if t > 2.0 { f64::NAN } else { 0.0 }));
        samples.put_time(time_s);
        samples
    }

    fn expectation(text: &str) -> Expectation {
        #[derive(Deserialize)]
        struct File {
            expect: Expectation,
        }
        toml::from_str::<File>(&format!("[expect]\n{text}")).unwrap().expect
    }

    #[track_caller]
    fn judged(text: &str) -> Verdict {
        let expectation = expectation(text);
        expectation.check(5.0).unwrap();
        expectation.judge(&samples(), &Facts::default()).unwrap()
    }

    #[track_caller]
    fn breaks_at(text: &str, time_s: f64) {
        let verdict = judged(text);
        let actual = verdict.broken.expect("it must break").time_s.unwrap();
        assert!((actual - time_s).abs() < 1.5e-3, "{text}: {actual}: {}", verdict.message);
    }

    #[track_caller]
    fn passes(text: &str) -> String {
        let verdict = judged(text);
        assert_eq!(verdict.broken, None, "{text}: {}", verdict.message);
        verdict.message
    }

    #[test]
    fn settling_is_the_time_after_which_a_band_is_kept() {
        // |exp(-t) cos(4 t)| has its extremes where tan(4 t) = -1/4; the last one above 0.05 is the
        // fourth, and the band is entered behind it.
        let extreme = |n: f64| (n * PI - (0.25_f64).atan()) / 4.0;
        assert!((-extreme(4.0)).exp() * (4.0 * extreme(4.0)).cos() < 0.05);
        let message = passes("settles = { signal = 'x', to = 1, within = 0.05, by_s = 2.95 }");
        let at: f64 = message.split(' ').nth(2).unwrap().parse().unwrap();
        assert!(((-at).exp() * (4.0 * at).cos()).abs() < 0.05);
        let before = at - 2e-3;
        assert!(((-before).exp() * (4.0 * before).cos()).abs() > 0.05, "{message}");
        breaks_at("settles = { signal = 'x', to = 1, within = 0.05, by_s = 0.5 }", 0.5);
        breaks_at("settles = { signal = 'hole', to = 0, within = 1, by_s = 1 }", 2.001);
    }

    #[test]
    fn overshoot_is_measured_in_the_direction_of_the_step() {
        // The largest value is 1 + exp(-t) / sqrt(1 + 1/16) at tan(4 t) = -1/4, second quadrant.
        let t = (PI - (0.25_f64).atan()) / 4.0;
        let most = (-t).exp() / (1.0 + 1.0 / 16.0_f64).sqrt();
        let above =
            format!("overshoot_below = {{ signal = 'x', to = 1, limit = {} }}", most + 1e-4);
        assert_eq!(passes(&above), format!("by {}", short(most)));
        let percent =
            format!("overshoot_below = {{ signal = '-x', to = -1, percent = {} }}", most * 99.0);
        let verdict = judged(&percent);
        let at = verdict.broken.unwrap().time_s.unwrap();
        assert!(
            at < t && (-(-at).exp() * (4.0 * at).cos() - 0.99 * most).abs() < 2e-3,
            "{verdict:?}"
        );
        // Begun at the target, both sides count.
        breaks_at("overshoot_below = { signal = '-line', to = 0, limit = 2 }", 2.0);
        passes("overshoot_below = { signal = '-line', to = 0, limit = 2, until_s = 1.5 }");
    }

    #[test]
    fn bounds_hold_in_their_time() {
        assert_eq!(
            passes("stays_inside = { signal = 'tone', low = -1, high = 1 }"),
            "between -1 and 1"
        );
        breaks_at("stays_inside = { signal = 'tone', low = -0.5 }", 7.0 / 12.0);
        breaks_at("stays_inside = { signal = 'line', to = 't - 1', within = '2 - t' }", 1.0);
        passes("stays_inside = { signal = 'line', high = 2, until_s = 2 }");
        breaks_at("stays_inside = { signal = 'line', low = 2, from_s = 1 }", 1.0);
        passes("never_exceeds = { signal = '-tone', limit = 't + 1e-9', until_s = 0.5 }");
        breaks_at("never_exceeds = { signal = '|tone|', limit = 0.5 }", 1.0 / 12.0);
        breaks_at("never_exceeds = { signal = 'hole', limit = 1 }", 2.001);
        passes("never_exceeds = { signal = 'hole', limit = 1, until_s = 2 }");
    }

    #[test]
    fn eventually_is_once() {
        assert_eq!(passes("eventually = { signal = 'line', low = 1.5 }"), "at 1.5 s");
        assert_eq!(
            passes("eventually = { signal = 'tone', to = 1, within = 1e-9, by_s = 0.25 }"),
            "at 0.25 s"
        );
        breaks_at("eventually = { signal = 'tone', low = 2, by_s = 0.5 }", 0.25);
        let nan = judged("eventually = { signal = 'hole', low = 0, from_s = 3 }");
        assert_eq!(nan.broken, Some(Break { time_s: None, value: None }));
    }

    #[test]
    fn ends_and_means() {
        assert_eq!(passes("final = { signal = 'line', to = 5, within = 1e-9 }"), "is 5");
        breaks_at("final = { signal = 'line', to = 4, within = 0.5 }", 5.0);
        breaks_at("final = { signal = 'hole', to = 0, within = 0.5 }", 5.0);
        passes("rms_below = { signal = 'tone', limit = 0.7072 }");
        let verdict = judged("rms_below = { signal = 'tone', limit = 0.707 }");
        let value = verdict.broken.unwrap().value.unwrap();
        assert!((value - FRAC_1_SQRT_2).abs() < 1e-3, "{value}");
        assert!(judged("rms_below = { signal = 'hole', limit = 1 }").broken.is_some());
    }

    #[test]
    fn facts_are_counted() {
        let judge = |text: &str, facts: &Facts| {
            expectation(text).judge(&Samples::default(), facts).unwrap().broken
        };
        let none = Facts::default();
        assert_eq!(judge("no_failures = true", &none), None);
        assert!(judge("deadline_misses_below = { limit = 3 }", &none).is_some());
        let facts =
            Facts { failures: vec![(0.5, "SINGULAR".to_owned())], deadline_misses: Some(3) };
        assert_eq!(judge("no_failures = true", &facts).unwrap().time_s, Some(0.5));
        assert!(judge("deadline_misses_below = { limit = 3 }", &facts).is_some());
        assert_eq!(judge("deadline_misses_below = { limit = 4 }", &facts), None);
        for text in [
            "settles = { signal = 'x', to = 0, within = 1, by_s = 0 }",
            "final = { signal = 'x', to = 0, within = 1 }",
            "rms_below = { signal = 'x', limit = 1 }",
        ] {
            let mut nothing = Samples::default();
            nothing.put("q(x)", Vec::new());
            let verdict = expectation(text).judge(&nothing, &none).unwrap();
            assert!(verdict.message.contains("no sample"), "{text}");
            assert!(expectation(text).judge(&Samples::default(), &none).is_err());
        }
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
