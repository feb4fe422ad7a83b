//! Trajectories, row by row.

use std::ops::Range;

use nalgebra::DMatrix;

use crate::model::mechanism::Dimensions;

/// States, inputs and constraint impulses of a motion, row-major.
#[derive(Clone, Debug, Default)]
pub(super) struct Trajectory {
    pub(super) coordinates: usize,
    pub(super) states: usize,
    pub(super) inputs: usize,
    pub(super) constraints: usize,
    pub(super) x: Vec<f64>,
    pub(super) u: Vec<f64>,
    pub(super) multipliers: Vec<f64>,
    /// Cost, without penalties.
    pub(super) cost: f64,
    /// Cost, with penalties.
    pub(super) merit: f64,
}

impl Trajectory {
    pub(super) fn new(d: Dimensions, steps: usize) -> Self {
        let (states, inputs, constraints) = (d.state(), d.input(), d.constraints);
        Self {
            coordinates: d.coordinates(),
            states,
            inputs,
            constraints,
            x: vec![0.0; (steps + 1) * states],
            u: vec![0.0; steps * inputs],
            multipliers: vec![0.0; steps * constraints],
            cost: 0.0,
            merit: 0.0,
        }
    }

    /// A copy of some steps.
    pub(super) fn part(&self, steps: Range<usize>) -> Self {
        let of = |numbers: &[f64], width: usize, rows: usize| {
            numbers[steps.start * width..][..rows * width].to_vec()
        };
        Self {
            x: of(&self.x, self.states, steps.len() + 1),
            u: of(&self.u, self.inputs, steps.len()),
            multipliers: of(&self.multipliers, self.constraints, steps.len()),
            ..*self
        }
    }

    pub(super) fn x(&self, k: usize) -> &[f64] {
        &self.x[k * self.states..][..self.states]
    }

    pub(super) fn u(&self, k: usize) -> &[f64] {
        &self.u[k * self.inputs..][..self.inputs]
    }

    pub(super) fn multipliers(&self, k: usize) -> &[f64] {
        &self.multipliers[k * self.constraints..][..self.constraints]
    }

    pub(super) fn set_x(&mut self, k: usize, parts: [&[f64]; 3]) {
        let mut row = &mut self.x[k * self.states..][..self.states];
        for part in parts {
            let (head, tail) = row.split_at_mut(part.len());
            head.copy_from_slice(part);
            row = tail;
        }
    }

    pub(super) fn set_multipliers(&mut self, k: usize, values: &[f64]) {
        self.multipliers[k * self.constraints..][..self.constraints].copy_from_slice(values);
    }
}

/// The rows of a matrix, one after the other.
pub(super) fn rows(matrix: &DMatrix<f64>) -> Vec<f64> {
    matrix.transpose().as_slice().to_vec()
}
