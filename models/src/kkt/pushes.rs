//! What constraints and ties push, in a linearization of a tree by generators.
//!
//! It acts as momentum does, so the columns of the momentum tell what it makes of the increments, `X_p`, and of the
//! momentum at the end, `P_p`.

use plantd_math::rows::{AlignedRows, LANES, Term, add_rows, non_zero, padded};
use plantd_math::simd::wide;

use crate::constraints::bends::{Bends, Sums};
use crate::constraints::closure::Closure;
use crate::model::mechanism::Model;

/// `A0ᵀ λ'`, and what it takes off a linearization; `λ'` are derivatives of multipliers, or of the forces of ties.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pushes {
    /// Where the columns of the momentum begin, and how long a row of the linearization is.
    momentum: usize,
    stride: usize,
    /// `A0ᵀ`, row-major, nd rows.
    by_multiplier: Vec<f64>,
    /// `−P_p A0ᵀ`, like `A0ᵀ`.
    to_momentum: Vec<f64>,
    /// How long these rows are.
    multipliers: usize,
}

impl Pushes {
    /// Room for so many multipliers, with rows of a linearization that are so long.
    pub(crate) fn new(model: &Model, stride: usize, multipliers: usize) -> Self {
        let d = model.dimensions;
        let multipliers = padded(multipliers);
        let zeros = || vec![0.0; d.dynamic * multipliers];
        Self {
            momentum: d.coordinates(),
            stride,
            by_multiplier: zeros(),
            to_momentum: zeros(),
            multipliers,
        }
    }

    /// Takes the Jacobian at the start.
    pub(crate) fn take_jacobian(&mut self, model: &Model, start: &Closure) {
        let n = model.dimensions.coordinates();
        for (c, row) in start.jacobian.chunks_exact(n).enumerate() {
            self.take_column(c, row.iter().copied());
        }
    }

    /// Takes entries of a column of `A0ᵀ`.
    pub(crate) fn take_column(&mut self, column: usize, entries: impl Iterator<Item = f64>) {
        let rows = self.by_multiplier.chunks_exact_mut(self.multipliers);
        rows.zip(entries).for_each(|(row, entry)| row[column] = entry);
    }

    /// Of rows `X`, writes `−X_p A0ᵀ`.
    pub(crate) fn respond(&self, rows: &[f64], responses: &mut [f64], terms: &mut Vec<Term>) {
        let Self { momentum, by_multiplier, multipliers, .. } = self;
        let responses = responses.chunks_exact_mut(*multipliers);
        let count = responses.len();
        for (row, response) in rows.chunks_exact(self.stride).zip(responses) {
            terms.clear();
            let by_momentum = row[*momentum..][..count].iter();
            terms.extend(non_zero(by_momentum.map(|entry| -entry)));
            response.fill(0.0);
            add_rows(response, by_multiplier, *multipliers, terms);
        }
    }

    /// The same of the rows of the momentum, and remembers the responses.
    pub(crate) fn respond_in_momentum(&mut self, rows: &[f64], terms: &mut Vec<Term>) {
        let mut responses = std::mem::take(&mut self.to_momentum);
        self.respond(rows, &mut responses, terms);
        self.to_momentum = responses;
    }

    /// What is remembered, a row for each momentum.
    pub(crate) fn of_momentum(&mut self) -> &mut [f64] {
        &mut self.to_momentum
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

/// `H` as products of vectors, and room for what it takes off a linearization.
#[derive(Clone, Debug)]
pub(crate) struct Bending {
    pub(crate) bends: Bends,
    n: usize,
    nd: usize,
    stride: usize,
    /// For products `s y zᵀ`: `y`, `−X_p y`, and `s zᵀ`.
    pushes: Pushes,
    responses: Vec<f64>,
    weighted: AlignedRows,
    /// Of rows side by side.
    sums: Sums<LANES>,
}

impl Bending {
    /// Room for a model, with rows of its linearization that are so long.
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let bends = Bends::new(model);
        let (nd, count, joints) =
            (model.dimensions.dynamic, bends.count(), model.closure.joints.len());
        Self {
            n: model.dimensions.coordinates(),
            nd,
            stride,
            pushes: Pushes::new(model, stride, count),
            responses: vec![0.0; nd * padded(count)],
            weighted: AlignedRows::zeros(count * stride),
            sums: Sums::new(joints),
            bends,
        }
    }

    /// Takes the products that have been found.
    pub(crate) fn take(&mut self) {
        for (k, (y, z, weight)) in self.bends.products().enumerate() {
            self.pushes.take_column(k, y[..self.nd].iter().copied());
            let weighted = self.weighted[k * self.stride..][..self.n].iter_mut();
            weighted.zip(z).for_each(|(to, entry)| *to = weight * entry);
        }
    }

    /// Takes `X_p H` off rows `X`.
    pub(crate) fn take_off(&mut self, rows: &mut [f64], terms: &mut Vec<Term>) {
        if !self.responses.is_empty() {
            self.pushes.respond(rows, &mut self.responses, terms);
            self.pushes.add_to(rows, &self.responses, &self.weighted, terms);
        }
        wide!({
            let Self { bends, n, nd, stride, sums, .. } = self;
            for rows in rows.chunks_mut(LANES * *stride) {
                let count = rows.len() / *stride;
                sums.add_up(&bends.joints, |i| {
                    let mut x = [0.0; LANES];
                    if i < *nd {
                        let numbers = rows[*n + i..].iter().step_by(*stride);
                        x.iter_mut().zip(numbers).for_each(|(x, number)| *x = *number);
                    }
                    x
                });
                for (i, taken) in sums.products(&bends.joints) {
                    let entries = rows[i..].iter_mut().step_by(*stride);
                    entries.zip(taken).take(count).for_each(|(entry, taken)| *entry -= taken);
                }
            }
        });
    }
}
