//! A damper on a sum of coordinates: `f_i = −d u c_i Σ c_j v_j`, `∂f_i/∂v_j = −d u c_i c_j`,
//! `∂f_i/∂u = −d c_i Σ c_j v_j`; `u` is an input, or 1.

use plantd_math::scalar::Scalar;

use crate::lagrangian::forces::{GeneralizedForce, Instant};
use crate::model::mechanism::LinearDamper;

impl LinearDamper {
    /// `Σ c_j v_j`
    fn rate<S: Scalar>(&self, at: &Instant<'_, S>) -> S {
        self.terms.iter().fold(S::ZERO, |sum, &(j, c)| sum + at.velocity[j] * c)
    }

    /// `d u`
    fn damping<S: Scalar>(&self, at: &Instant<'_, S>) -> S {
        match self.input {
            Some(input) => at.inputs[input] * self.damping,
            None => S::constant(self.damping),
        }
    }
}

impl GeneralizedForce for LinearDamper {
    fn couples(&self) -> Vec<usize> {
        self.terms.iter().map(|&(i, _)| i).collect()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let resistance = self.rate(at) * self.damping(at);
        for &(i, c) in &self.terms {
            if let Some(entry) = force.get_mut(i) {
                *entry -= resistance * c;
            }
        }
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        let damping = self.damping(at);
        for &(i, row) in &self.terms {
            for &(j, column) in &self.terms {
                entry(i, j, S::ZERO, damping * (-row * column));
            }
        }
    }

    fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let Some(input) = self.input else { return };
        let rate = self.rate(at);
        for &(i, c) in &self.terms {
            entry(i, input, rate * (-self.damping * c));
        }
    }
}
