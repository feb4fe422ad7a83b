//! Derivatives of a step whose solution is known: nothing is solved anew.

use nalgebra::DMatrix;

use crate::integrator::report::StepError;
use crate::integrator::scheme::Scheme;
use crate::integrator::workspace::StepContext;
use crate::linearization::linearize::Linearization;
use crate::model::manifold::{difference, orientations};
use crate::plant::facade::Plant;

/// A step that was taken before, or one that a reference asks for.
#[derive(Clone, Copy, Debug)]
pub struct KnownStep<'a> {
    /// Index of the step: the time of signals.
    pub index: u64,
    /// Configuration at the start, nd + nk.
    pub q0: &'a [f64],
    /// Momentum at the start, nd and whatever follows in the state; none where the end is asked for.
    pub p0: Option<&'a [f64]>,
    /// Configuration at the end, nd + nk.
    pub q1: &'a [f64],
    /// Constraint impulses, nc.
    pub multipliers: &'a [f64],
    /// Input, ni + nk.
    pub u: &'a [f64],
}

impl Plant {
    /// Linearizes the map at a known step. Costs one residual evaluation, a factorization, and
    /// O(n²·depth); where the period has several steps or stages, it is solved again from `p0`. Leaves
    /// the plant at the start of the step, with the momentum that it had.
    pub fn linearize_known(
        &mut self,
        step: &KnownStep<'_>,
        out: &mut Linearization,
    ) -> Result<(), StepError> {
        if let (false, Some(p0)) = (self.is_one_midpoint_step(), step.p0) {
            self.place_start(step);
            self.state.p.copy_from_slice(&p0[..self.model.dimensions.dynamic]);
            self.state.p_low.fill(0.0);
            self.state.past.forget();
            return self.solve(step.u, Some(out));
        }
        out.assert_model(&self.model);
        self.place_known(step)?;
        let Self { model, settings, state, workspace, period } = self;
        let u = period.input.of_step(model, state, settings.time_step_s, step.u, [0.0, 1.0])?;
        workspace.linearize(StepContext { model, settings, state, u }, out)
    }

    /// Whether the period is one step of the midpoint rule.
    pub fn is_one_midpoint_step(&self) -> bool {
        self.period.scheme == Scheme::Midpoint && self.settings.substeps == 1
    }

    /// Never halves a period: all steps are of one map.
    pub fn keep_periods_whole(&mut self) {
        self.settings.halvings = 0;
    }

    fn place_start(&mut self, step: &KnownStep<'_>) {
        self.place_configuration(step.q0);
        self.state.step = step.index;
    }

    /// Takes a configuration as it is.
    pub(crate) fn place_configuration(&mut self, q: &[f64]) {
        self.state.q.copy_from_slice(q);
        self.state.q_low.fill(0.0);
        self.state.orient(&self.model);
        self.workspace.forget();
    }

    /// Momenta that a step from `q0` to `q1` leaves with and arrives with, without the impulse of
    /// constraints: `−D1 Ld − F⁻` and `D2 Ld + F⁺`.
    pub fn momenta_of_known(
        &mut self,
        step: &KnownStep<'_>,
        at_start: &mut [f64],
        at_end: &mut [f64],
    ) -> Result<(), StepError> {
        self.state.p.fill(0.0);
        self.state.p_low.fill(0.0);
        let multipliers = &vec![0.0; self.model.dimensions.constraints];
        self.place_known(&KnownStep { multipliers, ..*step })?;
        self.workspace.find_impulse(&self.model, &self.settings);
        let workspace = &self.workspace;
        let momenta = at_start.iter_mut().zip(at_end);
        for ((start, end), (residual, impulse)) in
            momenta.zip(workspace.residual.dynamics.iter().zip(&workspace.step.impulse))
        {
            *start = -residual;
            *end = impulse - residual;
        }
        Ok(())
    }

    /// Mass matrix of the dynamic coordinates, nd square (allocates).
    pub fn mass_matrix_at(&mut self, q: &[f64]) -> DMatrix<f64> {
        let nd = self.model.dimensions.dynamic;
        self.place_configuration(q);
        let mut mass = DMatrix::zeros(nd, nd);
        let mut velocity = vec![0.0; q.len()];
        for j in 0..nd {
            velocity[j] = 1.0;
            self.workspace.gradient_at(&self.model, &self.state, &velocity);
            mass.column_mut(j).copy_from_slice(&self.workspace.mid.l_v);
            velocity[j] = 0.0;
        }
        mass
    }

    /// Values `h(q)` of the constraints and their Jacobian, nc by nd + nk (allocates).
    pub fn constraints_at(&mut self, q: &[f64]) -> (Vec<f64>, DMatrix<f64>) {
        let d = self.model.dimensions;
        let closure = &mut self.workspace.constraints.end;
        closure.evaluate(&self.model, q, &orientations(&self.model, q));
        closure.differentiate(&self.model, q);
        let jacobian = DMatrix::from_row_slice(d.constraints, d.coordinates(), &closure.jacobian);
        (closure.value.clone(), jacobian)
    }

    /// Puts the solution of a known step into the workspace.
    fn place_known(&mut self, step: &KnownStep<'_>) -> Result<(), StepError> {
        self.model.check_input(step.u)?;
        self.place_start(step);
        let Self { model, settings, state, workspace, period } = self;
        let u = period.input.of_step(model, state, settings.time_step_s, step.u, [0.0, 1.0])?;
        workspace.prepare(StepContext { model, settings, state, u });
        difference(&model.orientations, step.q0, step.q1, &mut workspace.step.increment);
        workspace.step.multipliers.copy_from_slice(step.multipliers);
        let residual = workspace.evaluate(model, settings, state);
        if residual.is_nan() { Err(StepError::NotFinite { iterations: 0 }) } else { Ok(()) }
    }
}
