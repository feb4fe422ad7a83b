//! The midpoint of a step: where `Ld(q0, q1) = h L((q0 + q1)/2, (q1 − q0)/h)` evaluates the Lagrangian.

use std::f64::consts::TAU;

use plantd_math::scalar::{Side, side_by_side};
use plantd_math::simd::wide;
use plantd_math::spatial::Mat3;
use plantd_math::tree_lu::TreeLu;

use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::fields::{Fields, OwnTorque};
use crate::lagrangian::forces;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::{Forces, Model, Mover, Spring};
use crate::model::tree::JointKind;

/// The midpoint of an increment `x`: `q0 + ½x`, `x/h` with `1/h` given, and the first without whole turns.
#[inline(always)]
pub(crate) fn middle<S: Side>(x: S, q: S, q_low: S, per_radian: S, inverse: f64) -> [S; 3] {
    let more = x * 0.5 + q_low;
    [q + more, x * inverse, Side::unwound(q, more, per_radian)]
}

impl Midpoint {
    /// Calls `take(orientation, torque)` for what depends on the turn and the velocity of one dynamic ball joint, beside
    /// the bodies: what acts across it, where forces count `weight` times, and what acts on bodies at poses. It
    /// may come more than once, and adds up.
    pub(crate) fn for_each_own_torque(
        &self,
        model: &Model,
        (fields, weight): (Option<&Fields>, f64),
        mut take: impl FnMut(usize, &OwnTorque),
    ) {
        let Mechanics { poses, momenta, .. } = &self.mechanics;
        let (joints, at) =
            (&model.dynamics.joints, Place { tree: &model.dynamics, poses, q: &self.q });
        for spring in &model.potentials.springs {
            let orientation = match (spring, spring.mover()) {
                (Spring::Orientation(spring), _) => joints[spring.joint].orientation,
                (_, Some(Mover::Ball(orientation))) => orientation,
                _ => continue,
            };
            let (mut own, first) = (OwnTorque::NONE, model.orientations[orientation]);
            spring.for_each_second_derivative(at, |i, j, value| {
                own.by_turn.0[j - first].0[i - first] -= value;
            });
            take(orientation, &own);
        }
        if let Some(forces) = model.forces.as_ref().filter(|forces| forces.act_on_balls()) {
            forces.for_each_derivative_across(&self.instant(model), |mover, i, j, by_q, by_v| {
                if let Mover::Ball(orientation) = mover {
                    let (mut own, first) = (OwnTorque::NONE, model.orientations[orientation]);
                    own.by_turn.0[j - first].0[i - first] = weight * by_q;
                    own.by_velocity.0[j - first].0[i - first] = weight * by_v;
                    take(orientation, &own);
                }
            });
            forces.for_each_derivative_of_balls(&self.instant(model), |orientation, axis, by_v| {
                let mut own = OwnTorque::NONE;
                own.by_velocity.0[axis].0[axis] = weight * by_v;
                take(orientation, &own);
            });
        }
        let Some(fields) = fields else { return };
        for (first, joint) in joints.iter().enumerate() {
            if joint.kind == JointKind::Ball(0) && joint.coordinate < model.dimensions.dynamic {
                take(joint.orientation, &fields.within_ball(&model.dynamics, momenta, first));
            }
        }
    }

    /// Goes to the midpoint of an increment, with `1/h` given.
    pub(crate) fn go_to(&mut self, state: &PreciseState, increment: &[f64], inverse: f64) {
        wide!({
            let nd = increment.len();
            side_by_side!(for (
                x in &increment[..nd],
                q in &state.q[..nd],
                q_low in &state.q_low[..nd],
                per_radian in &self.turns_per_radian[..nd],
            ) let [middle, velocity, angle] = middle(x, q, q_low, per_radian, inverse); {
                middle_out(&mut self.q[..nd]) = middle;
                velocity_out(&mut self.velocity[..nd]) = velocity;
                angle_out(&mut self.angles[..nd]) = angle;
            });
        })
    }
}

/// Configuration and velocity at the midpoint, with the derivatives of the Lagrangian and the forces there.
#[derive(Clone, Debug)]
pub(crate) struct Midpoint<S: Planar = f64> {
    /// Configuration.
    pub(crate) q: Vec<S>,
    /// Configuration with angles of hinges less their whole turns, in which they keep all digits.
    pub(crate) angles: Vec<S>,
    /// `1/2π` for the coordinates of hinges, else zero.
    pub(crate) turns_per_radian: Vec<S>,
    /// Orientations of ball joints.
    pub(crate) orientations: Vec<Mat3<S>>,
    pub(crate) velocity: Vec<S>,
    pub(crate) mechanics: Mechanics<S>,
    pub(crate) l_q: Vec<S>,
    pub(crate) l_v: Vec<S>,
    /// The inputs, where forces need them; else empty.
    pub(crate) inputs: Vec<S>,
    pub(crate) input_force: Vec<S>,
    /// Inputs, damping and forces.
    pub(crate) force: Vec<S>,
}

impl<S: Planar> Midpoint<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, n, no) = (d.dynamic, d.coordinates(), model.orientations.len());
        let zeros = |len: usize| vec![S::ZERO; len];
        let mut turns_per_radian = zeros(nd);
        for joint in model.dynamics.joints.iter().filter(|j| j.kind == JointKind::Revolute) {
            if let Some(turns) = turns_per_radian.get_mut(joint.coordinate) {
                *turns = S::constant(1.0 / TAU);
            }
        }
        Self {
            q: zeros(n),
            angles: zeros(n),
            turns_per_radian,
            orientations: vec![Mat3::IDENTITY; no],
            velocity: zeros(n),
            mechanics: Mechanics::new(model),
            l_q: zeros(nd),
            l_v: zeros(nd),
            inputs: zeros(if model.forces.is_some() { d.inputs } else { 0 }),
            input_force: zeros(nd),
            force: zeros(nd),
        }
    }

    /// Inputs, and their forces on coordinates.
    pub(crate) fn set_inputs(&mut self, model: &Model, inputs: &[S]) {
        forces::input_forces(&model.coordinate_inputs, inputs, &mut self.input_force);
        self.force.copy_from_slice(&self.input_force);
        if !self.inputs.is_empty() {
            self.inputs.copy_from_slice(inputs);
        }
    }

    /// Gradient of the Lagrangian, and forces.
    pub(crate) fn evaluate(&mut self, model: &Model) {
        let Self { l_q, l_v, force, .. } = self;
        self.mechanics.gradient(
            model,
            &self.angles,
            &self.orientations,
            &self.velocity,
            [&mut *l_q, &mut *l_v],
        );
        if model.potentials.any {
            model.add_spring_gradient(&self.mechanics.poses, &self.q, l_q);
            model.armature.add_momentum(&self.velocity, l_v);
        }
        if !model.damping.is_empty() {
            forces::add_damping(&model.damping, &self.velocity, &self.input_force, force);
        }
        if let Some(forces) = &model.forces {
            if model.damping.is_empty() {
                force.copy_from_slice(&self.input_force);
            }
            forces
                .add(&self.mechanics.instant(model, &self.q, &self.velocity, &self.inputs), force);
        }
    }

    /// Fills `K` of a model without ball joints at the last evaluation.
    pub(crate) fn fill_newton_matrix(
        &mut self,
        model: &Model,
        settings: &Settings,
        matrix: &mut TreeLu<S>,
    ) {
        let h = settings.time_step_s;
        if model.couples_more_than_bodies() {
            matrix.clear();
        }
        self.mechanics.fill_newton_matrix(model, h, matrix);
        if model.potentials.any {
            let dynamic = model.dimensions.dynamic;
            model.for_each_spring_derivative(&self.mechanics.poses, &self.q, |i, j, value| {
                if i < dynamic && j < dynamic {
                    matrix.add(&model.elimination, i, j, value * (-0.25 * h));
                }
            });
            model.armature.entries().for_each(|entry| entry.add_to(matrix, model, -1.0 / h));
        }
        for (i, c) in model.damping.iter().enumerate() {
            let slot = model.elimination.diagonal(i);
            matrix.add_to_diagonal(slot, S::constant(-settings.force_split.at_start() * c));
        }
        if let Some(forces) = &model.forces {
            self.add_forces_to_newton_matrix(model, forces, settings, matrix);
        }
    }

    /// What springs, armatures, dampers and forces of single coordinates add to the diagonal of `K`.
    pub(crate) fn fill_diagonal(&self, model: &Model, settings: &Settings, diagonal: &mut [S]) {
        let h = settings.time_step_s;
        diagonal.fill(S::ZERO);
        if model.potentials.any {
            let mut add = |i: usize, value: S| {
                if let Some(entry) = diagonal.get_mut(i) {
                    *entry -= value;
                }
            };
            let spring = |i: usize, value: S| add(i, value * (0.25 * h));
            model.for_each_own_spring_derivative(&self.mechanics.poses, &self.q, spring);
            for &(i, inertia) in &model.armature.own {
                add(i, S::constant(inertia / h));
            }
        }
        let a = settings.force_split.at_start();
        for (entry, c) in diagonal.iter_mut().zip(&model.damping) {
            *entry -= S::constant(a * c);
        }
        if let Some(forces) = &model.forces {
            forces.for_each_own_derivative(&self.instant(model), |i, by_q, by_v| {
                if let Some(entry) = diagonal.get_mut(i) {
                    *entry += (by_q * (0.5 * h) + by_v) * a;
                }
            });
        }
    }

    /// Adds the part `a (½h f_q + f_v)` of forces to `K` at the last evaluation.
    fn add_forces_to_newton_matrix(
        &self,
        model: &Model,
        forces: &Forces,
        settings: &Settings,
        matrix: &mut TreeLu<S>,
    ) {
        let (a, half) = (settings.force_split.at_start(), 0.5 * settings.time_step_s);
        let dynamic = model.dimensions.dynamic;
        forces.for_each_derivative(&self.instant(model), |i, j, by_q, by_v| {
            if i < dynamic && j < dynamic {
                matrix.add(&model.elimination, i, j, (by_q * half + by_v) * a);
            }
        });
    }

    /// What forces depend on, at the last evaluation.
    pub(crate) fn instant<'a>(&'a self, model: &'a Model) -> Instant<'a, S> {
        self.mechanics.instant(model, &self.q, &self.velocity, &self.inputs)
    }
}
