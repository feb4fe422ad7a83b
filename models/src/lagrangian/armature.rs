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

use crate::model::mechanism::{Armatures, Model, SumArmature};

/// What is added to the mass matrix in the row and the column of two dynamic coordinates, or of one; the entry mirrored
/// is another one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub(crate) row: usize,
    pub(crate) column: usize,
    pub(crate) inertia: f64,
}

impl Armatures {
    /// What they add to the mass matrix, to some of its entries more than once.
    pub(crate) fn entries(&self) -> impl Iterator<Item = Entry> {
        let own = self.own.iter().map(|&(i, inertia)| Entry { row: i, column: i, inertia });
        own.chain(self.sums.iter().flat_map(SumArmature::entries))
    }

    /// Adds what they make of velocities to `L_v`.
    pub(crate) fn add_momentum<S: Scalar>(&self, velocity: &[S], l_v: &mut [S]) {
        for &(i, inertia) in &self.own {
            l_v[i] += velocity[i] * inertia;
        }
        for sum in &self.sums {
            let momentum = sum.rate(velocity) * sum.inertia;
            sum.terms.iter().for_each(|&(i, c)| l_v[i] += momentum * c);
        }
    }

    /// Twice their kinetic energy, J.
    pub(crate) fn twice_kinetic_energy(&self, velocity: &[f64]) -> f64 {
        let own = self.own.iter().map(|&(i, inertia)| inertia * velocity[i].powi(2));
        let sums = self.sums.iter().map(|sum| sum.inertia * sum.rate(velocity).powi(2));
        own.sum::<f64>() + sums.sum::<f64>()
    }
}

impl Entry {
    /// Adds so many times it to a matrix.
    #[inline]
    pub(crate) fn add_to<S: Compared>(self, matrix: &mut TreeLu<S>, model: &Model, times: f64) {
        let Self { row, column, inertia } = self;
        let added = S::constant(times * inertia);
        if row == column {
            matrix.add_to_diagonal(model.elimination.diagonal(row), added);
        } else {
            matrix.add(&model.elimination, row, column, added);
        }
    }
}

impl SumArmature {
    /// `Σ c_i v_i`
    fn rate<S: Scalar>(&self, velocity: &[S]) -> S {
        self.terms.iter().fold(S::ZERO, |sum, &(i, c)| sum + velocity[i] * c)
    }

    fn entries(&self) -> impl Iterator<Item = Entry> {
        self.terms.iter().flat_map(move |&(row, a)| {
            let inertia = self.inertia * a;
            self.terms.iter().map(move |&(column, b)| Entry { row, column, inertia: inertia * b })
        })
    }
}
