//! Forces on coordinates that follow from their velocities, and of stops from their positions.

use plantd_math::scalar::Scalar;

use crate::lagrangian::forces::GeneralizedForce;
use crate::lagrangian::forces::linear_damper::FRICTION_CURVE;
use crate::lagrangian::instant::Instant;
use crate::model::mechanism::{CoordinateForce, CoordinateLaw};

impl GeneralizedForce for CoordinateForce {
    fn couples(&self) -> Vec<usize> {
        vec![self.coordinate]
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let v = at.velocity[self.coordinate];
        force[self.coordinate] += match self.law {
            CoordinateLaw::Drag([c, d]) => (magnitude(v) * -d - c) * magnitude(v) * v,
            CoordinateLaw::Friction { force, velocity } => (v * (1.0 / velocity)).tanh() * -force,
            CoordinateLaw::Stop(stop) => -(stop.resistance(at.q[self.coordinate]).0 * v),
            CoordinateLaw::Constant(force) => S::constant(force),
        };
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        let v = at.velocity[self.coordinate];
        let mut by_q = S::ZERO;
        let by_v = match self.law {
            CoordinateLaw::Constant(_) => S::ZERO,
            CoordinateLaw::Stop(stop) => {
                let (c, by_position) = stop.resistance(at.q[self.coordinate]);
                by_q = -(by_position * v);
                -c
            }
            CoordinateLaw::Drag([c, d]) => (magnitude(v) * (-3.0 * d) - 2.0 * c) * magnitude(v),
            CoordinateLaw::Friction { force, velocity } => {
                let t = (v * (1.0 / velocity)).tanh();
                (S::ONE - t * t) * (-force / velocity)
            }
        };
        entry(self.coordinate, self.coordinate, by_q, by_v);
    }

    fn second_derivative(&self, at: &Instant<'_>, [moved, faster]: [f64; 2]) -> f64 {
        let speed = at.velocity[self.coordinate].abs();
        match self.law {
            CoordinateLaw::Constant(_) => 0.0,
            CoordinateLaw::Drag([c, d]) => (2.0 * c + 6.0 * d * speed) * faster * faster,
            CoordinateLaw::Friction { force, velocity } => {
                force * FRICTION_CURVE * (faster / velocity).powi(2)
            }
            CoordinateLaw::Stop(stop) => {
                let [_, rising, bent] = stop.steepness(at.q[self.coordinate]);
                stop.damping * moved * (bent * moved * speed + 2.0 * rising * faster)
            }
        }
    }
}

/// `|v|`; its derivative at zero is that of the right side.
fn magnitude<S: Scalar>(v: S) -> S {
    if v.value() < 0.0 { -v } else { v }
}
