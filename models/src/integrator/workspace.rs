//! The memory of a step.

use std::f64::consts::TAU;

use crate::constraints::closure::Closure;
use crate::integrator::blocks::StepBlocks;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::kkt::system::KktSystem;
use crate::lagrangian::mechanics::Mechanics;
use crate::math::rows::{Term, padded, spread};
use crate::math::spatial::{Mat3, Vec3};
use crate::model::mechanism::Model;
use crate::model::tree::JointKind;

/// What a step is taken of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StepContext<'a> {
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
    pub(crate) magnitudes: Vec<f64>,
    pub(crate) round_off: f64,
    pub(crate) constraint_residual: Vec<f64>,
    /// At the midpoint.
    pub(crate) mechanics: Mechanics,
    pub(crate) kkt: KktSystem,
    /// What springs and dampers of coordinates add to the linearization: of the residual by the start, of the momentum by the increment.
    pub(crate) diagonals: [Vec<f64>; 2],
    /// Constraints at `q[k]`.
    pub(crate) start: Closure,
    /// `start` holds the constraints at the state's configuration.
    pub(crate) start_is_valid: bool,
    /// Constraints at `q[k+1]`.
    pub(crate) end: Closure,
    /// `end` holds the constraints, Jacobian included, at the solution.
    pub(crate) end_is_exact: bool,
    /// `Σ λ D²h`, for the linearization.
    pub(crate) constraint_hessian: Vec<f64>,
    /// `½h L_qq + L_qv`, for the linearization, row-major.
    pub(crate) end_slopes: Vec<f64>,
    /// `h L_qq`, for the linearization, row-major.
    pub(crate) stiffness: Vec<f64>,
    pub(crate) terms: Vec<Term>,
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
            kkt: KktSystem::new(model, spread(padded(2 * n))),
            diagonals: [zeros(nd), zeros(nd)],
            start: Closure::new(model),
            start_is_valid: false,
            end: Closure::new(model),
            end_is_exact: false,
            constraint_hessian: zeros(if nc > 0 { n * n } else { 0 }),
            end_slopes: zeros(nd * nd),
            stiffness: zeros(nd * nd),
            terms: Vec::with_capacity(nd.max(nc)),
        }
    }
}
