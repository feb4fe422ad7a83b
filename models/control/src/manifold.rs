//! The directions in which a constrained system moves.
//!
//! The state is `x = (q_d, q_k, p, v)`. Of all directions `dx` at a state with `h(q) = 0`, two kinds
//! carry no dynamics:
//!
//! - **off the manifold**: a step ends with `h = 0` whatever it starts from, so the configurations
//!   that occur satisfy `Dh_d dq_d + Dh_k dq_k = 0`. Prescribed coordinates take part: pulling a
//!   string moves what hangs on it.
//! - **gauge**: the momentum enters a step as `p − Dh_dᵀ λ` alone, so `Dh_dᵀ μ` added to it is
//!   absorbed by the multipliers and changes nothing.
//!
//! What is left has the orthonormal basis `T = diag(N, Z, I)` with `N = null [Dh_d Dh_k]` for the
//! configuration, `Z = null Dh_d` for the momentum (one representative of each class modulo gauge),
//! and the identity for `v`. With `ξ = Tᵀ dx` the map is exactly
//!
//! ```text
//! ξ[k+1] = (T₁ᵀ A T₀) ξ[k] + (T₁ᵀ B) du[k]
//! ```
//!
//! because `A` and `B` map into the manifold of the next state up to gauge, which the step after
//! ignores: `A = A T₀T₀ᵀ` on everything that can occur. A gain for `ξ` acts on the full state as
//! `K = K_ξ Tᵀ`, blind to gauge and to errors off the manifold.

use nalgebra::DMatrix;
use plantd_math::null_space::tangent_basis;

use crate::error::RiccatiError;

/// The tangent space of the constraint manifold at a state, modulo momentum gauge.
#[derive(Clone, Debug, PartialEq)]
pub struct Tangent {
    basis: DMatrix<f64>,
    pub(super) transpose: DMatrix<f64>,
}

impl Tangent {
    /// The tangent space where the constraint Jacobian is `dh`, constraints × (`dynamic` +
    /// prescribed coordinates).
    ///
    /// # Panics
    /// If `dh` has fewer than `dynamic` columns.
    pub fn new(dh: &DMatrix<f64>, dynamic: usize) -> Self {
        let coordinates = dh.ncols();
        let configuration = tangent_basis(dh);
        let momentum = tangent_basis(&dh.columns(0, dynamic).into_owned());
        let prescribed = coordinates - dynamic;
        let (nq, np) = (configuration.ncols(), momentum.ncols());
        let mut basis = DMatrix::zeros(2 * coordinates, nq + np + prescribed);
        basis.view_mut((0, 0), (coordinates, nq)).copy_from(&configuration);
        basis.view_mut((coordinates, nq), (dynamic, np)).copy_from(&momentum);
        for i in 0..prescribed {
            basis[(coordinates + dynamic + i, nq + np + i)] = 1.0;
        }
        Self { transpose: basis.transpose(), basis }
    }

    /// What moves by itself while the prescribed coordinates are held: `T = diag([Z; 0], Z, 0)`. The modes
    /// of a map are those of `Tᵀ A T`.
    ///
    /// # Panics
    /// If `dh` has fewer than `dynamic` columns.
    pub fn held(dh: &DMatrix<f64>, dynamic: usize) -> Self {
        let free = tangent_basis(&dh.columns(0, dynamic).into_owned());
        let (coordinates, directions) = (dh.ncols(), free.ncols());
        let mut basis = DMatrix::zeros(2 * coordinates, 2 * directions);
        basis.view_mut((0, 0), (dynamic, directions)).copy_from(&free);
        basis.view_mut((coordinates, directions), (dynamic, directions)).copy_from(&free);
        Self { transpose: basis.transpose(), basis }
    }

    /// `T`, states × dimension, orthonormal columns.
    pub fn basis(&self) -> &DMatrix<f64> {
        &self.basis
    }
    /// Number of independent directions.
    pub fn dimension(&self) -> usize {
        self.basis.ncols()
    }
    /// `Tᵀ m`: from a difference of states to its coordinates in the tangent space.
    pub fn reduce(&self, m: &DMatrix<f64>) -> DMatrix<f64> {
        &self.transpose * m
    }
    /// `Tᵀ a T`: a map on the tangent space.
    pub fn restrict_map(&self, a: &DMatrix<f64>) -> DMatrix<f64> {
        self.reduce(a) * &self.basis
    }

    pub(super) fn check(&self, sample: usize, states: usize) -> Result<(), RiccatiError> {
        RiccatiError::check_shape("T", sample, &self.basis, (states, self.basis.ncols()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_null_basis(dh: &DMatrix<f64>, columns: usize) {
        let basis = tangent_basis(dh);
        assert_eq!(basis.shape(), (dh.ncols(), columns));
        let gram = basis.transpose() * &basis;
        assert!((gram - DMatrix::identity(columns, columns)).amax() < 1e-14);
        for row in dh.row_iter() {
            assert!((row * &basis).amax() <= 1e-14 * row.norm());
        }
    }

    #[test]
    fn the_basis_is_orthonormal_and_spans_the_null_space() {
        let dh = DMatrix::from_row_slice(2, 4, &[1.0, 2.0, 0.0, -1.0, 0.5, 0.0, 3.0, 1.0]);
        assert_null_basis(&dh, 2);
        assert_null_basis(&DMatrix::zeros(0, 3), 3);
        assert_null_basis(&DMatrix::identity(3, 3), 0);
    }

    #[test]
    fn redundant_badly_scaled_and_empty_constraints_are_recognised() {
        let row = [1.0, 2.0, 0.0, -1.0];
        let mut dh = DMatrix::zeros(4, 4);
        for (col, value) in row.into_iter().enumerate() {
            dh[(0, col)] = value;
            dh[(1, col)] = -1e7 * value;
        }
        dh[(3, 2)] = 1e-9;
        assert_null_basis(&dh, 2);
    }

    #[test]
    fn more_constraints_than_coordinates() {
        let dh = DMatrix::from_row_slice(3, 2, &[1.0, 1.0, 2.0, 2.0, -1.0, -1.0]);
        assert_null_basis(&dh, 1);
    }

    #[test]
    fn prescribed_coordinates_move_what_hangs_on_them() {
        // One dynamic coordinate on a string of prescribed length: q_d = q_k.
        let tangent = Tangent::new(&DMatrix::from_row_slice(1, 2, &[1.0, -1.0]), 1);
        // One joint direction of the configuration, no free momentum, one velocity.
        assert_eq!(tangent.basis().shape(), (4, 2));
        let dx = DMatrix::from_column_slice(4, 1, &[0.5, 0.5, 0.0, 0.2]);
        assert!((tangent.basis() * tangent.reduce(&dx) - dx).amax() < 1e-15);
    }
}
