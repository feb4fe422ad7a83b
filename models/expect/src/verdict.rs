//! Whether what a scenario expects came true. Nothing but arithmetic on samples.

use crate::expectation::{Bounds, Count, Expectation, OvershootBelow};
use crate::expression::Expression;
use crate::number::short;
use crate::samples::Samples;

/// Times closer than this are the same, s.
const TIME_ROUNDING_S: f64 = 1e-9;

/// What happened beside the signals.
#[derive(Clone, Debug, Default)]
pub struct Facts {
    /// Steps that were refused or failed: time and reason.
    pub failures: Vec<(f64, String)>,
    /// Deadlines missed; only of a paced plant.
    pub deadline_misses: Option<u64>,
}

/// Whether an expectation came true, and why not.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The expectation, in words.
    pub expectation: String,
    /// None: it came true.
    pub broken: Option<Break>,
    /// In words: how near it came, or what broke it.
    pub message: String,
    /// What to plot; none for expectations without a signal.
    pub curve: Option<Curve>,
}

/// Where an expectation broke.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Break {
    /// Time, s; none if it is no single time.
    pub time_s: Option<f64>,
    /// Value of the signal then.
    pub value: Option<f64>,
}

/// A signal with its bounds and the time in which they hold.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// The signal, in words.
    pub name: String,
    /// Its values, sample by sample.
    pub values: Vec<f64>,
    /// Entries that are infinite are no bounds.
    pub low: Vec<f64>,
    /// The same.
    pub high: Vec<f64>,
    /// The first time at which they hold, s.
    pub from_s: f64,
    /// The last time at which they hold, s.
    pub until_s: f64,
}

impl Curve {
    /// A signal without bounds.
    pub fn unbounded(signal: &Expression, samples: &Samples) -> Result<Self, String> {
        let values = signal.values(samples)?;
        Ok(Self {
            name: signal.to_string(),
            low: vec![f64::NEG_INFINITY; values.len()],
            high: vec![f64::INFINITY; values.len()],
            values,
            from_s: 0.0,
            until_s: f64::INFINITY,
        })
    }

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

/// Judges a run.
///
/// # Errors
/// A signal that there is not, by name.
pub fn judge(
    expectation: &Expectation,
    samples: &Samples,
    facts: &Facts,
) -> Result<Verdict, String> {
    let time_s = samples.time_s();
    let end_s = time_s.last().copied().unwrap_or(0.0);
    let curve = |signal: &Expression, bounds: &Bounds<'_>, from_s: f64, until_s: Option<f64>| {
        let (low, high) = bounds.values(samples)?;
        let until_s = until_s.unwrap_or(f64::INFINITY);
        let (name, values) = (signal.to_string(), signal.values(samples)?);
        Ok::<_, String>(Curve { name, values, low, high, from_s, until_s })
    };
    let Finding { broken, message, curve } = match expectation {
        Expectation::Settles(e) => {
            let bounds = Bounds::near(&e.to, &e.within);
            settled(curve(&e.signal, &bounds, e.by_s, None)?, time_s)
        }
        Expectation::OvershootBelow(e) => overshoot(e, samples)?,
        Expectation::StaysInside(e) => {
            inside(curve(&e.signal, &e.bounds(), e.from_s, e.until_s)?, time_s)
        }
        Expectation::NeverExceeds(e) => {
            let bounds = Bounds { low: None, high: Some(&e.limit), to: None, within: None };
            inside(curve(&e.signal, &bounds, e.from_s, e.until_s)?, time_s)
        }
        Expectation::Eventually(e) => {
            eventually(curve(&e.signal, &e.bounds(), e.from_s, e.by_s)?, time_s)
        }
        Expectation::Final(e) => {
            let bounds = Bounds::near(&e.to, &e.within);
            inside(curve(&e.signal, &bounds, end_s, None)?, time_s)
        }
        Expectation::RmsBelow(e) => {
            let none = Bounds { low: None, high: None, to: None, within: None };
            let curve = curve(&e.signal, &none, e.from_s, e.until_s)?;
            rms(e.limit, curve, time_s)
        }
        Expectation::DeadlineMissesBelow(Count { limit }) => match facts.deadline_misses {
            None => broken("the plant was not paced", None, None, None),
            Some(misses) if misses < *limit => met(format!("{misses} missed"), None),
            Some(misses) => broken(format!("{misses} missed"), None, None, None),
        },
        Expectation::NoFailures(_) => match facts.failures.first() {
            None => met("none".to_owned(), None),
            Some((at_s, reason)) => {
                let message = format!("at {} s: {reason}", short(*at_s));
                broken(message, Some(*at_s), None, None)
            }
        },
    };
    Ok(Verdict { expectation: expectation.to_string(), broken, message, curve })
}

/// What came of an expectation.
struct Finding {
    broken: Option<Break>,
    message: String,
    curve: Option<Curve>,
}

fn met(message: String, curve: Option<Curve>) -> Finding {
    Finding { broken: None, message, curve }
}

fn broken(
    message: impl Into<String>,
    time_s: Option<f64>,
    value: Option<f64>,
    curve: Option<Curve>,
) -> Finding {
    Finding { broken: Some(Break { time_s, value }), message: message.into(), curve }
}

fn unseen(curve: Curve) -> Finding {
    broken("the run has no sample in that time", None, None, Some(curve))
}

/// Out of bounds at sample `k`.
fn outside(curve: Curve, time_s: &[f64], k: usize) -> Finding {
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
    broken(message, Some(t), Some(value), Some(curve))
}

fn inside(curve: Curve, time_s: &[f64]) -> Finding {
    let window = curve.window(time_s);
    if window.is_empty() {
        return unseen(curve);
    }
    if let Some(&k) = window.iter().find(|&&k| !curve.is_inside(k)) {
        return outside(curve, time_s, k);
    }
    let values = || window.iter().map(|&k| curve.values[k]);
    let low = values().fold(f64::INFINITY, f64::min);
    let high = values().fold(f64::NEG_INFINITY, f64::max);
    let message = match window.len() {
        1 => format!("is {}", short(low)),
        _ => format!("between {} and {}", short(low), short(high)),
    };
    met(message, Some(curve))
}

fn settled(curve: Curve, time_s: &[f64]) -> Finding {
    let window = curve.window(time_s);
    if window.is_empty() {
        return unseen(curve);
    }
    if let Some(&k) = window.iter().find(|&&k| !curve.is_inside(k)) {
        return outside(curve, time_s, k);
    }
    let last_outside = (0..time_s.len()).rev().find(|&k| !curve.is_inside(k));
    let since_s = time_s[last_outside.map_or(0, |k| k + 1)];
    met(format!("settled at {} s", short(since_s)), Some(curve))
}

fn overshoot(e: &OvershootBelow, samples: &Samples) -> Result<Finding, String> {
    let time_s = samples.time_s();
    let mut curve = Curve {
        from_s: e.from_s,
        until_s: e.until_s.unwrap_or(f64::INFINITY),
        ..Curve::unbounded(&e.signal, samples)?
    };
    let to = e.to.values(samples)?;
    let window = curve.window(time_s);
    let Some(&first) = window.first() else { return Ok(unseen(curve)) };
    let way = to[first] - curve.values[first];
    let limit = e.limit.unwrap_or_else(|| e.percent.unwrap_or(f64::NAN) / 100.0 * way.abs());
    let past = |k: usize| match way {
        way if way > 0.0 => curve.values[k] - to[k],
        way if way < 0.0 => to[k] - curve.values[k],
        _ => (curve.values[k] - to[k]).abs(),
    };
    let first_past = window.iter().copied().find(|&k| !(past(k) < limit));
    let most = window.iter().map(|&k| past(k)).fold(0.0, f64::max);
    let by = first_past.map(past);
    if !(way < 0.0) {
        curve.high = to.iter().map(|to| to + limit).collect();
    }
    if !(way > 0.0) {
        curve.low = to.iter().map(|to| to - limit).collect();
    }
    let (Some(k), Some(by)) = (first_past, by) else {
        return Ok(met(format!("by {}", short(most)), Some(curve)));
    };
    let (t, value) = (time_s[k], curve.values[k]);
    let message = format!("at {} s it is {}, past it by {}", short(t), short(value), short(by));
    Ok(broken(message, Some(t), Some(value), Some(curve)))
}

fn eventually(curve: Curve, time_s: &[f64]) -> Finding {
    let window = curve.window(time_s);
    if let Some(&k) = window.iter().find(|&&k| curve.is_inside(k)) {
        return met(format!("at {} s", short(time_s[k])), Some(curve));
    }
    let nearest = window.iter().copied().filter(|&k| !curve.distance(k).is_nan());
    let nearest = nearest.min_by(|&a, &b| curve.distance(a).total_cmp(&curve.distance(b)));
    let Some(k) = nearest else { return unseen(curve) };
    let (t, value) = (time_s[k], curve.values[k]);
    let message = format!("nearest at {} s, where it is {}", short(t), short(value));
    broken(message, Some(t), Some(value), Some(curve))
}

fn rms(limit: f64, curve: Curve, time_s: &[f64]) -> Finding {
    let window = curve.window(time_s);
    if window.is_empty() {
        return unseen(curve);
    }
    let squares = window.iter().map(|&k| curve.values[k] * curve.values[k]).sum::<f64>();
    let rms = (squares / window.len() as f64).sqrt();
    let message = format!("it is {}", short(rms));
    match rms < limit {
        true => met(message, Some(curve)),
        false => broken(message, None, Some(rms), Some(curve)),
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_1_SQRT_2, PI};

    use super::*;
    use crate::expectation::tests::expectation;

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

    #[track_caller]
    fn judged(text: &str) -> Verdict {
        let expectation = expectation(text);
        expectation.check(5.0).unwrap();
        judge(&expectation, &samples(), &Facts::default()).unwrap()
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
            super::judge(&expectation(text), &Samples::default(), facts).unwrap().broken
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
            let verdict = super::judge(&expectation(text), &nothing, &none).unwrap();
            assert!(verdict.message.contains("no sample"), "{text}");
            assert!(super::judge(&expectation(text), &Samples::default(), &none).is_err());
        }
    }
}
