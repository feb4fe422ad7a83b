//! The derivative of a control period as a map.

use crate::integrator::report::{StepError, StepReport};
use crate::integrator::workspace::StepContext;
use crate::linearization::derivative::{StepDerivative, is_generated};
use crate::plant::facade::Plant;

impl Plant {
    /// Differentiates the map at the current state and `u`, and stays there: what [`Plant::linearize`] finds, as
    /// products. Costs a step and a factorization, O(n) where [`StepDerivative`] says so. Where it fails, `out` is zero.
    ///
    /// # Panics
    ///
    /// If `out` was made for a model of other dimensions.
    pub fn differentiate(
        &mut self,
        u: &[f64],
        out: &mut StepDerivative,
    ) -> Result<StepReport, StepError> {
        out.begin(&self.model);
        if !self.is_one_midpoint_step() || !is_generated(&self.model, &self.settings) {
            return self.differentiate_by_matrices(u, out);
        }
        self.solve(u, None)?;
        if self.period.is_reached {
            return self.differentiate_by_matrices(u, out);
        }
        let Self { model, settings, state, workspace, period } = self;
        let of_step = period.input.of_step(model, state, settings.time_step_s, u, [0.0, 1.0])?;
        workspace.differentiate(StepContext { model, settings, state, u: of_step }, out)?;
        if !out.is_there() {
            return self.differentiate_by_matrices(u, out);
        }
        workspace.kkt.estimates.write(&mut workspace.step.report);
        Ok(workspace.step.report)
    }

    fn differentiate_by_matrices(
        &mut self,
        u: &[f64],
        out: &mut StepDerivative,
    ) -> Result<StepReport, StepError> {
        let model = std::sync::Arc::clone(&self.model);
        out.form(&model, |linearization| self.linearize(u, linearization))
    }

    /// Takes one step and differentiates it at its solution.
    ///
    /// # Panics
    ///
    /// If `out` was made for a model of other dimensions.
    pub fn step_and_differentiate(
        &mut self,
        u: &[f64],
        out: &mut StepDerivative,
    ) -> Result<StepReport, StepError> {
        let report = self.differentiate(u, out)?;
        self.commit();
        Ok(report)
    }
}
