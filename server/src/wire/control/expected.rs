//! What the cases of a rollout are expected to do, in the notation of scenarios, and whether they did.

use plantd_expect::{
    Columns, Expectation, Expression, Facts, Names, Sample, Samples, expectations, judge,
};
use plantd_models::Model;
use plantd_proto::v1;

use crate::wire::status::RpcError;

/// What is expected of each case.
pub(crate) struct Expected {
    list: Vec<Expectation>,
    time_step_s: f64,
    /// Energy is asked for, which takes a computation in each step.
    pub(crate) uses_energy: bool,
}

/// What was seen of a case.
pub(crate) struct Watched {
    columns: Columns,
    samples: Samples,
}

fn columns(model: &Model, outputs: &[String], has_energy: bool) -> Columns {
    let names = |list: &[plantd_models::Coordinate]| list.iter().map(|c| c.name.clone()).collect();
    let (dynamic, prescribed) = model.coordinates().split_at(model.dimensions().dynamic);
    let names = Names {
        coordinates: names(model.coordinates()),
        dynamic: names(dynamic),
        prescribed: names(prescribed),
        inputs: model.scene().inputs.iter().map(|input| input.name.clone()).collect(),
        constraints: model.constraint_names().to_vec(),
        outputs: outputs.to_vec(),
    };
    Columns::new(&names, false, has_energy)
}

impl Expected {
    /// Reads expectations of cases of up to so many steps; signals are looked for where no case has sensors.
    pub(crate) fn new(
        text: &str,
        model: &Model,
        time_step_s: f64,
        steps: usize,
        has_channels: bool,
    ) -> Result<Self, RpcError> {
        let nothing = columns(model, &[], true).empty();
        let nothing = (!has_channels).then_some(&nothing);
        let list = expectations(text, time_step_s * steps as f64, nothing)
            .map_err(|error| RpcError::field("expect", error.to_string()))?;
        let uses_energy =
            list.iter().flat_map(Expectation::expressions).any(Expression::uses_energy);
        Ok(Self { list, time_step_s, uses_energy })
    }

    /// How many numbers are kept of a case of so many steps.
    pub(crate) fn numbers(&self, model: &Model, steps: usize) -> usize {
        columns(model, &[], self.uses_energy).count().saturating_mul(steps.saturating_add(1))
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.list.len()
    }

    /// In words.
    pub(crate) fn sentences(&self) -> impl Iterator<Item = String> {
        self.list.iter().map(ToString::to_string)
    }

    /// Begins to watch a case whose sensors deliver these.
    pub(crate) fn watch(&self, model: &Model, outputs: &[String]) -> Result<Watched, RpcError> {
        let columns = columns(model, outputs, self.uses_energy);
        let samples = columns.empty();
        for (i, expectation) in self.list.iter().enumerate() {
            for expression in expectation.expressions() {
                expression.values(&samples).map_err(|problem| {
                    let key = expectation.key();
                    RpcError::field("expect", format!("expect[{i}].{key}: {problem}"))
                })?;
            }
        }
        Ok(Watched { columns, samples })
    }

    /// Whether what is expected came true; a step may have failed after all others.
    pub(crate) fn judge(
        &self,
        watched: &Watched,
        failure: Option<String>,
    ) -> Result<Vec<v1::RolloutVerdict>, RpcError> {
        let end_s = watched.samples.time_s().last().copied().unwrap_or_default();
        let failures = failure.into_iter().map(|reason| (end_s, reason)).collect();
        let facts = Facts { failures, deadline_misses: None };
        let verdict = |expectation: &Expectation| {
            let found = judge(expectation, &watched.samples, &facts);
            let found = found.map_err(|problem| RpcError::field("expect", problem))?;
            Ok(v1::RolloutVerdict {
                expectation: found.expectation,
                came_true: found.broken.is_none(),
                message: found.message,
                time_s: found.broken.and_then(|at| at.time_s),
                value: found.broken.and_then(|at| at.value),
            })
        };
        self.list.iter().map(verdict).collect()
    }
}

impl Watched {
    /// Adds a state, the input that led there, and what sensors delivered.
    pub(crate) fn push(
        &mut self,
        expected: &Expected,
        state: &v1::State,
        u: &[f64],
        y: &[f64],
        energy: Option<[f64; 2]>,
    ) {
        let x = [state.q.as_slice(), &state.p, &state.v].concat();
        let sample = Sample {
            time_s: state.time_s,
            time_step_s: expected.time_step_s,
            x: &x,
            velocity: &state.velocity,
            multipliers: &state.multipliers,
            u,
            y,
            energy,
            reference: None,
        };
        self.columns.push(&mut self.samples, sample);
    }
}
