//! The channels and faults of a plant, in the order in which a step passes them.

use std::sync::Arc;

use plantd_models::parameters::Parameters;
use plantd_models::{Model, Plant, Site};

use crate::core::channels::actuator::Actuator;
use crate::core::channels::fault::{Effect, FaultMemory, Injected};
use crate::core::channels::sensor::{Instant, Sensor, Source};
use crate::core::channels::timeline::{Set, Timeline};
use crate::core::origin::Origin;

/// What is under way in the channels and faults of a plant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ChannelMemory {
    /// Hash of what was declared: only the same channels go on with it.
    pub declared: u64,
    /// What the channels keep from one step to the next, and what they deliver.
    pub numbers: Vec<f64>,
    /// What is under way in faults.
    pub faults: Vec<FaultMemory>,
}

/// The channels and faults of a plant.
#[derive(Clone, Debug)]
pub struct Channels {
    pub(crate) seed: u64,
    pub(crate) sensors: Vec<Sensor>,
    pub(crate) actuators: Vec<Actuator>,
    pub(crate) faults: Vec<Injected>,
    /// Of faults that change parameters.
    pub(crate) timeline: Option<Box<Timeline>>,
    /// What they were made from.
    pub(crate) declared: Origin,
    /// What they were made from, with times in whole steps.
    pub(crate) info: Origin,
    /// Hash of what was declared.
    hash: u64,
    output: Vec<f64>,
    /// Of each sensor: 1 where its numbers stand for lost ones, else 0.
    lost: Vec<f64>,
    rates: Option<Box<Rates>>,
}

/// Velocities and accelerations by differences.
#[derive(Clone, Debug)]
struct Rates {
    q: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    change: Vec<f64>,
    /// Part of a step from the time of `velocity` to that of `q`.
    age: f64,
}

impl Channels {
    /// Channels before they begin at a state.
    pub(crate) fn new(
        seed: u64,
        sensors: Vec<Sensor>,
        actuators: Vec<Actuator>,
        declared: Origin,
        info: Origin,
        hash: u64,
        model: &Model,
    ) -> Self {
        let n = model.dimensions().coordinates();
        let needs_rates = |sensor: &Sensor| {
            matches!(sensor.source, Source::Velocity(_) | Source::Acceleration(_))
        };
        let rates = sensors.iter().any(needs_rates).then(|| {
            let zeros = || vec![0.0; n];
            let (q, velocity, acceleration, change) = (zeros(), zeros(), zeros(), zeros());
            Box::new(Rates { q, velocity, acceleration, change, age: 0.0 })
        });
        Self {
            seed,
            output: vec![0.0; sensors.iter().map(|sensor| sensor.source.width()).sum()],
            lost: vec![0.0; sensors.len()],
            sensors,
            actuators,
            faults: Vec::new(),
            timeline: None,
            hash,
            declared,
            info,
            rates,
        }
    }

    /// Nothing is declared and nothing is wrong.
    pub(crate) fn is_empty(&self) -> bool {
        let has_none =
            self.sensors.is_empty() && self.actuators.is_empty() && self.faults.is_empty();
        // Faults to come will want the seed.
        has_none && self.seed == 0
    }

    /// The numbers of all outputs.
    pub(crate) fn output(&self) -> &[f64] {
        &self.output
    }

    /// Of each output: 1 where its numbers stand for lost ones, else 0.
    pub(crate) fn lost(&self) -> &[f64] {
        &self.lost
    }

    /// Puts the faults in their places in the plant's time, with the last input.
    pub(crate) fn place_faults(&mut self, plant: &Plant, input: &[f64]) {
        for fault in &mut self.faults {
            fault.place(plant, input, &self.output);
        }
    }

    /// Begins at the present state: everything on its way has the value it has here.
    pub(crate) fn begin(&mut self, plant: &mut Plant, input: &[f64]) {
        if let Some(timeline) = &mut self.timeline {
            timeline.begin();
        }
        if let Some(rates) = &mut self.rates {
            rates.q.copy_from_slice(plant.q());
            plant.write_velocity(&mut rates.velocity);
            rates.acceleration.fill(0.0);
            rates.age = 0.0;
        }
        let mut at = instant(plant, self.rates.as_deref(), input, self.seed);
        for sensor in &mut self.sensors {
            sensor.begin(&mut at);
        }
        for actuator in &mut self.actuators {
            actuator.begin(input[actuator.entry]);
        }
        self.write_output(plant.step_index());
        for fault in &mut self.faults {
            fault.begin(input, &self.output);
        }
    }

    /// Puts the changes of parameters in force that belong to the next step; returns the numbers that are
    /// changed then, if they are others than before.
    pub(crate) fn change_on_schedule(&mut self, plant: &mut Plant) -> Option<Arc<Parameters>> {
        let mut timeline = self.timeline.take()?;
        let set = self.wanted_set(plant.step_index());
        let has_changed = timeline.ask(set, plant, self.sites_mut());
        let parameters = has_changed.then(|| timeline.parameters()).flatten();
        self.timeline = Some(timeline);
        parameters
    }

    fn wanted_set(&self, step: u64) -> Set {
        self.faults.iter().fold(0, |set, fault| match fault.effect {
            Effect::Parameters { bit } if fault.is_active_at(step, self.seed) => set | 1 << bit,
            _ => set,
        })
    }

    /// Everything that is under way.
    pub(crate) fn memory(&mut self) -> ChannelMemory {
        ChannelMemory {
            declared: self.hash,
            numbers: self.numbers_mut().map(|number| *number).collect(),
            faults: self.faults.iter_mut().map(Injected::memory).collect(),
        }
    }

    /// Whether this was under way in these channels and faults; if not, in what else.
    pub(crate) fn check(&self, memory: &ChannelMemory) -> Result<(), &'static str> {
        if self.hash != memory.declared {
            return Err("set of channels");
        }
        let is_here = |kept: &FaultMemory| self.faults.iter().any(|fault| fault.is_of(kept));
        if memory.faults.iter().all(is_here) { Ok(()) } else { Err("set of faults") }
    }

    /// Goes on with what was under way, in the channels and faults that are those of then.
    pub(crate) fn recall(&mut self, memory: &ChannelMemory) {
        if self.hash == memory.declared && self.numbers_mut().count() == memory.numbers.len() {
            for (number, kept) in self.numbers_mut().zip(&memory.numbers) {
                *number = *kept;
            }
        }
        for fault in &mut self.faults {
            memory.faults.iter().for_each(|memory| fault.recall(memory));
        }
    }

    /// What the channels keep from one step to the next, and what they deliver.
    fn numbers_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let Self { sensors, actuators, output, lost, rates, .. } = self;
        let rates = rates.iter_mut().flat_map(|rates| {
            let Rates { q, velocity, age, .. } = &mut **rates;
            q.iter_mut().chain(velocity).chain(Some(age))
        });
        let sensors = sensors.iter_mut().flat_map(Sensor::memory);
        let actuators = actuators.iter_mut().flat_map(Actuator::memory);
        rates.chain(sensors).chain(actuators).chain(output).chain(lost)
    }

    /// Turns what is given as input into what acts on the plant in its next step, and adds the impulses of
    /// pushes; an empty `impulse` is none. Until [`Channels::measure`] a step can be tried any number of
    /// times. False when nothing acts on inputs.
    pub(crate) fn actuate(
        &mut self,
        plant: &Plant,
        input: &mut [f64],
        impulse: &mut Vec<f64>,
    ) -> bool {
        // The plant will refuse it by name.
        if input.iter().any(|value| !value.is_finite()) {
            return false;
        }
        let mut acts = !self.actuators.is_empty();
        let step = plant.step_index();
        for actuator in &mut self.actuators {
            let entry = &mut input[actuator.entry];
            *entry = actuator.actuate(step, *entry);
        }
        for fault in &mut self.faults {
            acts |= matches!(fault.effect, Effect::Input(_));
            fault.disturb_input(input, step, self.seed);
            if let Effect::Push { site, force, torque } = &fault.effect
                && fault.is_active_at(step, self.seed)
            {
                let h = plant.settings().time_step_s;
                let over_step = |wrench: &[f64; 3]| wrench.map(|component| h * component);
                impulse.resize(plant.p().len(), 0.0);
                plant.add_wrench(site, over_step(force), over_step(torque), impulse);
            }
        }
        acts
    }

    /// Measures after a step with an input, and notes that it was taken.
    pub(crate) fn measure(&mut self, plant: &mut Plant, input: &[f64]) {
        for actuator in &mut self.actuators {
            actuator.commit();
        }
        if let Some(rates) = &mut self.rates {
            rates.update(plant);
        }
        let mut at = instant(plant, self.rates.as_deref(), input, self.seed);
        for sensor in &mut self.sensors {
            sensor.measure(&mut at);
        }
        let step = plant.step_index();
        self.write_output(step);
        for fault in &mut self.faults {
            fault.commit_input();
            fault.disturb_output(&mut self.output, &mut self.lost, step, self.seed);
            let at = fault.last_step(step);
            let is_active = fault.is_active_at(at, self.seed);
            fault.has_changed = is_active != fault.is_active;
            fault.beginnings += u64::from(is_active && fault.has_changed);
            fault.is_active = is_active;
        }
    }

    /// The faults that began (true) or ended with the last step, which led to `step`: their numbers, and
    /// the step in which they did.
    pub(crate) fn changes(&self, step: u64) -> impl Iterator<Item = (u64, u64, bool)> {
        let changed = self.faults.iter().filter(|fault| fault.has_changed);
        changed.map(move |fault| (fault.id, fault.last_step(step), fault.is_active))
    }

    fn write_output(&mut self, step: u64) {
        let mut rest = &mut self.output[..];
        for (sensor, lost) in self.sensors.iter().zip(&mut self.lost) {
            let values = sensor.present(step);
            let (part, after) = rest.split_at_mut(sensor.source.width());
            part.copy_from_slice(&values[..part.len()]);
            (rest, *lost) = (after, values[3]);
        }
    }

    /// Numbers that sensors, actuators and faults keep.
    pub(crate) fn numbers(&self) -> usize {
        let sensors = self.sensors.iter().map(|s| 4 * (s.settings.latency + 1));
        let actuators = self.actuators.iter().map(|a| a.settings.delay + 4);
        let faults = self.faults.iter().map(Injected::numbers);
        sensors.chain(actuators).chain(faults).sum()
    }

    /// The sites that follow the plant's model, in an order that stays.
    pub(crate) fn sites_mut(&mut self) -> impl Iterator<Item = &mut Site> {
        let sensors = self.sensors.iter_mut().filter_map(|sensor| sensor.source.site_mut());
        let pushes = self.faults.iter_mut().filter_map(|fault| match &mut fault.effect {
            Effect::Push { site, .. } => Some(&mut **site),
            _ => None,
        });
        sensors.chain(pushes)
    }
}

fn instant<'a>(
    plant: &'a mut Plant,
    rates: Option<&'a Rates>,
    input: &'a [f64],
    seed: u64,
) -> Instant<'a> {
    let (rates, accelerations) =
        rates.map_or((&[][..], &[][..]), |rates| (&rates.velocity, &rates.acceleration));
    Instant { plant, rates, accelerations, input, seed }
}

impl Rates {
    fn update(&mut self, plant: &Plant) {
        let h = plant.settings().time_step_s;
        plant.model().write_difference(&self.q, plant.q(), &mut self.change);
        self.q.copy_from_slice(plant.q());
        // The velocity at a beginning belongs to its time, all others to the middle of a step.
        let apart = (self.age + 0.5) * h;
        self.age = 0.5;
        for (i, change) in self.change.iter().enumerate() {
            let velocity = change / h;
            self.acceleration[i] = (velocity - self.velocity[i]) / apart;
            self.velocity[i] = velocity;
        }
    }
}
