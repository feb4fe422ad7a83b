//! The solver of a step: chord Newton on the increment, from an extrapolated guess, to round-off.
//!
//! Corrections solve the KKT system of [`crate::kkt::system`] with `A0 = Dh(q[k])` and `A1 = Dh(q[k+1])`.
//! `K` and `S` are factored at the guess and kept while the residual falls fast. The residual is
//! measured in units of its own round-off; the solver stops where arithmetic does, or where it is foreseen
//! to ([`foresight`](super::foresight)).

use plantd_math::norms::{larger, largest};
use plantd_math::scalar::Compared;

use crate::constraints::closure::Known;
use crate::integrator::foresight::{Strayed, is_negligible};
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::settings::{Precision, Settings};
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{Residual, StepContext, Workspace};
use crate::model::mechanism::Model;

/// A residual this small, in units of round-off, is as good as zero.
pub(crate) const CONVERGED: f64 = 4.0;
/// A residual this small will do where precision is not asked for.
const NEARLY: f64 = 1e5;
const ROUGHLY: f64 = 1e9;
/// A residual that no longer falls, with a fresh Jacobian, is at its floor if it is below this.
pub(crate) const FLOOR: f64 = 1e4;
/// [`FLOOR`] for a Jacobian that was kept, unless its last correction left no more than this part of a residual: then a
/// new one would do no better. Long chains have a floor of 1e3 and more, for their momenta are small sums of large terms.
pub(crate) const CHORD_FLOOR: f64 = 1e2;
const GOOD: f64 = 1e-4;
/// Corrections of larger residuals must be seen by the impulse, or energy drifts by a part of them.
pub(crate) const STALE: f64 = 2.0;

impl Precision {
    /// The residual, in units of round-off, after which one more correction is the last.
    pub(crate) fn residual(self) -> f64 {
        match self {
            Self::Exact => CONVERGED,
            Self::Fast => NEARLY,
            Self::Coarse => ROUGHLY,
        }
    }
}

/// How far an iteration with kept factors has come.
pub(crate) struct Chord<S: Compared = f64> {
    /// A residual after which one more correction is the last.
    enough: f64,
    /// What a factorization costs, in corrections.
    patience: u32,
    always_factor: bool,
    previous: S,
    /// The residual before that.
    before: S,
    /// The Jacobian is that of this residual.
    pub(crate) is_fresh: S::Truth,
    /// The last correction was no more than round-off of the coordinates.
    pub(crate) is_idle: S::Truth,
}

impl<S: Compared> Chord<S> {
    pub(crate) fn new(settings: &Settings, patience: u32, always_factor: bool) -> Self {
        let enough = settings.precision.residual();
        let [previous, before] = [S::constant(f64::INFINITY); 2];
        let [is_fresh, is_idle] = [S::all(false); 2];
        Self { enough, patience, always_factor, previous, before, is_fresh, is_idle }
    }

    /// Whether the correction of a residual is the last; `is_fresh` says whether it takes a new Jacobian.
    #[inline(always)]
    pub(crate) fn judge(&mut self, size: S, constraint_residual: S) -> S::Truth {
        let [fresh, kept] = [FLOOR, CHORD_FLOOR].map(S::constant);
        let is_good = self.is_fresh | self.previous.at_most(self.before * GOOD);
        let floor = S::choose(is_good, fresh, kept);
        let stagnates = (self.previous * 0.5).less(size);
        // Where forces balance, a unit of round-off of a coordinate outweighs the residual's own.
        let is_idle = self.is_idle & constraint_residual.at_most(fresh);
        let at_floor = stagnates & (size.at_most(floor) | is_idle);
        let enough = S::constant(self.enough);
        let converged = size.at_most(enough) | at_floor;
        // A new Jacobian squares the rate: it pays where the old one needs many corrections more.
        let rate = size / self.previous;
        let later = (0..self.patience).fold(size, |size, _| size * rate);
        // The first correction is one with this step's Jacobian, also where it is the last: factors of
        // another step would be memory beside the state.
        self.is_fresh = is_infinite(self.previous)
            | (!converged & (S::all(self.always_factor) | enough.less(later)));
        (self.before, self.previous) = (self.previous, size);
        converged
    }

    /// What the correction of the last residual leaves over, from how the residual has fallen: kept factors
    /// get no better, and those of a new Jacobian are off by twice as much as their first correction shows.
    #[inline(always)]
    pub(crate) fn expected(&self) -> S {
        let expected = self.previous * 8.0 * (self.previous / self.before);
        S::choose(is_infinite(self.before), S::constant(f64::INFINITY), expected)
    }
}

#[inline(always)]
fn is_infinite<S: Compared>(size: S) -> S::Truth {
    S::constant(f64::MAX).less(size)
}

/// Whether a correction is no more than the round-off of a coordinate at an angle, with an increment.
#[inline(always)]
pub(crate) fn is_round_off<S: Compared>(correction: S, angle: S, increment: S) -> S::Truth {
    // The midpoint may be next to zero where start and end are not.
    correction.abs().at_most((angle.abs() + increment.abs()) * (2.0 * f64::EPSILON))
}

impl Workspace {
    /// Solves one step; the solution stays in the workspace, with its report.
    #[inline]
    pub(crate) fn solve(&mut self, at: StepContext<'_>) -> Result<(), StepError> {
        if self.solve_few(at).is_some() {
            return Ok(());
        }
        if at.model.is_of_bodies() { self.solve_as::<true>(at) } else { self.solve_as::<false>(at) }
    }

    /// `BODIES`: whether the model is one of bodies ([`Model::is_of_bodies`]). All others have no push, and
    /// nothing of it in their steps.
    fn solve_as<const BODIES: bool>(&mut self, at: StepContext<'_>) -> Result<(), StepError> {
        let StepContext { model, settings, state, .. } = at;
        self.prepare(at);
        let is_guessed = state.past.predict(&mut self.step.increment);
        if BODIES && !state.past.point.is_empty() {
            self.push(at);
        }
        if is_guessed {
            if model.dimensions.constraints > 0 {
                // The equations are linear in the multipliers: any guess is as good.
                self.step.multipliers.copy_from_slice(&state.multipliers);
            }
            if self.iterate::<BODIES>(model, settings, state, false).is_ok() {
                return Ok(());
            }
        }
        self.ballistic(model, settings, state);
        self.iterate::<BODIES>(model, settings, state, true)
            .map_err(|error| model.explain(error, at, &self.step.q_end))
    }

    /// What does not change within a step: prescribed motion, input forces, constraints at the start.
    pub(crate) fn prepare(&mut self, at: StepContext<'_>) {
        let StepContext { model, settings, state, u } = at;
        let d = model.dimensions;
        let (inputs, next) = u.split_at(d.inputs);
        for (k, next) in next.iter().enumerate() {
            let i = d.dynamic + k;
            self.mid.q[i] = 0.5 * (state.q[i] + next);
            self.mid.angles[i] = self.mid.q[i];
            self.mid.velocity[i] = (next - state.q[i]) / settings.time_step_s;
            self.step.q_end[i] = *next;
        }
        if !model.orientations.is_empty() {
            self.prepare_orientations(model, settings, state);
        }
        if d.inputs > 0 {
            self.mid.set_inputs(model, inputs);
        }
        if d.constraints > 0 {
            self.place_start(model, state);
            // Until the end has a Jacobian of this step: nothing of the last may decide on this one.
            self.constraints.end.expect_round_off_of(&self.constraints.start);
        }
    }

    /// Constraints at the start of the step, kept from the end of the last one where possible; of loops
    /// without a Jacobian.
    fn place_start(&mut self, model: &Model, state: &PreciseState) {
        if self.constraints.start.in_plane.is_none() {
            self.prepare_start(model, state);
        } else if self.constraints.start.known < Known::Place {
            self.constraints.start.evaluate(model, &state.q, &self.balls.start);
            self.constraints.start.begin(model, &state.q);
        }
    }

    /// Constraints at the start of the step, with their Jacobian.
    pub(crate) fn prepare_start(&mut self, model: &Model, state: &PreciseState) {
        if model.dimensions.constraints > 0 && self.constraints.start.known < Known::All {
            self.balls.start_at(&state.orientations);
            self.constraints.start.complete(model, &state.q, &self.balls.start);
        }
    }

    /// Guess: the velocity that belongs to the momentum goes on.
    pub(crate) fn ballistic(&mut self, model: &Model, settings: &Settings, state: &PreciseState) {
        if !self.coast(model, settings, state) {
            let is_singular = self.find_velocity(model, state) < settings.singular_below;
            for (x, v) in self.step.increment.iter_mut().zip(&self.residual.dynamics) {
                // A singular mass matrix has no velocity; the Newton matrix will name the coordinate.
                *x = if v.is_finite() && !is_singular { settings.time_step_s * v } else { 0.0 };
            }
            self.step.multipliers.copy_from_slice(&state.multipliers);
        }
        // The velocity was found with the prescribed velocities of the last step, not of this one.
        for i in model.dimensions.dynamic..self.mid.velocity.len() {
            self.mid.velocity[i] = (self.step.q_end[i] - state.q[i]) / settings.time_step_s;
        }
        if !model.orientations.is_empty() {
            self.prepare_orientations(model, settings, state);
        }
    }

    /// Guesses by the recursion, where there is one and its pivots are sound.
    fn coast(&mut self, model: &Model, settings: &Settings, state: &PreciseState) -> bool {
        if !self.glide(model, settings, state) {
            return false;
        }
        self.step.multipliers.copy_from_slice(&state.multipliers);
        for (x, glided) in self.step.increment.iter_mut().zip(&self.residual.dynamics) {
            // A singular mass matrix has no velocity; the Newton matrix will name the coordinate.
            *x = if glided.is_finite() { *glided } else { 0.0 };
        }
        true
    }

    /// The velocity that belongs to the momentum, times the time step, into `residual`: by the recursion,
    /// where there is one and its pivots are sound. Needs the constraints at the start in their places.
    fn glide(&mut self, model: &Model, settings: &Settings, state: &PreciseState) -> bool {
        if !self.kkt.has_recursion() {
            return false;
        }
        let (dynamic, prescribed) = self.mid.velocity.split_at_mut(state.p.len());
        dynamic.fill(0.0);
        prescribed.copy_from_slice(&state.v);
        self.balls.start_at(&state.orientations);
        let (orientations, derivatives) =
            (&self.balls.start, [&mut *self.mid.l_q, &mut *self.mid.l_v]);
        self.mid.mechanics.gradient(model, &state.q, orientations, &self.mid.velocity, derivatives);
        if !self.factor_masses(model, settings) {
            return false;
        }
        let Residual { dynamics: x, constraints, .. } = &mut self.residual;
        // `L_v` is the momentum that belongs to what is prescribed.
        for ((x, p), l_v) in x.iter_mut().zip(&state.p).zip(&self.mid.l_v) {
            *x = l_v - p;
        }
        constraints.fill(0.0);
        self.kkt.solve(model, &self.constraints.start, x, constraints);
        true
    }

    /// Finds the velocity of the dynamic coordinates as [`Workspace::find_velocity`], by the recursion where
    /// that is faster and sound; false where it is not.
    pub(crate) fn find_velocity_by_recursion(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> bool {
        if model.dimensions.constraints > 0 {
            self.place_start(model, state);
        }
        let is_found = self.glide(model, settings, state);
        if is_found {
            self.residual.dynamics.iter_mut().for_each(|x| *x /= settings.time_step_s);
        }
        is_found
    }

    /// Corrects the guess until the residual is at round-off.
    fn iterate<const BODIES: bool>(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
        always_factor: bool,
    ) -> Result<(), StepError> {
        let mut report = StepReport::default();
        let mut chord = Chord::<f64>::new(settings, self.kkt.corrections(), always_factor);
        let mut strayed = model.is_foreseen(settings).then(Strayed::default);
        let pushes = BODIES && !state.past.point.is_empty();
        loop {
            if report.iterations == settings.max_iterations {
                let residual = chord.previous;
                return Err(StepError::NotConverged { iterations: report.iterations, residual });
            }
            report.iterations += 1;
            // Residual: r1 = p0 + D1Ld + F⁻ − Dh(q0)ᵀ λ, r2 = h(q1).
            report.residual = self.evaluate(model, settings, state);
            report.constraint_residual = self.evaluate_end(model, state);
            let size = larger(report.residual, report.constraint_residual);
            if !size.is_finite() {
                return Err(StepError::NotFinite { iterations: report.iterations });
            }
            // Factor: K = D2D1Ld + D2F⁻ and S = A1 K⁻¹ A0ᵀ.
            let converged = chord.judge(size, report.constraint_residual);
            if chord.is_fresh {
                if pushes {
                    self.response.save_first(&mut self.kkt);
                }
                self.factor(model, settings, state)?;
                if pushes && report.factorizations == 0 {
                    self.note_point(StepContext { model, settings, state, u: &[] });
                }
                report.factorizations += 1;
                strayed = strayed.map(|_| Strayed::default());
            }
            if report.iterations == 1 && size <= CONVERGED {
                // Nothing to correct, but what is singular has not passed for solved.
                break;
            }
            // Correct: x += dx, λ += dλ.
            self.correct(model);
            if converged && size <= STALE {
                break;
            }
            if let Some(strayed) = &mut strayed {
                let left = self.foresee::<BODIES>(model, settings, strayed);
                let expected = chord.expected();
                if is_negligible(left, expected)
                    && self.holds_constraints(model, state, &mut report)
                {
                    report.residual = left.min(expected);
                    self.step.is_evaluated = false;
                    if BODIES && chord.is_fresh {
                        self.step.strayed = strayed.turned();
                    }
                    break;
                }
            }
            if converged {
                self.evaluate(model, settings, state);
                break;
            }
            chord.is_idle = self.is_round_off_of_coordinates();
        }
        // Accept: p1 = D2Ld + F⁺.
        self.accept::<BODIES>(model, settings, report)
    }

    /// Constraint values `r2` at the current increment; returns their size in units of round-off.
    pub(crate) fn evaluate_end(&mut self, model: &Model, state: &PreciseState) -> f64 {
        if model.dimensions.constraints == 0 {
            return 0.0;
        }
        self.place_end(model, state);
        self.constraints.end.evaluate(model, &self.step.q_end, &self.balls.end);
        self.constraints.end.violation()
    }

    fn place_end(&mut self, model: &Model, state: &PreciseState) {
        for (i, x) in self.step.increment.iter().enumerate() {
            self.step.q_end[i] = state.q[i] + (state.q_low[i] + x);
        }
        if !model.orientations.is_empty() {
            self.turn_to_end(model, state);
        }
    }

    /// One correction with the factors at hand.
    fn correct(&mut self, model: &Model) {
        if model.dimensions.constraints > 0 {
            self.residual.constraints.copy_from_slice(&self.constraints.end.value);
        }
        let [r1, r2] = [&mut self.residual.dynamics, &mut self.residual.constraints];
        self.kkt.solve(model, &self.constraints.end, r1, r2);
        for (lambda, change) in self.step.multipliers.iter_mut().zip(&self.residual.constraints) {
            *lambda += change;
        }
        for (x, r) in self.step.increment.iter_mut().zip(&self.residual.dynamics) {
            *x -= r;
        }
    }

    /// Whether the last correction is no more than the round-off of the coordinates.
    fn is_round_off_of_coordinates(&self) -> bool {
        let mut corrections = self.residual.dynamics.iter().enumerate();
        corrections.all(|(i, x)| is_round_off(*x, self.mid.angles[i], self.step.increment[i]))
    }

    /// Checks the solution, and finds its impulse.
    fn accept<const BODIES: bool>(
        &mut self,
        model: &Model,
        settings: &Settings,
        mut report: StepReport,
    ) -> Result<(), StepError> {
        model.check_turns(&self.step.increment)?;
        self.find_impulse(model, settings);
        if !self.step.is_evaluated {
            self.nudge_impulse::<BODIES>(model, settings);
            if !BODIES {
                self.nudge_elements(model, settings.time_step_s);
            }
        }
        if model.dimensions.constraints > 0 {
            // The extrapolated guess has the least norm of other configurations.
            self.kkt.remove_null(&mut self.step.multipliers);
            self.constraints.start.subtract_pushes(
                model,
                &self.step.multipliers,
                &mut self.step.impulse,
            );
        }
        self.kkt.estimates.write(&mut report);
        self.step.report = report;
        Ok(())
    }

    /// Constraints with Jacobian at the solution, for the linearization and the next step.
    pub(crate) fn finish_end(&mut self, model: &Model, state: &PreciseState) {
        if model.dimensions.constraints == 0 {
            return;
        }
        if self.constraints.end.known < Known::All {
            self.place_end(model, state);
            self.constraints.end.complete(model, &self.step.q_end, &self.balls.end);
        }
        if !model.orientations.is_empty() {
            self.turn_end_jacobian(model);
        }
    }
}

impl Model {
    /// Refuses increments of more than half a turn. A function of its own, so that its share of a step is seen.
    #[inline(never)]
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
