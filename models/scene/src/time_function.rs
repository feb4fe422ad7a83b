//! The values of signals.
//!
//! Time is the step index times the time step, so that a motion goes on the same after a snapshot.

use std::f64::consts::TAU;

use plantd_math::spline::Spline;
use plantd_math::trigonometry::sin_cos_of;

use crate::signals::{Interpolation, Signal};

/// A signal that can be evaluated.
#[derive(Clone, Debug)]
pub struct TimeFunction {
    of: Signal,
    /// Through the knots, where it has some.
    spline: Option<Spline>,
}

impl TimeFunction {
    /// Of a signal that has been validated.
    ///
    /// # Panics
    ///
    /// If the knots make no spline, which validation refuses.
    pub fn new(signal: &Signal) -> Self {
        let spline = match signal {
            Signal::Spline { knots, .. } => {
                Some(Spline::new(knots).expect("validation refuses knots that make no spline"))
            }
            _ => None,
        };
        Self { of: signal.clone(), spline }
    }

    /// Value at time `t`, s.
    pub fn at(&self, t: f64) -> f64 {
        match &self.of {
            Signal::Constant { value, .. } => *value,
            Signal::Sinusoid { amplitude, frequency_hz, phase_rad, offset, .. } => {
                offset + amplitude * sin_cos_of(TAU * frequency_hz * t + phase_rad).0
            }
            Signal::Chirp { amplitude, start_hz, end_hz, duration_s, offset, .. } => {
                let rate = TAU * (end_hz - start_hz) / duration_s;
                let swept = t.min(*duration_s);
                let phase = TAU * start_hz * t + rate * swept * (t - 0.5 * swept);
                offset + amplitude * sin_cos_of(phase).0
            }
            Signal::Spline { knots, .. } => {
                let within = t.clamp(knots[0].x, knots[knots.len() - 1].x);
                self.spline.as_ref().map_or(f64::NAN, |spline| spline.value(within))
            }
            Signal::Table { times_s: times, values, interpolation, repeat, .. } => {
                let (first, last) = (times[0], times[times.len() - 1]);
                let t = if *repeat { first + (t - first).rem_euclid(last - first) } else { t };
                table(times, values, *interpolation == Interpolation::Linear, t)
            }
        }
    }
}

/// Value of a table at `t`: binary search, then the earlier value or a straight line.
fn table(times: &[f64], values: &[f64], linear: bool, t: f64) -> f64 {
    let after = times.partition_point(|time| *time <= t);
    match (after.checked_sub(1), linear && after < times.len()) {
        (None, _) => values[0],
        (Some(before), false) => values[before],
        (Some(before), true) => {
            let part = (t - times[before]) / (times[after] - times[before]);
            values[before] + part * (values[after] - values[before])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> TimeFunction {
        let signal = toml::from_str(&format!("drives = \"u\"\n{text}")).unwrap();
        TimeFunction::new(&signal)
    }

    #[test]
    fn sinusoid_has_amplitude_frequency_phase_and_mean() {
        let signal = parsed(
            "type = \"sinusoid\"\namplitude = 2.0\nfrequency_hz = 0.5\nphase_rad = 0.3\noffset = 1.0",
        );
        for t in [0.0, 0.1, 1.7, 20.0] {
            let expected = 1.0 + 2.0 * (std::f64::consts::PI * t + 0.3).sin();
            assert!((signal.at(t) - expected).abs() < 1e-13, "{t}");
        }
    }

    /// The frequency between two rising zeros is that of the middle, and constant after the sweep.
    #[test]
    fn chirp_sweeps_linearly_and_then_stays() {
        let signal = parsed(
            "type = \"chirp\"\namplitude = 1.0\nstart_hz = 1.0\nend_hz = 3.0\nduration_s = 10.0",
        );
        let step = 1e-4;
        let rising: Vec<f64> = (0..150_000)
            .map(|k| f64::from(k) * step)
            .filter(|t| signal.at(*t) < 0.0 && signal.at(t + step) >= 0.0)
            .collect();
        for pair in rising.windows(2) {
            let (middle, frequency) = (0.5 * (pair[0] + pair[1]), 1.0 / (pair[1] - pair[0]));
            let expected = if middle < 10.0 { 1.0 + 0.2 * middle } else { 3.0 };
            assert!((frequency - expected).abs() < 0.02, "{frequency} Hz at {middle} s");
        }
        assert!(rising.len() > 30);
    }

    #[test]
    fn spline_goes_through_its_knots_and_stays_at_its_ends() {
        let signal = parsed(
            "type = \"spline\"\nknots = [{ x = 1.0, value = 3.0, slope = 0.0 }, { x = 2.0, value = 5.0 }, { x = 4.0, value = 1.0, slope = 7.0 }]",
        );
        for (t, value) in [(0.0, 3.0), (1.0, 3.0), (2.0, 5.0), (4.0, 1.0), (9.0, 1.0)] {
            assert!((signal.at(t) - value).abs() < 1e-12, "{t}");
        }
        assert!((signal.at(4.0) - signal.at(4.0 - 1e-6) - 7e-6).abs() < 1e-10);
    }

    #[test]
    fn table_holds_or_goes_straight_and_stays_at_its_ends() {
        let points = "type = \"table\"\ntimes_s = [1.0, 2.0, 4.0]\nvalues = [3.0, 5.0, 1.0]";
        let cases = [(0.0, 3.0, 3.0), (1.0, 3.0, 3.0), (1.5, 3.0, 4.0), (2.0, 5.0, 5.0)];
        let (hold, linear) =
            (parsed(points), parsed(&format!("{points}\ninterpolation = \"linear\"")));
        for (t, held, straight) in
            cases.into_iter().chain([(3.0, 5.0, 3.0), (4.0, 1.0, 1.0), (9.0, 1.0, 1.0)])
        {
            assert_eq!((hold.at(t), linear.at(t)), (held, straight), "{t}");
        }
    }

    #[test]
    fn repeated_table_starts_again_at_its_last_time() {
        let points = "type = \"table\"\ntimes_s = [0.5, 1.0, 2.0]\nvalues = [3.0, 5.0, 1.0]";
        let signal = parsed(&format!("{points}\nrepeat = true\ninterpolation = \"linear\""));
        for t in [0.5, 0.6, 1.2, 1.9] {
            for round in [-1.0, 1.0, 7.0] {
                assert!((signal.at(t + 1.5 * round) - signal.at(t)).abs() < 1e-12, "{t}");
            }
        }
        assert_eq!((signal.at(2.0), signal.at(0.0)), (3.0, 3.0));
    }
}
