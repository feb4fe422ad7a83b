//! The memory of a step.

use plantd_math::rows::{Term, padded, spread};

use crate::constraints::closure::{Closure, Known};
use crate::integrator::balls::BallJoints;
use crate::integrator::midpoint::Midpoint;
use crate::integrator::report::StepReport;
use crate::integrator::response::Response;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::kkt::planar::Diagonals;
use crate::kkt::pushes::{Bending, Pushes};
use crate::kkt::space::margins::OfBall;
use crate::kkt::system::KktSystem;
use crate::kkt::tied::TiedTangents;
use crate::lagrangian::generators::Flanks;
use crate::lagrangian::nudge::Nudge;
use crate::model::mechanism::Model;

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
    pub(crate) step: StepIncrement,
    pub(crate) mid: Midpoint,
    pub(crate) balls: BallJoints,
    pub(crate) residual: Residual,
    pub(crate) constraints: ConstraintPair,
    pub(crate) kkt: KktSystem,
    pub(crate) tangents: Tangents,
    /// How the last correction changes the gradient.
    pub(crate) nudge: Nudge,
    pub(crate) response: Response,
    /// Joints, where steps are [those of a few](super::few), else zero.
    pub(crate) few_joints: usize,
}

/// The unknowns of a step, and where they lead.
#[derive(Clone, Debug)]
pub(crate) struct StepIncrement {
    /// `x = q[k+1] − q[k]` of the dynamic coordinates.
    pub(crate) increment: Vec<f64>,
    /// `λ`.
    pub(crate) multipliers: Vec<f64>,
    /// `p[k+1] − p[k]`.
    pub(crate) impulse: Vec<f64>,
    /// `q[k+1]`.
    pub(crate) q_end: Vec<f64>,
    /// Whether the last evaluation was at the increment.
    pub(crate) is_evaluated: bool,
    /// `Σ |x'|` of the corrections since the last evaluation, of bodies whose system was factored there; else infinite.
    /// Steps of [a few joints](super::few) leave it as it is.
    pub(crate) strayed: f64,
    /// How it was solved. It stays here: to hand it on from function to function takes a tenth of a pendulum's step.
    pub(crate) report: StepReport,
}

/// What a step's equations leave over; a correction takes its place.
#[derive(Clone, Debug)]
pub(crate) struct Residual {
    /// `r1`, of the discrete Euler-Lagrange equations.
    pub(crate) dynamics: Vec<f64>,
    /// `r2 = h(q1)`.
    pub(crate) constraints: Vec<f64>,
    /// Magnitudes of what `r1` is the sum of, and the largest.
    pub(crate) magnitudes: Vec<f64>,
    pub(crate) round_off: f64,
}

/// The constraints at both ends of a step.
#[derive(Clone, Debug)]
pub(crate) struct ConstraintPair {
    /// At `q[k]`; complete where it is known to be at the state's configuration.
    pub(crate) start: Closure,
    /// At `q[k+1]`; complete at the solution.
    pub(crate) end: Closure,
}

impl ConstraintPair {
    /// The end of this step is the start of the next.
    pub(crate) fn move_on(&mut self) {
        if self.end.known > Known::Nothing {
            self.end.turn_back();
            std::mem::swap(&mut self.start, &mut self.end);
            self.end.known = Known::Nothing;
        } else {
            self.forget();
        }
    }

    /// The state has changed: nothing of the last step holds.
    pub(crate) fn forget(&mut self) {
        self.start.known = Known::Nothing;
        self.end.known = Known::Nothing;
    }
}

/// What a linearization is made of, row-major.
#[derive(Clone, Debug)]
pub(crate) struct Tangents {
    pub(crate) diagonals: Diagonals,
    /// `Σ λ D²h`; without room until it is needed, where generators stand for it.
    pub(crate) constraint_hessian: Vec<f64>,
    /// `½h L_qq + L_qv`; without room until they are needed, where generators stand for them.
    pub(crate) end_slopes: Vec<f64>,
    /// Of joints, with ball joints; the same.
    pub(crate) flanks: Vec<Flanks>,
    /// What ball joints have of themselves.
    pub(crate) balls: Vec<OfBall>,
    /// For linearizations by generators, with constraints.
    pub(crate) pushes: Pushes,
    /// `Σ λ D²h` there.
    pub(crate) bending: Option<Box<Bending>>,
    /// For linearizations by generators, with rows of ties.
    pub(crate) tied: Option<Box<TiedTangents>>,
    pub(crate) terms: Vec<Term>,
}

impl Tangents {
    /// Makes room for a linearization entry by entry.
    pub(crate) fn make_room(&mut self, model: &Model) {
        let (nd, joints) = (model.dimensions.dynamic, model.dynamics.joints.len());
        let (n, nc) = (model.dimensions.coordinates(), model.dimensions.constraints);
        self.constraint_hessian.resize(if nc > 0 { n * n } else { 0 }, 0.0);
        self.end_slopes.resize(nd * nd, 0.0);
        if !model.orientations.is_empty() {
            self.flanks.resize(joints, Flanks::default());
        }
    }

    /// Makes room for what a linearization by generators needs beside them, with rows that are so long.
    pub(crate) fn make_room_beside_generators(&mut self, model: &Model, stride: usize) {
        let nc = model.dimensions.constraints;
        if nc > 0 {
            self.bending = Some(Box::new(Bending::new(model, stride)));
            self.pushes = Pushes::new(model, stride, nc);
        }
        if model.tied_rows > 0 {
            self.tied = Some(Box::new(TiedTangents::new(model, stride)));
        }
    }
}

impl Workspace {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, n, nc) = (d.dynamic, d.coordinates(), d.constraints);
        let zeros = |len: usize| vec![0.0; len];
        let stride = spread(padded(2 * n));
        let kkt = KktSystem::new(model, stride);
        let mut tangents = Tangents {
            diagonals: Diagonals::new(nd),
            constraint_hessian: Vec::new(),
            end_slopes: Vec::new(),
            flanks: Vec::new(),
            balls: vec![OfBall::ZERO; model.orientations.len()],
            pushes: Pushes::default(),
            bending: None,
            tied: None,
            terms: Vec::with_capacity(nd.max(nc)),
        };
        if kkt.in_space.is_none() {
            tangents.make_room(model);
        } else {
            tangents.make_room_beside_generators(model, stride);
        }
        Self {
            response: Response::new(model),
            step: StepIncrement {
                increment: zeros(nd),
                multipliers: zeros(nc),
                impulse: zeros(nd),
                q_end: zeros(n),
                is_evaluated: false,
                strayed: f64::INFINITY,
                report: StepReport::default(),
            },
            mid: Midpoint::new(model),
            balls: BallJoints::new(model),
            residual: Residual {
                dynamics: zeros(nd),
                constraints: zeros(nc),
                magnitudes: zeros(nd),
                round_off: 0.0,
            },
            constraints: ConstraintPair { start: Closure::new(model), end: Closure::new(model) },
            kkt,
            tangents,
            nudge: Nudge::new(model),
            few_joints: model.few_joints(),
        }
    }

    /// The state has changed: nothing of the last step holds.
    pub(crate) fn forget(&mut self) {
        self.constraints.forget();
    }

    /// The end of this step is the start of the next.
    pub(crate) fn move_on(&mut self) {
        self.constraints.move_on();
        self.response.move_on(&mut self.kkt);
    }
}
