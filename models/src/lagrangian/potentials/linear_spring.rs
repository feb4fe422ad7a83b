//! A spring on a sum of coordinates.
//!
//! ```text
//! V = ½ k s²    V_i = k s c_i    V_ij = k c_i c_j    s = Σ c_i q_i − rest
//! ```

use plantd_math::scalar::Scalar;

use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::potentials::Potential;
use crate::lagrangian::ties::{Tie, Ties};
use crate::model::mechanism::{LinearSpring, PointPair};

impl LinearSpring {
    /// `s`.
    fn stretch<S: Scalar>(&self, q: &[S]) -> S {
        self.terms.iter().fold(S::constant(-self.rest), |sum, &(i, c)| sum + q[i] * c)
    }
}

impl Tie for LinearSpring {
    fn segments(&self) -> &[PointPair] {
        &[]
    }

    fn rows(&self) -> usize {
        1
    }

    fn tie(&self, _: &Instant<'_>, out: &mut Ties) {
        out.add_sum(&self.terms, [-self.stiffness, 0.0]);
    }
}

impl Potential for LinearSpring {
    const NEEDS_POSES: bool = false;

    fn couples(&self) -> Vec<usize> {
        self.terms.iter().map(|&(i, _)| i).collect()
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        let stretch = self.stretch(at.q);
        stretch * stretch * (0.5 * self.stiffness)
    }

    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        let tension = self.stretch(at.q) * self.stiffness;
        for &(i, c) in &self.terms {
            if let Some(entry) = l_q.get_mut(i) {
                *entry -= tension * c;
            }
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        _: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        for &(i, row) in &self.terms {
            for &(j, column) in &self.terms {
                entry(i, j, S::constant(self.stiffness * row * column));
            }
        }
    }

    fn third_derivative(&self, _: Place<'_, f64>) -> f64 {
        0.0
    }
}
