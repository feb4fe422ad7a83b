//! The signals of a plant as the contract has them.

use plantd_client::v1;
use plantd_expect::{Names, Reference, Samples};

use crate::contract::names;

/// The columns of a model, in the order of the contract's vectors.
#[derive(Clone, Debug, Default)]
pub(crate) struct Columns {
    columns: plantd_expect::Columns,
    rotations: Vec<u32>,
}

/// One sample, as the contract has it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample<'a> {
    pub(crate) state: &'a v1::State,
    pub(crate) time_step_s: f64,
    /// Input of the step that led here.
    pub(crate) u: &'a [f64],
    /// What sensors deliver.
    pub(crate) y: &'a [f64],
    pub(crate) energy: Option<&'a v1::Energy>,
    /// State and input of the reference.
    pub(crate) reference: Option<(&'a [f64], &'a [f64])>,
}

impl Columns {
    /// The columns of a model, with outputs of these names.
    pub(crate) fn new(
        model: &v1::Model,
        outputs: &[String],
        has_reference: bool,
        has_energy: bool,
    ) -> Self {
        let names = Names {
            coordinates: model.coordinates.iter().map(|c| c.name.clone()).collect(),
            dynamic: names::dynamic(model).cloned().collect(),
            prescribed: names::prescribed(model).cloned().collect(),
            inputs: model.inputs.clone(),
            constraints: model.constraints.clone(),
            outputs: outputs.to_vec(),
        };
        let columns = plantd_expect::Columns::new(&names, has_reference, has_energy);
        Self { columns, rotations: plantd_client::rotations(model) }
    }

    /// Samples that have all columns and no rows.
    pub(crate) fn empty(&self) -> Samples {
        self.columns.empty()
    }

    /// Adds a sample. What the server did not send is NaN, which no expectation takes for good.
    pub(crate) fn push(&self, samples: &mut Samples, sample: Sample<'_>) {
        let Sample { state, time_step_s, u, y, energy, reference } = sample;
        let x = [state.q.as_slice(), &state.p, &state.v].concat();
        let error = match reference {
            Some((reference, _)) if reference.len() == x.len() => {
                plantd_client::difference(reference, &x, &self.rotations)
            }
            _ => Vec::new(),
        };
        let sample = plantd_expect::Sample {
            time_s: state.time_s,
            time_step_s,
            x: &x,
            velocity: &state.velocity,
            multipliers: &state.multipliers,
            u,
            y,
            energy: energy.map(|energy| [energy.kinetic_j, energy.potential_j]),
            reference: reference.map(|(x, u)| Reference { x, u, error: &error }),
        };
        self.columns.push(samples, sample);
    }
}
