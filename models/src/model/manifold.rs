//! The configuration manifold: sums and differences of configurations, with the rotations of ball joints.

use crate::math::rotation::Quaternion;
use crate::math::spatial::{Mat3, three};
use crate::model::mechanism::Model;

/// Orientations of all ball joints at `q`.
pub(crate) fn orientations(model: &Model, q: &[f64]) -> Vec<Mat3> {
    let matrix = |&i: &usize| Quaternion::exp(three(q, i)).matrix();
    model.orientations.iter().map(matrix).collect()
}

impl Model {
    /// The configuration that lies `change` beyond `q`: sums, and for ball joints the rotation vector of
    /// `exp(q) exp(change)`.
    ///
    /// # Panics
    ///
    /// If a length is not nd + nk.
    pub fn retract(&self, q: &[f64], change: &[f64]) -> Vec<f64> {
        let n = self.dimensions.coordinates();
        assert!(q.len() == n && change.len() == n, "a configuration has {n} coordinates");
        let mut moved: Vec<f64> = q.iter().zip(change).map(|(q, change)| q + change).collect();
        for &i in &self.orientations {
            let turned = Quaternion::exp(three(q, i)).times(Quaternion::exp(three(change, i)));
            moved[i..i + 3].copy_from_slice(&turned.log().0);
        }
        moved
    }

    /// What [`Model::retract`] takes from `reference` to `q`: differences, and for ball joints the
    /// rotation vector of `exp(reference)⁻¹ exp(q)`. A feedback `u = u_ref − K (x ⊖ x_ref)` needs it.
    ///
    /// # Panics
    ///
    /// If a length is not nd + nk.
    pub fn difference(&self, reference: &[f64], q: &[f64]) -> Vec<f64> {
        let mut change = vec![0.0; self.dimensions.coordinates()];
        self.write_difference(reference, q, &mut change);
        change
    }

    /// [`Model::difference`] without allocation.
    ///
    /// # Panics
    ///
    /// If a length is not nd + nk.
    pub fn write_difference(&self, reference: &[f64], q: &[f64], change: &mut [f64]) {
        let n = self.dimensions.coordinates();
        assert!(
            q.len() == n && reference.len() == n && change.len() == n,
            "a configuration has {n} coordinates"
        );
        for (change, (q, r)) in change.iter_mut().zip(q.iter().zip(reference)) {
            *change = q - r;
        }
        for &i in &self.orientations {
            let turned =
                Quaternion::exp(three(reference, i)).inverse().times(Quaternion::exp(three(q, i)));
            change[i..i + 3].copy_from_slice(&turned.log().0);
        }
    }
}
