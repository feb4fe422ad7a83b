//! `linearize` and `second-order`: derivatives of the discrete map.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Vector, given, vector};
use crate::input::point::Point;
use crate::output::derivatives::{linearization, slices};
use crate::output::page::{Page, matrix};
use crate::server::context::Context;

/// Linearizes the discrete map of a model: `dx[k+1] = A dx[k] + B du[k]`.
#[derive(Debug, Args)]
pub(crate) struct Linearize {
    #[command(flatten)]
    point: Point,
}

/// Second derivatives of the discrete map: all tensors, or contracted with weights.
#[derive(Debug, Args)]
pub(crate) struct SecondOrder {
    #[command(flatten)]
    point: Point,
    /// Weights of the entries of x[k+1], comma-separated or by name: print the contraction.
    #[arg(long, value_name = "Z", value_parser = vector, allow_hyphen_values = true)]
    weights: Option<Vector>,
    /// Weights of the constraint multipliers, comma-separated or by name: print the contraction.
    #[arg(long, value_name = "Z", value_parser = vector, allow_hyphen_values = true)]
    multiplier_weights: Option<Vector>,
}

impl Linearize {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (model, settings, point) = self.point.resolve(&client).await?;
        let request = v1::LinearizeRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
        };
        let answer = client.linearize(request).await?;
        context.output.message("LinearizeResponse", &answer, || {
            let rank = answer.controllability_rank;
            let order = 2 * model.coordinates.len();
            let matrices = answer.linearization.as_ref().map(|l| linearization(l, &model));
            let mut page = matrices.unwrap_or_default();
            let _ = write!(page, "\ncontrollability rank: {rank} of {order}\n");
            page
        })
    }
}

impl SecondOrder {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (model, settings, point) = self.point.resolve(&client).await?;
        let is_contracted = self.weights.is_some() || self.multiplier_weights.is_some();
        let weights = v1::ContractionWeights {
            x: given(self.weights.as_ref(), "weights", &names::state(&model))?,
            multipliers: given(
                self.multiplier_weights.as_ref(),
                "multiplier-weights",
                &model.constraints,
            )?,
        };
        let request = v1::LinearizeSecondOrderRequest {
            model: model.name.clone(),
            settings: Some(settings),
            point: Some(point),
            weights: is_contracted.then_some(weights),
        };
        let answer = client.linearize_second_order(request).await?;
        context.output.message("LinearizeSecondOrderResponse", &answer, || {
            let tensors = answer.tensors.as_ref().map(|t| second_order(t, &model));
            let contraction = answer.contraction.as_ref().map(|c| contraction(c, &model));
            tensors.or(contraction).unwrap_or_default()
        })
    }
}

/// Second derivatives, block by block and output by output.
fn second_order(tensors: &v1::SecondOrder, model: &v1::Model) -> Page {
    let (x, u, c) = (names::state(model), names::input(model), &model.constraints);
    let blocks = [
        slices("d²/dxdx", tensors.xx.as_ref(), &x, &x, &x),
        slices("d²/dxdu", tensors.xu.as_ref(), &x, &x, &u),
        slices("d²/dudu", tensors.uu.as_ref(), &x, &u, &u),
        slices("d²/dxdx", tensors.multipliers_xx.as_ref(), c, &x, &x),
        slices("d²/dxdu", tensors.multipliers_xu.as_ref(), c, &x, &u),
        slices("d²/dudu", tensors.multipliers_uu.as_ref(), c, &u, &u),
    ];
    let mut page = Page::default();
    blocks.into_iter().flatten().for_each(|slice| page.next_table(slice));
    page
}

/// A Hessian of a weighted sum of outputs.
fn contraction(contraction: &v1::Contraction, model: &v1::Model) -> Page {
    let (x, u) = (names::state(model), names::input(model));
    let blocks = [
        ("d²/dxdx", &contraction.xx, &x, &x),
        ("d²/dxdu", &contraction.xu, &x, &u),
        ("d²/dudu", &contraction.uu, &u, &u),
    ];
    let filled = blocks.into_iter().filter_map(|(title, block, rows, cols)| {
        Some(matrix(title, block.as_ref().filter(|m| !m.data.is_empty())?, rows, cols))
    });
    let mut page = Page::default();
    filled.for_each(|block| page.next_table(block));
    page
}
