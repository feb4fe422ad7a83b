//! Analysis of the discrete map and linear-quadratic control on it, `x[k+1] = A x[k] + B u[k]`.
//!
//! The cost is `Σ ½ xᵀQx + xᵀSu + ½ uᵀRu`, with `½ xᵀ Q_f x` at the end of a finite horizon, and the
//! feedback law is `u = u_ref − K (x − x_ref)`.
//!
//! | question | answer |
//! | --- | --- |
//! | gains along a trajectory | [`finite_horizon`], [`finite_horizon_on_manifold`] |
//! | a regulator about an equilibrium | [`infinite_horizon`], [`infinite_horizon_on_manifold`] |
//! | a filter for noisy outputs | [`steady_state_kalman`], [`steady_state_kalman_on_manifold`] |
//! | filters along a trajectory | [`time_varying_kalman`], [`time_varying_kalman_on_manifold`] |
//! | directions that a constrained system can move in | [`Tangent`], [`tangent_basis`] |
//! | what the inputs reach, what the outputs show | [`controllability_rank`], [`observability_rank`] |
//! | how the map moves by itself | [`modes`] |
//! | how it answers a sinusoid | [`TransferFunction`] |
//!
//! Read `finite_horizon` first, then `infinite_horizon`; filters (`kalman`) are their duals. Under the first, and
//! under trajectory optimisation, is the recursion `lq`. A tangent space makes the same problem one on the
//! manifold of the constraints: `coordinates` has the maps between both.
//!
//! Everything here allocates and may take milliseconds to seconds: it belongs on a worker, never
//! on a control path. Costs are given in flops of `n` states and `m` inputs.

mod controllability;
mod coordinates;
mod doubling;
mod error;
mod finite_horizon;
mod frequency;
mod infinite_horizon;
mod kalman;
mod lq;
mod manifold;
mod matrix;
mod modes;
mod noise;
pub mod optimize;
pub mod reference;
mod spectrum;
mod weights;

pub use crate::controllability::{controllability_rank, observability_rank};
pub use crate::error::{AnalysisError, RiccatiError};
pub use crate::finite_horizon::{
    FiniteHorizon, Sample, Values, finite_horizon, finite_horizon_on_manifold,
};
pub use crate::frequency::TransferFunction;
pub use crate::infinite_horizon::{Regulator, infinite_horizon, infinite_horizon_on_manifold};
pub use crate::kalman::{
    Kalman, KalmanTrajectory, steady_state_kalman, steady_state_kalman_on_manifold,
    time_varying_kalman, time_varying_kalman_on_manifold,
};
pub use crate::manifold::Tangent;
pub use crate::modes::{Mode, modes};
pub use crate::noise::{KalmanError, NoiseCovariances, NoiseError};
pub use crate::spectrum::spectral_radius;
pub use crate::weights::error::WeightsError;
pub use crate::weights::{Momentum, StageWeights, TrajectoryWeights, Weights};
pub use plantd_math::null_space::tangent_basis;
