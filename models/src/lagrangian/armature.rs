//! Armature: inertia of what a coordinate alone moves, such as a geared rotor, or a sum of coordinates.
//!
//! ```text
//! T += ½ a (Σ c_i v_i)²    (L_v)_i += a c_i Σ c_j v_j    (L_vv)_ij += a c_i c_j
//! ```
//!
//! `v` is a coordinate's velocity; of a ball joint that is a component of the angular velocity in its own
//! axes.

use plantd_math::scalar::{Compared, Scalar};
use plantd_math::tree_lu::TreeLu;

use crate::model::mechanism::{Armature, Model};

/// Adds what they make of velocities to `L_v`.
pub(crate) fn add_momentum<S: Scalar>(armature: &[Armature], velocity: &[S], l_v: &mut [S]) {
    for &Armature { row, column, inertia } in armature {
        l_v[row] += velocity[column] * inertia;
    }
}

/// Twice their kinetic energy, J.
pub(crate) fn twice_kinetic_energy(armature: &[Armature], velocity: &[f64]) -> f64 {
    let entry = |a: &Armature| a.inertia * velocity[a.row] * velocity[a.column];
    armature.iter().map(entry).sum()
}

/// Adds so many times an entry to a matrix.
#[inline]
pub(crate) fn add_to<S: Compared>(
    matrix: &mut TreeLu<S>,
    model: &Model,
    entry: &Armature,
    times: f64,
) {
    let &Armature { row, column, inertia } = entry;
    let added = S::constant(times * inertia);
    if row == column {
        matrix.add_to_diagonal(model.elimination.diagonal(row), added);
    } else {
        matrix.add(&model.elimination, row, column, added);
    }
}
