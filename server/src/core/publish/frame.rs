//! What a plant publishes after a step.

use std::sync::Arc;

use plantd_models::{Dimensions, State, StepReport};

use crate::core::publish::report::{from_words, to_words};
use crate::core::publish::ring::{Reader, Ring};

/// Room for the numbers of a frame that are neither state nor input.
const FIXED_WORDS: usize = 32;
/// Most output values and flags of a plant: a frame has room for them.
pub const OUTPUTS_MAX: usize = 256;

/// When a step was due, and when it was taken, ns on the system's monotonic clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timing {
    /// When it was due; 0 unless the plant follows a clock.
    pub due_ns: u64,
    /// When it began; 0 when nobody looked at the clock.
    pub began_ns: u64,
    /// When it was over; 0 when nobody looked at the clock.
    pub ended_ns: u64,
    /// Sequence number of the driver's input that was in force; 0 for none.
    pub input_sequence: u64,
    /// Age of that input when the step began, ns.
    pub input_age_ns: u64,
    /// What is to be said of the input, see [`Timing::LATE`].
    pub flags: u64,
}

impl Timing {
    /// No new input has come since the step before.
    pub const LATE: u64 = 1;
    /// The safe input was in force: none had come, or none for longer than the policy allows.
    pub const SAFE: u64 = 2;
}

/// A state with the step that led to it.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// The state.
    pub state: State,
    /// Its time, s.
    pub time_s: f64,
    /// Velocity that belongs to it: of all coordinates, from the projected momentum.
    pub velocity: Vec<f64>,
    /// Number of changes of the plant's parameters and time step so far.
    pub generation: u64,
    /// Report of the step.
    pub report: StepReport,
    /// Input of the step; before the first one, the input that holds the plant.
    pub input: Vec<f64>,
    /// What the driver asked for.
    pub driver_input: Vec<f64>,
    /// Impulse that was added to the momentum before the step; empty for none.
    pub impulse: Vec<f64>,
    /// What the output channels deliver.
    pub outputs: Vec<f64>,
    /// A flag for each of these channels: 1 where it delivers once more what it did before, else 0.
    pub lost: Vec<f64>,
    /// Time step of the plant, s.
    pub time_step_s: f64,
    /// Digest of its model.
    pub model_digest: u64,
    /// When the step was taken.
    pub timing: Timing,
}

/// A [`Frame`] without memory of its own.
#[derive(Clone, Copy)]
pub(crate) struct Published<'a> {
    pub(crate) step: u64,
    pub(crate) time_s: f64,
    pub(crate) q: &'a [f64],
    pub(crate) p: &'a [f64],
    pub(crate) v: &'a [f64],
    pub(crate) multipliers: &'a [f64],
    pub(crate) velocity: &'a [f64],
    pub(crate) input: &'a [f64],
    pub(crate) driver_input: &'a [f64],
    pub(crate) impulse: &'a [f64],
    pub(crate) outputs: &'a [f64],
    pub(crate) lost: &'a [f64],
    pub(crate) report: StepReport,
    pub(crate) generation: u64,
    pub(crate) time_step_s: f64,
    pub(crate) model_digest: u64,
    pub(crate) timing: Timing,
}

/// Words of a record of a plant of these sizes.
pub fn record_words(d: Dimensions) -> usize {
    let state = d.state() + d.constraints + d.coordinates();
    FIXED_WORDS + state + 2 * d.input() + d.dynamic + OUTPUTS_MAX
}

impl Published<'_> {
    /// The words of a record.
    pub(crate) fn record(&self) -> impl Iterator<Item = u64> {
        let timing = &self.timing;
        let fixed = [
            self.step,
            self.time_s.to_bits(),
            self.generation,
            self.time_step_s.to_bits(),
            self.model_digest,
            timing.due_ns,
            timing.began_ns,
            timing.ended_ns,
            timing.input_sequence,
            timing.input_age_ns,
            timing.flags,
        ];
        let Self { q, p, v, multipliers, velocity, .. } = *self;
        let Self { input, driver_input, impulse, outputs, lost, .. } = *self;
        let vectors = [q, p, v, multipliers, velocity, input, driver_input, impulse, outputs, lost];
        let sizes = vectors.map(|vector| vector.len() as u64);
        let numbers = vectors.into_iter().flatten().map(|number| number.to_bits());
        fixed.into_iter().chain(to_words(&self.report)).chain(sizes).chain(numbers)
    }
}

impl Frame {
    /// Copies into memory that is allocated at the first call only.
    pub(crate) fn copy_from(&mut self, published: &Published<'_>) {
        self.state.step = published.step;
        self.time_s = published.time_s;
        self.generation = published.generation;
        self.report = published.report;
        self.time_step_s = published.time_step_s;
        self.model_digest = published.model_digest;
        self.timing = published.timing;
        for (target, source) in [
            (&mut self.state.q, published.q),
            (&mut self.state.p, published.p),
            (&mut self.state.v, published.v),
            (&mut self.state.multipliers, published.multipliers),
            (&mut self.velocity, published.velocity),
            (&mut self.input, published.input),
            (&mut self.driver_input, published.driver_input),
            (&mut self.impulse, published.impulse),
            (&mut self.outputs, published.outputs),
            (&mut self.lost, published.lost),
        ] {
            target.clear();
            target.extend_from_slice(source);
        }
    }

    /// The frame that a record holds. Allocates at the first call only.
    pub fn read(&mut self, record: &[u64]) {
        let mut words = record.iter().copied();
        let mut next = || words.next().unwrap_or(0);
        let number = f64::from_bits;
        self.state.step = next();
        self.time_s = number(next());
        self.generation = next();
        self.time_step_s = number(next());
        self.model_digest = next();
        self.timing = Timing {
            due_ns: next(),
            began_ns: next(),
            ended_ns: next(),
            input_sequence: next(),
            input_age_ns: next(),
            flags: next(),
        };
        self.report = from_words(&mut next);
        let sizes: [usize; 10] = std::array::from_fn(|_| next() as usize);
        let vectors = [
            &mut self.state.q,
            &mut self.state.p,
            &mut self.state.v,
            &mut self.state.multipliers,
            &mut self.velocity,
            &mut self.input,
            &mut self.driver_input,
            &mut self.impulse,
            &mut self.outputs,
            &mut self.lost,
        ];
        for (vector, size) in vectors.into_iter().zip(sizes) {
            vector.clear();
            vector.extend(words.by_ref().take(size).map(number));
        }
    }

    /// The frame as what was published.
    pub(crate) fn published(&self) -> Published<'_> {
        Published {
            step: self.state.step,
            time_s: self.time_s,
            q: &self.state.q,
            p: &self.state.p,
            v: &self.state.v,
            multipliers: &self.state.multipliers,
            velocity: &self.velocity,
            input: &self.input,
            driver_input: &self.driver_input,
            impulse: &self.impulse,
            outputs: &self.outputs,
            lost: &self.lost,
            report: self.report,
            generation: self.generation,
            time_step_s: self.time_step_s,
            model_digest: self.model_digest,
            timing: self.timing,
        }
    }
}

/// Frames, read from a plant's ring.
#[derive(Debug)]
pub struct Frames {
    reader: Reader,
    frame: Frame,
}

impl Frames {
    /// Record `next` and what comes after it.
    pub fn from(ring: Arc<Ring>, next: u64) -> Self {
        Self { reader: Reader::from(ring, next), frame: Frame::default() }
    }

    /// The next one and the number of its record, if there is one before record `end`. Skips what has been
    /// overwritten.
    pub fn read_before(&mut self, end: u64) -> Option<(u64, &Frame)> {
        let (number, record) = self.reader.read_before(end)?;
        self.frame.read(record);
        Some((number, &self.frame))
    }

    /// Number of those that were overwritten before they were read.
    pub fn lost(&self) -> u64 {
        self.reader.lost()
    }

    /// The last one, if it was not read.
    pub fn read_last(&mut self) -> Option<&Frame> {
        self.reader.skip_to_last();
        self.read_before(u64::MAX).map(|(_, frame)| frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_comes_back_from_its_record() {
        let frame = Frame {
            state: State {
                step: 7,
                q: vec![1.0, -0.0, f64::MIN_POSITIVE],
                p: vec![2.0, 3.0],
                v: vec![4.0],
                multipliers: vec![5.0],
            },
            time_s: 0.07,
            velocity: vec![11.0, -12.0, 4.0],
            generation: 3,
            report: StepReport {
                iterations: 1,
                factorizations: 2,
                redundant_constraints: 3,
                steps: 4,
                halvings: 5,
                residual: 0.1,
                constraint_residual: 0.2,
                reciprocal_condition: 0.3,
                constraint_reciprocal_condition: 0.4,
            },
            input: vec![6.0, 7.0],
            driver_input: vec![8.0],
            impulse: vec![9.0, 10.0],
            outputs: vec![f64::INFINITY],
            lost: vec![1.0],
            time_step_s: 0.01,
            model_digest: u64::MAX,
            timing: Timing {
                due_ns: 1,
                began_ns: 2,
                ended_ns: 3,
                input_sequence: 4,
                input_age_ns: 5,
                flags: Timing::LATE,
            },
        };
        let record: Vec<u64> = frame.published().record().collect();
        let mut back = Frame { outputs: vec![1.0; 9], ..Frame::default() };
        back.read(&record);
        assert_eq!(format!("{back:?}"), format!("{frame:?}"));
        let d = Dimensions { dynamic: 2, prescribed: 1, inputs: 1, constraints: 1 };
        assert!(record.len() - 2 + OUTPUTS_MAX <= record_words(d));
    }
}
