//! Faults: what goes wrong on purpose, when, and for how long.
//!
//! A fault is bound to steps of the plant: at step `k` of a plant that was reset it happens again. Whether it
//! is active is a function of the step alone.

use std::ops::Range;

use plantd_models::{Plant, Site};

use crate::core::channels::noise::Stream;
use crate::core::origin::Origin;

/// When a fault is active, in steps of the plant. On inputs, and of pushes, `k` is the step from `k` to
/// `k + 1`; on outputs the measurement at `k`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Schedule {
    pub(crate) start: u64,
    /// After the last step, if there is one.
    pub(crate) end: Option<u64>,
    pub(crate) pattern: Pattern,
}

/// Between start and end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Pattern {
    Always,
    /// The first `on` steps of every `period`.
    Intermittent {
        period: u64,
        on: u64,
    },
    /// Each window of so many steps with a probability.
    Random {
        window: u64,
        probability: f64,
    },
}

impl Schedule {
    pub(crate) fn is_active(&self, step: u64, seed: u64, stream: Stream) -> bool {
        let Some(since) = step.checked_sub(self.start) else { return false };
        if self.is_over(step) {
            return false;
        }
        match self.pattern {
            Pattern::Always => true,
            Pattern::Intermittent { period, on } => since % period < on,
            Pattern::Random { window, probability } => {
                stream.part(WINDOW).uniform(seed, since / window) <= probability
                    && probability > 0.0
            }
        }
    }

    pub(crate) fn is_over(&self, step: u64) -> bool {
        self.end.is_some_and(|end| step >= end)
    }
}

const LOSS: usize = 0;
const WINDOW: usize = 1;
/// The first of the streams of noise, one for each number.
const NOISE: usize = 2;

/// What a fault does to numbers of an input or output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Disturbance {
    /// The last value before it stays.
    Stuck,
    /// Zero.
    Off,
    WrongSign,
    Offset(f64),
    /// Standard deviation.
    Noise(f64),
    /// Steps.
    Delay(usize),
    /// Each step's value is lost with a probability, and the last one stays.
    DropOut(f64),
}

/// What a fault acts on.
#[derive(Clone, Debug)]
pub(crate) enum Effect {
    /// Entries of the input.
    Input(Line),
    /// Entries of the output vector, of one channel.
    Output { line: Line, channel: usize },
    /// A force and a torque in world axes.
    Push { site: Box<Site>, force: [f64; 3], torque: [f64; 3] },
    /// Numbers of the scene: the change of that number in the plant's [`crate::core::channels::timeline::Timeline`].
    Parameters { bit: u32 },
}

/// When a fault begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Start {
    /// With the next step.
    Next,
    Step(u64),
    /// s.
    Time(f64),
}

impl Start {
    /// The step that is meant at a step and time of the plant.
    fn step(self, present: u64, time_s: f64, time_step_s: f64, is_output: bool) -> u64 {
        match self {
            // The present outputs have been delivered.
            Self::Next => present + u64::from(is_output),
            Self::Step(step) => step,
            Self::Time(start_s) => {
                let ahead = (start_s - time_s) / time_step_s;
                // Casts saturate.
                if ahead < 0.0 {
                    present.saturating_sub(ahead.abs().round() as u64)
                } else {
                    present.saturating_add(ahead.round() as u64)
                }
            }
        }
    }
}

/// A disturbance of neighbouring numbers, with what it keeps of them.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) range: Range<usize>,
    pub(crate) disturbance: Disturbance,
    /// The last values given.
    held: Vec<f64>,
    /// Those after the step that is tried.
    next: Vec<f64>,
    /// Values on their way, by steps; see [`crate::core::channels::actuator`].
    late: Vec<f64>,
}

impl Line {
    pub(crate) fn new(range: Range<usize>, disturbance: Disturbance) -> Self {
        let width = range.len();
        let steps = match disturbance {
            Disturbance::Delay(steps) => steps + 1,
            _ => 0,
        };
        Self {
            range,
            disturbance,
            held: vec![0.0; width],
            next: vec![0.0; width],
            late: vec![0.0; steps * width],
        }
    }

    /// Begins as if these had always been the values.
    pub(crate) fn begin(&mut self, values: &[f64]) {
        let values = &values[self.range.clone()];
        self.held.copy_from_slice(values);
        self.next.copy_from_slice(values);
        for late in self.late.chunks_exact_mut(values.len().max(1)) {
            late.copy_from_slice(values);
        }
    }

    /// Disturbs the values of a step, if it is active. True when they stand for lost ones.
    fn disturb(&mut self, values: &mut [f64], step: u64, draw: &Draw) -> bool {
        let values = &mut values[self.range.clone()];
        let width = values.len();
        let mut is_lost = false;
        if let Disturbance::Delay(steps) = self.disturbance {
            let place = |step: u64| (step % (steps as u64 + 1)) as usize * width;
            self.late[place(step)..][..width].copy_from_slice(values);
            if draw.is_active {
                values.copy_from_slice(&self.late[place(step + 1)..][..width]);
            }
        } else if draw.is_active {
            match self.disturbance {
                Disturbance::Stuck => values.copy_from_slice(&self.held),
                Disturbance::Off => values.fill(0.0),
                Disturbance::WrongSign => values.iter_mut().for_each(|value| *value = -*value),
                Disturbance::Offset(offset) => values.iter_mut().for_each(|value| *value += offset),
                Disturbance::Noise(deviation) => {
                    for (i, value) in values.iter_mut().enumerate() {
                        *value += deviation * draw.stream.part(NOISE + i).normal(draw.seed, step);
                    }
                }
                Disturbance::DropOut(chance) => {
                    is_lost = draw.stream.part(LOSS).uniform(draw.seed, step) <= chance;
                    if is_lost {
                        values.copy_from_slice(&self.held);
                    }
                }
                Disturbance::Delay(_) => {}
            }
        }
        self.next.copy_from_slice(values);
        is_lost
    }

    fn commit(&mut self) {
        std::mem::swap(&mut self.held, &mut self.next);
    }

    /// What it keeps from step to step.
    fn memory(&mut self) -> impl Iterator<Item = &mut f64> {
        self.held.iter_mut().chain(&mut self.late)
    }
}

/// Whether and with which numbers a fault acts in a step.
struct Draw {
    is_active: bool,
    seed: u64,
    stream: Stream,
}

/// What is under way in a fault.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultMemory {
    /// Number of the fault.
    pub id: u64,
    /// Hash of what was asked for, and its start: only the same fault goes on with it.
    pub fault: u64,
    /// What it keeps from one step to the next.
    pub numbers: Vec<f64>,
    /// It was active in the last step.
    pub active: bool,
    /// How often it has begun.
    pub beginnings: u64,
}

/// A fault of a plant.
#[derive(Clone, Debug)]
pub(crate) struct Injected {
    pub(crate) id: u64,
    pub(crate) schedule: Schedule,
    pub(crate) effect: Effect,
    pub(crate) start: Start,
    pub(crate) duration: Option<u64>,
    /// As it was asked for.
    pub(crate) given: Origin,
    /// Hash of that.
    hash: u64,
    stream: Stream,
    /// It was active in the last step.
    pub(crate) is_active: bool,
    /// It was not in the one before, or the other way round.
    pub(crate) has_changed: bool,
    /// How often it has begun since the plant began.
    pub(crate) beginnings: u64,
}

impl Injected {
    pub(crate) fn new(
        id: u64,
        effect: Effect,
        start: Start,
        duration: Option<u64>,
        pattern: Pattern,
        given: Origin,
        hash: u64,
    ) -> Self {
        Self {
            id,
            schedule: Schedule { start: u64::MAX, end: None, pattern },
            effect,
            start,
            duration,
            hash,
            given,
            stream: Stream::of("fault").part(id as usize),
            is_active: false,
            has_changed: false,
            beginnings: 0,
        }
    }

    /// Binds it to steps of a plant that is at a step and time.
    pub(crate) fn schedule(&mut self, step: u64, time_s: f64, time_step_s: f64) {
        let is_output = matches!(self.effect, Effect::Output { .. });
        self.begin_at(self.start.step(step, time_s, time_step_s, is_output));
    }

    /// Its start lies before a step of the plant, or all of it: it would not do what was asked for. A start
    /// at the present outputs, which have been delivered, is taken for the next ones.
    pub(crate) fn is_late(&self, step: u64) -> bool {
        let is_output = matches!(self.effect, Effect::Output { .. });
        let next = step.saturating_add(is_output.into());
        self.schedule.start < step || self.schedule.is_over(next)
    }

    /// Binds it to the step with which it begins.
    pub(crate) fn begin_at(&mut self, step: u64) {
        self.schedule.start = step;
        self.schedule.end = self.duration.map(|steps| step.saturating_add(steps));
    }

    /// Binds it to steps of a plant for good, and begins at its state.
    pub(crate) fn place(&mut self, plant: &Plant, input: &[f64], output: &[f64]) {
        let h = plant.settings().time_step_s;
        self.schedule(plant.step_index(), plant.time_s(), h);
        self.keep_start();
        self.begin(input, output);
    }

    /// The next step is this one from now on.
    pub(crate) fn keep_start(&mut self) {
        if self.start == Start::Next {
            self.start = Start::Step(self.schedule.start);
        }
    }

    pub(crate) fn is_active_at(&self, step: u64, seed: u64) -> bool {
        self.schedule.is_active(step, seed, self.stream)
    }

    fn draw(&self, step: u64, seed: u64) -> Draw {
        Draw { is_active: self.is_active_at(step, seed), seed, stream: self.stream }
    }

    /// Begins at a state.
    pub(crate) fn begin(&mut self, input: &[f64], output: &[f64]) {
        (self.is_active, self.has_changed, self.beginnings) = (false, false, 0);
        match &mut self.effect {
            Effect::Input(line) => line.begin(input),
            Effect::Output { line, .. } => line.begin(output),
            Effect::Push { .. } | Effect::Parameters { .. } => {}
        }
    }

    /// The last of its steps that has been taken at a step of the plant.
    pub(crate) fn last_step(&self, step: u64) -> u64 {
        match self.effect {
            Effect::Output { .. } => step,
            _ => step.saturating_sub(1),
        }
    }

    /// Numbers that it keeps.
    pub(crate) fn numbers(&self) -> usize {
        match &self.effect {
            Effect::Input(line) | Effect::Output { line, .. } => {
                line.held.len() + line.next.len() + line.late.len()
            }
            Effect::Push { .. } | Effect::Parameters { .. } => 0,
        }
    }

    /// What it keeps from one step to the next.
    pub(super) fn memory(&mut self) -> FaultMemory {
        let fault = self.hash ^ self.schedule.start;
        let (active, beginnings) = (self.is_active, self.beginnings);
        let numbers = self.numbers_mut().map(|number| *number).collect();
        FaultMemory { id: self.id, fault, numbers, active, beginnings }
    }

    /// Whether this is what this fault kept.
    pub(super) fn is_of(&self, memory: &FaultMemory) -> bool {
        (self.id, self.hash ^ self.schedule.start) == (memory.id, memory.fault)
    }

    /// Goes on with what it kept, if it was this one.
    pub(super) fn recall(&mut self, memory: &FaultMemory) {
        if !self.is_of(memory) || self.numbers_mut().count() != memory.numbers.len() {
            return;
        }
        (self.is_active, self.beginnings) = (memory.active, memory.beginnings);
        for (number, kept) in self.numbers_mut().zip(&memory.numbers) {
            *number = *kept;
        }
    }

    fn numbers_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let line = match &mut self.effect {
            Effect::Input(line) | Effect::Output { line, .. } => Some(line),
            Effect::Push { .. } | Effect::Parameters { .. } => None,
        };
        line.into_iter().flat_map(Line::memory)
    }

    /// Disturbs the input of the step from `step`.
    pub(crate) fn disturb_input(&mut self, input: &mut [f64], step: u64, seed: u64) {
        let draw = self.draw(step, seed);
        if let Effect::Input(line) = &mut self.effect {
            line.disturb(input, step, &draw);
        }
    }

    /// The step was taken.
    pub(crate) fn commit_input(&mut self) {
        if let Effect::Input(line) = &mut self.effect {
            line.commit();
        }
    }

    /// Disturbs the outputs at `step`.
    pub(crate) fn disturb_output(
        &mut self,
        output: &mut [f64],
        lost: &mut [f64],
        step: u64,
        seed: u64,
    ) {
        let draw = self.draw(step, seed);
        if let Effect::Output { line, channel } = &mut self.effect {
            if line.disturb(output, step, &draw) {
                lost[*channel] = 1.0;
            }
            line.commit();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(start: u64, end: Option<u64>, pattern: Pattern) -> Schedule {
        Schedule { start, end, pattern }
    }

    fn active(schedule: Schedule, steps: Range<u64>) -> Vec<u64> {
        steps.filter(|step| schedule.is_active(*step, 1, Stream::of("fault"))).collect()
    }

    #[test]
    fn schedules_are_exact() {
        let always = schedule(3, Some(6), Pattern::Always);
        assert_eq!(active(always, 0..20), [3, 4, 5]);
        let blinking = Pattern::Intermittent { period: 4, on: 2 };
        assert_eq!(active(schedule(1, Some(11), blinking), 0..20), [1, 2, 5, 6, 9, 10]);
        assert_eq!(active(schedule(u64::MAX, None, Pattern::Always), 0..20), [] as [u64; 0]);
        for probability in [0.0, 1.0] {
            let window = Pattern::Random { window: 3, probability };
            let count = active(schedule(0, None, window), 0..30).len();
            assert_eq!(count as f64, 30.0 * probability);
        }
    }

    /// Windows are active as a whole, as often as they should.
    #[test]
    fn random_windows_have_their_probability() {
        let pattern = Pattern::Random { window: 5, probability: 0.3 };
        let steps = active(schedule(0, None, pattern), 0..50_000);
        assert!(steps.chunks_exact(5).all(|w| w[0] % 5 == 0 && w[4] == w[0] + 4));
        let windows = steps.len() as f64 / 5.0;
        let sigma = (10_000.0_f64 * 0.3 * 0.7).sqrt();
        assert!((windows - 3000.0).abs() < 4.0 * sigma, "{windows}");
    }

    /// What a fault between the steps 3 and 6 makes of 1, 2, 3, …; each step is tried twice.
    fn disturbed(disturbance: Disturbance) -> Vec<f64> {
        let line = Line::new(0..1, disturbance);
        let schedule = schedule(3, Some(6), Pattern::Always);
        let (start, given): (_, Origin) = (Start::Step(3), std::sync::Arc::new(()));
        let effect = Effect::Input(line);
        let mut fault = Injected::new(1, effect, start, Some(3), Pattern::Always, given, 0);
        fault.schedule = schedule;
        fault.begin(&[0.0], &[]);
        (0..8)
            .map(|step| {
                fault.disturb_input(&mut [1e9], step, 0);
                let mut value = [step as f64 + 1.0];
                fault.disturb_input(&mut value, step, 0);
                fault.commit_input();
                value[0]
            })
            .collect()
    }

    #[test]
    fn disturbances_do_what_they_say() {
        let expect = |disturbance, inside: [f64; 3]| {
            let [a, b, c] = inside;
            assert_eq!(disturbed(disturbance), [1.0, 2.0, 3.0, a, b, c, 7.0, 8.0]);
        };
        expect(Disturbance::Stuck, [3.0; 3]);
        expect(Disturbance::Off, [0.0; 3]);
        expect(Disturbance::WrongSign, [-4.0, -5.0, -6.0]);
        expect(Disturbance::Offset(0.5), [4.5, 5.5, 6.5]);
        expect(Disturbance::Delay(2), [2.0, 3.0, 4.0]);
        expect(Disturbance::Delay(5), [0.0, 0.0, 1.0]);
        expect(Disturbance::DropOut(0.0), [4.0, 5.0, 6.0]);
        expect(Disturbance::DropOut(1.0), [3.0; 3]);
        let noisy = disturbed(Disturbance::Noise(0.1));
        assert_eq!(noisy[..3], [1.0, 2.0, 3.0]);
        assert!(
            (3..6).all(|i| noisy[i] != i as f64 + 1.0 && (noisy[i] - i as f64 - 1.0).abs() < 0.6)
        );
    }
}
