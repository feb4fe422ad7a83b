//! Gauss collocation in Lagrangian form, order `2s` with `s` stages: coupled midpoint rules.
//!
//! With the velocities `V_i` at the nodes, `Y_i = h b_i V_i`, and the impulses `P_i = h b_i (L_q + f)`,
//!
//! ```text
//! Q_i = q + Σ_j μ_ij Y_j                    x = Σ Y_j          μ_ij = a_ij / b_j
//! 0 = p + Σ_j μ_ij P_j − L_v(Q_i, V_i)      p[k+1] = p + Σ P_j
//! ```
//!
//! Since `μ_ii = ½`, each stage is a step of the midpoint rule of length `h b_i`, from what the other
//! stages give it to begin with: its Newton matrix is that of such a step.
//!
//! Few unknowns are corrected all at once, with the dense Jacobian of the guess. Many are corrected stage
//! after stage, each with its own factors of O(n), until all residuals are at round-off; where that is slow,
//! because the coupling is stiff, they are taken at once too. `μ_ij + μ_ji = 1` makes the method
//! symplectic whatever the rounding of the weights.
//!
//! Prescribed coordinates move at a constant rate, `c_i` of the way at node `i`. Inputs that signals drive
//! are taken at the nodes.

mod linearize;
mod stage;

use crate::Model;
use crate::plant::closure::larger;
use crate::plant::dense_lu::DenseLu;
use crate::plant::newton::{At, CHORD_FLOOR, FLOOR, Factors, STALE, Workspace};
use crate::plant::predictor::Past;
use crate::plant::scheme::{Scheme, Tableau};
use crate::plant::{PreciseState, Settings, StepError, StepReport};

pub(crate) use linearize::StageTangents;
use stage::Hessian;

/// A residual that falls by less than this from one sweep to the next falls too slowly.
const SLOW: f64 = 0.5;

/// Rounds of corrections of all stages beyond which shorter steps are the better way.
const ROUNDS: u32 = 16;
/// Unknowns up to which all stages are corrected at once.
const AT_ONCE: usize = 48;

/// The stages of a step, and all memory that they need.
#[derive(Clone, Debug)]
pub(crate) struct Collocation {
    pub(crate) tableau: Tableau,
    pub(crate) stages: Vec<Stage>,
    /// Where the midpoint rule of a stage begins, and its input.
    base: PreciseState,
    input: Vec<f64>,
    /// Velocities at the stages, one after the other, then forces `L_q + f`.
    motion: Vec<f64>,
    /// For Newton's method and derivatives; empty until they are needed.
    system: Option<Box<System>>,
}

/// A stage.
#[derive(Clone, Debug)]
pub(crate) struct Stage {
    /// `Y_i` and `P_i`.
    increment: Vec<f64>,
    impulse: Vec<f64>,
    /// `L_v`.
    momentum: Vec<f64>,
    factors: Factors,
    inputs: Vec<f64>,
}

/// All stages at once.
#[derive(Clone, Debug)]
pub(crate) struct System {
    /// Second derivatives at the stages.
    hessians: Vec<Hessian>,
    /// Derivatives of the residuals by all `Y`.
    matrix: DenseLu,
    residual: Vec<f64>,
    /// For the filling of `matrix`.
    products: Vec<f64>,
    rates: Vec<f64>,
}

impl Collocation {
    pub(crate) fn new(model: &Model, stages: usize) -> Self {
        let d = model.dimensions;
        let stage = || Stage {
            increment: vec![0.0; d.dynamic],
            impulse: vec![0.0; d.dynamic],
            momentum: vec![0.0; d.dynamic],
            factors: Factors::new(model),
            inputs: vec![0.0; d.inputs],
        };
        Self {
            tableau: Tableau::new(stages),
            stages: (0..stages).map(|_| stage()).collect(),
            base: PreciseState::new(model, Scheme::Midpoint),
            input: vec![0.0; d.input()],
            motion: vec![0.0; 2 * stages * d.dynamic],
            system: None,
        }
    }

    /// Velocities at the stages of the solution, one after the other, then forces.
    pub(crate) fn motion(&self) -> &[f64] {
        &self.motion
    }

    /// Solves one step, which starts at a time; the solution stays here and in the workspace. `u` has no
    /// signals of inputs.
    pub(crate) fn solve(
        &mut self,
        workspace: &mut Workspace,
        at: At<'_>,
        start_s: f64,
    ) -> Result<StepReport, StepError> {
        self.begin(workspace, at, start_s)?;
        let report = if self.stages.len() * at.model.dimensions.dynamic <= AT_ONCE {
            self.correct_all(workspace, at)?
        } else {
            match self.sweep(workspace, at)? {
                Some(report) => report,
                None => self.correct_all(workspace, at)?,
            }
        };
        self.finish(workspace, at, report)
    }

    /// Guesses the stages; places what does not change within the step.
    fn begin(
        &mut self,
        workspace: &mut Workspace,
        at: At<'_>,
        start_s: f64,
    ) -> Result<(), StepError> {
        let At { model, settings, state, u } = at;
        let d = model.dimensions;
        let h = settings.time_step_s;
        let is_guessed = match &state.past {
            Past::Stages(past) => past.predict(&self.tableau, &mut self.motion),
            Past::Increments(_) | Past::Trail(_) => false,
        };
        if !is_guessed {
            workspace.prepare(at);
            workspace.ballistic(model, settings, state);
            let (velocities, forces) = self.motion.split_at_mut(self.stages.len() * d.dynamic);
            for velocities in velocities.chunks_exact_mut(d.dynamic.max(1)) {
                let pairs = velocities.iter_mut().zip(&workspace.increment);
                pairs.for_each(|(v, x)| *v = x / h);
            }
            forces.fill(0.0);
        }
        let Self { stages, tableau, motion, input, .. } = self;
        let (velocities, forces) = motion.split_at(stages.len() * d.dynamic);
        for (i, stage) in stages.iter_mut().enumerate() {
            let length = h * tableau.weights[i];
            let range = i * d.dynamic..(i + 1) * d.dynamic;
            let increments = stage.increment.iter_mut().zip(&velocities[range.clone()]);
            increments.for_each(|(y, v)| *y = length * v);
            let impulses = stage.impulse.iter_mut().zip(&forces[range]);
            impulses.for_each(|(p, force)| *p = length * force);
            stage.inputs.copy_from_slice(&u[..d.inputs]);
            model.add_input_signals(start_s + tableau.nodes[i] * h, &mut stage.inputs);
            if !model.signals.is_empty() {
                input.copy_from_slice(u);
                input[..d.inputs].copy_from_slice(&stage.inputs);
                model.check_input(input)?;
            }
        }
        self.base.q.copy_from_slice(&state.q);
        self.base.p.copy_from_slice(&state.p);
        if d.inputs > 0 {
            workspace.set_inputs(model, &u[..d.inputs]);
        }
        Ok(())
    }

    /// Evaluates a stage; returns the size of its residual, which is left in the workspace, in units of
    /// round-off.
    fn evaluate(&mut self, workspace: &mut Workspace, at: At<'_>, i: usize) -> f64 {
        let At { model, state, u, .. } = at;
        let d = model.dimensions;
        let Self { tableau, stages, base, input, .. } = &mut *self;
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
            input[..d.inputs].copy_from_slice(&stages[i].inputs);
            workspace.prepare(At { model, settings: &settings, state: base, u: input });
        }
        workspace.increment.copy_from_slice(&stages[i].increment);
        workspace.evaluate(model, &settings, base)
    }

    /// Takes the impulse of the last evaluation.
    fn take_impulse(&mut self, workspace: &Workspace, settings: &Settings, i: usize) {
        let length = settings.time_step_s * self.tableau.weights[i];
        for (k, impulse) in self.stages[i].impulse.iter_mut().enumerate() {
            *impulse = length * (workspace.l_q[k] + workspace.force[k]);
        }
    }

    /// Corrects stage after stage until all are solved; `None` if that takes too long.
    fn sweep(
        &mut self,
        workspace: &mut Workspace,
        at: At<'_>,
    ) -> Result<Option<StepReport>, StepError> {
        let At { model, settings, .. } = at;
        let enough = settings.precision.residual();
        let mut report = StepReport::default();
        let mut previous = f64::INFINITY;
        let mut slow = 0;
        while report.iterations < settings.max_iterations {
            report.iterations += 1;
            let mut size: f64 = 0.0;
            for i in 0..self.stages.len() {
                let residual = self.evaluate(workspace, at, i);
                self.take_impulse(workspace, settings, i);
                if !residual.is_finite() {
                    return Ok(None);
                }
                size = size.max(residual);
                if report.iterations == 1 {
                    let settings = stage_settings(settings, self.tableau.weights[i]);
                    workspace.factor_generators(model, &settings)?;
                    std::mem::swap(&mut workspace.factors, &mut self.stages[i].factors);
                    report.factorizations += 1;
                }
                let stage = &mut self.stages[i];
                stage.factors.solve(model, &mut workspace.residual);
                for (y, correction) in stage.increment.iter_mut().zip(&workspace.residual) {
                    *y -= correction;
                }
            }
            report.residual = size;
            let stagnates = size > SLOW * previous;
            if report.iterations > 1 && (size <= enough || (stagnates && size <= CHORD_FLOOR)) {
                if size > STALE {
                    for i in 0..self.stages.len() {
                        self.evaluate(workspace, at, i);
                        self.take_impulse(workspace, settings, i);
                    }
                }
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

    /// Chord Newton on all stages at once; the Jacobian is renewed where that saves corrections.
    fn correct_all(
        &mut self,
        workspace: &mut Workspace,
        at: At<'_>,
    ) -> Result<StepReport, StepError> {
        let mut system = self.take_system(at.model);
        let result = self.correct_with(&mut system, workspace, at);
        self.system = Some(system);
        result
    }

    fn correct_with(
        &mut self,
        system: &mut System,
        workspace: &mut Workspace,
        at: At<'_>,
    ) -> Result<StepReport, StepError> {
        let At { model, settings, .. } = at;
        let enough = settings.precision.residual();
        let mut report = StepReport::default();
        let mut previous = f64::INFINITY;
        let nd = model.dimensions.dynamic;
        // Whether the next correction renews the Jacobian, and whether the last one did.
        let (mut fresh, mut was_fresh) = (true, false);
        for iteration in 1..=settings.max_iterations.min(ROUNDS) {
            report.iterations = iteration;
            let mut round_off = f64::MIN_POSITIVE;
            for i in 0..self.stages.len() {
                self.evaluate(workspace, at, i);
                self.take_impulse(workspace, settings, i);
                round_off = round_off.max(workspace.round_off);
                self.stages[i].momentum.copy_from_slice(&workspace.l_v);
                if fresh {
                    system.hessians[i].take(model, workspace);
                }
            }
            let largest = self.find_residuals(at, &mut system.residual);
            let size = largest / (f64::EPSILON * round_off);
            if !size.is_finite() {
                return Err(StepError::NotFinite { iterations: iteration });
            }
            let stagnates = size > SLOW * previous;
            let floor = if was_fresh { FLOOR } else { CHORD_FLOOR };
            let converged = size <= enough || (stagnates && size <= floor);
            if fresh && !(converged && iteration > 1) {
                self.fill_system(model, settings, system);
                report.factorizations += 1;
                if !system.matrix.factor() {
                    return Err(StepError::NotConverged { iterations: iteration, residual: size });
                }
            }
            system.matrix.solve(&mut system.residual);
            let corrections = system.residual.chunks_exact(nd.max(1));
            for (stage, correction) in self.stages.iter_mut().zip(corrections) {
                stage.increment.iter_mut().zip(correction).for_each(|(y, c)| *y -= c);
            }
            report.residual = size;
            if converged {
                self.correct_impulses(settings, system);
                return Ok(report);
            }
            was_fresh = fresh;
            fresh = size > SLOW * previous;
            previous = size;
        }
        Err(StepError::NotConverged { iterations: report.iterations, residual: previous })
    }

    /// Takes the last correction, which `residual` holds, into the impulses, which were evaluated before it.
    fn correct_impulses(&mut self, settings: &Settings, system: &mut System) {
        let Self { stages, tableau, .. } = self;
        let System { hessians, residual, products, .. } = system;
        let (count, nd) = (stages.len(), stages.first().map_or(0, |stage| stage.impulse.len()));
        if nd == 0 {
            return;
        }
        let n = hessians[0].qq.len() / nd;
        for (i, (stage, hessian)) in stages.iter_mut().zip(hessians).enumerate() {
            let (length, own) = (settings.time_step_s * tableau.weights[i], &residual[i * nd..]);
            let moved = &mut products[..nd];
            moved.fill(0.0);
            for (weight, correction) in
                tableau.coupling[i * count..].iter().zip(residual.chunks_exact(nd))
            {
                moved.iter_mut().zip(correction).for_each(|(moved, c)| *moved += weight * c);
            }
            for (k, impulse) in stage.impulse.iter_mut().enumerate() {
                let by_position = hessian.qq[k * n..].iter().zip(&*moved);
                let by_velocity = hessian.qv[k * n..][..nd].iter().zip(own);
                *impulse -= length * by_position.map(|(l, q)| l * q).sum::<f64>()
                    + by_velocity.map(|(l, y)| l * y).sum::<f64>();
            }
        }
    }

    /// Writes the residuals of all stages from their impulses and momenta; returns the largest entry.
    fn find_residuals(&self, at: At<'_>, residual: &mut [f64]) -> f64 {
        let state = at.state;
        let (count, nd) = (self.stages.len(), state.p.len());
        let mut largest = 0.0;
        for (i, (residual, stage)) in
            residual.chunks_exact_mut(nd.max(1)).zip(&self.stages).enumerate()
        {
            let coupling = &self.tableau.coupling[i * count..][..count];
            for (k, residual) in residual.iter_mut().enumerate() {
                let impulses = self.stages.iter().zip(coupling).map(|(s, m)| m * s.impulse[k]);
                *residual =
                    ((state.p[k] - stage.momentum[k]) + impulses.sum::<f64>()) + state.p_low[k];
                largest = larger(largest, residual.abs());
            }
        }
        largest
    }

    /// Checks the solution and sums it up in the workspace.
    fn finish(
        &mut self,
        workspace: &mut Workspace,
        at: At<'_>,
        mut report: StepReport,
    ) -> Result<StepReport, StepError> {
        for stage in &self.stages {
            at.model.check_turns(&stage.increment)?;
        }
        self.sum_up(workspace, at);
        workspace.estimates.write(&mut report);
        Ok(report)
    }

    /// Puts the solution into the workspace.
    fn sum_up(&mut self, workspace: &mut Workspace, at: At<'_>) {
        let At { model, settings, .. } = at;
        workspace.prepare(at);
        workspace.increment.fill(0.0);
        workspace.impulse.fill(0.0);
        let (count, stages) = (model.dimensions.dynamic, self.stages.len());
        for (i, stage) in self.stages.iter().enumerate() {
            let rate = 1.0 / (settings.time_step_s * self.tableau.weights[i]);
            for k in 0..count {
                workspace.increment[k] += stage.increment[k];
                workspace.impulse[k] += stage.impulse[k];
                self.motion[i * count + k] = rate * stage.increment[k];
                self.motion[(stages + i) * count + k] = rate * stage.impulse[k];
            }
        }
    }

    /// Room for all stages at once, made when it is first needed.
    fn take_system(&mut self, model: &Model) -> Box<System> {
        let (count, nd) = (self.stages.len(), model.dimensions.dynamic);
        self.system.take().unwrap_or_else(|| {
            Box::new(System {
                hessians: (0..count).map(|_| Hessian::new(model)).collect(),
                matrix: DenseLu::new(count * nd),
                residual: vec![0.0; count * nd],
                products: vec![0.0; count * nd * count * nd],
                rates: vec![0.0; nd * count * nd],
            })
        })
    }

    /// Derivatives of the residuals `R_i = p + Σ μ_ij P_j − L_v,i` by all `Y`, at the last evaluation:
    ///
    /// ```text
    /// ∂R_i/∂Y_k = Σ_j μ_ij h_j (L_qq + f_q)_j μ_jk + μ_ik (L_qv + f_v)_k − μ_ik (L_vq)_i − δ_ik (L_vv)_i / h_i
    /// ```
    fn fill_system(&self, model: &Model, settings: &Settings, system: &mut System) {
        let (count, nd) = (self.stages.len(), model.dimensions.dynamic);
        let n = model.dimensions.coordinates();
        let order = count * nd;
        let coupling = |i: usize, j: usize| self.tableau.coupling[i * count + j];
        let length = |i: usize| settings.time_step_s * self.tableau.weights[i];
        let System { hessians, matrix, products, rates, .. } = system;
        if nd == 0 {
            return;
        }
        for (j, stage) in hessians.iter().enumerate() {
            for a in 0..nd {
                let product = &mut products[(j * nd + a) * order..][..order];
                let entries = &stage.qq[a * n..][..nd];
                for (k, target) in product.chunks_exact_mut(nd).enumerate() {
                    let weight = length(j) * coupling(j, k);
                    target.iter_mut().zip(entries).for_each(|(t, l)| *t = weight * l);
                }
                rates[a * order + j * nd..][..nd].copy_from_slice(&stage.qv[a * n..][..nd]);
            }
        }
        for i in 0..count {
            for a in 0..nd {
                let row = &mut matrix.matrix[(i * nd + a) * order..][..order];
                let by_position = &hessians[i].vq[a * n..][..nd];
                let rates = rates[a * order..][..order].chunks_exact(nd);
                for (k, (target, rates)) in row.chunks_exact_mut(nd).zip(rates).enumerate() {
                    let (weight, changes) = (coupling(i, k), rates.iter().zip(by_position));
                    target.iter_mut().zip(changes).for_each(|(t, (p, l))| *t = weight * (p - l));
                }
                for j in 0..count {
                    let (weight, product) = (coupling(i, j), &products[(j * nd + a) * order..]);
                    row.iter_mut().zip(product).for_each(|(t, l)| *t += weight * l);
                }
                let inverse = 1.0 / length(i);
                let own = row[i * nd..][..nd].iter_mut().zip(&hessians[i].vv[a * n..]);
                own.for_each(|(t, l)| *t -= inverse * l);
            }
        }
    }
}

/// The settings of the midpoint rule of a stage.
fn stage_settings(settings: &Settings, weight: f64) -> Settings {
    Settings { time_step_s: weight * settings.time_step_s, ..*settings }
}
