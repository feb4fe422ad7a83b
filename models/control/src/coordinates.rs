//! The coordinates of a state that a problem is solved in.

use std::borrow::Cow;

use nalgebra::{DMatrix, DVector};

use crate::error::RiccatiError;
use crate::manifold::Tangent;
use crate::matrix::{congruent, symmetrize};

/// Those of the tangent space `T` at the state; without one those of the state itself, `T = I`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Coordinates<'a>(pub(super) Option<&'a Tangent>);

impl Coordinates<'_> {
    /// How many there are, of `n` states.
    pub(super) fn dimension(self, n: usize) -> usize {
        self.0.map_or(n, Tangent::dimension)
    }

    /// Refuses a tangent space of another number of states.
    pub(super) fn check(self, sample: usize, n: usize) -> Result<(), RiccatiError> {
        self.0.map_or(Ok(()), |tangent| tangent.check(sample, n))
    }

    /// `T₁ᵀ A T`: a map from these coordinates to others.
    pub(super) fn map<'m>(self, next: Self, a: &'m DMatrix<f64>) -> Cow<'m, DMatrix<f64>> {
        self.columns(next.reduce(a))
    }

    /// `Tᵀ m`.
    pub(super) fn reduce<'m>(self, m: &'m DMatrix<f64>) -> Cow<'m, DMatrix<f64>> {
        self.0.map_or(Cow::Borrowed(m), |tangent| Cow::Owned(tangent.reduce(m)))
    }

    /// `Tᵀ v`.
    pub(super) fn reduce_vector<'m>(self, v: &'m DVector<f64>) -> Cow<'m, DVector<f64>> {
        self.0.map_or(Cow::Borrowed(v), |tangent| Cow::Owned(&tangent.transpose * v))
    }

    /// `m T`.
    pub(super) fn columns<'m>(self, m: Cow<'m, DMatrix<f64>>) -> Cow<'m, DMatrix<f64>> {
        match self.0 {
            None => m,
            Some(tangent) => Cow::Owned(m.as_ref() * tangent.basis()),
        }
    }

    /// `Tᵀ q T`: a weight, or a covariance.
    pub(super) fn restrict<'m>(self, q: &'m DMatrix<f64>) -> Cow<'m, DMatrix<f64>> {
        let Some(tangent) = self.0 else { return Cow::Borrowed(q) };
        let mut restricted = tangent.restrict_map(q);
        symmetrize(&mut restricted);
        Cow::Owned(restricted)
    }

    /// `T m`.
    pub(super) fn extend(self, m: &DMatrix<f64>) -> DMatrix<f64> {
        self.0.map_or_else(|| m.clone(), |tangent| tangent.basis() * m)
    }

    /// `T v`.
    pub(super) fn extend_vector(self, v: &DVector<f64>) -> DVector<f64> {
        self.0.map_or_else(|| v.clone(), |tangent| tangent.basis() * v)
    }

    /// `K Tᵀ`: a gain on the full state.
    pub(super) fn extend_gain(self, gain: &DMatrix<f64>) -> DMatrix<f64> {
        self.0.map_or_else(|| gain.clone(), |tangent| gain * &tangent.transpose)
    }

    /// `T P Tᵀ`: a cost to go, or a covariance, of the full state.
    pub(super) fn extend_value(self, value: &DMatrix<f64>) -> DMatrix<f64> {
        self.0.map_or_else(|| value.clone(), |tangent| congruent(&tangent.transpose, value))
    }
}
