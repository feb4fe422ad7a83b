//! Derivatives of the discrete map, and gains computed from them, as matrices for people.

use plantd_client::v1;

use crate::contract::names;
use crate::output::text::{label, matrix};

/// A and B of a linearization, and the multipliers' rows where there are constraints.
pub(crate) fn linearization(linearization: &v1::Linearization, model: &v1::Model) -> String {
    let (x, u) = (names::state(model), names::input(model));
    let blocks = [
        ("A = df/dx", &linearization.a, &x, &x),
        ("B = df/du", &linearization.b, &x, &u),
        ("C = dλ/dx", &linearization.multipliers_x, &model.constraints, &x),
        ("D = dλ/du", &linearization.multipliers_u, &model.constraints, &u),
    ];
    let filled = blocks.into_iter().filter_map(|(title, block, rows, cols)| {
        let block = block.as_ref().filter(|m| !m.data.is_empty())?;
        Some(matrix(title, block, rows, cols))
    });
    filled.collect::<Vec<_>>().join("\n")
}

/// One matrix per output of a tensor that has any, under a title with the output's name.
pub(crate) fn slices(
    title: &str,
    tensor: Option<&v1::Tensor>,
    outputs: &[String],
    first: &[String],
    second: &[String],
) -> String {
    let Some(tensor) = tensor.filter(|t| !t.data.is_empty()) else { return String::new() };
    let (rows, cols) = (tensor.first, tensor.second);
    let slices = tensor.data.chunks(rows as usize * cols as usize).enumerate();
    let slice = |(output, data): (usize, &[f64])| {
        let block = v1::Matrix { rows, cols, data: data.to_vec() };
        matrix(&format!("{title} of {}", label(outputs, output)), &block, first, second)
    };
    slices.map(slice).collect::<Vec<_>>().join("\n")
}

/// A feedback law.
pub(crate) fn gain(gain: &v1::Gain, model: &v1::Model) -> String {
    let (x, u) = (names::state(model), names::input(model));
    let k = gain.k.as_ref().map_or(String::new(), |k| matrix("K", k, &u, &x));
    let forward = if gain.feedforward.is_empty() { "" } else { " + feedforward" };
    format!("u = u_reference{forward} - K (x - x_reference)\n\n{k}")
}
