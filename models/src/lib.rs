//! The mechanics of plantd: scenes, models, the midpoint variational integrator, its exact
//! linearization, and linear-quadratic control on it.
//!
//! ```text
//! Scene (what a person writes) --compile--> Model (immutable, shared)
//!                                             |
//!                              Plant { Arc<Model>, state, workspace }
//!                                             |
//!                    step(u) -> StepReport      linearize(u) -> Linearization
//! ```
//!
//! A step solves the forced, constrained discrete Euler-Lagrange equations of Johnson, Schultz and
//! Murphey, "Structured Linearization of Discrete Mechanical Systems for Analysis and Optimal
//! Control" (IEEE T-ASE 12(1), 2015). Units are SI, angles are radians.

// The mechanics does not log.
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod compile;
mod constraints;
mod continuous;
pub mod drawing;
mod integrator;
mod kkt;
mod lagrangian;
mod linearization;
mod model;
pub mod parameters;
mod plant;

pub use plantd_scene as scene;
pub use plantd_scene::builtin;

pub use crate::compile::cost::StageCost;
pub use crate::continuous::kinematics::{CenterOfMass, FrameMotion, FramePoint, Kinematics};
pub use crate::continuous::terms::{InverseDynamics, Terms};
pub use crate::continuous::{
    Accelerations, Continuous, ContinuousError, ContinuousLinearization, ContinuousPoint,
};
pub use crate::integrator::report::{StepError, StepReport};
pub use crate::integrator::settings::{
    ForceSplit, HALVINGS_MAX, Precision, SUBSTEPS_MAX, Settings,
};
pub use crate::integrator::state::State;
pub use crate::lagrangian::energy::Energy;
pub use crate::linearization::derivative::StepDerivative;
pub use crate::linearization::linearize::Linearization;
pub use crate::linearization::matrices::Layout;
pub use crate::linearization::second_order::contraction::Contraction;
pub use crate::linearization::second_order::tensors::{SecondOrder, TooLarge};
pub use crate::model::mechanism::{Coordinate, Dimensions, Model, OperatingPoint, Violation};
pub use crate::model::site::Site;
pub use crate::plant::choice::{Choice, ChoiceError, ErrorEstimate};
pub use crate::plant::diagnose::Diagnostics;
pub use crate::plant::facade::Plant;
pub use crate::plant::fleet::Fleet;
pub use crate::plant::initial::{Initial, InitialError};
pub use crate::plant::known::KnownStep;
pub use crate::plant::settle::{Equilibrium, SettleError, SettleRequest};
pub use crate::plant::site::Pose;
pub use crate::plant::snapshot::{Snapshot, SnapshotError};
pub use crate::plant::spare::Spare;
pub use crate::plant::targets::Target;
pub use plantd_math::hash::fnv1a;
pub use plantd_scene::{Problem, Scene, SceneError};
