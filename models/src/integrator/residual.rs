//! The discrete Euler-Lagrange equations of a step, and its momenta.
//!
//! With the discrete Lagrangian of the midpoint rule, `L_q`, `L_v` and forces `f` at the midpoint, and the
//! weight `a` of `F⁻` ([`ForceSplit`](crate::integrator::settings::ForceSplit)),
//!
//! ```text
//! Ld(q0, q1) = h L((q0 + q1)/2, (q1 − q0)/h)
//!
//! D1Ld = ½h L_q − L_v      F⁻ = a h f              p0 = −D1Ld − F⁻ + Dh(q0)ᵀ λ
//! D2Ld = ½h L_q + L_v      F⁺ = (1 − a) h f        p1 = D2Ld + F⁺
//! ```
//!
//! A step solves `r1 = p0 + D1Ld + F⁻ − Dh(q0)ᵀ λ = 0`, and where that holds
//!
//! ```text
//! p1 − p0 = D1Ld + D2Ld + F⁻ + F⁺ − Dh(q0)ᵀ λ = h (L_q + f) − Dh(q0)ᵀ λ
//! ```
//!
//! Ball joints weigh the terms by their maps: see [`balls`](crate::integrator::balls).

use plantd_math::norms::largest;
use plantd_math::scalar::{Compared, Scalar, side_by_side};
use plantd_math::simd::wide;
use plantd_math::spatial::{Vec3, three};

use crate::integrator::midpoint::Midpoint;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{Residual, Workspace};
use crate::lagrangian::arrangement::Planar;
use crate::model::mechanism::Model;

/// `r1 = p0 + D1Ld + F⁻` of a coordinate, without constraints, and the magnitude of its terms.
#[inline(always)]
pub(crate) fn sum_of<S: Compared>(
    [p, p_low]: [S; 2],
    [l_q, l_v, force, angle]: [S; 4],
    half: f64,
    weight: f64,
) -> [S; 2] {
    let (half_q, force) = (l_q * half, force * weight);
    let residual = ((p - l_v) + (half_q + force)) + p_low;
    [residual, p.abs() + l_v.abs() + half_q.abs() * (angle.abs() + 1.0) + force.abs()]
}

/// `D1Ld + D2Ld + F⁻ + F⁺ = h (L_q + f)` of a coordinate.
#[inline(always)]
pub(crate) fn impulse_of<S: Scalar>(l_q: S, force: S, h: f64) -> S {
    (l_q + force) * h
}

impl Residual {
    /// Sums up `r1 = p0 + D1Ld + F⁻`, without constraints, and the magnitudes; `half` is `½h`, `weight`
    /// is `a h`.
    pub(crate) fn sum_up(&mut self, state: &PreciseState, mid: &Midpoint, half: f64, weight: f64) {
        wide!({
            let nd = self.dynamics.len();
            side_by_side!(for (
                p in &state.p[..nd],
                p_low in &state.p_low[..nd],
                l_q in &mid.l_q[..nd],
                l_v in &mid.l_v[..nd],
                force in &mid.force[..nd],
                angle in &mid.angles[..nd],
            ) let sums = sum_of([p, p_low], [l_q, l_v, force, angle], half, weight); {
                residual(&mut self.dynamics[..nd]) = sums[0];
                magnitude(&mut self.magnitudes[..nd]) = sums[1];
            });
        })
    }
}

impl<S: Planar> Midpoint<S> {
    /// Writes [`impulse_of`] all coordinates.
    pub(crate) fn write_impulse(&self, h: f64, impulse: &mut [S]) {
        let pairs = self.l_q.iter().zip(&self.force);
        for (impulse, (l_q, force)) in impulse.iter_mut().zip(pairs) {
            *impulse = impulse_of(*l_q, *force, h);
        }
    }
}

impl Workspace {
    /// Evaluates `r1` at the current increment; returns its size in units of round-off.
    pub(crate) fn evaluate(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> f64 {
        let h = settings.time_step_s;
        self.mid.go_to(state, &self.step.increment, 1.0 / h);
        if !model.orientations.is_empty() {
            self.turn_to_midpoint(model);
        }
        self.mid.evaluate(model);
        (self.step.is_evaluated, self.step.strayed) = (true, f64::INFINITY);
        let weight = settings.force_split.at_start() * h;
        self.residual.sum_up(state, &self.mid, 0.5 * h, weight);
        self.residual.round_off = largest(&self.residual.magnitudes).max(f64::MIN_POSITIVE);
        if !model.orientations.is_empty() {
            self.turn_residual(model, settings, state);
        }
        if model.dimensions.constraints > 0 {
            let r1 = &mut self.residual.dynamics;
            self.constraints.start.subtract_pushes(model, &self.step.multipliers, r1);
        }
        largest(&self.residual.dynamics) / (f64::EPSILON * self.residual.round_off)
    }

    /// Finds `p1 − p0` at the last evaluation, without the impulse of constraints.
    pub(crate) fn find_impulse(&mut self, model: &Model, settings: &Settings) {
        self.mid.write_impulse(settings.time_step_s, &mut self.step.impulse);
        if !model.orientations.is_empty() {
            self.turn_impulse(model, settings);
        }
    }

    /// `p1 = D2Ld + F⁺ = L_v + ½h L_q + (1 − a) h f` at the last evaluation; allocates.
    pub(crate) fn momentum_at_end(&self, model: &Model, settings: &Settings) -> Vec<f64> {
        let (h, mid) = (settings.time_step_s, &self.mid);
        let at_end = (1.0 - settings.force_split.at_start()) * h;
        let torque = |i: usize| 0.5 * h * mid.l_q[i] + at_end * mid.force[i];
        let mut momentum: Vec<f64> = (0..mid.l_v.len()).map(|i| mid.l_v[i] + torque(i)).collect();
        for (turn, &i) in self.balls.turns().zip(&model.orientations) {
            if let Some(momentum) = momentum.get_mut(i..i + 3) {
                let carried = turn.momentum_at_start().apply_transposed(three(&mid.l_v, i));
                let torque = Vec3([torque(i), torque(i + 1), torque(i + 2)]);
                let torque = turn.torque_at_start().apply_transposed(torque);
                momentum.copy_from_slice(&(carried + torque).0);
            }
        }
        momentum
    }

    /// The residual of ball joints, `p − N⁻ m + T⁻ (½h τ + a h f)`.
    pub(crate) fn turn_residual(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) {
        let h = settings.time_step_s;
        let weight = settings.force_split.at_start() * h;
        for (o, &i) in model.orientations.iter().enumerate() {
            if i >= model.dimensions.dynamic {
                continue;
            }
            let turn = self.balls.turn(o);
            let momentum = three(&self.mid.l_v, i);
            let torque = three(&self.mid.l_q, i) * (0.5 * h) + three(&self.mid.force, i) * weight;
            let momentum = turn.momentum_to_start(momentum);
            let torque = turn.torque_to_start(torque);
            for a in 0..3 {
                self.residual.dynamics[i + a] =
                    ((state.p[i + a] - momentum[a]) + torque[a]) + state.p_low[i + a];
            }
        }
    }

    /// The change of the momentum of ball joints beyond `h (τ + f)`: `−ξ × m + (2a − 1) h (T⁻ − 1) f`.
    pub(crate) fn turn_impulse(&mut self, model: &Model, settings: &Settings) {
        let h = settings.time_step_s;
        let skew = (2.0 * settings.force_split.at_start() - 1.0) * h;
        for (o, &i) in model.orientations.iter().enumerate() {
            if i >= model.dimensions.dynamic {
                continue;
            }
            let turn = self.balls.turn(o);
            let carried = three(&self.mid.l_v, i).cross(turn.xi);
            let force = three(&self.mid.force, i);
            let change = if skew == 0.0 {
                carried
            } else {
                carried + (turn.torque_to_start(force) - force) * skew
            };
            for a in 0..3 {
                self.step.impulse[i + a] += change[a];
            }
        }
    }
}
