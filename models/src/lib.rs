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

pub mod builtin;
mod compile;
mod continuous;
pub mod control;
mod cost;
mod elimination;
mod loops;
mod model;
pub mod optimize;
mod planar;
mod plant;
pub mod reference;
mod rotation;
#[allow(dead_code, reason = "derivatives of second order use all of it")]
mod scalar;
pub mod scene;
mod signal;
mod spatial;
mod spline;
mod tree;
mod trigonometry;
mod wide;

pub use continuous::{
    Accelerations, Continuous, ContinuousError, ContinuousLinearization, ContinuousPoint,
};
pub use cost::StageCost;
pub use model::{Coordinate, Dimensions, Model, OperatingPoint, Violation};
pub use plant::{
    Choice, ChoiceError, Contraction, Diagnostics, Energy, Equilibrium, ErrorEstimate, ForceSplit,
    HALVINGS_MAX, Initial, InitialError, Linearization, Plant, Pose, Precision, SUBSTEPS_MAX,
    SecondOrder, Settings, SettleError, SettleRequest, Site, Snapshot, SnapshotError, Spare, State,
    StepError, StepReport, TooLarge,
};
pub use scene::{Problem, Scene, SceneError};
