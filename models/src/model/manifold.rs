//! The configuration manifold: sums and differences of configurations, with the rotations of ball joints.

use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Mat3, three};

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
        let mut moved = vec![0.0; n];
        retract(&self.orientations, q, change, 1.0, &mut moved);
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
        difference(&self.orientations, reference, q, change);
    }

    /// [`Model::difference`] of whole states, `x ⊖ reference`.
    ///
    /// # Panics
    ///
    /// If a state ends within an orientation.
    pub fn write_state_difference(&self, reference: &[f64], x: &[f64], change: &mut [f64]) {
        difference(&self.orientations, reference, x, change);
    }

    /// [`Model::retract`] of whole states, by `length` times `change`.
    ///
    /// # Panics
    ///
    /// If a state ends within an orientation.
    pub fn write_state_retraction(&self, x: &[f64], change: &[f64], length: f64, out: &mut [f64]) {
        retract(&self.orientations, x, change, length, out);
    }
}

/// `x ⊖ reference`, of configurations or whole states, as far as `out` goes; `orientations` are the first
/// coordinates of ball joints.
pub(crate) fn difference(orientations: &[usize], reference: &[f64], x: &[f64], out: &mut [f64]) {
    for (out, (x, r)) in out.iter_mut().zip(x.iter().zip(reference)) {
        *out = x - r;
    }
    for &i in orientations {
        let Some(out) = out.get_mut(i..i + 3) else { continue };
        let from = Quaternion::exp(three(reference, i)).inverse();
        out.copy_from_slice(&from.times(Quaternion::exp(three(x, i))).log().0);
    }
}

/// `x` moved by `length · change`, of configurations or whole states.
pub(crate) fn retract(
    orientations: &[usize],
    x: &[f64],
    change: &[f64],
    length: f64,
    out: &mut [f64],
) {
    for (out, (x, change)) in out.iter_mut().zip(x.iter().zip(change)) {
        *out = x + length * change;
    }
    for &i in orientations {
        let turn = Quaternion::exp(three(change, i) * length);
        out[i..i + 3].copy_from_slice(&Quaternion::exp(three(x, i)).times(turn).log().0);
    }
}
