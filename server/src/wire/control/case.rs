//! One case of a rollout: a plant that is made, takes its steps, and is gone. With nothing but inputs it is the bare
//! map; else a session like any other, so that it moves bit for bit as a plant does that is driven step by step.

pub(crate) mod flock;

use std::sync::{Arc, LazyLock};

use nalgebra::{DMatrix, DVector};
use plantd_models::parameters::{self, Parameters};
use plantd_models::{Model, Plant, Settings};
use plantd_proto::v1;

use crate::core::driver::DriverKind;
use crate::core::inputs::{Inputs, hold_input};
use crate::core::metrics::registry::Metrics;
use crate::core::plant::core::Core;
use crate::core::plant::watchdog::Trip;
use crate::core::session::lease::Lease;
use crate::core::workers::pool::Abandoned;
use crate::wire::control::expected::{Expected, Watched};
use crate::wire::message::start::{self, Start};
use crate::wire::message::{checks, states, weights};
use crate::wire::plants::change::ParametersError;
use crate::wire::plants::feedback::install;
use crate::wire::plants::run::protect;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// What all cases of a rollout share.
pub(crate) struct Shared {
    pub(crate) hub: Arc<Hub>,
    pub(crate) model: Arc<Model>,
    pub(crate) model_name: String,
    pub(crate) settings: Settings,
    /// Every how many steps a state is returned; `None` means only the last one.
    pub(crate) every: Option<usize>,
    pub(crate) extremes: bool,
    pub(crate) cost: Option<Cost>,
    pub(crate) expected: Option<Expected>,
    /// What cases have that do not say otherwise, but for inputs.
    pub(crate) common: v1::RolloutCase,
    /// Of plants that are nobody's, where there are any.
    pub(crate) metrics: LazyLock<Arc<Metrics>>,
}

/// A checked case.
pub(crate) struct Case {
    pub(crate) index: u32,
    pub(crate) start: Start,
    pub(crate) inputs: Arc<Inputs>,
    pub(crate) steps: usize,
    /// What else it has of its own.
    pub(crate) own: v1::RolloutCase,
}

/// A case that has ended: what is said of it, and its last state; none of one that never began.
pub(crate) type Ended = (v1::RolloutResponse, Vec<f64>);

/// A quadratic cost along a case.
pub(crate) struct Cost {
    q: Option<DMatrix<f64>>,
    r: Option<DMatrix<f64>>,
    end: Option<DMatrix<f64>>,
    x_reference: Vec<f64>,
    u_reference: DVector<f64>,
}

impl Cost {
    pub(crate) fn new(cost: v1::RolloutCost, model: &Model) -> Result<Self, RpcError> {
        let d = model.dimensions();
        let weight = |name: &str, given: Option<v1::Weight>, size: usize| {
            let field = format!("cost.{name}");
            given.map(|given| weights::weight(&field, Some(given), size)).transpose()
        };
        let reference = |name: &str, given: Vec<f64>, size: usize| {
            if given.is_empty() {
                return Ok(vec![0.0; size]);
            }
            checks::check_numbers(&format!("cost.{name}"), &given, size).map(|()| given)
        };
        Ok(Self {
            q: weight("q", cost.q, d.state())?,
            r: weight("r", cost.r, d.input())?,
            end: weight("end", cost.end, d.state())?,
            x_reference: reference("x_reference", cost.x_reference, d.state())?,
            u_reference: reference("u_reference", cost.u_reference, d.input())?.into(),
        })
    }

    /// `e' W e` of a state.
    fn of_state(&self, weight: Option<&DMatrix<f64>>, model: &Model, x: &[f64]) -> f64 {
        let Some(weight) = weight else { return 0.0 };
        let mut change = DVector::zeros(x.len());
        model.write_state_difference(&self.x_reference, x, change.as_mut_slice());
        change.dot(&(weight * &change))
    }

    /// `d' R d` of an input.
    fn of_input(&self, u: &[f64]) -> f64 {
        let Some(r) = &self.r else { return 0.0 };
        let change = DVector::from_column_slice(u) - &self.u_reference;
        change.dot(&(r * &change))
    }
}

/// What steps.
enum Machine {
    Map(Box<Plant>),
    Whole(Lease),
}

impl Machine {
    /// Looks at the plant.
    fn look<R>(&self, look: impl FnOnce(&Plant) -> R) -> Result<R, RpcError> {
        match self {
            Self::Map(plant) => Ok(look(plant)),
            Self::Whole(lease) => lease
                .look(|core| look(core.plant()))
                .map_err(|error| RpcError::from_drive(error, lease.session())),
        }
    }
}

/// A case on its way.
pub(crate) struct Simulation {
    case: Case,
    shared: Arc<Shared>,
    /// Made in the first part.
    machine: Option<Machine>,
    /// The input of the steps after those that have one of their own.
    held: Vec<f64>,
    taken: usize,
    x: Vec<f64>,
    /// What was seen of it, where something is expected.
    watched: Option<Watched>,
    response: v1::RolloutResponse,
}

impl Simulation {
    pub(crate) fn new(case: Case, shared: Arc<Shared>) -> Self {
        let response = v1::RolloutResponse { case_index: case.index, ..Default::default() };
        let x = Vec::new();
        let (machine, held, watched) = (None, Vec::new(), None);
        Self { case, shared, machine, held, taken: 0, x, watched, response }
    }

    /// Goes on for a part; the answer, and the last state, when the case has ended.
    pub(crate) fn go_on(&mut self, abandoned: &Abandoned) -> Result<Option<Ended>, RpcError> {
        match self.simulate(abandoned) {
            Ok(false) => return Ok(None),
            Ok(true) => {}
            Err(fault) if fault.reason() == "CANCELLED" => return Err(fault),
            Err(fault) => self.response.failure = Some(fault.into()),
        }
        Ok(Some(self.ended()))
    }

    fn ended(&mut self) -> Ended {
        self.response.steps = self.taken as u64;
        (std::mem::take(&mut self.response), std::mem::take(&mut self.x))
    }

    /// Takes steps until all are taken, which is true, or the part is over.
    fn simulate(&mut self, abandoned: &Abandoned) -> Result<bool, RpcError> {
        if self.machine.is_none() {
            self.begin(abandoned)?;
        }
        let mut outcome = Ok(());
        while self.taken < self.case.steps && self.response.ended_by.is_none() {
            outcome = self.step();
            if outcome.is_err() {
                break;
            }
            self.taken += 1;
            if self.shared.every.is_some_and(|every| self.taken.is_multiple_of(every)) {
                self.note_state();
            }
            if self.taken < self.case.steps && abandoned.part_is_over()? {
                return Ok(false);
            }
        }
        self.sum_up()?;
        if let (Some(expected), Some(watched)) = (&self.shared.expected, &self.watched) {
            let failure = outcome.as_ref().err().map(|fault| fault.message().to_owned());
            self.response.verdicts = expected.judge(watched, failure)?;
        }
        outcome.map(|()| true)
    }

    /// Says what is asked for of the last state.
    fn sum_up(&mut self) -> Result<(), RpcError> {
        if let Some(machine) = &self.machine {
            self.x = machine.look(states::x)?;
        }
        if self.shared.every.is_none() {
            self.note_state();
        }
        if let Some(cost) = &self.shared.cost {
            self.response.cost += cost.of_state(cost.end.as_ref(), &self.shared.model, &self.x);
        }
        Ok(())
    }

    fn begin(&mut self, abandoned: &Abandoned) -> Result<(), RpcError> {
        let machine = make(&self.case, &self.shared, abandoned)?;
        self.held = match self.case.inputs.last() {
            Some(last) => last.to_vec(),
            None => machine.look(hold_input)?,
        };
        self.x = machine.look(states::x)?;
        if self.shared.extremes {
            self.response.min = self.x.clone();
            self.response.max = self.x.clone();
        }
        let outputs = match &machine {
            Machine::Map(_) => Vec::new(),
            Machine::Whole(lease) => lease.session().channels().0.names.clone(),
        };
        let expected = self.shared.expected.as_ref();
        self.watched =
            expected.map(|expected| expected.watch(&self.shared.model, &outputs)).transpose()?;
        self.machine = Some(machine);
        let d = self.shared.model.dimensions();
        let prescribed = &self.x[d.dynamic..d.coordinates()];
        let at_rest = [&vec![0.0; d.input() - prescribed.len()][..], prescribed].concat();
        self.watch(&at_rest)
    }

    /// Looks at the plant after a step with an input, where something is expected.
    fn watch(&mut self, u: &[f64]) -> Result<(), RpcError> {
        let (Some(expected), Some(watched)) = (&self.shared.expected, &mut self.watched) else {
            return Ok(());
        };
        let energy = |plant: &mut Plant| {
            let energy = plant.energy();
            [energy.kinetic_j, energy.potential_j]
        };
        match &mut self.machine {
            None => {}
            Some(Machine::Map(plant)) => {
                let state = states::plant_state(plant);
                let energy = expected.uses_energy.then(|| energy(plant));
                watched.push(expected, &state, u, &[], energy);
            }
            Some(Machine::Whole(lease)) => {
                let (u, uses_energy) = (u.to_vec(), expected.uses_energy);
                let look = move |core: &mut Core| {
                    let applied = core.applied_input().map_or(u, <[f64]>::to_vec);
                    let copy = uses_energy.then(|| core.plant().clone());
                    (states::shown(&core.published()), states::core_outputs(core), applied, copy)
                };
                let (state, outputs, applied, copy) = lease.session().with_core(look);
                let y = outputs.map(|outputs| outputs.y).unwrap_or_default();
                watched.push(
                    expected,
                    &state,
                    &applied,
                    &y,
                    copy.map(|mut copy| energy(&mut copy)),
                );
            }
        }
        Ok(())
    }

    /// The input of the next step.
    fn input(&self) -> &[f64] {
        self.case.input(self.taken, &self.held)
    }

    /// Counts what the next step costs.
    fn count_cost(&mut self) {
        if let Some(cost) = &self.shared.cost {
            let of_state = cost.of_state(cost.q.as_ref(), &self.shared.model, &self.x);
            self.response.cost += of_state + cost.of_input(self.input());
        }
    }

    /// The state after each step is of interest.
    fn is_looked_at(&self) -> bool {
        self.shared.extremes || self.shared.cost.is_some()
    }

    fn note_extremes(&mut self) {
        if self.shared.extremes {
            let Self { x, response, .. } = self;
            for ((x, min), max) in x.iter().zip(&mut response.min).zip(&mut response.max) {
                (*min, *max) = (min.min(*x), max.max(*x));
            }
        }
    }

    /// Takes a step, and notes what is asked for of it.
    fn step(&mut self) -> Result<(), RpcError> {
        self.count_cost();
        let is_looked_at = self.is_looked_at();
        let Self { case, machine: Some(machine), held, taken, x, response, .. } = self else {
            return Err(RpcError::internal("a case that has not begun"));
        };
        let u = case.input(*taken, held);
        match machine {
            Machine::Map(plant) => {
                plant.step(u)?;
                if is_looked_at {
                    *x = states::x(plant);
                }
            }
            Machine::Whole(lease) => {
                let look = |core: &mut Core| {
                    if is_looked_at {
                        *x = states::x(core.plant());
                    }
                    core.frozen()
                };
                let frozen = lease
                    .step_and(u, None, look)
                    .map_err(|error| RpcError::from_drive(error, lease.session()))?;
                response.ended_by = frozen.map(|Trip { watchdog, value, step, .. }| {
                    v1::WatchdogTrip { watchdog: watchdog as u32, value, step }
                });
            }
        }
        self.note_extremes();
        if self.shared.expected.is_none() {
            return Ok(());
        }
        let u = self.input().to_vec();
        self.watch(&u)
    }

    /// Adds the present state to the answer.
    fn note_state(&mut self) {
        match &mut self.machine {
            None => {}
            Some(Machine::Map(plant)) => self.response.states.push(states::plant_state(plant)),
            Some(Machine::Whole(lease)) => {
                let shown = lease.session().with_core(|core| {
                    (states::shown(&core.published()), states::core_outputs(core))
                });
                self.response.states.push(shown.0);
                self.response.outputs.extend(shown.1);
            }
        }
    }
}

impl Case {
    /// The input of a step: its own, or the one that is held after those.
    fn input<'a>(&'a self, step: usize, held: &'a [f64]) -> &'a [f64] {
        if step < self.inputs.count() { self.inputs.get(step) } else { held }
    }

    /// It has nothing but inputs and numbers.
    fn is_bare(&self, common: &v1::RolloutCase) -> bool {
        [&self.own, common].iter().all(|case| {
            let v1::RolloutCase { feedback, channels, faults, until, .. } = case;
            feedback.is_none() && channels.is_none() && faults.is_empty() && until.is_empty()
        })
    }

    /// It has nothing but inputs, and the model of all.
    pub(crate) fn is_like_others(&self, common: &v1::RolloutCase) -> bool {
        let has_numbers = !self.own.parameters.is_empty() || !common.parameters.is_empty();
        self.is_bare(common) && !has_numbers
    }
}

/// Makes what a case steps.
fn make(case: &Case, shared: &Shared, abandoned: &Abandoned) -> Result<Machine, RpcError> {
    let (own, common, limits) = (&case.own, &shared.common, &shared.hub.limits);
    let changes = common.parameters.iter().chain(&own.parameters);
    let changes: Vec<_> = changes.map(|change| (change.path.clone(), change.value)).collect();
    let model = match changes.is_empty() {
        true => Arc::clone(&shared.model),
        false => {
            let changed = parameters::change(&shared.model, &Parameters::new(), &changes);
            Arc::new(changed.map_err(ParametersError::from)?.model)
        }
    };
    let field = format!("cases[{}].initial", case.index);
    let plant = start::plant(&model, shared.settings, &case.start, &field)?;
    if case.is_bare(common) {
        return Ok(Machine::Map(Box::new(plant)));
    }
    let channels = own.channels.as_ref().or(common.channels.as_ref());
    let feedback = own.feedback.as_ref().or(common.feedback.as_ref());
    let faults = || common.faults.iter().chain(&own.faults);
    let until = if own.until.is_empty() { &common.until } else { &own.until };
    let metrics = Arc::clone(&*shared.metrics);
    let session = shared.hub.apart(&shared.model_name, plant, metrics);
    let mut channels = channels.cloned().unwrap_or_default();
    if let Some(seed) = own.seed.or(common.seed) {
        channels.seed = seed;
    }
    let has_channels = !channels.outputs.is_empty() || !channels.inputs.is_empty();
    if has_channels {
        session.set_channels(channels.clone(), limits)?;
    }
    if let Some(feedback) = feedback {
        install(&shared.hub, &session, feedback.clone(), abandoned)?;
    }
    for fault in faults() {
        session.inject_fault(fault.clone(), limits)?;
    }
    if !has_channels && faults().next().is_some() {
        // The seed of their chance.
        session.set_channels(channels, limits)?;
    }
    protect(&session, until.clone(), 0)?;
    Ok(Machine::Whole(session.acquire(DriverKind::Step)?))
}
