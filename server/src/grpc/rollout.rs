//! `ControlService.Rollout`: many simulations of one model, as many at a time as there are workers.

use std::sync::Arc;

use futures::{StreamExt, stream};
use plantd_models::{Model, Settings};
use plantd_proto::v1;

use super::Answers;
use super::control::model_and_settings;
use crate::convert::{self, Inputs, Start};
use crate::hub::Hub;
use crate::limits::LimitExceeded;
use crate::status::Fault;
use crate::workers::{Abandoned, Workers};

/// A checked request.
pub(super) struct Rollout {
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
    pub(super) fn new(hub: &Hub, request: v1::RolloutRequest) -> Result<Self, Fault> {
        let limits = &hub.limits;
        let count = request.cases.len();
        LimitExceeded::check("rollout_cases", limits.rollout_cases, "cases", count)?;
        let (model, settings) = model_and_settings(hub, &request.model, request.settings)?;
        let every = (request.every > 0).then_some(request.every as usize);
        let state_numbers = convert::state_numbers(model.dimensions());
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
            let start = convert::start(case.initial, &model, &hub.limits)?;
            cases.push(Case { index, start, inputs, steps });
        }
        Ok(Self { shared: Arc::new(Shared { model, settings, every }), cases })
    }

    /// The answers, in the order in which the cases end.
    pub(super) fn run(self, workers: Workers) -> Answers<v1::RolloutResponse> {
        let parallel = workers.count();
        let shared = self.shared;
        let answers = stream::iter(self.cases).map(move |case| {
            let (workers, shared) = (workers.clone(), Arc::clone(&shared));
            async move {
                let job = move |abandoned: &Abandoned| case.run(&shared, abandoned);
                Ok(workers.resume(job).await?)
            }
        });
        Box::pin(answers.buffer_unordered(parallel))
    }
}

impl Case {
    fn run(&self, shared: &Shared, abandoned: &Abandoned) -> Result<v1::RolloutResponse, Fault> {
        let mut response = v1::RolloutResponse { case_index: self.index, ..Default::default() };
        match self.simulate(shared, abandoned, &mut response.states) {
            Ok(()) => {}
            Err(fault) if fault.reason() == "CANCELLED" => return Err(fault),
            Err(fault) => response.failure = Some(fault.into()),
        }
        Ok(response)
    }

    fn simulate(
        &self,
        shared: &Shared,
        abandoned: &Abandoned,
        states: &mut Vec<v1::State>,
    ) -> Result<(), Fault> {
        let field = format!("cases[{}].initial", self.index);
        let mut plant = convert::plant(&shared.model, shared.settings, &self.start, &field)?;
        let held = match self.inputs.last() {
            Some(last) => last.to_vec(),
            None => convert::hold_input(&plant),
        };
        let mut outcome = Ok(());
        for k in 0..self.steps {
            abandoned.check()?;
            let u = if k < self.inputs.count() { self.inputs.get(k) } else { &held };
            outcome = plant.step(u).map(|_| ());
            if outcome.is_err() {
                break;
            }
            if shared.every.is_some_and(|every| (k + 1) % every == 0) {
                states.push(convert::plant_state(&plant));
            }
        }
        if shared.every.is_none() {
            states.push(convert::plant_state(&plant));
        }
        Ok(outcome?)
    }
}
