//! Trajectories, row by row.

use nalgebra::DMatrix;
use plantd_models::{Dimensions, KnownStep, State};

/// States, inputs and constraint impulses of a motion, row-major.
#[derive(Clone, Debug)]
pub(super) struct Trajectory {
    /// Index of the first step.
    pub(super) first_step: u64,
    pub(super) d: Dimensions,
    pub(super) x: Vec<f64>,
    pub(super) u: Vec<f64>,
    pub(super) multipliers: Vec<f64>,
    /// Cost, without penalties.
    pub(super) cost: f64,
    /// Cost, with penalties.
    pub(super) merit: f64,
}

impl Trajectory {
    pub(super) fn new(d: Dimensions, first_step: u64, steps: usize) -> Self {
        Self {
            first_step,
            d,
            x: vec![0.0; (steps + 1) * d.state()],
            u: vec![0.0; steps * d.input()],
            multipliers: vec![0.0; steps * d.constraints],
            cost: 0.0,
            merit: 0.0,
        }
    }

    /// Step `k`.
    pub(super) fn known(&self, k: usize) -> KnownStep<'_> {
        let n = self.d.coordinates();
        KnownStep {
            index: self.first_step.saturating_add(k as u64),
            q0: &self.x(k)[..n],
            p0: Some(&self.x(k)[n..]),
            q1: &self.x(k + 1)[..n],
            multipliers: self.multipliers(k),
            u: self.u(k),
        }
    }

    /// The state that it begins with.
    pub(super) fn initial(&self) -> State {
        let (q, rest) = self.x(0).split_at(self.d.coordinates());
        let (p, v) = rest.split_at(self.d.dynamic);
        let [q, p, v] = [q, p, v].map(<[f64]>::to_vec);
        State { step: self.first_step, q, p, v, multipliers: vec![0.0; self.d.constraints] }
    }

    pub(super) fn x(&self, k: usize) -> &[f64] {
        &self.x[k * self.d.state()..][..self.d.state()]
    }

    /// `u[k]`; nothing after the last step.
    pub(super) fn u(&self, k: usize) -> &[f64] {
        self.u.get(k * self.d.input()..(k + 1) * self.d.input()).unwrap_or_default()
    }

    pub(super) fn multipliers(&self, k: usize) -> &[f64] {
        &self.multipliers[k * self.d.constraints..][..self.d.constraints]
    }

    pub(super) fn set_x(&mut self, k: usize, parts: [&[f64]; 3]) {
        let mut row = &mut self.x[k * self.d.state()..][..self.d.state()];
        for part in parts {
            let (head, tail) = row.split_at_mut(part.len());
            head.copy_from_slice(part);
            row = tail;
        }
    }

    pub(super) fn set_multipliers(&mut self, k: usize, values: &[f64]) {
        self.multipliers[k * self.d.constraints..][..self.d.constraints].copy_from_slice(values);
    }
}

/// The rows of a matrix, one after the other.
pub(super) fn rows(matrix: &DMatrix<f64>) -> Vec<f64> {
    matrix.transpose().as_slice().to_vec()
}
