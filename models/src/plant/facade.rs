//! The plant itself: a model with a state and a workspace, and what is done with it.

use std::sync::Arc;

use nalgebra::DMatrix;

use crate::integrator::report::{StepError, StepReport};
use crate::integrator::settings::Settings;
use crate::integrator::state::{PreciseState, State};
use crate::integrator::workspace::Workspace;
use crate::linearization::linearize::Linearization;
use crate::model::mechanism::Model;
use crate::plant::period::Period;

/// A plant: the discrete map `x[k+1] = f(x[k], u[k])` with its state.
///
/// After construction [`Plant::step`], [`Plant::linearize`] and [`Plant::step_and_linearize`]
/// allocate nothing, take no lock, do no input or output, and do not panic.
#[derive(Clone, Debug)]
pub struct Plant {
    pub(crate) model: Arc<Model>,
    pub(crate) settings: Settings,
    pub(crate) state: PreciseState,
    pub(crate) workspace: Workspace,
    pub(crate) period: Period,
}

impl Plant {
    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// The settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Takes one step with `u = (inputs, next prescribed positions)`.
    ///
    /// Solves for the increment `x = q[k+1] − q[k]` and the multipliers `λ`:
    ///
    /// ```text
    /// 0 = p + ½h L_q − L_v + a h f − Dh(q[k])ᵀ λ      at (q[k] + ½x, x/h)
    /// 0 = h(q[k+1])
    /// p[k+1] = p + h (L_q + f) − Dh(q[k])ᵀ λ
    /// ```
    ///
    /// One to four residual evaluations of O(n) and one factorization for a smooth motion. Methods of
    /// higher order and substeps: see [`Settings`]. A step that fails leaves the plant as it was.
    ///
    /// ```
    /// use std::sync::Arc;
    /// use plantd_models::{Initial, Model, Plant, Settings, builtin};
    ///
    /// // A pendulum without damping keeps its energy.
    /// let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap())?);
    /// let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
    /// plant.initialize(&Initial::Velocity { q: vec![1.0], v: vec![0.0] })?;
    /// let total = |plant: &mut Plant| plant.energy().kinetic_j + plant.energy().potential_j;
    /// let before = total(&mut plant);
    /// for _ in 0..1000 {
    ///     let report = plant.step(&[0.0])?;
    ///     assert!(report.residual < 10.0, "in units of round-off");
    /// }
    /// assert!((total(&mut plant) - before).abs() < 1e-2);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn step(&mut self, u: &[f64]) -> Result<StepReport, StepError> {
        self.solve(u, None)?;
        self.commit();
        Ok(self.workspace.step.report)
    }

    /// Linearizes the map at the current state and `u`, and stays there. Costs a step, a
    /// factorization, and O(n²·depth) for `n` coordinates; O(n²) in planes.
    ///
    /// # Panics
    ///
    /// If `out` was made for a model of other dimensions.
    pub fn linearize(
        &mut self,
        u: &[f64],
        out: &mut Linearization,
    ) -> Result<StepReport, StepError> {
        self.solve(u, Some(out))?;
        Ok(self.workspace.step.report)
    }

    /// Takes one step and linearizes it at its solution.
    ///
    /// # Panics
    ///
    /// If `out` was made for a model of other dimensions.
    pub fn step_and_linearize(
        &mut self,
        u: &[f64],
        out: &mut Linearization,
    ) -> Result<StepReport, StepError> {
        let report = self.linearize(u, out)?;
        self.commit();
        Ok(report)
    }

    /// Writes the input that exerts no force and leaves prescribed coordinates where they are; those
    /// that signals drive, where the signals have them at the end of the step.
    ///
    /// # Panics
    ///
    /// If `u` does not have `ni + nk` entries.
    pub fn hold_input(&self, u: &mut [f64]) {
        let d = self.model.dimensions;
        let (inputs, prescribed) = u.split_at_mut(d.inputs);
        inputs.fill(0.0);
        prescribed.copy_from_slice(&self.state.q[d.dynamic..]);
        self.model.replace_prescribed(self.time_after_s(1.0), prescribed);
    }

    /// The input with which a step from here runs if it is given `u`: signals add to inputs and replace
    /// prescribed positions.
    ///
    /// # Panics
    ///
    /// If `u` does not have `ni + nk` entries.
    pub fn effective_input(&self, u: &[f64]) -> Vec<f64> {
        assert_eq!(u.len(), self.model.dimensions.input(), "entries of the input");
        let mut effective = u.to_vec();
        let (inputs, prescribed) = effective.split_at_mut(self.model.dimensions.inputs);
        self.model.add_input_signals(self.time_after_s(0.5), inputs);
        self.model.replace_prescribed(self.time_after_s(1.0), prescribed);
        effective
    }

    fn time_after_s(&self, steps: f64) -> f64 {
        self.state.time_after_s(steps, self.settings.time_step_s)
    }

    /// Steps since the plant was initialised.
    pub fn step_index(&self) -> u64 {
        self.state.step
    }

    /// Sets the steps since the plant was initialised, and with them the time of signals: for a plant
    /// that goes on from a state of another one.
    pub fn set_step_index(&mut self, step: u64) {
        self.state.step = step;
    }

    /// `step_index × h`, and what [`Plant::set_time_s`] has added, s.
    pub fn time_s(&self) -> f64 {
        self.time_after_s(0.0)
    }

    /// Sets the present time, and with it that of signals: for a plant that goes on with another time
    /// step. Until it is initialised again, its time differs from `step_index × h` by the same amount.
    pub fn set_time_s(&mut self, time_s: f64) {
        self.state.time_origin_s = time_s - self.state.step as f64 * self.settings.time_step_s;
    }

    /// Configuration, nd + nk.
    pub fn q(&self) -> &[f64] {
        &self.state.q
    }

    /// Momentum, nd (the paper's: not projected onto the constraints).
    pub fn p(&self) -> &[f64] {
        &self.state.p
    }

    /// Velocity of prescribed coordinates over the last step, nk.
    pub fn v(&self) -> &[f64] {
        &self.state.v
    }

    /// Constraint impulses of the last step, nc.
    pub fn multipliers(&self) -> &[f64] {
        &self.state.multipliers
    }

    /// The state by value (allocates).
    pub fn state(&self) -> State {
        State {
            step: self.state.step,
            q: self.state.q.clone(),
            p: self.state.p.clone(),
            v: self.state.v.clone(),
            multipliers: self.state.multipliers.clone(),
        }
    }

    /// Constraint Jacobian `Dh` at the current configuration, nc by nd + nk (allocates).
    pub fn constraint_jacobian(&mut self) -> DMatrix<f64> {
        self.workspace.prepare_start(&self.model, &self.state);
        let d = self.model.dimensions;
        DMatrix::from_row_slice(
            d.constraints,
            d.coordinates(),
            &self.workspace.constraints.start.jacobian,
        )
    }
}
