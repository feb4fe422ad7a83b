//! What a problem is made of.

use nalgebra::DMatrix;

use crate::weights::{Momentum, TrajectoryWeights};

/// What a trajectory costs; see the [module](super).
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryCost {
    /// Row k is the desired `x[k]`: n + 1 rows of `2 nd + 2 nk`. It need not be a motion of the plant.
    pub x: DMatrix<f64>,
    /// Row k is the desired `u[k]`: n rows of `ni + nk`.
    pub u: DMatrix<f64>,
    /// Weights, constant or one set per step. They need only be convex together with the map.
    pub weights: TrajectoryWeights,
    /// Which momentum they weigh.
    pub momentum: Momentum,
}

/// Bounds of single entries.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bounds {
    /// Of entries of `x` at steps 1 to n.
    pub states: Vec<Bound>,
    /// Of entries of `u` at steps 0 to n − 1.
    pub inputs: Vec<Bound>,
    /// Of entries of `x[n]`.
    pub final_state: Vec<Bound>,
}

/// Bounds of one entry; at least one end is given, and equal ends fix it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bound {
    /// Index of the entry in `x` or `u`.
    pub index: usize,
    /// Smallest value.
    pub min: Option<f64>,
    /// Largest value.
    pub max: Option<f64>,
}

/// An initial state that is free to move on the constraints.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FreeInitialState {
    /// Indices of the entries of `x` that may change; empty means all.
    pub entries: Vec<usize>,
    /// Weight `W` of `½ dxᵀ W dx`, `dx = x[0] ⊖` the initial state of the guess; symmetric positive
    /// semidefinite, square of `2 nd + 2 nk`. None means zero.
    pub weight: Option<DMatrix<f64>>,
}
