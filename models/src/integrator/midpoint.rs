//! The midpoint of a step: where `Ld(q0, q1) = h L((q0 + q1)/2, (q1 − q0)/h)` evaluates the Lagrangian.

use std::f64::consts::TAU;

use plantd_math::scalar::{Side, side_by_side};
use plantd_math::simd::wide;
use plantd_math::spatial::Mat3;

use crate::integrator::state::PreciseState;
use crate::lagrangian::forces::Instant;
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::{armature, forces};
use crate::model::mechanism::Model;
use crate::model::tree::JointKind;

/// Configuration and velocity at the midpoint, with the derivatives of the Lagrangian and the forces there.
#[derive(Clone, Debug)]
pub(crate) struct Midpoint {
    /// Configuration.
    pub(crate) q: Vec<f64>,
    /// Configuration with angles of hinges less their whole turns, in which they keep all digits.
    pub(crate) angles: Vec<f64>,
    /// `1/2π` for the coordinates of hinges, else zero.
    pub(crate) turns_per_radian: Vec<f64>,
    /// Orientations of ball joints.
    pub(crate) orientations: Vec<Mat3>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) mechanics: Mechanics,
    pub(crate) l_q: Vec<f64>,
    pub(crate) l_v: Vec<f64>,
    /// The inputs, where forces need them; else empty.
    pub(crate) inputs: Vec<f64>,
    pub(crate) input_force: Vec<f64>,
    /// Inputs, damping and forces.
    pub(crate) force: Vec<f64>,
}

impl Midpoint {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, n, no) = (d.dynamic, d.coordinates(), model.orientations.len());
        let zeros = |len: usize| vec![0.0; len];
        let mut turns_per_radian = zeros(nd);
        for joint in model.dynamics.joints.iter().filter(|j| j.kind == JointKind::Revolute) {
            if let Some(turns) = turns_per_radian.get_mut(joint.coordinate) {
                *turns = 1.0 / TAU;
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
    pub(crate) fn set_inputs(&mut self, model: &Model, inputs: &[f64]) {
        forces::input_forces(&model.coordinate_inputs, inputs, &mut self.input_force);
        self.force.copy_from_slice(&self.input_force);
        if !self.inputs.is_empty() {
            self.inputs.copy_from_slice(inputs);
        }
    }

    /// Goes to the midpoint of an increment: `q0 + ½x`, and `x/h` with `1/h` given.
    pub(crate) fn go_to(&mut self, state: &PreciseState, increment: &[f64], inverse: f64) {
        wide!({
            let nd = increment.len();
            side_by_side!(for (
                x in &increment[..nd],
                q in &state.q[..nd],
                q_low in &state.q_low[..nd],
                per_radian in &self.turns_per_radian[..nd],
            ) let more = x * 0.5 + q_low; {
                middle(&mut self.q[..nd]) = q + more;
                velocity(&mut self.velocity[..nd]) = x * inverse;
                angle(&mut self.angles[..nd]) = Side::unwound(q, more, per_radian);
            });
        })
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
            armature::add_momentum(&model.armature, &self.velocity, l_v);
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

    /// What forces depend on, at the last evaluation.
    pub(crate) fn instant<'a>(&'a self, model: &'a Model) -> Instant<'a> {
        self.mechanics.instant(model, &self.q, &self.velocity, &self.inputs)
    }
}
