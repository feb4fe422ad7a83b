//! Regulators about points and along trajectories: what the control service answers with, and what
//! feedbacks of plants are computed from, again whenever a plant's parameters change.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_control::{
    self as control, FiniteHorizon, Momentum, Regulator, RiccatiError, Sample, Tangent,
    TrajectoryWeights, Values, Weights, WeightsError,
};
use plantd_models::{
    Initial, InitialError, Linearization, Model, Plant, Settings, Spare, State, StepError,
};

use crate::core::feedback::law::{Law, Stage};
use crate::core::inputs::{Inputs, at_operating_point};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::origin::Origin;
use crate::core::room::Room;
use crate::core::workers::pool::{Abandoned, WorkError};

/// Acceleration, in m/s² or rad/s², below which a point counts as an equilibrium.
const EQUILIBRIUM_DRIFT_MAX: f64 = 1e-4;

/// Why there is no such regulator.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RegulatorError {
    /// A step fails at the point or along the trajectory.
    #[error("{error}")]
    Step {
        /// The step's error.
        error: StepError,
        /// Steps of the trajectory before it.
        steps_taken: Option<usize>,
    },
    /// The point is no equilibrium.
    #[error(
        "the point is not an equilibrium: coordinate `{coordinate}` moves by {distance:e} in a step of \
         {time_step_s} s"
    )]
    Moves {
        /// The coordinate that moves most.
        coordinate: String,
        /// By how much, in a step.
        distance: f64,
        /// The step, s.
        time_step_s: f64,
    },
    /// The plant cannot be put where the feedback is about.
    #[error("{error}")]
    Initial {
        /// Field of the request.
        field: &'static str,
        /// Why not.
        error: InitialError,
    },
    /// The trajectory belongs to another time step than the plant's.
    #[error(
        "the trajectory of the feedback was given for a time step of {given_s} s; the plant's is \
         {present_s} s now: call SetFeedback with a trajectory for it"
    )]
    TimeStepChanged {
        /// That of the trajectory, s.
        given_s: f64,
        /// The plant's, s.
        present_s: f64,
    },
    /// There are no weights.
    #[error("are missing")]
    NoWeights,
    /// A weight has the wrong size or definiteness.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The Riccati equation has no solution, or it was not found.
    #[error(transparent)]
    Riccati(#[from] RiccatiError),
    /// It needs more memory than there may be.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
    /// It was not computed.
    #[error(transparent)]
    Work(#[from] WorkError),
}

impl From<StepError> for RegulatorError {
    fn from(error: StepError) -> Self {
        Self::Step { error, steps_taken: None }
    }
}

/// Where a state was refused.
fn refused(field: &'static str) -> impl Fn(InitialError) -> RegulatorError {
    move |error| RegulatorError::Initial { field, error }
}

/// The numbers of a matrix, row by row.
fn row_major(matrix: &DMatrix<f64>) -> Vec<f64> {
    matrix.transpose().as_slice().to_vec()
}

/// On which space a regulator is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Constraints {
    /// The tangent space of the constraints.
    Manifold,
    /// The full state.
    Full,
}

impl Constraints {
    /// The tangent space of the constraints at the plant's state, if it is to be used.
    pub fn tangent(self, plant: &mut Plant) -> Option<Tangent> {
        let d = plant.model().dimensions();
        let is_needed = self == Self::Manifold && d.constraints > 0;
        is_needed.then(|| Tangent::new(&plant.constraint_jacobian(), d.dynamic))
    }
}

/// Refuses a point that moves. Two steps: a momentum that does not belong to the point shows in the
/// second at the latest.
pub fn check_equilibrium(mut plant: Plant, u: &[f64]) -> Result<(), RegulatorError> {
    let time_step_s = plant.settings().time_step_s;
    let mut q = plant.q().to_vec();
    for _ in 0..2 {
        plant.step(u)?;
        let drifts = plant.model().difference(&q, plant.q());
        let worst = drifts.into_iter().map(f64::abs).enumerate().max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((index, distance)) = worst else { return Ok(()) };
        let drift = distance / (time_step_s * time_step_s);
        if drift > EQUILIBRIUM_DRIFT_MAX {
            let coordinate = &plant.model().coordinates()[index].name;
            let coordinate = coordinate.clone();
            return Err(RegulatorError::Moves { coordinate, distance, time_step_s });
        }
        q.copy_from_slice(plant.q());
    }
    Ok(())
}

/// What pulls weights on a momentum back to the plant's state; none where they are on it.
fn projection(momentum: Momentum, plant: &mut Plant) -> Option<DMatrix<f64>> {
    let is_needed = momentum == Momentum::Projected && plant.model().dimensions().constraints > 0;
    is_needed.then(|| plant.projection_by_state())
}

/// The regulator of a linearization at the plant's state.
pub fn at_state(
    plant: &mut Plant,
    linearization: &Linearization,
    weights: &Weights,
    momentum: Momentum,
    constraints: Constraints,
) -> Result<Regulator, RegulatorError> {
    let (a, b) = (linearization.a(), linearization.b());
    let pulled = projection(momentum, plant).map(|by_state| weights.pull_back(&by_state));
    let pulled = pulled.transpose()?;
    let weights = pulled.as_ref().unwrap_or(weights);
    Ok(match constraints.tangent(plant) {
        Some(tangent) => control::infinite_horizon_on_manifold(&a, &b, &tangent, weights)?,
        None => control::infinite_horizon(&a, &b, weights)?,
    })
}

/// The regulator about an equilibrium.
pub fn about_point(
    plant: &mut Plant,
    u: &[f64],
    weights: &Weights,
    momentum: Momentum,
    constraints: Constraints,
) -> Result<Regulator, RegulatorError> {
    check_equilibrium(plant.clone(), u)?;
    let mut linearization = Linearization::new(plant.model());
    plant.linearize(u, &mut linearization)?;
    at_state(plant, &linearization, weights, momentum, constraints)
}

/// What a regulator along a trajectory needs memory for.
#[derive(Clone, Copy, Debug)]
pub struct Memory {
    /// Steps.
    pub steps: usize,
    /// Steps with weights of their own.
    pub stages: usize,
    /// Which momentum weights weigh.
    pub momentum: Momentum,
    /// Whether value functions are kept.
    pub values: Values,
}

impl Memory {
    /// The numbers that a trajectory's matrices need; refuses too many: A, B, the gain, the tangent
    /// space twice, weights, what pulls them back and what it makes of them, and value functions.
    pub fn check(self, limits: &Limits, model: &Model) -> Result<usize, RegulatorError> {
        let d = model.dimensions();
        let (nx, nu) = (d.state(), d.input());
        let tangents = if d.constraints > 0 { 2 * nx * nx } else { 0 };
        let values = if self.values == Values::Keep { nx * nx + nx } else { 0 };
        let numbers = (self.steps + 1).saturating_mul(nx * nx + 2 * nx * nu + tangents + values);
        let weights = self.stages.saturating_mul(stage_numbers(model));
        let is_projected = self.momentum == Momentum::Projected && d.constraints > 0;
        let pulled = if is_projected { nx * nx + stage_numbers(model) } else { 0 };
        let weights = weights.saturating_add((self.steps + 1).saturating_mul(pulled));
        let (name, limit) = ("trajectory_numbers", limits.trajectory_numbers);
        let (what, numbers) =
            ("numbers in the trajectory's matrices", numbers.saturating_add(weights));
        LimitExceeded::check(name, limit, what, numbers)?;
        Ok(numbers)
    }
}

/// Numbers in the weights of one step.
fn stage_numbers(model: &Model) -> usize {
    let d = model.dimensions();
    let (nx, nu) = (d.state(), d.input());
    nx * nx + nu * nu + nx * nu + nx + nu
}

/// A reference motion with its linearizations.
pub struct Path {
    /// States, one more than steps.
    pub states: Vec<State>,
    /// Linearizations, one per step.
    pub samples: Vec<Sample>,
    /// Tangent spaces of the constraints, one per state, or none.
    pub tangents: Vec<Tangent>,
    /// What pulls weights on the projected momentum back, one per state, or none.
    projections: Vec<DMatrix<f64>>,
}

impl Path {
    /// Takes the steps of the inputs.
    pub fn follow(
        mut plant: Plant,
        inputs: &Inputs,
        momentum: Momentum,
        constraints: Constraints,
        abandoned: &Abandoned,
    ) -> Result<Self, RegulatorError> {
        let mut linearization = Linearization::new(plant.model());
        let mut path = Self {
            states: Vec::new(),
            samples: Vec::new(),
            tangents: Vec::new(),
            projections: Vec::new(),
        };
        for k in 0..inputs.count() {
            abandoned.check()?;
            path.note_state(&mut plant, momentum, constraints);
            plant
                .step_and_linearize(inputs.get(k), &mut linearization)
                .map_err(|error| RegulatorError::Step { error, steps_taken: Some(k) })?;
            path.samples.push(Sample { a: linearization.a(), b: linearization.b() });
        }
        path.note_state(&mut plant, momentum, constraints);
        Ok(path)
    }

    fn note_state(&mut self, plant: &mut Plant, momentum: Momentum, constraints: Constraints) {
        self.states.push(plant.state());
        self.tangents.extend(constraints.tangent(plant));
        self.projections.extend(projection(momentum, plant));
    }

    /// The regulator along the path, with weights on the momentum that the path was followed for.
    pub fn solve(
        &self,
        weights: &TrajectoryWeights,
        values: Values,
    ) -> Result<FiniteHorizon, RegulatorError> {
        let is_projected = !self.projections.is_empty();
        let pulled = is_projected.then(|| weights.pull_back(&self.projections)).transpose()?;
        let weights = pulled.as_ref().unwrap_or(weights);
        Ok(if self.tangents.is_empty() {
            control::finite_horizon(&self.samples, weights, values)?
        } else {
            let (samples, tangents) = (&self.samples, &self.tangents);
            control::finite_horizon_on_manifold(samples, tangents, weights, values)?
        })
    }
}

/// What a feedback is about.
#[derive(Clone, Debug)]
pub enum Reference {
    /// An operating point of the scene.
    OperatingPoint(String),
    /// A state and an input.
    Point {
        /// State.
        start: Initial,
        /// Input.
        u: Vec<f64>,
    },
    /// A motion.
    Trajectory {
        /// Initial state.
        start: Initial,
        /// Inputs.
        inputs: Inputs,
    },
    /// A gain as it stands.
    Gain(Stage),
}

/// What a feedback's law is computed from.
#[derive(Clone, Debug)]
pub struct Spec {
    /// What it is about.
    pub reference: Reference,
    /// Weights of a regulator about a point.
    pub weights: Option<Weights>,
    /// Weights of one along a trajectory.
    pub trajectory_weights: Option<TrajectoryWeights>,
    /// Which momentum they weigh.
    pub momentum: Momentum,
    /// On which space it is solved.
    pub constraints: Constraints,
    /// Time step for which a trajectory was given, s.
    pub time_step_s: f64,
    /// Along a trajectory: the request, from which all this comes.
    pub given: Option<Origin>,
}

impl Spec {
    /// A gain that was given holds whatever happens to the plant.
    pub fn is_fixed(&self) -> bool {
        matches!(self.reference, Reference::Gain(_))
    }

    /// Computes the law for a model.
    pub fn solve(
        &self,
        model: &Arc<Model>,
        settings: Settings,
        limits: &Limits,
        room: &Arc<Room>,
        abandoned: &Abandoned,
    ) -> Result<Law, RegulatorError> {
        match &self.reference {
            Reference::Gain(stage) => {
                let room = room.reserve(numbers(model, 1, 0))?;
                Ok(Law { stages: vec![stage.clone()], end: None, room })
            }
            Reference::OperatingPoint(name) => {
                let point = at_operating_point(model, settings, name);
                let (plant, u) = point.map_err(refused("point.operating_point"))?;
                self.solve_about(plant, &u, room)
            }
            Reference::Point { start, u } => {
                let spare = Spare::new(Arc::clone(model), settings).map_err(refused("point"))?;
                let plant = spare.start(start).map_err(refused("point"))?;
                self.solve_about(plant, u, room)
            }
            Reference::Trajectory { start, inputs } => {
                if settings.time_step_s != self.time_step_s {
                    let (given_s, present_s) = (self.time_step_s, settings.time_step_s);
                    return Err(RegulatorError::TimeStepChanged { given_s, present_s });
                }
                let missing = || RegulatorError::NoWeights;
                let weights = self.trajectory_weights.as_ref().ok_or_else(missing)?;
                let (steps, stages) = (inputs.count(), weights.steps().unwrap_or(1));
                let momentum = self.momentum;
                Memory { steps, stages, momentum, values: Values::Drop }.check(limits, model)?;
                // The request has the weights once more.
                let room = room.reserve(numbers(model, steps, stages.saturating_mul(2)))?;
                let field = "trajectory.initial";
                let spare = Spare::new(Arc::clone(model), settings).map_err(refused(field))?;
                let plant = spare.start(start).map_err(refused(field))?;
                let path = Path::follow(plant, inputs, momentum, self.constraints, abandoned)?;
                let solution = path.solve(weights, Values::Drop)?;
                let mut feedforward = solution.feedforward.into_iter();
                let mut states = path.states.into_iter().map(|state| state.x());
                let stages = solution.gains.iter().zip(states.by_ref()).enumerate();
                let stages = stages.map(|(k, (gain, x))| Stage {
                    k: row_major(gain),
                    x,
                    u: inputs.get(k).to_vec(),
                    feedforward: feedforward
                        .next()
                        .map(|u| u.as_slice().to_vec())
                        .unwrap_or_default(),
                });
                Ok(Law { stages: stages.collect(), end: states.next(), room })
            }
        }
    }

    fn solve_about(
        &self,
        mut plant: Plant,
        u: &[f64],
        room: &Arc<Room>,
    ) -> Result<Law, RegulatorError> {
        let missing = || RegulatorError::NoWeights;
        let weights = self.weights.as_ref().ok_or_else(missing)?;
        let room = room.reserve(numbers(plant.model(), 1, 1))?;
        let regulator = about_point(&mut plant, u, weights, self.momentum, self.constraints)?;
        let stage = Stage {
            k: row_major(&regulator.gain),
            x: plant.state().x(),
            u: u.to_vec(),
            feedforward: Vec::new(),
        };
        Ok(Law { stages: vec![stage], end: None, room })
    }
}

/// Numbers that a law of so many steps holds, with the weights of so many that it is computed from.
fn numbers(model: &Model, steps: usize, stages: usize) -> usize {
    let d = model.dimensions();
    let (nx, nu) = (d.state(), d.input());
    let weights = stages.saturating_mul(stage_numbers(model)).saturating_add(nx * nx);
    steps.saturating_mul(nx * nu + nx + 4 * nu).saturating_add(weights + nx)
}
