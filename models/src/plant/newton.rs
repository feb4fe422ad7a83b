//! The solver of a step: chord Newton on the increment, from an extrapolated guess, to round-off.
//!
//! With `A0 = Dh(q[k])` and `A1 = Dh(q[k+1])` a correction solves
//!
//! ```text
//! [ K   −A0ᵀ ] [dx]     [r1]       S = A1 K⁻¹ A0ᵀ,   S dλ = A1 K⁻¹ r1 − r2
//! [ A1    0  ] [dλ] = − [r2],      dx = K⁻¹ (A0ᵀ dλ − r1)
//! ```
//!
//! `K` and `S` are factored at the guess and kept while the residual falls fast. The residual is
//! measured in units of its own round-off; the solver stops where arithmetic does. Loops in planes are
//! factored with `K` in place of `S` ([`crate::plant::planar::LoopElimination`]).

mod matrix;

use std::f64::consts::TAU;

use crate::Model;
use crate::model::Solver;
use crate::plant::blocks::StepBlocks;
use crate::plant::closure::{Closure, larger, largest};
use crate::plant::forces::Instant;
use crate::plant::mechanics::Mechanics;
use crate::plant::pivoted_lu::PivotedLu;
use crate::plant::planar::Of;
use crate::plant::rows::{Term, padded, spread};
use crate::plant::{PreciseState, Precision, Settings, StepError, StepReport, forces, potentials};
use crate::scalar::{Side, side_by_side};
use crate::spatial::{Mat3, Vec3};
use crate::tree::JointKind;
use crate::wide::wide;

#[cfg(test)]
pub(crate) use matrix::Generators;
pub(crate) use matrix::{Factors, fill_schur};

/// A residual this small, in units of round-off, is as good as zero.
const CONVERGED: f64 = 4.0;
/// A residual this small will do where precision is not asked for.
const NEARLY: f64 = 1e5;
/// A residual that no longer falls, with a fresh Jacobian, is at its floor if it is below this.
pub(crate) const FLOOR: f64 = 1e4;
/// The same for a Jacobian that was kept.
pub(crate) const CHORD_FLOOR: f64 = 1e2;
/// Corrections of larger residuals must be seen by the impulse, or energy drifts by a part of them.
pub(crate) const STALE: f64 = 2.0;

/// What a step is taken of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct At<'a> {
    pub(crate) model: &'a Model,
    /// Of this step: its time step may be a part of the control period, or negative.
    pub(crate) settings: &'a Settings,
    pub(crate) state: &'a PreciseState,
    /// Inputs with the signals, next prescribed positions.
    pub(crate) u: &'a [f64],
}

/// All memory that a step and its linearization need.
#[derive(Clone, Debug)]
pub(crate) struct Workspace {
    pub(crate) increment: Vec<f64>,
    pub(crate) multipliers: Vec<f64>,
    /// Change of the momentum over the step.
    pub(crate) impulse: Vec<f64>,
    /// Configuration at the midpoint.
    pub(crate) q_mid: Vec<f64>,
    /// The same with angles of hinges less their whole turns, in which they keep all digits.
    pub(crate) angles: Vec<f64>,
    /// `1/2π` for the coordinates of hinges, else zero.
    pub(crate) turns_per_radian: Vec<f64>,
    /// Configuration at the end.
    pub(crate) q_end: Vec<f64>,
    /// Orientations of ball joints at the start, the midpoint and the end.
    pub(crate) orientations_start: Vec<Mat3>,
    pub(crate) orientations_mid: Vec<Mat3>,
    pub(crate) orientations_end: Vec<Mat3>,
    /// How ball joints turn over the step, in their own axes.
    pub(crate) turns: Vec<Vec3>,
    /// Derivatives with ball joints; none without.
    pub(crate) turned: Option<Box<StepBlocks>>,
    /// Velocity over the step.
    pub(crate) velocity: Vec<f64>,
    pub(crate) l_q: Vec<f64>,
    pub(crate) l_v: Vec<f64>,
    /// The inputs, where forces or ball joints need them; else empty.
    pub(crate) inputs: Vec<f64>,
    pub(crate) input_force: Vec<f64>,
    /// Inputs, damping and forces at the midpoint.
    pub(crate) force: Vec<f64>,
    pub(crate) residual: Vec<f64>,
    /// Magnitudes of what the residuals are the sums of, and the largest.
    magnitudes: Vec<f64>,
    pub(crate) round_off: f64,
    pub(crate) constraint_residual: Vec<f64>,
    /// At the midpoint.
    pub(crate) mechanics: Mechanics,
    pub(crate) factors: Factors,
    /// What springs and dampers of coordinates add to its diagonal.
    diagonal: Vec<f64>,
    /// The same for the linearization: of the residual by the start, of the momentum by the increment.
    pub(crate) diagonals: [Vec<f64>; 2],
    /// Constraints at `q[k]`.
    pub(crate) start: Closure,
    /// `start` holds the constraints at the state's configuration.
    pub(crate) start_is_valid: bool,
    /// Constraints at `q[k+1]`.
    pub(crate) end: Closure,
    /// `end` holds the constraints, Jacobian included, at the solution.
    pub(crate) end_is_exact: bool,
    /// `K⁻¹ A0ᵀ`, row-major, nd by padded nc.
    pub(crate) responses: Vec<f64>,
    pub(crate) schur: PivotedLu,
    /// The last factorization was one of loops, not of `K` and `S`.
    pub(crate) in_loops: bool,
    /// `Σ λ D²h`, for the linearization.
    pub(crate) constraint_hessian: Vec<f64>,
    /// `½h L_qq + L_qv`, for the linearization, row-major.
    pub(crate) end_slopes: Vec<f64>,
    /// `h L_qq`, for the linearization, row-major.
    pub(crate) stiffness: Vec<f64>,
    pub(crate) terms: Vec<Term>,
    pub(crate) estimates: Estimates,
}

impl Precision {
    /// The residual, in units of round-off, after which one more correction is the last.
    pub(crate) fn residual(self) -> f64 {
        match self {
            Self::Exact => CONVERGED,
            Self::Fast => NEARLY,
        }
    }
}

/// Reciprocal condition estimates of the last factorization.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimates {
    matrix: f64,
    constraints: f64,
    redundant: u32,
}

impl Estimates {
    const NONE: Self = Self { matrix: 1.0, constraints: 1.0, redundant: 0 };

    pub(crate) fn write(&self, report: &mut StepReport) {
        report.reciprocal_condition = self.matrix;
        report.constraint_reciprocal_condition = self.constraints;
        report.redundant_constraints = self.redundant;
    }
}

impl Workspace {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, n, nc) = (d.dynamic, d.coordinates(), d.constraints);
        let no = model.orientations.len();
        let zeros = |len: usize| vec![0.0; len];
        let mut turns_per_radian = zeros(nd);
        for joint in model.dynamics.joints.iter().filter(|j| j.kind == JointKind::Revolute) {
            if let Some(turns) = turns_per_radian.get_mut(joint.coordinate) {
                *turns = 1.0 / TAU;
            }
        }
        Self {
            increment: zeros(nd),
            multipliers: zeros(nc),
            impulse: zeros(nd),
            q_mid: zeros(n),
            angles: zeros(n),
            turns_per_radian,
            q_end: zeros(n),
            orientations_start: vec![Mat3::IDENTITY; no],
            orientations_mid: vec![Mat3::IDENTITY; no],
            orientations_end: vec![Mat3::IDENTITY; no],
            turns: vec![Vec3::ZERO; no],
            turned: (no > 0).then(|| Box::new(StepBlocks::new(model))),
            velocity: zeros(n),
            l_q: zeros(nd),
            l_v: zeros(nd),
            inputs: zeros(if model.forces.is_some() || no > 0 { d.inputs } else { 0 }),
            input_force: zeros(nd),
            force: zeros(nd),
            residual: zeros(nd),
            magnitudes: zeros(nd),
            round_off: 0.0,
            constraint_residual: zeros(nc),
            mechanics: Mechanics::new(model),
            factors: Factors::new(model),
            diagonal: zeros(nd),
            diagonals: [zeros(nd), zeros(nd)],
            start: Closure::new(model),
            start_is_valid: false,
            end: Closure::new(model),
            end_is_exact: false,
            responses: zeros(nd * padded(nc)),
            schur: PivotedLu::of_constraints(model, spread(padded(2 * n))),
            in_loops: false,
            constraint_hessian: zeros(if nc > 0 { n * n } else { 0 }),
            end_slopes: zeros(nd * nd),
            stiffness: zeros(nd * nd),
            terms: Vec::with_capacity(nd.max(nc)),
            estimates: Estimates::NONE,
        }
    }

    /// Solves one step; the solution stays in the workspace.
    pub(crate) fn solve(&mut self, at: At<'_>) -> Result<StepReport, StepError> {
        let At { model, settings, state, .. } = at;
        self.prepare(at);
        if state.past.predict(settings.time_step_s, &mut self.increment) {
            // The equations are linear in the multipliers: any guess is as good.
            self.multipliers.copy_from_slice(&state.multipliers);
            let report = self.iterate(model, settings, state, false);
            if report.is_ok() {
                return report;
            }
        }
        self.ballistic(model, settings, state);
        self.iterate(model, settings, state, true)
            .map_err(|error| model.explain(error, state, &self.q_end))
    }

    /// What does not change within a step: prescribed motion, input forces, constraints at the start.
    pub(crate) fn prepare(&mut self, at: At<'_>) {
        let At { model, settings, state, u } = at;
        let d = model.dimensions;
        let (inputs, next) = u.split_at(d.inputs);
        for (k, next) in next.iter().enumerate() {
            let i = d.dynamic + k;
            self.q_mid[i] = 0.5 * (state.q[i] + next);
            self.angles[i] = self.q_mid[i];
            self.velocity[i] = (next - state.q[i]) / settings.time_step_s;
            self.q_end[i] = *next;
        }
        if !model.orientations.is_empty() {
            self.prepare_orientations(model, settings, state);
        }
        if d.inputs > 0 {
            self.set_inputs(model, inputs);
        }
        if d.constraints > 0 {
            self.place_start(model, state);
            // Until the end has a Jacobian of this step: nothing of the last may decide on this one.
            self.end.expect_round_off_of(&self.start);
        }
    }

    /// Inputs, and their forces on coordinates.
    pub(crate) fn set_inputs(&mut self, model: &Model, inputs: &[f64]) {
        forces::input_forces(&model.coordinate_inputs, inputs, &mut self.input_force);
        self.force.copy_from_slice(&self.input_force);
        if !self.inputs.is_empty() {
            self.inputs.copy_from_slice(inputs);
        }
    }

    /// Constraints at the start of the step, kept from the end of the last one where possible; of loops
    /// without a Jacobian.
    fn place_start(&mut self, model: &Model, state: &PreciseState) {
        if model.loops.is_none() {
            self.prepare_start(model, state);
        } else if !self.start_is_valid {
            self.start.evaluate(model, &state.q, &self.orientations_start);
            self.start.place_in_plane(model, &state.q);
        }
    }

    /// The same with a Jacobian.
    pub(crate) fn prepare_start(&mut self, model: &Model, state: &PreciseState) {
        if model.dimensions.constraints > 0 && !self.start_is_valid {
            for (matrix, q) in self.orientations_start.iter_mut().zip(&state.orientations) {
                *matrix = q.matrix();
            }
            self.start.evaluate(model, &state.q, &self.orientations_start);
            self.start.differentiate(model, &state.q);
            self.start.place_in_plane(model, &state.q);
            self.start_is_valid = true;
        }
    }

    /// The end of this step is the start of the next.
    pub(crate) fn move_on(&mut self) {
        // With ball joints the Jacobian at the end is one by the increment.
        self.end_is_exact &= self.turns.is_empty();
        if self.end_is_exact {
            std::mem::swap(&mut self.start, &mut self.end);
        }
        self.start_is_valid = self.end_is_exact;
        self.end_is_exact = false;
    }

    /// Guess: the velocity that belongs to the momentum goes on.
    pub(crate) fn ballistic(&mut self, model: &Model, settings: &Settings, state: &PreciseState) {
        if self.coast(model, settings, state) {
            return;
        }
        let is_singular = self.find_velocity(model, state) < settings.singular_below;
        for (x, v) in self.increment.iter_mut().zip(&self.residual) {
            // A singular mass matrix has no velocity; the Newton matrix will name the coordinate.
            *x = if v.is_finite() && !is_singular { settings.time_step_s * v } else { 0.0 };
        }
        self.multipliers.copy_from_slice(&state.multipliers);
        // The velocity was found with the prescribed velocities of the last step, not of this one.
        for i in model.dimensions.dynamic..self.velocity.len() {
            self.velocity[i] = (self.q_end[i] - state.q[i]) / settings.time_step_s;
        }
        if !model.orientations.is_empty() {
            self.prepare_orientations(model, settings, state);
        }
    }

    /// The same by generators, where there are some and loops allow it.
    fn coast(&mut self, model: &Model, settings: &Settings, state: &PreciseState) -> bool {
        if self.factors.generators.is_none() {
            return false;
        }
        self.velocity.fill(0.0);
        let (orientations, derivatives) =
            (&self.orientations_mid, [&mut *self.l_q, &mut *self.l_v]);
        self.mechanics.gradient(model, &state.q, orientations, &self.velocity, derivatives);
        self.diagonal.fill(0.0);
        if model.loops.is_none() {
            let (mechanics, h) = (&mut self.mechanics, settings.time_step_s);
            self.factors.generate(model, mechanics, &self.diagonal, h, Of::Masses);
        } else if !self.factor_loops_of(model, settings, Of::Masses) {
            return false;
        }
        for (x, p) in self.increment.iter_mut().zip(&state.p) {
            *x = -p;
        }
        if model.loops.is_none() {
            self.factors.solve(model, &mut self.increment);
        } else {
            self.constraint_residual.fill(0.0);
            self.factors.solve_loops(model, &mut self.increment, &mut self.constraint_residual);
            self.multipliers.copy_from_slice(&state.multipliers);
        }
        // A singular mass matrix has no velocity; the Newton matrix will name the coordinate.
        for x in self.increment.iter_mut().filter(|x| !x.is_finite()) {
            *x = 0.0;
        }
        true
    }

    /// Corrects the guess until the residual is at round-off.
    fn iterate(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
        always_factor: bool,
    ) -> Result<StepReport, StepError> {
        let mut report = StepReport::default();
        // What a factorization costs, in corrections.
        let patience = match model.solver {
            Solver::Tree => 3,
            Solver::Planar | Solver::Spatial | Solver::Loops => 2,
        };
        let enough = settings.precision.residual();
        let mut previous = f64::INFINITY;
        let (mut fresh, mut idle) = (false, false);
        while report.iterations < settings.max_iterations {
            report.iterations += 1;
            report.residual = self.evaluate(model, settings, state);
            report.constraint_residual = self.evaluate_end(model, state);
            let size = larger(report.residual, report.constraint_residual);
            if !size.is_finite() {
                return Err(StepError::NotFinite { iterations: report.iterations });
            }
            if report.iterations == 1 && size <= CONVERGED {
                // Nothing to correct, but what is singular shall not pass for solved.
                self.factor(model, settings, state)?;
                report.factorizations += 1;
                return self.accept(model, settings, report);
            }
            let floor = if fresh { FLOOR } else { CHORD_FLOOR };
            let stagnates = size > 0.5 * previous;
            // Where forces balance, a unit of round-off of a coordinate outweighs the residual's own.
            let is_idle = idle && report.constraint_residual <= FLOOR;
            let at_floor = stagnates && (size <= floor || is_idle);
            let converged = size <= enough || at_floor;
            // A new Jacobian squares the rate: it pays where the old one needs many corrections more.
            let rate = size / previous;
            let later = (0..patience).fold(size, |size, _| size * rate);
            // The first correction is one with this step's Jacobian, also where it is the last: factors of
            // another step would be memory beside the state.
            fresh = previous.is_infinite() || (!converged && (always_factor || later > enough));
            if fresh {
                self.factor(model, settings, state)?;
                report.factorizations += 1;
            }
            self.correct(model);
            if converged {
                if size > STALE {
                    self.evaluate(model, settings, state);
                }
                return self.accept(model, settings, report);
            }
            idle = self.is_round_off_of_coordinates();
            previous = size;
        }
        Err(StepError::NotConverged { iterations: report.iterations, residual: previous })
    }

    /// Residual `r1` at the current increment; returns its size in units of round-off.
    pub(crate) fn evaluate(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> f64 {
        let h = settings.time_step_s;
        self.go_to_middle(state, 1.0 / h);
        if !model.orientations.is_empty() {
            self.turn_to_midpoint(model);
        }
        self.evaluate_lagrangian(model);
        self.sum_up(state, 0.5 * h, settings.force_split.at_start() * h);
        self.round_off = largest(&self.magnitudes).max(f64::MIN_POSITIVE);
        if !model.orientations.is_empty() {
            self.turn_residual(model, settings, state);
        }
        if model.dimensions.constraints > 0 {
            self.start.subtract_pushes(model, &self.multipliers, &mut self.residual);
        }
        largest(&self.residual) / (f64::EPSILON * self.round_off)
    }

    wide! {
        /// Configuration and velocity at the midpoint.
        fn go_to_middle(mut self, state: &PreciseState, inverse: f64)
            = go_to_middle_portable, go_to_middle_avx2;

        /// The residual, and what it is the sum of.
        fn sum_up(mut self, state: &PreciseState, half: f64, weight: f64)
            = sum_up_portable, sum_up_avx2;
    }

    #[inline(always)]
    fn go_to_middle_portable(&mut self, state: &PreciseState, inverse: f64) {
        let nd = self.increment.len();
        side_by_side!(for (
            x in &self.increment[..nd],
            q in &state.q[..nd],
            q_low in &state.q_low[..nd],
            per_radian in &self.turns_per_radian[..nd],
        ) let more = x * 0.5 + q_low; {
            middle(&mut self.q_mid[..nd]) = q + more;
            velocity(&mut self.velocity[..nd]) = x * inverse;
            angle(&mut self.angles[..nd]) = Side::unwound(q, more, per_radian);
        });
    }

    #[inline(always)]
    fn sum_up_portable(&mut self, state: &PreciseState, half: f64, weight: f64) {
        let nd = self.increment.len();
        side_by_side!(for (
            p in &state.p[..nd],
            p_low in &state.p_low[..nd],
            l_q in &self.l_q[..nd],
            l_v in &self.l_v[..nd],
            force in &self.force[..nd],
            angle in &self.angles[..nd],
        ) let (half_q, force) = (l_q * half, force * weight); {
            residual(&mut self.residual[..nd]) = ((p - l_v) + (half_q + force)) + p_low;
            magnitude(&mut self.magnitudes[..nd]) =
                p.abs() + l_v.abs() + half_q.abs() * (angle.abs() + 1.0) + force.abs();
        });
    }

    /// Gradient of the Lagrangian and forces at the midpoint.
    pub(crate) fn evaluate_lagrangian(&mut self, model: &Model) {
        let (orientations, derivatives) =
            (&self.orientations_mid, [&mut *self.l_q, &mut *self.l_v]);
        self.mechanics.gradient(model, &self.angles, orientations, &self.velocity, derivatives);
        if model.potentials.any {
            potentials::add_gradient(
                &model.potentials,
                &model.dynamics,
                &self.mechanics.poses,
                &self.q_mid,
                &mut self.l_q,
            );
        }
        if !model.damping.is_empty() {
            forces::add_damping(&model.damping, &self.velocity, &self.input_force, &mut self.force);
        }
        if let Some(forces) = &model.forces {
            if model.damping.is_empty() {
                self.force.copy_from_slice(&self.input_force);
            }
            let mut force = std::mem::take(&mut self.force);
            forces.add(&self.instant(model), &mut force);
            self.force = force;
        }
    }

    /// What forces depend on, at the last evaluation.
    pub(crate) fn instant<'a>(&'a self, model: &'a Model) -> Instant<'a> {
        Instant {
            tree: &model.dynamics,
            poses: &self.mechanics.poses,
            momenta: &self.mechanics.momenta,
            velocity: &self.velocity,
            inputs: &self.inputs,
        }
    }

    /// Constraint values `r2` at the current increment; returns their size in units of round-off.
    fn evaluate_end(&mut self, model: &Model, state: &PreciseState) -> f64 {
        if model.dimensions.constraints == 0 {
            return 0.0;
        }
        self.place_end(model, state);
        self.end_is_exact = false;
        self.end.evaluate(model, &self.q_end, &self.orientations_end);
        self.end.violation()
    }

    fn place_end(&mut self, model: &Model, state: &PreciseState) {
        for (i, x) in self.increment.iter().enumerate() {
            self.q_end[i] = state.q[i] + (state.q_low[i] + x);
        }
        if !model.orientations.is_empty() {
            self.turn_to_end(model);
        }
    }

    /// One correction with the factors at hand.
    fn correct(&mut self, model: &Model) {
        if self.in_loops {
            self.constraint_residual.copy_from_slice(&self.end.value);
            self.factors.solve_loops(model, &mut self.residual, &mut self.constraint_residual);
            for (lambda, change) in self.multipliers.iter_mut().zip(&self.constraint_residual) {
                *lambda -= change;
            }
            for (x, r) in self.increment.iter_mut().zip(&self.residual) {
                *x -= r;
            }
            return;
        }
        self.factors.solve(model, &mut self.residual);
        if model.dimensions.constraints > 0 {
            let n = model.dimensions.coordinates();
            let stride = padded(model.dimensions.constraints);
            for (c, constraint) in model.constraints.iter().enumerate() {
                let row = &self.end.jacobian[c * n..][..n];
                let mut value = -self.end.value[c];
                for &i in constraint.dynamic_coordinates() {
                    value += row[i] * self.residual[i];
                }
                self.constraint_residual[c] = value;
            }
            self.schur.solve(&mut self.constraint_residual);
            for (lambda, change) in self.multipliers.iter_mut().zip(&self.constraint_residual) {
                *lambda += change;
            }
            for (i, r) in self.residual.iter_mut().enumerate() {
                for (response, change) in
                    self.responses[i * stride..].iter().zip(&self.constraint_residual)
                {
                    *r -= response * change;
                }
            }
        }
        for (x, r) in self.increment.iter_mut().zip(&self.residual) {
            *x -= r;
        }
    }

    /// Whether the last correction is no more than the round-off of the coordinates.
    fn is_round_off_of_coordinates(&self) -> bool {
        // The midpoint may be next to zero where start and end are not.
        let size = |i: usize| self.angles[i].abs() + self.increment[i].abs();
        let mut corrections = self.residual.iter().enumerate();
        corrections.all(|(i, x)| x.abs() <= 2.0 * f64::EPSILON * size(i))
    }

    /// Checks the solution, and finds its impulse.
    fn accept(
        &mut self,
        model: &Model,
        settings: &Settings,
        mut report: StepReport,
    ) -> Result<StepReport, StepError> {
        model.check_turns(&self.increment)?;
        let pairs = self.l_q.iter().zip(&self.force);
        for (impulse, (l_q, force)) in self.impulse.iter_mut().zip(pairs) {
            *impulse = settings.time_step_s * (l_q + force);
        }
        if !model.orientations.is_empty() {
            self.turn_impulse(model, settings);
        }
        if model.dimensions.constraints > 0 {
            if !self.in_loops {
                // The extrapolated guess has the least norm of other configurations.
                self.schur.remove_null(&mut self.multipliers);
            }
            self.start.subtract_pushes(model, &self.multipliers, &mut self.impulse);
        }
        self.estimates.write(&mut report);
        Ok(report)
    }

    /// Constraints with Jacobian at the solution, for the linearization and the next step.
    pub(crate) fn finish_end(&mut self, model: &Model, state: &PreciseState) {
        if model.dimensions.constraints > 0 && !self.end_is_exact {
            self.place_end(model, state);
            self.end.evaluate(model, &self.q_end, &self.orientations_end);
            self.end.differentiate(model, &self.q_end);
            self.end.place_in_plane(model, &self.q_end);
            if !model.orientations.is_empty() {
                self.turn_end_jacobian(model);
            }
            self.end_is_exact = true;
        }
    }
}

impl Model {
    /// Refuses increments of more than half a turn.
    pub(crate) fn check_turns(&self, increments: &[f64]) -> Result<(), StepError> {
        if largest(increments) <= std::f64::consts::PI {
            return Ok(());
        }
        for (coordinate, x) in self.coordinates.iter().zip(increments) {
            if coordinate.is_angle && x.abs() > std::f64::consts::PI {
                let coordinate = coordinate.name.clone();
                return Err(StepError::TooFast { coordinate, increment: *x });
            }
        }
        Ok(())
    }
}
