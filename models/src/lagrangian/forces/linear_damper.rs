//! A damper on a sum of coordinates: `f_i = −d c_i Σ c_j v_j`, `∂f_i/∂v_j = −d c_i c_j`.

use plantd_math::scalar::Scalar;

use crate::lagrangian::forces::{GeneralizedForce, Instant};
use crate::model::mechanism::LinearDamper;

impl GeneralizedForce for LinearDamper {
    fn couples(&self) -> Vec<usize> {
        self.terms.iter().map(|&(i, _)| i).collect()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let rate = self.terms.iter().fold(S::ZERO, |sum, &(j, c)| sum + at.velocity[j] * c);
        for &(i, c) in &self.terms {
            if let Some(entry) = force.get_mut(i) {
                *entry -= rate * (self.damping * c);
            }
        }
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        _: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        for &(i, row) in &self.terms {
            for &(j, column) in &self.terms {
                entry(i, j, S::ZERO, S::constant(-self.damping * row * column));
            }
        }
    }
}
