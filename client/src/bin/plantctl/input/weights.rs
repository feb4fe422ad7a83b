//! Weights of regulators.

use anyhow::Result;
use clap::Args;
use plantd_client::{WeightsExt as _, v1};

use crate::contract::names;
use crate::input::numbers::{Vector, vector};

/// Weights of a regulator.
#[derive(Debug, Args)]
pub(crate) struct Weights {
    /// Diagonal of the state weight, comma-separated; one number stands for all, and entries that are not named
    /// have 1: `theta=100,p(theta)=0`.
    #[arg(long = "q", value_name = "Q", value_parser = vector, default_value = "1")]
    pub(crate) q: Vector,
    /// Diagonal of the input weight, in the same way.
    #[arg(long = "r", value_name = "R", value_parser = vector, default_value = "1")]
    pub(crate) r: Vector,
}

impl Weights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> Result<v1::LqrWeights> {
        diagonals(&self.q, &self.r, model)
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
    pub(crate) fn for_model(&self, model: &v1::Model) -> Result<v1::LqrWeights> {
        let weights = self.weights.for_model(model)?;
        Ok(if self.projected_momentum { weights.on_projected_momentum() } else { weights })
    }
}

/// Diagonal weights for a model; one number stands for all entries, and those that are not named have 1.
pub(crate) fn diagonals(q: &Vector, r: &Vector, model: &v1::Model) -> Result<v1::LqrWeights> {
    let q = q.diagonal("q", &names::state(model), 1.0)?;
    let r = r.diagonal("r", &names::input(model), 1.0)?;
    Ok(plantd_client::weights(q, r))
}
