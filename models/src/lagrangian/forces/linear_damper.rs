//! Forces against the rate `s = Σ c_j v_j` of a sum of coordinates.
//!
//! ```text
//! f_i = −c_i g(s)    ∂f_i/∂v_j = −g' c_i c_j    ∂f_i/∂u = −c_i ∂g/∂u
//! damper    g = d u s                    g' = d u    u is an input, or 1
//! friction  g = force tanh(s / velocity)    g' = force / velocity (1 − tanh²)
//! ```

use plantd_math::scalar::Scalar;

use crate::lagrangian::forces::GeneralizedForce;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::ties::{Tie, Ties};
use crate::model::mechanism::{LinearDamper, LinearLaw, PointPair};

/// A bound of the second derivative of `tanh`.
pub(super) const FRICTION_CURVE: f64 = 0.77;

/// `force tanh(s / velocity)` and its slope.
pub(super) fn friction<S: Scalar>(force: f64, velocity: f64, rate: S) -> (S, S) {
    let t = (rate * (1.0 / velocity)).tanh();
    (t * force, (S::ONE - t * t) * (force / velocity))
}

impl LinearDamper {
    /// `s`
    fn rate<S: Scalar>(&self, at: &Instant<'_, S>) -> S {
        self.terms.iter().fold(S::ZERO, |sum, &(j, c)| sum + at.velocity[j] * c)
    }

    /// `g` and `g'`
    fn resistance<S: Scalar>(&self, at: &Instant<'_, S>) -> (S, S) {
        let rate = self.rate(at);
        match self.law {
            LinearLaw::Damper { damping, input } => {
                let damping = match input {
                    Some(input) => at.inputs[input] * damping,
                    None => S::constant(damping),
                };
                (rate * damping, damping)
            }
            LinearLaw::Friction { force, velocity } => friction(force, velocity, rate),
        }
    }
}

impl Tie for LinearDamper {
    fn segments(&self) -> &[PointPair] {
        &[]
    }

    fn rows(&self) -> usize {
        1
    }

    fn tie(&self, at: &Instant<'_>, out: &mut Ties) {
        let (_, slope) = self.resistance(at);
        out.add_sum(&self.terms, [0.0, -slope]);
    }
}

impl GeneralizedForce for LinearDamper {
    fn couples(&self) -> Vec<usize> {
        self.terms.iter().map(|&(i, _)| i).collect()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let (resistance, _) = self.resistance(at);
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
        let (_, slope) = self.resistance(at);
        for &(i, row) in &self.terms {
            for &(j, column) in &self.terms {
                entry(i, j, S::ZERO, slope * (-row * column));
            }
        }
    }

    fn second_derivative(&self, _: &Instant<'_>, [_, faster]: [f64; 2]) -> f64 {
        let LinearLaw::Friction { force, velocity } = self.law else { return 0.0 };
        let most = self.terms.iter().fold(0.0_f64, |most, (_, c)| most.max(c.abs()));
        force * FRICTION_CURVE * most * (most * faster / velocity).powi(2)
    }

    fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let LinearLaw::Damper { damping, input: Some(input) } = self.law else { return };
        let rate = self.rate(at);
        for &(i, c) in &self.terms {
            entry(i, input, rate * (-damping * c));
        }
    }
}
