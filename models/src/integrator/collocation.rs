//! Gauss collocation in Lagrangian form, order `2s` with `s` stages: coupled midpoint rules.
//!
//! With the velocities `V_i` at the nodes, `Y_i = h b_i V_i`, and the impulses `P_i = h b_i (L_q + f)`,
//!
//! ```text
//! Q_i = q + Σ_j μ_ij Y_j                    x = Σ Y_j          μ_ij = a_ij / b_j
//! 0 = p + Σ_j μ_ij P_j − L_v(Q_i, V_i)      p[k+1] = p + Σ P_j
//! ```
//!
//! `μ_ij + μ_ji = 1` makes the method symplectic whatever the rounding of the weights. Where ball joints turn it
//! says the same of curves on the rotations: see [`balls`]. Constraints hold at nodes of their own: see [`closures`].
//!
//! Few unknowns are corrected by Newton's method with the dense Jacobian of the guess. Many, and those of ball
//! joints, are corrected with the mass matrices of the stages, O(n·depth), by corrections that learn from those
//! before ([`masses`], [`secants`]), until all residuals are at round-off; with constraints, by the linear system of
//! the midpoint rule ([`middle`]). Where that is slow, because something is stiff, the dense Jacobian is taken after
//! all; not of ball joints with constraints, as that of a guess which is far off leads to where legs are bent the other
//! way, and shorter steps do not.
//!
//! Prescribed coordinates move at a constant rate, `c_i` of the way at node `i`. Inputs that signals drive
//! are taken at the nodes.

pub(crate) mod balls;
pub(crate) mod closures;
pub(crate) mod hessian;
pub(crate) mod masses;
pub(crate) mod middle;
pub(crate) mod secants;
pub(crate) mod slopes;
pub(crate) mod system;

use plantd_math::scalar::Lanes;
use plantd_math::simd::{AVX512, has};

use crate::integrator::collocation::system::System;
use crate::integrator::report::StepError;
use crate::integrator::scheme::Tableau;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::model::mechanism::Model;

/// Unknowns up to which the dense Jacobian is taken. With 28 (an arm at order 8) rounds with the mass matrices take as
/// long to large errors and 0.6 of it to small ones; with 48 (a chain of 8 at order 12) 0.4 of it.
const DENSE: usize = 24;
/// The same with constraints, whose multipliers count: where the two cost the same (scissor lifts, the marionette).
const DENSE_BOUND: usize = 54;

/// A step, and all memory that it needs.
#[derive(Clone, Debug)]
pub(crate) struct Collocation {
    pub(crate) tableau: Tableau,
    /// Inputs at the stages, one after the other.
    pub(crate) inputs: Vec<f64>,
    /// Velocities at the stages of the solution, one after the other, then forces `L_q + f`; of ball joints angular
    /// velocities.
    pub(crate) motion: Vec<f64>,
    pub(crate) stages: Stages,
}

/// The stages, in registers that suit them. A few more than four lie in one of eight, which takes about as long as
/// one of four.
#[derive(Clone, Debug)]
pub(crate) enum Stages {
    Fours(Box<System<4>>),
    Eights(Box<System<8>>),
}

/// The same with the stages, however many lie side by side.
macro_rules! with_stages {
    ($stages:expr, $system:ident => $result:expr) => {
        match $stages {
            $crate::integrator::collocation::Stages::Fours($system) => $result,
            $crate::integrator::collocation::Stages::Eights($system) => $result,
        }
    };
}
pub(crate) use with_stages;

impl Collocation {
    pub(crate) fn new(model: &Model, stages: usize) -> Self {
        let d = model.dimensions;
        let tableau = Tableau::new(stages);
        let most = if d.constraints > 0 { DENSE_BOUND } else { DENSE };
        let unknowns = stages * (d.dynamic + d.constraints);
        let by_masses = unknowns > most || !model.orientations.is_empty();
        let mut stages = if stages > Lanes::COUNT && has(AVX512) {
            Stages::Eights(Box::new(System::new(model, &tableau, by_masses)))
        } else {
            Stages::Fours(Box::new(System::new(model, &tableau, by_masses)))
        };
        if !by_masses {
            with_stages!(&mut stages, system => system.make_dense(model, &tableau));
        }
        Self {
            inputs: vec![0.0; tableau.nodes.len() * d.inputs],
            motion: vec![0.0; 2 * tableau.nodes.len() * d.dynamic],
            stages,
            tableau,
        }
    }

    /// Solves one step, which starts at a time; the solution stays here and in the workspace, with its report. `u` has
    /// no signals of inputs.
    pub(crate) fn solve(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        start_s: f64,
    ) -> Result<(), StepError> {
        self.guess(workspace, at, start_s)?;
        let Self { tableau, inputs, motion, stages } = self;
        with_stages!(stages, system => system.solve(workspace, at, tableau, [inputs, motion]))
    }

    /// Guesses the motion; takes the inputs of the stages.
    fn guess(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        start_s: f64,
    ) -> Result<(), StepError> {
        let StepContext { model, settings, state, u } = at;
        let d = model.dimensions;
        let h = settings.time_step_s;
        if !state.past.predict_stages(&self.tableau, &mut self.motion) {
            workspace.prepare(at);
            workspace.ballistic(model, settings, state);
            let half = self.motion.len() / 2;
            let (velocities, forces) = self.motion.split_at_mut(half);
            for velocities in velocities.chunks_exact_mut(d.dynamic.max(1)) {
                let pairs = velocities.iter_mut().zip(&workspace.step.increment);
                pairs.for_each(|(v, x)| *v = x / h);
            }
            forces.fill(0.0);
        }
        if d.inputs == 0 {
            return Ok(());
        }
        for (inputs, node) in self.inputs.chunks_exact_mut(d.inputs).zip(&self.tableau.nodes) {
            inputs.copy_from_slice(&u[..d.inputs]);
            if !model.signals.is_empty() {
                model.add_input_signals(start_s + node * h, inputs);
                model.check_finite(inputs)?;
            }
        }
        Ok(())
    }
}

impl<const N: usize> System<N> {
    /// Solves a step from the guess in `motion`, which becomes that of the solution.
    fn solve(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        tableau: &Tableau,
        [inputs, motion]: [&mut [f64]; 2],
    ) -> Result<(), StepError> {
        self.begin(at, motion, inputs, &mut workspace.mid);
        let has_both = self.balls.is_some() && self.closures.is_some();
        let mut report = match self.correct_alike(workspace, at, inputs) {
            Some(Ok(report)) => report,
            Some(Err(error)) if has_both => return Err(explain(workspace, at, error)),
            _ => {
                self.make_dense(at.model, tableau);
                self.begin(at, motion, inputs, &mut workspace.mid);
                let corrected = self.correct(workspace, at, inputs);
                corrected.map_err(|error| explain(workspace, at, error))?
            }
        };
        let step = &mut workspace.step;
        let sums = [&mut *step.increment, &mut *step.impulse, &mut *step.multipliers];
        self.finish(at.model, motion, report.redundant_constraints, sums)?;
        workspace.prepare(at);
        if at.model.dimensions.constraints == 0 {
            workspace.kkt.estimates.write(&mut report);
        }
        workspace.step.report = report;
        Ok(())
    }
}

/// Why a step could not be solved, where constraints are the reason.
#[cold]
fn explain(workspace: &mut Workspace, at: StepContext<'_>, error: StepError) -> StepError {
    if at.model.dimensions.constraints > 0 {
        workspace.prepare(at);
    }
    at.model.explain(error, at, &workspace.step.q_end)
}
