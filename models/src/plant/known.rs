//! Derivatives of a step whose solution is known: nothing is solved anew.

use nalgebra::DMatrix;

use crate::plant::balls::orientations;
use crate::plant::linearize::Linearization;
use crate::plant::{Plant, StepError};

/// A step that was taken before, or one that a reference asks for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KnownStep<'a> {
    /// Index of the step: the time of signals.
    pub(crate) index: u64,
    /// Configuration at the start, nd + nk.
    pub(crate) q0: &'a [f64],
    /// Configuration at the end, nd + nk.
    pub(crate) q1: &'a [f64],
    /// Constraint impulses, nc.
    pub(crate) multipliers: &'a [f64],
    /// Input, ni + nk.
    pub(crate) u: &'a [f64],
}

impl Plant {
    /// Linearizes the map at a known step. Costs one residual evaluation, a factorization, and
    /// O(n²·depth). Leaves the plant at the start of the step, with the momentum that it had.
    pub(crate) fn linearize_known(
        &mut self,
        step: &KnownStep<'_>,
        out: &mut Linearization,
    ) -> Result<(), StepError> {
        self.place_known(step)?;
        self.linearize_solution(step.u, out)
    }

    /// Momenta that a step from `q0` to `q1` leaves with and arrives with, without the impulse of
    /// constraints: `−D1 Ld − F⁻` and `D2 Ld + F⁺`.
    pub(crate) fn momenta_of_known(
        &mut self,
        step: &KnownStep<'_>,
        at_start: &mut [f64],
        at_end: &mut [f64],
    ) -> Result<(), StepError> {
        self.state.p.fill(0.0);
        self.state.p_low.fill(0.0);
        let multipliers = &vec![0.0; self.model.dimensions.constraints];
        self.place_known(&KnownStep { multipliers, ..*step })?;
        let (h, workspace) = (self.settings.time_step_s, &mut self.workspace);
        for (i, impulse) in workspace.impulse.iter_mut().enumerate() {
            *impulse = h * (workspace.l_q[i] + workspace.force[i]);
        }
        if !self.model.orientations.is_empty() {
            workspace.turn_impulse(&self.model, &self.settings);
        }
        let momenta = at_start.iter_mut().zip(at_end);
        for ((start, end), (residual, impulse)) in
            momenta.zip(workspace.residual.iter().zip(&workspace.impulse))
        {
            *start = -residual;
            *end = impulse - residual;
        }
        Ok(())
    }

    /// Mass matrix of the dynamic coordinates, nd square (allocates).
    pub(crate) fn mass_matrix_at(&mut self, q: &[f64]) -> DMatrix<f64> {
        let nd = self.model.dimensions.dynamic;
        self.state.q.copy_from_slice(q);
        self.state.orient(&self.model);
        self.workspace.forget();
        let mut mass = DMatrix::zeros(nd, nd);
        let mut velocity = vec![0.0; q.len()];
        for j in 0..nd {
            velocity[j] = 1.0;
            self.workspace.gradient_at(&self.model, &self.state, &velocity);
            mass.column_mut(j).copy_from_slice(&self.workspace.l_v);
            velocity[j] = 0.0;
        }
        mass
    }

    /// Values `h(q)` of the constraints and their Jacobian, nc by nd + nk (allocates).
    pub(crate) fn constraints_at(&mut self, q: &[f64]) -> (Vec<f64>, DMatrix<f64>) {
        let d = self.model.dimensions;
        let closure = &mut self.workspace.end;
        self.workspace.end_is_exact = false;
        closure.evaluate(&self.model, q, &orientations(&self.model, q));
        closure.differentiate(&self.model, q);
        let jacobian = DMatrix::from_row_slice(d.constraints, d.coordinates(), &closure.jacobian);
        (closure.value.clone(), jacobian)
    }

    /// Puts the solution of a known step into the workspace.
    fn place_known(&mut self, step: &KnownStep<'_>) -> Result<(), StepError> {
        self.check_input(step.u)?;
        self.state.q.copy_from_slice(step.q0);
        self.state.q_low.fill(0.0);
        self.state.step = step.index;
        self.state.orient(&self.model);
        self.workspace.forget();
        let mut effective = std::mem::take(&mut self.workspace.effective_input);
        let u = if effective.is_empty() {
            step.u
        } else {
            effective.copy_from_slice(step.u);
            self.apply_signals(&mut effective);
            &effective
        };
        self.workspace.prepare(&self.model, &self.settings, &self.state, u);
        self.workspace.effective_input = effective;
        let nd = self.model.dimensions.dynamic;
        let increment = &mut self.workspace.increment;
        for (x, (q1, q0)) in increment.iter_mut().zip(step.q1.iter().zip(step.q0)) {
            *x = q1 - q0;
        }
        self.workspace.multipliers.copy_from_slice(step.multipliers);
        if self.model.orientations.iter().any(|&i| i < nd) {
            let change = self.model.difference(step.q0, step.q1);
            for &i in self.model.orientations.iter().filter(|i| **i < nd) {
                self.workspace.increment[i..i + 3].copy_from_slice(&change[i..i + 3]);
            }
        }
        let residual = self.workspace.evaluate(&self.model, &self.settings, &self.state);
        if residual.is_nan() { Err(StepError::NotFinite { iterations: 0 }) } else { Ok(()) }
    }
}
