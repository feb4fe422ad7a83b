//! The directions of a plant's state in which it can move.

use nalgebra::DMatrix;
use plantd_control::Tangent;
use plantd_models::Plant;

use crate::core::feedback::regulator::Constraints;

/// The directions of the state that count.
pub enum Space {
    /// All of them.
    Full,
    /// Those on the constraints.
    Manifold {
        /// In which the plant can be moved.
        moving: Tangent,
        /// In which it moves by itself.
        free: Tangent,
    },
}

impl Space {
    /// Those of a plant at its state.
    pub fn new(plant: &mut Plant, constraints: Constraints) -> Self {
        if constraints == Constraints::Full {
            return Self::Full;
        }
        let dynamic = plant.model().dimensions().dynamic;
        let jacobian = plant.constraint_jacobian();
        Self::Manifold {
            moving: Tangent::new(&jacobian, dynamic),
            free: Tangent::held(&jacobian, dynamic),
        }
    }

    /// A on the directions in which the plant moves by itself.
    pub fn free(&self, a: &DMatrix<f64>) -> DMatrix<f64> {
        match self {
            Self::Full => a.clone(),
            Self::Manifold { free, .. } => free.restrict_map(a),
        }
    }

    /// A map on the directions in which it can be moved.
    pub fn moving_map(&self, map: &DMatrix<f64>) -> DMatrix<f64> {
        match self {
            Self::Full => map.clone(),
            Self::Manifold { moving, .. } => moving.restrict_map(map),
        }
    }

    /// A, B, C on the directions in which it can be moved.
    pub fn moving(
        &self,
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        c: &DMatrix<f64>,
    ) -> (DMatrix<f64>, DMatrix<f64>, DMatrix<f64>) {
        match self {
            Self::Full => (a.clone(), b.clone(), c.clone()),
            Self::Manifold { moving, .. } => {
                (self.moving_map(a), moving.reduce(b), c * moving.basis())
            }
        }
    }
}
