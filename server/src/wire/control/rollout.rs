//! `ControlService.Rollout`: many simulations of one model, as many at a time as there are workers.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use futures::{StreamExt, TryStreamExt as _, stream};
use plantd_models::{Model, Settings};
use plantd_proto::v1;

use crate::core::identity::build;
use crate::core::inputs::Inputs;
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::workers::pool::Abandoned;
use crate::core::workers::queue::Admission;
use crate::wire::answers::Answers;
use crate::wire::control::case::flock::{ABREAST, Flock, may_go_together};
use crate::wire::control::case::{Case, Cost, Ended, Shared, Simulation};
use crate::wire::control::expected::Expected;
use crate::wire::control::points::model_and_settings;
use crate::wire::message::{settings, start, states};
use crate::wire::models::model::compile;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::jobs::Jobs;
use crate::wire::status::RpcError;

/// Rows of a message with many cases, at most.
const ROWS_MAX: usize = 1000;

/// A checked request.
pub(crate) struct Rollout {
    shared: Arc<Shared>,
    cases: Vec<Case>,
    /// Answer with rows.
    table: bool,
}

impl Rollout {
    pub(crate) fn new(hub: &Arc<Hub>, request: v1::RolloutRequest) -> Result<Self, RpcError> {
        let limits = &hub.limits;
        let count = request.cases.len();
        LimitExceeded::check("rollout_cases", limits.rollout_cases, "cases", count)?;
        let v1::RolloutRequest { model, scene, settings, every, table, .. } = request;
        let (model_name, model, settings) = mechanics(hub, model, &scene, settings)?;
        let every = (every > 0).then_some(every as usize);
        let state_numbers = states::state_numbers(model.dimensions());
        let width = model.dimensions().input();
        let mut common = request.common.unwrap_or_default();
        let common_inputs = Arc::new(Inputs::new("common.u", common.u.take(), width)?);
        check_feedback("common", &common)?;
        let mut cases = Vec::with_capacity(count);
        for (index, mut own) in (0..).zip(request.cases) {
            let inputs = match own.u.take() {
                Some(u) => Arc::new(Inputs::new(&format!("cases[{index}].u"), Some(u), width)?),
                None => Arc::clone(&common_inputs),
            };
            let hold = if own.hold == 0 { common.hold } else { own.hold };
            let steps = inputs.count().saturating_add(hold as usize);
            LimitExceeded::check("horizon", limits.horizon, "steps", steps)?;
            let states = if table { 0 } else { every.map_or(1, |every| steps / every) };
            let numbers = states.saturating_mul(state_numbers);
            let (name, limit) = ("reply_numbers", limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in the states of a case", numbers)?;
            check_feedback(&format!("cases[{index}]"), &own)?;
            let initial = own.initial.take().or_else(|| common.initial.clone());
            let start = start::start(initial, &model, limits)?;
            cases.push(Case { index, start, inputs, steps, own });
        }
        let cost = request.cost.map(|cost| Cost::new(cost, &model)).transpose()?;
        let expected =
            expected(&request.expect, &model, settings.time_step_s, &common, &cases, limits)?;
        let shared = Shared {
            hub: Arc::clone(hub),
            model,
            model_name,
            settings,
            // Of a table's cases the last state is all that is shown.
            every: if table { None } else { every },
            extremes: request.extremes,
            cost,
            expected,
            common,
            metrics: LazyLock::new(Arc::default),
        };
        Ok(Self { shared: Arc::new(shared), cases, table })
    }

    /// The answers, in the order in which the cases end.
    pub(crate) fn run(self, workers: Jobs) -> Answers<v1::RolloutResponse> {
        let parallel = workers.count();
        let Self { shared, cases, table } = self;
        let whole = Arc::clone(&shared);
        let jobs = together(&shared, cases, parallel);
        let ended = stream::iter(jobs).map(move |cases| {
            let (workers, shared) = (workers.clone(), Arc::clone(&shared));
            async move {
                let ended = match <[Case; 1]>::try_from(cases) {
                    Ok([case]) => {
                        let mut simulation = Simulation::new(case, shared);
                        let part = move |abandoned: &Abandoned| simulation.go_on(abandoned);
                        vec![workers.in_parts(Admission::Granted, part).await?]
                    }
                    Err(cases) => {
                        let mut flock = Flock::new(cases, &shared);
                        let part = move |abandoned: &Abandoned| flock.go_on(abandoned);
                        workers.in_parts(Admission::Granted, part).await?
                    }
                };
                Ok::<_, tonic::Status>(stream::iter(ended.into_iter().map(Ok)))
            }
        });
        let ended = ended.buffer_unordered(parallel).try_flatten();
        if !table {
            return Box::pin(ended.map_ok(|(response, _)| response));
        }
        let columns = columns(&whole);
        let rows = rows_at_a_time(&whole.hub.limits, columns.len());
        let chunks = ended.try_chunks(rows).map_err(|broken| broken.1);
        Box::pin(chunks.map_ok(move |cases| table_of(&whole, &columns, cases)))
    }
}

/// Cases job by job: those with nothing but inputs together, as long as there is work for all workers.
fn together(shared: &Shared, cases: Vec<Case>, parallel: usize) -> Vec<Vec<Case>> {
    let size = cases.len().div_ceil(parallel.max(1)).clamp(1, ABREAST);
    let mut jobs: Vec<Vec<Case>> = Vec::new();
    let mut is_open = false;
    for case in cases {
        let is_bare = may_go_together(shared) && case.is_like_others(&shared.common);
        match jobs.last_mut().filter(|job| is_bare && is_open && job.len() < size) {
            Some(job) => job.push(case),
            None => jobs.push(vec![case]),
        }
        is_open = is_bare;
    }
    jobs
}

/// The model of a request, by its name or its scene, and its settings.
fn mechanics(
    hub: &Hub,
    name: String,
    scene: &str,
    given: Option<v1::PlantSettings>,
) -> Result<(String, Arc<Model>, Settings), RpcError> {
    if scene.is_empty() {
        let (model, settings) = model_and_settings(hub, &name, given)?;
        return Ok((name, model, settings));
    }
    if !name.is_empty() {
        return Err(RpcError::field("model", "and `scene` are both given"));
    }
    let format = v1::SceneFormat::Unspecified.into();
    let (model, _) = compile(scene, format, &HashMap::new(), &hub.limits)??;
    let settings = settings::settings(given, &model, &hub.limits)?;
    Ok((model.scene().name.clone(), Arc::new(model), settings))
}

fn check_feedback(field: &str, case: &v1::RolloutCase) -> Result<(), RpcError> {
    match &case.feedback {
        Some(feedback) if !feedback.id.is_empty() => {
            Err(RpcError::field(format!("{field}.feedback.id"), "is of a plant; cases have none"))
        }
        _ => Ok(()),
    }
}

/// What is expected of the cases, if anything is.
fn expected(
    text: &str,
    model: &Model,
    time_step_s: f64,
    common: &v1::RolloutCase,
    cases: &[Case],
    limits: &Limits,
) -> Result<Option<Expected>, RpcError> {
    if text.is_empty() {
        return Ok(None);
    }
    let steps = cases.iter().map(|case| case.steps).max().unwrap_or_default();
    let has_channels =
        common.channels.is_some() || cases.iter().any(|case| case.own.channels.is_some());
    let expected = Expected::new(text, model, time_step_s, steps, has_channels)?;
    let (name, limit) = ("trajectory_numbers", limits.trajectory_numbers);
    let what = "numbers of signals that are kept of a case to judge it";
    LimitExceeded::check(name, limit, what, expected.numbers(model, steps))?;
    Ok(Some(expected))
}

/// Names of a table's columns.
fn columns(shared: &Shared) -> Vec<String> {
    let x = states::state_names(&shared.model);
    let mut names = vec!["steps".to_owned(), "end".to_owned()];
    names.extend(x.iter().cloned());
    if shared.extremes {
        names.extend(x.iter().map(|name| format!("min {name}")));
        names.extend(x.iter().map(|name| format!("max {name}")));
    }
    names.extend(shared.cost.as_ref().map(|_| "cost".to_owned()));
    let expected = shared.expected.iter().flat_map(Expected::sentences);
    names.extend(expected.map(|sentence| format!("expect: {sentence}")));
    names
}

fn rows_at_a_time(limits: &Limits, columns: usize) -> usize {
    (Limits::size(limits.reply_numbers) / columns).clamp(1, ROWS_MAX)
}

fn table_of(shared: &Shared, columns: &[String], cases: Vec<Ended>) -> v1::RolloutResponse {
    let names = columns.to_vec();
    let mut table = v1::RolloutTable { columns: names, build: build(), ..Default::default() };
    let mut data = Vec::with_capacity(cases.len() * columns.len());
    for (case, x) in cases {
        let row = data.len();
        let end = match (&case.failure, &case.ended_by) {
            (Some(_), _) => 2.0,
            (None, Some(_)) => 1.0,
            (None, None) => 0.0,
        };
        data.extend([case.steps as f64, end]);
        data.extend(x);
        data.extend(case.min);
        data.extend(case.max);
        let expected = shared.expected.as_ref().map_or(0, Expected::count);
        if shared.cost.is_some() && data.len() + 1 + expected == row + columns.len() {
            data.push(case.cost);
        }
        data.resize(row + columns.len() - expected, f64::NAN);
        data.extend(case.verdicts.iter().map(|verdict| f64::from(verdict.came_true)));
        data.resize(row + columns.len(), f64::NAN);
        table.case_indices.push(case.case_index);
        let case_index = case.case_index;
        let failure = case.failure.map(|why| v1::RolloutFailure { case_index, failure: Some(why) });
        table.failures.extend(failure);
    }
    let (rows, cols) = (table.case_indices.len() as u32, columns.len() as u32);
    table.rows = Some(v1::Matrix { rows, cols, data });
    v1::RolloutResponse { table: Some(table), ..Default::default() }
}
