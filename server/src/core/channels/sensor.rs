//! Output channels: what sensors see of a plant.
//!
//! ```text
//! source ─► sampled ─► + bias + noise ─► quantised ─► limited ─► lost at times ─► late
//! ```

use plantd_models::{Plant, Site};

use crate::core::channels::noise::Stream;

/// What a sensor measures.
#[derive(Clone, Debug)]
pub(crate) enum Source {
    /// A coordinate.
    Coordinate(usize),
    /// Its mean velocity over the last step, `(q[k] ⊖ q[k−1]) / h`: what an ideal encoder differentiates
    /// to. At a start, that of the state.
    Velocity(usize),
    /// The change of that velocity over a step, by the time between the middles of the two steps.
    Acceleration(usize),
    /// A point of a frame in the world.
    Position(Box<Site>),
    /// The rotation vector of a frame in the world.
    Orientation(Box<Site>),
    /// The multiplier of a constraint equation over the time step.
    ConstraintForce(usize),
    /// An entry of the input, as it acts.
    Input(usize),
    /// Kinetic and potential energy.
    Energy,
}

impl Source {
    /// Numbers that it has.
    pub(crate) fn width(&self) -> usize {
        match self {
            Self::Position(_) | Self::Orientation(_) => 3,
            _ => 1,
        }
    }

    pub(crate) fn site_mut(&mut self) -> Option<&mut Site> {
        match self {
            Self::Position(site) | Self::Orientation(site) => Some(site),
            _ => None,
        }
    }

    fn read(&self, at: &mut Instant<'_>) -> [f64; 3] {
        let plant = &mut *at.plant;
        let one = |value: f64| [value, 0.0, 0.0];
        match self {
            Self::Coordinate(i) => one(plant.q()[*i]),
            Self::Velocity(i) => one(at.rates[*i]),
            Self::Acceleration(i) => one(at.accelerations[*i]),
            Self::Position(site) => plant.pose(site).position,
            Self::Orientation(site) => plant.pose(site).rotation,
            Self::ConstraintForce(c) => one(plant.multipliers()[*c] / plant.settings().time_step_s),
            Self::Input(i) => one(at.input[*i]),
            Self::Energy => {
                let energy = plant.energy();
                one(energy.kinetic_j + energy.potential_j)
            }
        }
    }
}

/// What sensors look at.
pub(crate) struct Instant<'a> {
    pub(crate) plant: &'a mut Plant,
    pub(crate) rates: &'a [f64],
    pub(crate) accelerations: &'a [f64],
    pub(crate) input: &'a [f64],
    pub(crate) seed: u64,
}

/// Errors of a sensor, and how it samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SensorSettings {
    /// Steps from one sample to the next, at least 1: those divisible by it.
    pub(crate) period: u64,
    /// Steps by which it is late.
    pub(crate) latency: usize,
    pub(crate) bias: f64,
    /// Standard deviation.
    pub(crate) noise: f64,
    /// Zero means none.
    pub(crate) quantum: f64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    /// Probability that a sample is lost.
    pub(crate) drop_out: f64,
}

/// An output channel.
#[derive(Clone, Debug)]
pub(crate) struct Sensor {
    pub(crate) source: Source,
    pub(crate) settings: SensorSettings,
    stream: Stream,
    /// The last sample, and 1 where it stands for one that was lost, else 0.
    reading: [f64; 4],
    /// Samples on their way, by steps.
    line: Vec<[f64; 4]>,
}

impl Sensor {
    pub(crate) fn new(name: &str, source: Source, settings: SensorSettings) -> Self {
        Self {
            source,
            settings,
            stream: Stream::of(name),
            reading: [0.0; 4],
            line: vec![[0.0; 4]; settings.latency + 1],
        }
    }

    /// Begins at a state: all that was under way has its value.
    pub(crate) fn begin(&mut self, at: &mut Instant<'_>) {
        self.sample(at);
        self.line.fill(self.reading);
    }

    /// Measures after a step.
    pub(crate) fn measure(&mut self, at: &mut Instant<'_>) {
        let step = at.plant.step_index();
        if step.is_multiple_of(self.settings.period) {
            let chance = self.settings.drop_out;
            if chance > 0.0 && self.stream.part(3).uniform(at.seed, step) <= chance {
                self.reading[3] = 1.0;
            } else {
                self.sample(at);
            }
        }
        let length = self.line.len() as u64;
        self.line[(step % length) as usize] = self.reading;
    }

    /// What it delivers at a step, and 1 if that stands for a lost sample, else 0.
    pub(crate) fn present(&self, step: u64) -> [f64; 4] {
        self.line[((step + 1) % self.line.len() as u64) as usize]
    }

    /// What it keeps from step to step.
    pub(super) fn memory(&mut self) -> impl Iterator<Item = &mut f64> {
        self.reading.iter_mut().chain(self.line.as_flattened_mut())
    }

    fn sample(&mut self, at: &mut Instant<'_>) {
        let SensorSettings { bias, noise, quantum, min, max, .. } = self.settings;
        let values = self.source.read(at);
        let step = at.plant.step_index();
        for (part, value) in values.iter().take(self.source.width()).enumerate() {
            let mut reading = value + bias;
            if noise > 0.0 {
                reading += noise * self.stream.part(part).normal(at.seed, step);
            }
            self.reading[part] = quantised(reading, quantum).max(min).min(max);
        }
        self.reading[3] = 0.0;
    }
}

/// The nearest multiple of a quantum, where there is one.
pub(super) fn quantised(value: f64, quantum: f64) -> f64 {
    if quantum == 0.0 {
        return value;
    }
    let count = (value / quantum).round();
    // Beyond 2⁵³ every number is a multiple.
    if count.abs() < 9e15 { count * quantum } else { value }
}
