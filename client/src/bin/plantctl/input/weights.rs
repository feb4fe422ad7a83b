//! Weights of regulators.

use clap::Args;
use plantd_client::{WeightsExt as _, v1};

use crate::contract::names;
use crate::input::numbers::{Numbers, diagonal, numbers};

/// Weights of a regulator.
#[derive(Debug, Args)]
pub(crate) struct Weights {
    /// Diagonal of the state weight, comma-separated; one number stands for all.
    #[arg(long = "q", value_name = "Q", value_parser = numbers, default_value = "1")]
    pub(crate) q: Numbers,
    /// Diagonal of the input weight, comma-separated; one number stands for all.
    #[arg(long = "r", value_name = "R", value_parser = numbers, default_value = "1")]
    pub(crate) r: Numbers,
}

impl Weights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> v1::LqrWeights {
        diagonals(&self.q.0, &self.r.0, model)
    }
}

/// Weights of a regulator that may be on either momentum.
#[derive(Debug, Args)]
pub(crate) struct RegulatorWeights {
    #[command(flatten)]
    weights: Weights,
    /// Weigh the projected momentum in place of the state's own.
    #[arg(long)]
    projected_momentum: bool,
}

impl RegulatorWeights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> v1::LqrWeights {
        let weights = self.weights.for_model(model);
        if self.projected_momentum { weights.on_projected_momentum() } else { weights }
    }
}

/// Diagonal weights for a model; one number stands for all entries.
pub(crate) fn diagonals(q: &[f64], r: &[f64], model: &v1::Model) -> v1::LqrWeights {
    let (states, inputs) = (names::state(model).len(), names::input(model).len());
    plantd_client::weights(diagonal(q, states), diagonal(r, inputs))
}
