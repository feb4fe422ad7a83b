//! One stage corrected after the other, each as a step of the midpoint rule with factors of O(n), until all
//! residuals are at round-off.

use crate::integrator::newton::{CHORD_FLOOR, STALE};
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::scheme::{Scheme, Tableau};
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::system::KktSystem;
use crate::model::mechanism::Model;

/// A residual that falls by less than this from one sweep to the next falls too slowly.
const SLOW: f64 = 0.5;

/// The stages, and all memory that they need.
#[derive(Clone, Debug)]
pub(crate) struct Sweep {
    stages: Vec<Stage>,
    /// Where the midpoint rule of a stage begins, and its input.
    base: PreciseState,
    input: Vec<f64>,
}

/// A stage.
#[derive(Clone, Debug)]
struct Stage {
    /// `Y_i` and `P_i`.
    increment: Vec<f64>,
    impulse: Vec<f64>,
    kkt: KktSystem,
}

impl Sweep {
    pub(super) fn new(model: &Model, stages: usize) -> Self {
        let d = model.dimensions;
        let stage = || Stage {
            increment: vec![0.0; d.dynamic],
            impulse: vec![0.0; d.dynamic],
            kkt: KktSystem::new(model, 0),
        };
        Self {
            stages: (0..stages).map(|_| stage()).collect(),
            base: PreciseState::new(model, Scheme::Midpoint),
            input: vec![0.0; d.input()],
        }
    }

    /// Corrects stage after stage until all are solved; `None`, and `motion` as it was, if that takes too
    /// long.
    pub(super) fn correct(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        tableau: &Tableau,
        inputs: &[f64],
        motion: &mut [f64],
    ) -> Result<Option<StepReport>, StepError> {
        let StepContext { model, settings, state, u } = at;
        let (ni, nd) = (model.dimensions.inputs, model.dimensions.dynamic);
        let count = self.stages.len();
        for (i, stage) in self.stages.iter_mut().enumerate() {
            let length = settings.time_step_s * tableau.weights[i];
            for k in 0..nd {
                stage.increment[k] = length * motion[i * nd + k];
                stage.impulse[k] = length * motion[(count + i) * nd + k];
            }
        }
        self.base.q.copy_from_slice(&state.q);
        self.base.p.copy_from_slice(&state.p);
        if ni > 0 {
            workspace.mid.set_inputs(model, &u[..ni]);
        }
        let enough = settings.precision.residual();
        let mut report = StepReport::default();
        let mut previous = f64::INFINITY;
        let mut slow = 0;
        while report.iterations < settings.max_iterations {
            report.iterations += 1;
            let mut size: f64 = 0.0;
            for i in 0..count {
                let residual = self.evaluate(workspace, at, tableau, inputs, i);
                if !residual.is_finite() {
                    return Ok(None);
                }
                size = size.max(residual);
                if report.iterations == 1 {
                    let settings = stage_settings(settings, tableau.weights[i]);
                    workspace.factor(model, &settings, state)?;
                    std::mem::swap(&mut workspace.kkt, &mut self.stages[i].kkt);
                    workspace.kkt.estimates = self.stages[i].kkt.estimates;
                    report.factorizations += 1;
                }
                let stage = &mut self.stages[i];
                stage.kkt.solve(
                    model,
                    &workspace.constraints.end,
                    &mut workspace.residual.dynamics,
                    &mut [],
                );
                for (y, correction) in stage.increment.iter_mut().zip(&workspace.residual.dynamics)
                {
                    *y -= correction;
                }
            }
            report.residual = size;
            let stagnates = size > SLOW * previous;
            if report.iterations > 1 && (size <= enough || (stagnates && size <= CHORD_FLOOR)) {
                if size > STALE {
                    for i in 0..count {
                        self.evaluate(workspace, at, tableau, inputs, i);
                    }
                }
                self.finish(workspace, at, tableau, motion)?;
                return Ok(Some(report));
            }
            slow = if stagnates { slow + 1 } else { 0 };
            if slow == 3 {
                return Ok(None);
            }
            previous = size;
        }
        Ok(None)
    }

    /// Evaluates a stage and takes its impulse; returns the size of its residual, which is left in the
    /// workspace, in units of round-off.
    fn evaluate(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        tableau: &Tableau,
        inputs: &[f64],
        i: usize,
    ) -> f64 {
        let StepContext { model, state, u, .. } = at;
        let d = model.dimensions;
        let Self { stages, base, input } = self;
        base.q_low.copy_from_slice(&state.q_low);
        base.p_low.copy_from_slice(&state.p_low);
        for j in (0..stages.len()).filter(|j| *j != i) {
            let (stage, weight) = (&stages[j], tableau.coupling[i * stages.len() + j]);
            for k in 0..d.dynamic {
                base.q_low[k] += weight * stage.increment[k];
                base.p_low[k] += weight * stage.impulse[k];
            }
        }
        let (node, half) = (tableau.nodes[i], 0.5 * tableau.weights[i]);
        for k in 0..d.prescribed {
            let (start, way) = (state.q[d.dynamic + k], u[d.inputs + k] - state.q[d.dynamic + k]);
            base.q[d.dynamic + k] = start + (node - half) * way;
            input[d.inputs + k] = start + (node + half) * way;
        }
        let settings = stage_settings(at.settings, tableau.weights[i]);
        if d.prescribed > 0 || !model.signals.is_empty() {
            input[..d.inputs].copy_from_slice(&inputs[i * d.inputs..][..d.inputs]);
            workspace.prepare(StepContext { model, settings: &settings, state: base, u: input });
        }
        workspace.step.increment.copy_from_slice(&stages[i].increment);
        let residual = workspace.evaluate(model, &settings, base);
        workspace.mid.write_impulse(settings.time_step_s, &mut stages[i].impulse);
        residual
    }

    /// Checks the solution; writes velocities and forces, and their sums over the step.
    fn finish(
        &self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        tableau: &Tableau,
        motion: &mut [f64],
    ) -> Result<(), StepError> {
        let (count, nd) = (self.stages.len(), at.model.dimensions.dynamic);
        for stage in &self.stages {
            at.model.check_turns(&stage.increment)?;
        }
        workspace.step.increment.fill(0.0);
        workspace.step.impulse.fill(0.0);
        for (i, stage) in self.stages.iter().enumerate() {
            let rate = 1.0 / (at.settings.time_step_s * tableau.weights[i]);
            for k in 0..nd {
                workspace.step.increment[k] += stage.increment[k];
                workspace.step.impulse[k] += stage.impulse[k];
                motion[i * nd + k] = rate * stage.increment[k];
                motion[(count + i) * nd + k] = rate * stage.impulse[k];
            }
        }
        Ok(())
    }
}

/// The settings of the midpoint rule of a stage.
fn stage_settings(settings: &Settings, weight: f64) -> Settings {
    Settings { time_step_s: weight * settings.time_step_s, ..*settings }
}
