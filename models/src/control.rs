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
//! Everything here allocates and may take milliseconds to seconds: it belongs on a worker, never
//! on a control path. Costs are given in flops of `n` states and `m` inputs.

pub(crate) mod controllability;
pub(crate) mod doubling;
pub(crate) mod error;
pub(crate) mod finite_horizon;
pub(crate) mod frequency;
pub(crate) mod infinite_horizon;
pub(crate) mod kalman;
pub(crate) mod lq;
pub(crate) mod manifold;
pub(crate) mod modes;
pub(crate) mod spectrum;
pub(crate) mod weights;

pub use crate::math::null_space::tangent_basis;
pub use controllability::{controllability_rank, observability_rank};
pub use error::{AnalysisError, RiccatiError};
pub use finite_horizon::{
    FiniteHorizon, Sample, Values, finite_horizon, finite_horizon_on_manifold,
};
pub use frequency::TransferFunction;
pub use infinite_horizon::{Regulator, infinite_horizon, infinite_horizon_on_manifold};
pub use kalman::{
    Kalman, KalmanError, KalmanTrajectory, NoiseCovariances, NoiseError, steady_state_kalman,
    steady_state_kalman_on_manifold, time_varying_kalman, time_varying_kalman_on_manifold,
};
pub use manifold::Tangent;
pub use modes::{Mode, modes};
pub use spectrum::spectral_radius;
pub use weights::{Momentum, StageWeights, TrajectoryWeights, Weights, WeightsError};

use nalgebra::DMatrix;

/// Replaces a matrix that is symmetric but for round-off by its symmetric part.
pub(crate) fn symmetrize(m: &mut DMatrix<f64>) {
    for column in 0..m.ncols() {
        for row in 0..column {
            let mean = 0.5 * (m[(row, column)] + m[(column, row)]);
            m[(row, column)] = mean;
            m[(column, row)] = mean;
        }
    }
}

/// `m ≥ 0` up to round-off: `m` shifted by `1e-12` of its largest diagonal entry has a Cholesky
/// factor.
fn is_positive_semidefinite(m: &DMatrix<f64>) -> bool {
    let largest = m.diagonal().amax();
    if largest == 0.0 {
        return m.iter().all(|&entry| entry == 0.0);
    }
    let mut shifted = m / largest;
    for i in 0..m.nrows() {
        shifted[(i, i)] += 1e-12;
    }
    shifted.cholesky().is_some()
}

fn all_finite(m: &DMatrix<f64>) -> bool {
    // Without a branch per entry: products with zero are zero, or NaN.
    let (blocks, rest) = m.as_slice().as_chunks::<8>();
    let mut sums = [0.0; 8];
    for block in blocks {
        for (sum, entry) in sums.iter_mut().zip(block) {
            *sum += 0.0 * entry;
        }
    }
    sums.iter().all(|&sum| sum == 0.0) && rest.iter().all(|entry| entry.is_finite())
}
