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

pub(crate) mod controllability;
pub(crate) mod coordinates;
pub(crate) mod doubling;
pub(crate) mod error;
pub(crate) mod finite_horizon;
pub(crate) mod frequency;
pub(crate) mod infinite_horizon;
pub(crate) mod kalman;
pub(crate) mod lq;
pub(crate) mod manifold;
pub(crate) mod matrix;
pub(crate) mod modes;
pub(crate) mod noise;
pub(crate) mod spectrum;
pub(crate) mod weights;

pub use crate::control::controllability::{controllability_rank, observability_rank};
pub use crate::control::error::{AnalysisError, RiccatiError};
pub use crate::control::finite_horizon::{
    FiniteHorizon, Sample, Values, finite_horizon, finite_horizon_on_manifold,
};
pub use crate::control::frequency::TransferFunction;
pub use crate::control::infinite_horizon::{
    Regulator, infinite_horizon, infinite_horizon_on_manifold,
};
pub use crate::control::kalman::{
    Kalman, KalmanTrajectory, steady_state_kalman, steady_state_kalman_on_manifold,
    time_varying_kalman, time_varying_kalman_on_manifold,
};
pub use crate::control::manifold::Tangent;
pub use crate::control::modes::{Mode, modes};
pub use crate::control::noise::{KalmanError, NoiseCovariances, NoiseError};
pub use crate::control::spectrum::spectral_radius;
pub use crate::control::weights::error::WeightsError;
pub use crate::control::weights::{Momentum, StageWeights, TrajectoryWeights, Weights};
pub use crate::math::null_space::tangent_basis;
