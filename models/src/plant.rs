//! Plants: a model with a state and a workspace.

use std::sync::Arc;

use nalgebra::DMatrix;

use crate::Model;

/// How a plant is stepped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Time step `h`, s; finite and greater than zero.
    pub time_step_s: f64,
    /// How forces are split between the ends of a step.
    pub force_split: ForceSplit,
    /// Corrections before a step is given up.
    pub max_iterations: u32,
}

impl Settings {
    /// The model's time step, symmetric split, 40 iterations.
    pub fn new(_model: &Model) -> Self {
        unimplemented!()
    }
}

/// How the force impulse of a step is split into `F⁻` and `F⁺`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ForceSplit {
    /// `F⁻ = F⁺ = ½ h f`: second order.
    #[default]
    Symmetric,
    /// `F⁻ = h f`, `F⁺ = 0`, as in the paper: first order with forcing.
    Paper,
}

/// How a state is given.
#[derive(Clone, Debug, PartialEq)]
pub enum Initial {
    /// The scene's initial configuration, at rest.
    Scene,
    /// A named operating point, at rest with its input.
    OperatingPoint(String),
    /// Configuration `q` (nd + nk), momentum `p` (nd), velocity of prescribed coordinates `v` (nk).
    Momentum { q: Vec<f64>, p: Vec<f64>, v: Vec<f64> },
    /// Configuration and velocity, both nd + nk: `p = M(q) v`.
    Velocity { q: Vec<f64>, v: Vec<f64> },
    /// Two configurations one time step apart, no input forces: `p = D2 Ld(q0, q1) + F⁺`. The plant
    /// starts at the second.
    TwoConfigurations { q0: Vec<f64>, q1: Vec<f64> },
    /// A guess that Newton's method projects onto the constraints; named coordinates and prescribed
    /// ones keep their value. The plant starts there at rest.
    Projection { q: Vec<f64>, hold: Vec<String> },
}

/// Why a state was refused. The plant is as it was.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InitialError {
    /// A vector has the wrong length.
    #[error("{name} has {actual} entries; {expected} are needed")]
    Dimension { name: &'static str, expected: usize, actual: usize },
    /// A number is NaN or infinite.
    #[error("{name}[{index}] is {value}")]
    NotFinite { name: &'static str, index: usize, value: f64 },
    /// No operating point or coordinate of that name.
    #[error("there is no {kind} `{name}`")]
    Unknown { kind: &'static str, name: String },
    /// The configuration violates a constraint by more than 1e-6 relative.
    #[error("constraint `{constraint}` is violated by {violation:e}")]
    OffConstraint { constraint: String, violation: f64 },
    /// The projection found no configuration that satisfies the constraints.
    #[error("no configuration found near the guess; constraint `{constraint}` stays violated by {violation:e}")]
    Projection { constraint: String, violation: f64 },
    /// A time step or an iteration limit is out of range.
    #[error("{name} is {value}; it must be finite and greater than zero")]
    Settings { name: &'static str, value: f64 },
}

/// A state, by value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Steps since the plant was initialised.
    pub step: u64,
    /// Configuration, nd + nk.
    pub q: Vec<f64>,
    /// Momentum, nd.
    pub p: Vec<f64>,
    /// Velocity of prescribed coordinates over the last step, nk.
    pub v: Vec<f64>,
    /// Constraint impulses of the last step, nc; zero before the first.
    pub multipliers: Vec<f64>,
}

impl State {
    /// `x = (q, p, v)`.
    pub fn x(&self) -> Vec<f64> {
        [&self.q[..], &self.p, &self.v].concat()
    }
}

/// What the solver did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Residual evaluations, each followed by one correction.
    pub iterations: u32,
    /// Factorizations of the Newton matrix.
    pub factorizations: u32,
    /// Final residual in units of its own round-off.
    pub residual: f64,
    /// Final constraint violation in units of its own round-off.
    pub constraint_residual: f64,
    /// Smallest pivot of the Newton matrix relative to its largest entry.
    pub reciprocal_condition: f64,
}

/// Why a step failed. The plant is as it was.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// The input has the wrong length.
    #[error("the input has {actual} entries; {expected} are needed")]
    Dimension { expected: usize, actual: usize },
    /// An entry of the input is NaN or infinite.
    #[error("input {index} (`{name}`) is {value}")]
    InputNotFinite { index: usize, name: String, value: f64 },
    /// Newton's method did not reach the round-off level.
    #[error("no convergence after {iterations} iterations: residual is {residual:e} times round-off; the step may be too large for the motion")]
    NotConverged { iterations: u32, residual: f64 },
    /// The iteration left the finite numbers.
    #[error("the motion left the finite numbers after {iterations} iterations")]
    NotFinite { iterations: u32 },
    /// The Newton matrix is singular.
    #[error("singular Newton matrix at coordinate `{coordinate}` (pivot {pivot:e} of the largest entry)")]
    Singular { coordinate: String, pivot: f64 },
}

/// Kinetic and potential energy, J.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    /// `T(q, v)`.
    pub kinetic_j: f64,
    /// Gravity and springs.
    pub potential_j: f64,
}

/// The exact first-order linearization of one step, preallocated.
#[derive(Clone, Debug)]
pub struct Linearization {}

impl Linearization {
    /// Room for the linearization of a model.
    pub fn new(_model: &Model) -> Self {
        unimplemented!()
    }
    /// `A = ∂f/∂x`, square of `2 nd + 2 nk`; its `v` columns are zero.
    pub fn a(&self) -> DMatrix<f64> {
        unimplemented!()
    }
    /// `B = ∂f/∂u`, `2 nd + 2 nk` by `ni + nk`.
    pub fn b(&self) -> DMatrix<f64> {
        unimplemented!()
    }
    /// `∂λ/∂x`, nc by `2 nd + 2 nk`.
    pub fn multipliers_x(&self) -> DMatrix<f64> {
        unimplemented!()
    }
    /// `∂λ/∂u`, nc by `ni + nk`.
    pub fn multipliers_u(&self) -> DMatrix<f64> {
        unimplemented!()
    }
}

/// Everything a plant needs to go on bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {}

/// Why a snapshot was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// Not a snapshot, cut short, or damaged.
    #[error("not a snapshot: {0}")]
    Malformed(&'static str),
    /// Taken from another model, or with other settings.
    #[error("the snapshot was taken from another {0}")]
    Mismatch(&'static str),
}

impl Snapshot {
    /// Encodes (versioned, little-endian, with a checksum).
    pub fn to_bytes(&self) -> Vec<u8> {
        unimplemented!()
    }
    /// Decodes.
    pub fn from_bytes(_bytes: &[u8]) -> Result<Self, SnapshotError> {
        unimplemented!()
    }
}

/// A plant: the discrete map `x[k+1] = f(x[k], u[k])` with its state.
///
/// After construction [`Plant::step`] and [`Plant::linearize`] allocate nothing, take no lock, do no
/// input or output, and do not panic.
#[derive(Clone, Debug)]
pub struct Plant {}

impl Plant {
    /// A plant in the scene's initial configuration, at rest.
    pub fn new(_model: Arc<Model>, _settings: Settings) -> Result<Self, InitialError> {
        unimplemented!()
    }
    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        unimplemented!()
    }
    /// The settings.
    pub fn settings(&self) -> &Settings {
        unimplemented!()
    }
    /// Puts the plant into a state, step 0.
    pub fn initialize(&mut self, _initial: &Initial) -> Result<(), InitialError> {
        unimplemented!()
    }
    /// Takes one step with `u = (inputs, next prescribed positions)`.
    pub fn step(&mut self, _u: &[f64]) -> Result<StepReport, StepError> {
        unimplemented!()
    }
    /// Linearizes the map at the current state and `u`, and stays there.
    pub fn linearize(&mut self, _u: &[f64], _out: &mut Linearization) -> Result<StepReport, StepError> {
        unimplemented!()
    }
    /// Takes one step and linearizes it from the step's own factorization.
    pub fn step_and_linearize(
        &mut self,
        _u: &[f64],
        _out: &mut Linearization,
    ) -> Result<StepReport, StepError> {
        unimplemented!()
    }
    /// Writes the input that exerts no force and leaves prescribed coordinates where they are.
    pub fn hold_input(&self, _u: &mut [f64]) {
        unimplemented!()
    }
    /// Steps since the plant was initialised.
    pub fn step_index(&self) -> u64 {
        unimplemented!()
    }
    /// `step_index × h`, s.
    pub fn time_s(&self) -> f64 {
        unimplemented!()
    }
    /// Configuration, nd + nk.
    pub fn q(&self) -> &[f64] {
        unimplemented!()
    }
    /// Momentum, nd (the paper's: not projected onto the constraints).
    pub fn p(&self) -> &[f64] {
        unimplemented!()
    }
    /// Velocity of prescribed coordinates over the last step, nk.
    pub fn v(&self) -> &[f64] {
        unimplemented!()
    }
    /// Constraint impulses of the last step, nc.
    pub fn multipliers(&self) -> &[f64] {
        unimplemented!()
    }
    /// The state by value (allocates).
    pub fn state(&self) -> State {
        unimplemented!()
    }
    /// Constraint Jacobian `Dh` at the current configuration, nc by nd + nk (allocates).
    pub fn constraint_jacobian(&mut self) -> DMatrix<f64> {
        unimplemented!()
    }
    /// Velocity `q̇` (nd + nk) that belongs to the projected momentum (allocates).
    pub fn velocity(&mut self) -> Vec<f64> {
        unimplemented!()
    }
    /// Energy of the state, with the projected momentum.
    pub fn energy(&mut self) -> Energy {
        unimplemented!()
    }
    /// Takes a snapshot.
    pub fn snapshot(&self) -> Snapshot {
        unimplemented!()
    }
    /// Restores a snapshot of a plant of the same model and settings.
    pub fn restore(&mut self, _snapshot: &Snapshot) -> Result<(), SnapshotError> {
        unimplemented!()
    }
}
