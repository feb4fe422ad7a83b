//! Derivatives of the discrete map, and gains computed from them, as matrices for people.

use plantd_client::v1;

use crate::contract::names;
use crate::output::page::{Page, Table, matrix};
use crate::output::text::label;

/// A and B of a linearization, and the multipliers' rows where there are constraints.
pub(crate) fn linearization(linearization: &v1::Linearization, model: &v1::Model) -> Page {
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
    let mut page = Page::default();
    filled.for_each(|block| page.next_table(block));
    page
}

/// One matrix per output of a tensor that has any, under a title with the output's name.
pub(crate) fn slices(
    title: &str,
    tensor: Option<&v1::Tensor>,
    outputs: &[String],
    first: &[String],
    second: &[String],
) -> Vec<Table> {
    let Some(tensor) = tensor.filter(|t| !t.data.is_empty()) else { return Vec::new() };
    let (rows, cols) = (tensor.first, tensor.second);
    let slices = tensor.data.chunks(rows as usize * cols as usize).enumerate();
    let slice = |(output, data): (usize, &[f64])| {
        let block = v1::Matrix { rows, cols, data: data.to_vec() };
        matrix(&format!("{title} of {}", label(outputs, output)), &block, first, second)
    };
    slices.map(slice).collect()
}

/// A feedback law.
pub(crate) fn gain(gain: &v1::Gain, model: &v1::Model) -> Page {
    let (x, u) = (names::state(model), names::input(model));
    let forward = if gain.feedforward.is_empty() { "" } else { " + feedforward" };
    let mut page = Page::from(format!("u = u_reference{forward} - K (x - x_reference)\n"));
    gain.k.iter().for_each(|k| page.next_table(matrix("K", k, &u, &x)));
    page
}
