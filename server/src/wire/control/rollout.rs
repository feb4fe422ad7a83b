//! `ControlService.Rollout`: many simulations of one model, as many at a time as there are workers.

use std::sync::Arc;

use futures::{StreamExt, stream};
use plantd_models::{Model, Plant, Settings};
use plantd_proto::v1;

use crate::core::inputs::{Inputs, hold_input};
use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::Abandoned;
use crate::core::workers::queue::Admission;
use crate::wire::answers::Answers;
use crate::wire::control::points::model_and_settings;
use crate::wire::message::start::{self, Start};
use crate::wire::message::states;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::jobs::Jobs;
use crate::wire::status::RpcError;

/// A checked request.
pub(crate) struct Rollout {
    shared: Arc<Shared>,
    cases: Vec<Case>,
}

struct Shared {
    model: Arc<Model>,
    settings: Settings,
    /// Every how many steps a state is returned; `None` means only the last one.
    every: Option<usize>,
}

struct Case {
    index: u32,
    start: Start,
    inputs: Inputs,
    steps: usize,
}

impl Rollout {
    pub(crate) fn new(hub: &Hub, request: v1::RolloutRequest) -> Result<Self, RpcError> {
        let limits = &hub.limits;
        let count = request.cases.len();
        LimitExceeded::check("rollout_cases", limits.rollout_cases, "cases", count)?;
        let (model, settings) = model_and_settings(hub, &request.model, request.settings)?;
        let every = (request.every > 0).then_some(request.every as usize);
        let state_numbers = states::state_numbers(model.dimensions());
        let mut cases = Vec::with_capacity(count);
        for (index, case) in (0..).zip(request.cases) {
            let field = format!("cases[{index}].u");
            let inputs = Inputs::new(&field, case.u, model.dimensions().input())?;
            let steps = inputs.count().saturating_add(case.hold as usize);
            LimitExceeded::check("horizon", limits.horizon, "steps", steps)?;
            let states = every.map_or(1, |every| steps / every);
            let numbers = states.saturating_mul(state_numbers);
            let (name, limit) = ("reply_numbers", limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in the states of a case", numbers)?;
            let start = start::start(case.initial, &model, &hub.limits)?;
            cases.push(Case { index, start, inputs, steps });
        }
        Ok(Self { shared: Arc::new(Shared { model, settings, every }), cases })
    }

    /// The answers, in the order in which the cases end.
    pub(crate) fn run(self, workers: Jobs) -> Answers<v1::RolloutResponse> {
        let parallel = workers.count();
        let shared = self.shared;
        let answers = stream::iter(self.cases).map(move |case| {
            let (workers, shared) = (workers.clone(), Arc::clone(&shared));
            async move {
                let mut simulation = Simulation::new(case, shared);
                let part = move |abandoned: &Abandoned| simulation.go_on(abandoned);
                Ok(workers.in_parts(Admission::Granted, part).await?)
            }
        });
        Box::pin(answers.buffer_unordered(parallel))
    }
}

/// A case on its way.
struct Simulation {
    case: Case,
    shared: Arc<Shared>,
    /// Made in the first part.
    plant: Option<Box<Plant>>,
    /// The input of the steps after those that have one of their own.
    held: Vec<f64>,
    taken: usize,
    response: v1::RolloutResponse,
}

impl Simulation {
    fn new(case: Case, shared: Arc<Shared>) -> Self {
        let response = v1::RolloutResponse { case_index: case.index, ..Default::default() };
        Self { case, shared, plant: None, held: Vec::new(), taken: 0, response }
    }

    /// Goes on for a part; the answer when the case has ended.
    fn go_on(&mut self, abandoned: &Abandoned) -> Result<Option<v1::RolloutResponse>, RpcError> {
        match self.simulate(|| Ok(abandoned.part_is_over()?)) {
            Ok(false) => return Ok(None),
            Ok(true) => {}
            Err(fault) if fault.reason() == "CANCELLED" => return Err(fault),
            Err(fault) => self.response.failure = Some(fault.into()),
        }
        Ok(Some(std::mem::take(&mut self.response)))
    }

    /// Takes steps until all are taken, which is true, or `is_over` after one of them.
    fn simulate(&mut self, is_over: impl Fn() -> Result<bool, RpcError>) -> Result<bool, RpcError> {
        let Self { case, shared, held, taken, response, .. } = self;
        let plant = match &mut self.plant {
            Some(plant) => plant,
            None => {
                let field = format!("cases[{}].initial", case.index);
                let plant = start::plant(&shared.model, shared.settings, &case.start, &field)?;
                *held = match case.inputs.last() {
                    Some(last) => last.to_vec(),
                    None => hold_input(&plant),
                };
                self.plant.insert(Box::new(plant))
            }
        };
        let mut outcome = Ok(());
        while *taken < case.steps {
            let u = if *taken < case.inputs.count() { case.inputs.get(*taken) } else { &*held };
            outcome = plant.step(u).map(|_| ());
            if outcome.is_err() {
                break;
            }
            *taken += 1;
            if shared.every.is_some_and(|every| *taken % every == 0) {
                response.states.push(states::plant_state(plant));
            }
            if *taken < case.steps && is_over()? {
                return Ok(false);
            }
        }
        if shared.every.is_none() {
            response.states.push(states::plant_state(plant));
        }
        Ok(outcome.map(|()| true)?)
    }
}
