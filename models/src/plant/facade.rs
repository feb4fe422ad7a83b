//! Plants: a model with a state and a workspace.
//!
//! The files in the order in which a step runs: [`initial`], [`predictor`], [`kinematics`], [`momenta`],
//! [`mechanics`], [`vectors`], [`potentials`], [`forces`], [`closure`] (constraints), [`curvature`], [`tree_lu`],
//! [`planar`] (in place of kinematics to tree LU), [`pivoted_lu`], [`newton`], [`conditioning`],
//! [`linearize`]; [`scheme`], [`collocation`] and [`period`] (higher order, substeps); [`blocks`] and
//! [`second_order`]; then
//! [`choice`] (accuracy mode), [`projected`] (momentum), [`known`], [`diagnose`], [`settle`], [`site`], [`snapshot`],
//! [`spare`] (plants made ahead).

use std::sync::Arc;

use crate::integrator::settings::Settings;
use crate::linearization::linearize::Linearization;
use crate::plant::initial::{Initial, InitialError};
use crate::plant::spare::Spare;

use nalgebra::DMatrix;

use crate::integrator::balls::three;
use crate::integrator::newton::Workspace;
use crate::integrator::predictor::Past;
use crate::integrator::scheme::Scheme;
use crate::math::rotation::Quaternion;
use crate::model::mechanism::Model;
use crate::plant::period::Period;

/// A state, by value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Steps since the plant was initialised.
    pub step: u64,
    /// Configuration, nd + nk.
    pub q: Vec<f64>,
    /// Momentum, nd.
    pub p: Vec<f64>,
    /// Velocity of prescribed coordinates over the last step, nk.
    pub v: Vec<f64>,
    /// Constraint impulses of the last step, nc; zero before the first.
    pub multipliers: Vec<f64>,
}

impl State {
    /// `x = (q, p, v)`.
    pub fn x(&self) -> Vec<f64> {
        [&self.q[..], &self.p, &self.v].concat()
    }
}

/// What the solver did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Residual evaluations, each followed by one correction; those of all steps of the period. Of
    /// collocation, sweeps over the stages.
    pub iterations: u32,
    /// Factorizations of the Newton matrix.
    pub factorizations: u32,
    /// Final residual in units of its own round-off.
    pub residual: f64,
    /// Final constraint violation in units of its own round-off.
    pub constraint_residual: f64,
    /// Estimate of the reciprocal condition of the Newton matrix `M[k+1]`, at most 1: its smallest
    /// pivot, each relative to the larger of its diagonal entry and the inertia that its coordinate
    /// has at most, over `h`. Of the last factorization of the step.
    pub reciprocal_condition: f64,
    /// Estimate of the reciprocal condition of `Dh(q[k+1]) M[k+1]⁻¹ Dh(q[k])ᵀ`, at most 1: its
    /// smallest pivot that does not belong to a redundant equation, relative to the largest, each
    /// equation scaled by the steepest that it gets; where loops are eliminated one after the other, that
    /// of their own pivots. Of the last factorization of the step; 1 without constraints.
    pub constraint_reciprocal_condition: f64,
    /// Equations of constraints that depend on others.
    pub redundant_constraints: u32,
    /// Steps of the method in the period.
    pub steps: u32,
    /// How often the period was halved: 0 unless it could not be solved in longer steps.
    pub halvings: u32,
}

/// Why a step failed. The plant is as it was.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// The input has the wrong length.
    #[error("the input has {actual} entries; {expected} are needed")]
    Dimension {
        /// Entries it must have.
        expected: usize,
        /// Entries it has.
        actual: usize,
    },
    /// An entry of the input is NaN or infinite.
    #[error("input {index} (`{name}`) is {value}")]
    InputNotFinite {
        /// Index of the entry.
        index: usize,
        /// Name of the input or prescribed coordinate.
        name: String,
        /// The entry.
        value: f64,
    },
    /// Newton's method did not reach the round-off level.
    #[error(
        "no convergence after {iterations} iterations: residual is {residual:e} times round-off; the step may be too large for the motion"
    )]
    NotConverged {
        /// Iterations done.
        iterations: u32,
        /// Residual in units of its round-off.
        residual: f64,
    },
    /// The iteration left the finite numbers.
    #[error("the motion left the finite numbers after {iterations} iterations")]
    NotFinite {
        /// Iterations done.
        iterations: u32,
    },
    /// A joint turned by more than half a turn: the solution is not the continuation of the motion.
    #[error(
        "`{coordinate}` turned by {increment:.3} rad in one step; the step is too large for the motion"
    )]
    TooFast {
        /// Coordinate of the joint.
        coordinate: String,
        /// Its increment, rad.
        increment: f64,
    },
    /// The Newton matrix is singular.
    #[error(
        "singular Newton matrix at coordinate `{coordinate}` (pivot {pivot:e} of what it can be)"
    )]
    Singular {
        /// Coordinate of the vanishing pivot.
        coordinate: String,
        /// The pivot, as in [`StepReport::reciprocal_condition`].
        pivot: f64,
    },
    /// Constraints lost their independence: `Dh(q[k+1]) M⁻¹ Dh(q[k])ᵀ` is singular, beyond equations
    /// that are redundant everywhere.
    #[error(
        "singular configuration of the constraints {} (reciprocal condition {reciprocal_condition:e})",
        quoted(constraints)
    )]
    SingularConstraints {
        /// Names of the equations concerned.
        constraints: Vec<String>,
        /// The estimate.
        reciprocal_condition: f64,
    },
    /// Second derivatives of a period of that many steps take too much memory.
    #[error(
        "second derivatives of a period of {steps} steps of this model take more than 1 GiB; take fewer substeps"
    )]
    TooManySteps {
        /// Steps of the period.
        steps: usize,
    },
    /// Constraints that depend on each other contradict each other.
    #[error(
        "the constraints {} contradict each other: the best configuration violates them by {violation:e}",
        quoted(constraints)
    )]
    InconsistentConstraints {
        /// Names of the equations that stay violated.
        constraints: Vec<String>,
        /// Largest value `h(q)` at the best configuration found.
        violation: f64,
    },
}

/// Names in a sentence; the first few of many.
fn quoted(names: &[String]) -> String {
    const SHOWN: usize = 8;
    let mut text =
        names.iter().take(SHOWN).map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN {
        text.push_str(&format!(" and {} more", names.len() - SHOWN));
    }
    text
}

/// Kinetic and potential energy, J.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    /// `T(q, v)`.
    pub kinetic_j: f64,
    /// Gravity and springs.
    pub potential_j: f64,
}

/// The state with what keeps its digits: sums are compensated, and past increments start the solver.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PreciseState {
    pub(crate) step: u64,
    /// Time that step 0 would have had with the present time step, s; zero unless it has changed.
    pub(crate) time_origin_s: f64,
    pub(crate) q: Vec<f64>,
    /// What `q` of the dynamic coordinates lost to rounding.
    pub(crate) q_low: Vec<f64>,
    pub(crate) p: Vec<f64>,
    /// What `p` lost to rounding.
    pub(crate) p_low: Vec<f64>,
    pub(crate) v: Vec<f64>,
    /// Orientations of ball joints; `q` has their rotation vectors.
    pub(crate) orientations: Vec<Quaternion>,
    /// What they lost to rounding.
    pub(crate) orientations_low: Vec<[f64; 4]>,
    pub(crate) multipliers: Vec<f64>,
    /// What the next step is guessed from.
    pub(crate) past: Past,
    /// How often the last period was halved, and how many since went well.
    pub(crate) halvings: u8,
    pub(crate) calm: u8,
}

impl PreciseState {
    pub(crate) fn zeros([nd, nk, nc, orientations]: [usize; 4], past: Past) -> Self {
        Self {
            step: 0,
            time_origin_s: 0.0,
            q: vec![0.0; nd + nk],
            q_low: vec![0.0; nd],
            p: vec![0.0; nd],
            p_low: vec![0.0; nd],
            v: vec![0.0; nk],
            orientations: vec![Quaternion::default(); orientations],
            orientations_low: vec![[0.0; 4]; orientations],
            multipliers: vec![0.0; nc],
            past,
            halvings: 0,
            calm: 0,
        }
    }

    /// Becomes another state of the same model and method; allocates nothing.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        let Self { step, time_origin_s, halvings, calm, .. } = *other;
        (self.step, self.time_origin_s, self.halvings, self.calm) =
            (step, time_origin_s, halvings, calm);
        self.q.copy_from_slice(&other.q);
        self.q_low.copy_from_slice(&other.q_low);
        self.p.copy_from_slice(&other.p);
        self.p_low.copy_from_slice(&other.p_low);
        self.v.copy_from_slice(&other.v);
        self.orientations.copy_from_slice(&other.orientations);
        self.orientations_low.copy_from_slice(&other.orientations_low);
        self.multipliers.copy_from_slice(&other.multipliers);
        self.past.copy_from(&other.past);
    }

    /// Takes the orientations from `q`.
    pub(crate) fn orient(&mut self, model: &Model) {
        self.orientations_low.fill([0.0; 4]);
        for (orientation, &i) in self.orientations.iter_mut().zip(&model.orientations) {
            *orientation = Quaternion::exp(three(&self.q, i));
            self.q[i..i + 3].copy_from_slice(&orientation.log().0);
        }
    }

    /// At rest in the initial configuration of the scene.
    pub(crate) fn new(model: &Model, scheme: Scheme) -> Self {
        let d = model.dimensions();
        let no = model.orientations.len();
        let q = model.coordinates().iter().map(|c| c.initial).collect();
        let past = Past::new(scheme, d.dynamic);
        let sizes = [d.dynamic, d.prescribed, d.constraints, no];
        let mut state = Self { q, ..Self::zeros(sizes, past) };
        state.orient(model);
        state
    }
}

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
    /// A plant in the scene's initial configuration, at rest. Refused where that is only a guess
    /// ([`Model::initial_violations`]): [`Plant::at`] starts elsewhere.
    pub fn new(model: Arc<Model>, settings: Settings) -> Result<Self, InitialError> {
        Self::at(model, settings, &Initial::Scene)
    }

    /// A plant in a state, step 0.
    pub fn at(
        model: Arc<Model>,
        settings: Settings,
        initial: &Initial,
    ) -> Result<Self, InitialError> {
        Spare::new(model, settings)?.start(initial)
    }

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
    /// Two to four residual evaluations of O(n) and one factorization for a smooth motion. Methods of
    /// higher order and substeps: see [`Settings`]. A step that fails leaves the plant as it was.
    pub fn step(&mut self, u: &[f64]) -> Result<StepReport, StepError> {
        let report = self.solve(u, None)?;
        self.commit();
        Ok(report)
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
        self.solve(u, Some(out))
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
        DMatrix::from_row_slice(d.constraints, d.coordinates(), &self.workspace.start.jacobian)
    }
}

impl Model {
    /// Refuses an input of the wrong length, or with a number that is not finite.
    pub fn check_input(&self, u: &[f64]) -> Result<(), StepError> {
        let d = self.dimensions;
        if u.len() != d.input() {
            return Err(StepError::Dimension { expected: d.input(), actual: u.len() });
        }
        self.check_finite(u)
    }

    /// Refuses an input, or its first entries, with a number that is not finite.
    pub(crate) fn check_finite(&self, u: &[f64]) -> Result<(), StepError> {
        let d = self.dimensions;
        match u.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(index) => {
                let name = match self.scene.inputs.get(index) {
                    Some(input) => input.name.clone(),
                    None => self.coordinates[d.dynamic + index - d.inputs].name.clone(),
                };
                Err(StepError::InputNotFinite { index, name, value: u[index] })
            }
        }
    }
}

/// The sum of two numbers, and what rounding took from it.
#[inline(always)]
pub(crate) fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let b_in_sum = sum - a;
    (sum, (a - (sum - b_in_sum)) + (b - b_in_sum))
}
