//! The parameters of a step, in the one order that derivatives keep.
//!
//! ```text
//! θ = (q, p, u, k)      q: n coordinates at the start, nd dynamic and nk prescribed ones
//!                       p: nd momenta        u: ni inputs        k: nk next prescribed positions
//! ```
//!
//! Derivatives by `x = (q, p, v)` are those by `(q, p)`, with zeros for `v`; those by the input of the
//! map are those by `(u, k)`. Where inputs act like momenta, rows leave their columns out: `(q, p, k)`.

use plantd_math::rows::padded;

use crate::model::mechanism::Model;

/// How many parameters there are of each kind, so which columns are theirs; and how many constraints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Parameters {
    pub(crate) nd: usize,
    pub(crate) nk: usize,
    pub(crate) ni: usize,
    pub(crate) nc: usize,
    /// Length of a row over the parameters, padded.
    pub(crate) stride: usize,
}

impl Parameters {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, nk, ni, nc) = (d.dynamic, d.prescribed, d.inputs, d.constraints);
        Self { nd, nk, ni, nc, stride: padded((2 * (nd + nk) + ni).max(1)) }
    }

    /// Coordinates: first column of the momenta.
    pub(crate) fn n(&self) -> usize {
        self.nd + self.nk
    }

    /// `nd` and `n`.
    pub(crate) fn coordinates(&self) -> (usize, usize) {
        (self.nd, self.n())
    }

    /// First column of the inputs.
    pub(crate) fn inputs(&self) -> usize {
        self.n() + self.nd
    }

    /// First column of the next prescribed positions.
    pub(crate) fn next(&self) -> usize {
        self.inputs() + self.ni
    }

    pub(crate) fn count(&self) -> usize {
        self.next() + self.nk
    }

    /// By which parameters a coordinate is moved at a fraction of the step, if it is not moved by unknowns, and how
    /// far.
    pub(crate) fn moves(
        &self,
        coordinate: usize,
        fraction: f64,
    ) -> impl Iterator<Item = (usize, f64)> {
        let start = if coordinate < self.nd { 1.0 } else { 1.0 - fraction };
        let next = coordinate.checked_sub(self.nd).map(|k| (self.next() + k, fraction));
        std::iter::once((coordinate, start)).chain(next)
    }

    /// Which of the six numbers that turn the ends of a prescribed ball joint a parameter is.
    pub(crate) fn end_of(&self, coordinate: usize, parameter: usize) -> Option<usize> {
        let ends = [coordinate, self.next() + coordinate.wrapping_sub(self.nd)];
        let first = ends.iter().position(|end| (*end..*end + 3).contains(&parameter))?;
        Some(3 * first + parameter - ends[first])
    }

    /// Copies a row into one without the columns of the inputs.
    pub(crate) fn drop_inputs(&self, row: &[f64], out: &mut [f64]) {
        out[..self.inputs()].copy_from_slice(&row[..self.inputs()]);
        out[self.inputs()..][..self.nk].copy_from_slice(&row[self.next()..][..self.nk]);
    }
}
