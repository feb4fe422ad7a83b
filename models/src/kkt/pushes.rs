//! What constraints and ties push, in a linearization of a tree by generators.
//!
//! It acts as momentum does, so the columns of the momentum tell what it makes of the increments, `X_p`, and of the
//! momentum at the end, `P_p`.

use plantd_math::rows::{Term, add_rows, non_zero, padded};

use crate::constraints::closure::Closure;
use crate::model::mechanism::Model;

/// `H q' + A0ᵀ λ'`, and what it takes off a linearization; `λ'` are derivatives of multipliers, or of the forces of ties.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pushes {
    /// Where the columns of the momentum begin, and how long a row of the linearization is.
    momentum: usize,
    stride: usize,
    /// `H` and `A0ᵀ`, row-major, nd rows.
    by_start: Vec<f64>,
    by_multiplier: Vec<f64>,
    /// `−P_p A0ᵀ`, like `A0ᵀ`.
    to_momentum: Vec<f64>,
    /// Lengths of rows.
    starts: usize,
    multipliers: usize,
}

impl Pushes {
    /// Room for those of the constraints of a model, with rows of its linearization that are so long.
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let d = model.dimensions;
        Self::with_room(model, stride, [d.coordinates(), d.constraints])
    }

    /// Room for those of so many ties, which do not follow the start.
    pub(crate) fn of_ties(model: &Model, stride: usize, ties: usize) -> Self {
        Self::with_room(model, stride, [0, ties])
    }

    fn with_room(model: &Model, stride: usize, columns: [usize; 2]) -> Self {
        let (d, [starts, multipliers]) = (model.dimensions, columns.map(padded));
        let zeros = |width: usize| vec![0.0; d.dynamic * width];
        Self {
            momentum: d.coordinates(),
            stride,
            by_start: zeros(starts),
            by_multiplier: zeros(multipliers),
            to_momentum: zeros(multipliers),
            starts,
            multipliers,
        }
    }

    /// Takes `H`, row-major, with the Jacobian at the start.
    pub(crate) fn take(&mut self, model: &Model, hessian: &[f64], start: &Closure) {
        let n = model.dimensions.coordinates();
        let rows = self.by_start.chunks_exact_mut(self.starts);
        for (row, hessian) in rows.zip(hessian.chunks_exact(n)) {
            row[..n].copy_from_slice(hessian);
        }
        for (c, row) in start.jacobian.chunks_exact(n).enumerate() {
            self.take_column(c, row.iter().copied());
        }
    }

    /// Takes entries of a column of `A0ᵀ`.
    pub(crate) fn take_column(&mut self, column: usize, entries: impl Iterator<Item = f64>) {
        let rows = self.by_multiplier.chunks_exact_mut(self.multipliers);
        rows.zip(entries).for_each(|(row, entry)| row[column] = entry);
    }

    /// Takes `X_p H` off rows `X`, and writes `−X_p A0ᵀ`.
    pub(crate) fn respond(&self, rows: &mut [f64], responses: &mut [f64], terms: &mut Vec<Term>) {
        let Self { momentum, by_start, by_multiplier, starts, multipliers, .. } = self;
        let responses = responses.chunks_exact_mut(*multipliers);
        let count = responses.len();
        for (row, response) in rows.chunks_exact_mut(self.stride).zip(responses) {
            terms.clear();
            let by_momentum = row[*momentum..][..count].iter();
            terms.extend(non_zero(by_momentum.map(|entry| -entry)));
            add_rows(&mut row[..*starts], by_start, *starts, terms);
            response.fill(0.0);
            add_rows(response, by_multiplier, *multipliers, terms);
        }
    }

    /// The same of the rows of the momentum, and remembers the responses.
    pub(crate) fn respond_in_momentum(&mut self, rows: &mut [f64], terms: &mut Vec<Term>) {
        let mut responses = std::mem::take(&mut self.to_momentum);
        self.respond(rows, &mut responses, terms);
        self.to_momentum = responses;
    }

    /// What is remembered, a row for each momentum, and their length.
    pub(crate) fn of_momentum(&mut self) -> (&mut [f64], usize) {
        (&mut self.to_momentum, self.multipliers)
    }

    /// Adds to rows what derivatives of the multipliers make of them, by responses.
    pub(crate) fn add_to(
        &self,
        rows: &mut [f64],
        responses: &[f64],
        multipliers: &[f64],
        terms: &mut Vec<Term>,
    ) {
        let responses = responses.chunks_exact(self.multipliers);
        for (row, response) in rows.chunks_exact_mut(self.stride).zip(responses) {
            terms.clear();
            terms.extend(non_zero(response.iter().copied()));
            add_rows(row, multipliers, self.stride, terms);
        }
    }

    /// The same of the momentum, by what is remembered.
    pub(crate) fn add_to_momentum(
        &self,
        rows: &mut [f64],
        multipliers: &[f64],
        terms: &mut Vec<Term>,
    ) {
        self.add_to(rows, &self.to_momentum, multipliers, terms);
    }
}
