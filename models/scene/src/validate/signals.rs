//! Signals: what they drive, and their numbers.

use std::collections::BTreeMap;

use crate::scene::CoordinateKind;
use crate::signals::Signal;
use crate::time_function::TimeFunction;
use crate::validate::Check;
use crate::words::UnknownName;

impl Check<'_> {
    pub(super) fn signals(&mut self) {
        let lengths = self.length_coordinates();
        let mut driven = BTreeMap::new();
        for (i, signal) in self.scene.signals.iter().enumerate() {
            let path = format!("signals[{i}]");
            let name = signal.drives();
            let drives = format!("{path}.drives");
            match self.kinds.get(name) {
                Some(CoordinateKind::Prescribed) => match driven.get(name) {
                    Some(first) => {
                        let message = format!("signals[{first}] drives `{name}` already");
                        self.report(drives, message);
                    }
                    None => {
                        driven.insert(name, i);
                    }
                },
                _ if self.inputs.contains(name) => {}
                Some(CoordinateKind::Dynamic) => {
                    let message =
                        format!("coordinate `{name}` is dynamic; a signal needs an input");
                    self.report(drives, message);
                }
                None => {
                    let driven = self.inputs.iter().copied().chain(self.prescribed());
                    let name = UnknownName::among(name, driven);
                    self.report(
                        drives,
                        format!("there is no input or prescribed coordinate {name}"),
                    );
                }
            }
            let before = self.problems.len();
            self.signal(&path, signal);
            if self.problems.len() == before {
                self.initial_value(path, signal, lengths.contains(name));
            }
        }
    }

    /// The value at the start, which is that of a prescribed coordinate.
    fn initial_value(&mut self, path: String, signal: &Signal, is_length: bool) {
        let initial = TimeFunction::new(signal).at(0.0);
        if !initial.is_finite() {
            self.report(path, format!("starts at {initial}; must be a finite number"));
        } else if is_length && initial <= 0.0 {
            self.report(path, format!("starts at {initial}; a length must be greater than zero"));
        }
    }

    fn signal(&mut self, path: &str, signal: &Signal) {
        match signal {
            Signal::Constant { value, .. } => {
                self.finite(format!("{path}.value"), *value);
            }
            Signal::Sinusoid { amplitude, frequency_hz, phase_rad, offset, .. } => {
                self.finite(format!("{path}.amplitude"), *amplitude);
                self.not_negative(format!("{path}.frequency_hz"), *frequency_hz);
                self.finite(format!("{path}.phase_rad"), *phase_rad);
                self.finite(format!("{path}.offset"), *offset);
            }
            Signal::Chirp { amplitude, start_hz, end_hz, duration_s, offset, .. } => {
                self.finite(format!("{path}.amplitude"), *amplitude);
                self.not_negative(format!("{path}.start_hz"), *start_hz);
                self.not_negative(format!("{path}.end_hz"), *end_hz);
                self.positive(format!("{path}.duration_s"), *duration_s);
                self.finite(format!("{path}.offset"), *offset);
            }
            Signal::Spline { knots, .. } => self.knots(format!("{path}.knots"), knots),
            Signal::Table { times_s, values, repeat, .. } => {
                self.table(path, times_s, values, *repeat);
            }
        }
    }

    fn table(&mut self, path: &str, times_s: &[f64], values: &[f64], repeat: bool) {
        let times = format!("{path}.times_s");
        let least = if repeat { 2 } else { 1 };
        if times_s.len() < least {
            self.report(times.clone(), format!("has {} entries; needs {least}", times_s.len()));
        }
        let unordered = times_s.windows(2).position(|pair| pair[0] >= pair[1]);
        if let (true, Some(k)) = (self.finite_all(&times, times_s), unordered) {
            self.report(format!("{times}[{}]", k + 1), "is not after the time before it");
        }
        let path = format!("{path}.values");
        if values.len() != times_s.len() {
            let message = format!("has {} entries for {} times", values.len(), times_s.len());
            self.report(path.clone(), message);
        }
        self.finite_all(&path, values);
    }
}
