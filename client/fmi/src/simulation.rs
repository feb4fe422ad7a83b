//! One instance: a plant behind its variables.

use std::sync::Arc;

use plantd_models::parameters::{Parameters, change};
use plantd_models::{Energy, Initial, InitialError, Model, Plant, Spare};

use crate::blueprint::Blueprint;
use crate::error::FmuError;
use crate::partial::Derivatives;
use crate::variables::{EnergyKind, Kind, Variable};

/// How far a time may be off, in time steps: importers add times up, and rounding with them.
const TIME_TOLERANCE: f64 = 0.01;

/// Where an instance is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    Instantiated,
    Initialization,
    Step,
    Terminated,
}

/// What was set, and what it led to: a state of an instance without its plant's.
#[derive(Clone)]
pub(crate) struct Settled {
    pub(crate) phase: Phase,
    pub(crate) start_s: f64,
    pub(crate) stop_s: Option<f64>,
    /// Numbers of the scene as they were set.
    pub(crate) numbers: Vec<f64>,
    /// Those that the mechanism has, and the mechanism.
    pub(crate) taken: Vec<f64>,
    pub(crate) model: Arc<Model>,
    /// Start values, and which of them were set.
    pub(crate) q: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) held: Vec<bool>,
    pub(crate) input: Vec<f64>,
    pub(crate) given: Vec<bool>,
}

/// An instance.
pub(crate) struct Simulation {
    pub(crate) blueprint: Arc<Blueprint>,
    pub(crate) settled: Settled,
    /// Made when it is needed first; before the step mode it is made anew when start values change.
    pub(crate) plant: Option<Plant>,
    known: Known,
}

/// What follows from the state, found when it is asked for.
#[derive(Default)]
struct Known {
    velocity: Vec<f64>,
    energy: Option<Energy>,
    /// These depend on the input, too.
    next: Vec<f64>,
    derivatives: Option<Derivatives>,
}

impl Simulation {
    pub(crate) fn new(blueprint: Arc<Blueprint>) -> Self {
        let settled = Settled::new(&blueprint);
        Self { blueprint, settled, plant: None, known: Known::default() }
    }

    pub(crate) fn reset(&mut self) {
        self.settled = Settled::new(&self.blueprint);
        self.forget_plant();
    }

    pub(crate) fn phase(&self) -> Phase {
        self.settled.phase
    }

    pub(crate) fn enter_initialization(
        &mut self,
        start_s: f64,
        stop_s: Option<f64>,
    ) -> Result<(), FmuError> {
        self.require(Phase::Instantiated, "but right after the instantiation")?;
        if !start_s.is_finite() || stop_s.is_some_and(|stop_s| stop_s.is_nan() || stop_s < start_s)
        {
            return Err(FmuError::Times { start_s, stop_s: stop_s.unwrap_or(f64::INFINITY) });
        }
        (self.settled.start_s, self.settled.stop_s) = (start_s, stop_s);
        self.settled.phase = Phase::Initialization;
        self.forget_plant();
        Ok(())
    }

    pub(crate) fn exit_initialization(&mut self) -> Result<(), FmuError> {
        self.require(Phase::Initialization, "outside of the initialization mode")?;
        self.plant()?;
        self.settled.phase = Phase::Step;
        Ok(())
    }

    pub(crate) fn terminate(&mut self) -> Result<(), FmuError> {
        self.require(Phase::Step, "outside of the step mode")?;
        self.settled.phase = Phase::Terminated;
        Ok(())
    }

    /// Takes the time steps of a communication step, all or none.
    pub(crate) fn step(&mut self, at_s: f64, size_s: f64) -> Result<(), FmuError> {
        self.require(Phase::Step, "outside of the step mode")?;
        let h = self.blueprint.settings.time_step_s;
        let now_s = self.plant()?.time_s();
        if !((at_s - now_s).abs() <= TIME_TOLERANCE * h) {
            return Err(FmuError::OtherTime { at_s: now_s, given_s: at_s });
        }
        let count = (size_s / h).round();
        if !(count >= 1.0 && (size_s - count * h).abs() <= TIME_TOLERANCE * h) {
            return Err(FmuError::StepSize { given_s: size_s, time_step_s: h });
        }
        if let Some(stop_s) = self.settled.stop_s.filter(|s| at_s + size_s > s + TIME_TOLERANCE * h)
        {
            return Err(FmuError::BeyondStop { end_s: at_s + size_s, stop_s });
        }
        self.advance(count as u64)
    }

    fn advance(&mut self, count: u64) -> Result<(), FmuError> {
        let Self { plant: Some(plant), settled, .. } = self else { return Err(FmuError::Lost) };
        let before = (count > 1).then(|| plant.snapshot());
        for _ in 0..count {
            let at_s = plant.time_s();
            if let Err(source) = plant.step(&settled.input) {
                if let Some(before) = before {
                    plant.restore(&before)?;
                }
                return Err(FmuError::Step { at_s, source });
            }
        }
        self.forget_known();
        Ok(())
    }

    pub(crate) fn variable(&self, reference: u32) -> Result<&Variable, FmuError> {
        let variable = self.blueprint.variables.get(reference as usize);
        variable.ok_or(FmuError::NoVariable(reference))
    }

    /// The value of a variable.
    pub(crate) fn value(&mut self, reference: u32) -> Result<f64, FmuError> {
        Ok(match self.variable(reference)?.kind {
            Kind::Time => self.plant.as_ref().map_or(self.settled.start_s, Plant::time_s),
            Kind::Input(i) => self.settled.input[i],
            Kind::Parameter(i) => self.settled.numbers[i],
            Kind::Position(i) => self.plant()?.q()[i],
            Kind::Momentum(i) => self.plant()?.p()[i],
            Kind::Rate(i) => self.plant()?.v()[i],
            Kind::Force(i) => {
                let h = self.blueprint.settings.time_step_s;
                self.plant()?.multipliers()[i] / h
            }
            Kind::Velocity(i) => self.velocity()?[i],
            Kind::Energy(kind) => {
                let energy = self.energy()?;
                match kind {
                    EnergyKind::Total => energy.kinetic_j + energy.potential_j,
                    EnergyKind::Kinetic => energy.kinetic_j,
                    EnergyKind::Potential => energy.potential_j,
                }
            }
            Kind::Next(i) => self.next()?[i],
        })
    }

    /// Sets variables, all or none.
    pub(crate) fn set(&mut self, references: &[u32], values: &[f64]) -> Result<(), FmuError> {
        for (&reference, &value) in references.iter().zip(values) {
            self.check_settable(reference, value)?;
        }
        for (&reference, &value) in references.iter().zip(values) {
            match self.blueprint.variables[reference as usize].kind {
                Kind::Input(i) => {
                    (self.settled.input[i], self.settled.given[i]) = (value, true);
                    self.known.next.clear();
                    self.known.derivatives = None;
                }
                Kind::Parameter(i) => self.settled.numbers[i] = value,
                Kind::Position(i) => {
                    (self.settled.q[i], self.settled.held[i]) = (value, true);
                    self.forget_plant();
                }
                Kind::Velocity(i) => {
                    self.settled.velocity[i] = value;
                    self.forget_plant();
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn check_settable(&self, reference: u32, value: f64) -> Result<(), FmuError> {
        let Variable { name, kind, .. } = self.variable(reference)?;
        if !value.is_finite() {
            return Err(FmuError::NotFinite { name: name.clone(), value });
        }
        let is_starting = matches!(self.phase(), Phase::Instantiated | Phase::Initialization);
        match kind {
            Kind::Input(_) | Kind::Parameter(_) if is_starting || self.phase() == Phase::Step => {
                Ok(())
            }
            Kind::Input(_) | Kind::Parameter(_) => Err(FmuError::Phase("after the end")),
            Kind::Position(_) | Kind::Velocity(_) if is_starting => Ok(()),
            Kind::Position(_) | Kind::Velocity(_) => Err(FmuError::TooLate(name.clone())),
            _ => Err(FmuError::NotSettable(name.clone())),
        }
    }

    /// `Σ_j ∂unknown_i/∂known_j seed_j` for each unknown.
    pub(crate) fn directional(
        &mut self,
        unknowns: &[u32],
        knowns: &[u32],
        seed: &[f64],
    ) -> Result<Vec<f64>, FmuError> {
        unknowns
            .iter()
            .map(|&unknown| {
                let terms = knowns.iter().zip(seed);
                terms.map(|(&known, seed)| Ok(self.partial(unknown, known)? * seed)).sum()
            })
            .collect()
    }

    /// `Σ_i seed_i ∂unknown_i/∂known_j` for each known.
    pub(crate) fn adjoint(
        &mut self,
        unknowns: &[u32],
        knowns: &[u32],
        seed: &[f64],
    ) -> Result<Vec<f64>, FmuError> {
        knowns
            .iter()
            .map(|&known| {
                let terms = unknowns.iter().zip(seed);
                terms.map(|(&unknown, seed)| Ok(self.partial(unknown, known)? * seed)).sum()
            })
            .collect()
    }

    fn partial(&mut self, unknown: u32, known: u32) -> Result<f64, FmuError> {
        let (of, by) = (self.variable(unknown)?, self.variable(known)?);
        let dimensions = self.blueprint.model.dimensions();
        if let Some(value) = Derivatives::without_map(of.kind, by.kind, dimensions) {
            return Ok(value);
        }
        if !Derivatives::are_of_map(of.kind, by.kind) {
            let (unknown, known) = (of.name.clone(), by.name.clone());
            return Err(FmuError::NoDerivative { unknown, known });
        }
        let (of, by) = (of.kind, by.kind);
        self.plant()?;
        let Self { plant: Some(plant), settled, known, .. } = self else {
            return Err(FmuError::Lost);
        };
        if known.derivatives.is_none() {
            known.derivatives = Some(Derivatives::new(plant, &settled.input)?);
        }
        let value = known.derivatives.as_ref().and_then(|d| d.of_map(of, by, dimensions));
        value.ok_or(FmuError::Lost)
    }

    fn velocity(&mut self) -> Result<&[f64], FmuError> {
        self.plant()?;
        let Self { plant: Some(plant), known, .. } = self else { return Err(FmuError::Lost) };
        if known.velocity.is_empty() {
            known.velocity.resize(plant.q().len(), 0.0);
            plant.write_velocity(&mut known.velocity);
        }
        Ok(&known.velocity)
    }

    fn energy(&mut self) -> Result<Energy, FmuError> {
        self.plant()?;
        let Self { plant: Some(plant), known, .. } = self else { return Err(FmuError::Lost) };
        Ok(*known.energy.get_or_insert_with(|| plant.energy()))
    }

    /// The state after a step that is not taken.
    fn next(&mut self) -> Result<&[f64], FmuError> {
        self.plant()?;
        let Self { plant: Some(plant), settled, known, .. } = self else {
            return Err(FmuError::Lost);
        };
        if known.next.is_empty() {
            let mut ahead = plant.clone();
            let at_s = ahead.time_s();
            ahead.step(&settled.input).map_err(|source| FmuError::Step { at_s, source })?;
            known.next = [ahead.q(), ahead.p(), ahead.v()].concat();
        }
        Ok(&known.next)
    }

    /// The plant, with all that was set.
    pub(crate) fn plant(&mut self) -> Result<&mut Plant, FmuError> {
        if self.settled.numbers != self.settled.taken {
            self.take_over_numbers()?;
        }
        if self.plant.is_none() {
            self.plant = Some(self.start()?);
        }
        self.plant.as_mut().ok_or(FmuError::Lost)
    }

    fn take_over_numbers(&mut self) -> Result<(), FmuError> {
        let model = self.blueprint.model_with(&self.settled.numbers)?;
        if let Some(plant) = &self.plant {
            // A plant that has not moved begins anew with the changed mechanism.
            let changed = match self.settled.phase {
                Phase::Instantiated | Phase::Initialization => None,
                _ => {
                    let spare = Spare::new(Arc::clone(&model), self.blueprint.settings)?;
                    Some(spare.go_on_from(plant).map_err(FmuError::Change)?)
                }
            };
            self.plant = changed;
        }
        self.settled.model = model;
        self.settled.taken.clone_from(&self.settled.numbers);
        self.forget_known();
        Ok(())
    }

    /// A plant at the start. Start values that were set hold; the others satisfy the constraints.
    fn start(&mut self) -> Result<Plant, FmuError> {
        let (blueprint, settled) = (&self.blueprint, &mut self.settled);
        let spare = Spare::new(Arc::clone(&settled.model), blueprint.settings)?;
        let (q, v) = (settled.q.clone(), settled.velocity.clone());
        let mut plant = if q == blueprint.start.q && v == blueprint.start.velocity {
            spare.start(&blueprint.initial)?
        } else {
            match spare.clone().start(&Initial::Velocity { q: q.clone(), v: v.clone() }) {
                Err(InitialError::OffConstraint { .. }) if settled.held.contains(&false) => {
                    let names = settled.model.coordinates().iter().zip(&settled.held);
                    let hold =
                        names.filter(|(_, held)| **held).map(|(c, _)| c.name.clone()).collect();
                    let near = spare.clone().start(&Initial::Projection { q, hold })?;
                    spare.start(&Initial::Velocity { q: near.q().to_vec(), v })?
                }
                plant => plant?,
            }
        };
        plant.set_time_s(settled.start_s);
        for i in (0..settled.input.len()).filter(|i| !settled.given[*i]) {
            if let Some(coordinate) = blueprint.prescribed(i) {
                settled.input[i] = plant.q()[coordinate];
            }
        }
        Ok(plant)
    }

    fn require(&self, phase: Phase, otherwise: &'static str) -> Result<(), FmuError> {
        if self.settled.phase == phase { Ok(()) } else { Err(FmuError::Phase(otherwise)) }
    }

    pub(crate) fn forget_known(&mut self) {
        self.known.velocity.clear();
        self.known.next.clear();
        (self.known.energy, self.known.derivatives) = (None, None);
    }

    fn forget_plant(&mut self) {
        self.plant = None;
        self.forget_known();
    }
}

impl Settled {
    fn new(blueprint: &Blueprint) -> Self {
        let numbers: Vec<f64> = blueprint.numbers.iter().map(|(_, value)| *value).collect();
        let start = &blueprint.start;
        Self {
            phase: Phase::Instantiated,
            start_s: 0.0,
            stop_s: None,
            taken: numbers.clone(),
            numbers,
            model: Arc::clone(&blueprint.model),
            held: vec![false; start.q.len()],
            q: start.q.clone(),
            velocity: start.velocity.clone(),
            given: vec![false; start.input.len()],
            input: start.input.clone(),
        }
    }
}

impl Blueprint {
    /// The mechanism with other numbers.
    pub(crate) fn model_with(&self, numbers: &[f64]) -> Result<Arc<Model>, FmuError> {
        let changes: Vec<(String, f64)> = self
            .numbers
            .iter()
            .zip(numbers)
            .filter(|((_, usual), value)| usual.to_bits() != value.to_bits())
            .map(|((path, _), value)| (path.clone(), *value))
            .collect();
        if changes.is_empty() {
            return Ok(Arc::clone(&self.model));
        }
        Ok(Arc::new(change(&self.model, &Parameters::new(), &changes)?.model))
    }
}
