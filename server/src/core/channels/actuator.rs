//! Input channels: what actuators make of an input.
//!
//! ```text
//! u ─► sampled and held ─► late ─► dead band ─► limited ─► rate limited ─► quantised ─► plant
//! ```

use crate::core::channels::sensor::quantised;

/// What happens between two samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hold {
    /// The last sample is held.
    Zero,
    /// A straight line from the sample before the last one to the last one, over a period.
    First,
}

/// How an actuator acts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ActuatorSettings {
    /// Steps from one sample to the next, at least 1: those divisible by it.
    pub(crate) period: u64,
    pub(crate) hold: Hold,
    /// Steps by which it is late.
    pub(crate) delay: usize,
    /// Half the width about zero in which nothing happens; beyond, what exceeds it acts.
    pub(crate) dead_band: f64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    /// Most that it changes in one step.
    pub(crate) most_change: f64,
    /// Zero means none.
    pub(crate) quantum: f64,
}

/// What an actuator keeps from step to step.
#[derive(Clone, Copy, Debug, Default)]
struct Memory {
    before: f64,
    sample: f64,
    /// Before quantisation.
    given: f64,
}

/// An input channel.
#[derive(Clone, Debug)]
pub(crate) struct Actuator {
    /// Entry of the input.
    pub(crate) entry: usize,
    pub(crate) settings: ActuatorSettings,
    memory: Memory,
    /// That after the step that is tried.
    next: Memory,
    /// Values on their way, by steps. The one that a failed step leaves is overwritten when it is tried
    /// again.
    line: Vec<f64>,
}

impl Actuator {
    pub(crate) fn new(entry: usize, settings: ActuatorSettings) -> Self {
        let memory = Memory::default();
        Self { entry, settings, memory, next: memory, line: vec![0.0; settings.delay + 1] }
    }

    /// Begins as if a value had always been given.
    pub(crate) fn begin(&mut self, value: f64) {
        self.memory = Memory { before: value, sample: value, given: value };
        self.next = self.memory;
        self.line.fill(value);
    }

    /// What acts in the step from `step`, if `value` is given.
    pub(crate) fn actuate(&mut self, step: u64, value: f64) -> f64 {
        let ActuatorSettings { period, hold, dead_band, min, max, most_change, quantum, .. } =
            self.settings;
        let mut next = self.memory;
        if step.is_multiple_of(period) {
            (next.before, next.sample) = (next.sample, value);
        }
        let held = match hold {
            Hold::Zero => next.sample,
            Hold::First => {
                let fraction = (step % period + 1) as f64 / period as f64;
                next.before + fraction * (next.sample - next.before)
            }
        };
        let length = self.line.len() as u64;
        self.line[(step % length) as usize] = held;
        let late = self.line[((step + 1) % length) as usize];
        let beyond =
            if dead_band > 0.0 { (late.abs() - dead_band).max(0.0).copysign(late) } else { late };
        let limited = beyond.max(min).min(max);
        let last = next.given;
        next.given = limited.max(last - most_change).min(last + most_change);
        self.next = next;
        quantised(next.given, quantum).max(min).min(max)
    }

    /// The step was taken.
    pub(crate) fn commit(&mut self) {
        self.memory = self.next;
    }

    /// What it keeps from step to step.
    pub(super) fn memory(&mut self) -> impl Iterator<Item = &mut f64> {
        let Memory { before, sample, given } = &mut self.memory;
        [before, sample, given].into_iter().chain(&mut self.line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDEAL: ActuatorSettings = ActuatorSettings {
        period: 1,
        hold: Hold::Zero,
        delay: 0,
        dead_band: 0.0,
        min: f64::NEG_INFINITY,
        max: f64::INFINITY,
        most_change: f64::INFINITY,
        quantum: 0.0,
    };

    fn run(settings: ActuatorSettings, given: &[f64]) -> Vec<f64> {
        let mut actuator = Actuator::new(0, settings);
        actuator.begin(0.0);
        let mut out = Vec::new();
        for (step, value) in given.iter().enumerate() {
            // A step that fails first must leave no trace.
            actuator.actuate(step as u64, 1e9);
            out.push(actuator.actuate(step as u64, *value));
            actuator.commit();
        }
        out
    }

    #[test]
    fn an_ideal_actuator_gives_what_it_gets() {
        let given = [1.0, -0.0, 1e-300, -7.5];
        let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&run(IDEAL, &given)), bits(&given));
    }

    #[test]
    fn delays_are_exact() {
        let given: Vec<f64> = (1..=8).map(f64::from).collect();
        for delay in 0..5 {
            let late = run(ActuatorSettings { delay, ..IDEAL }, &given);
            let expected: Vec<f64> =
                (1..=8).map(|k: i32| f64::from((k - delay as i32).max(0))).collect();
            assert_eq!(late, expected);
        }
    }

    #[test]
    fn samples_are_held_or_joined_by_lines() {
        let given = [2.0, 9.0, 9.0, 9.0, 4.0, 9.0, 9.0, 9.0];
        let zero = ActuatorSettings { period: 4, ..IDEAL };
        assert_eq!(run(zero, &given), [2.0, 2.0, 2.0, 2.0, 4.0, 4.0, 4.0, 4.0]);
        let first = ActuatorSettings { hold: Hold::First, ..zero };
        assert_eq!(run(first, &given), [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0]);
    }

    #[test]
    fn dead_band_limits_rate_and_quantum() {
        let band = ActuatorSettings { dead_band: 1.0, ..IDEAL };
        assert_eq!(run(band, &[0.5, -0.5, 3.0, -1.5]), [0.0, 0.0, 2.0, -0.5]);
        let limits = ActuatorSettings { min: -1.0, max: 2.0, ..IDEAL };
        assert_eq!(run(limits, &[5.0, -5.0, 0.3]), [2.0, -1.0, 0.3]);
        let rate = ActuatorSettings { most_change: 0.5, max: 1.25, ..IDEAL };
        // At its limit it does not wind up.
        assert_eq!(run(rate, &[9.0, 9.0, 9.0, 9.0, 0.0, 0.0]), [0.5, 1.0, 1.25, 1.25, 0.75, 0.25]);
        let quantum = ActuatorSettings { quantum: 0.25, max: 1.1, ..IDEAL };
        assert_eq!(run(quantum, &[0.3, 0.4, -0.4, 9.0]), [0.25, 0.5, -0.5, 1.0]);
    }
}
