//! A sum of polynomials of coordinates.
//!
//! ```text
//! h = Σ c_jk q_j^k + c    h_j = Σ k c_jk q_j^(k−1)    h_jj = Σ k (k − 1) c_jk q_j^(k−2)
//! ```

use plantd_math::scalar::Scalar;

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::Place;
use crate::model::mechanism::{Coupling, Polynomial};

impl Equation for Coupling {
    fn coordinates(&self) -> Vec<usize> {
        self.terms.iter().map(|term| term.coordinate).collect()
    }

    #[inline(never)]
    fn value<S: Scalar>(&self, Place { q, .. }: Place<'_, S>, values: &mut [S]) -> S::Magnitude {
        let (mut value, mut magnitude) =
            (S::constant(self.constant), S::Magnitude::constant(self.constant.abs()));
        for term in &self.terms {
            let term = term.value(q);
            value += term;
            magnitude += term.magnitude();
        }
        values[0] = value;
        magnitude
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { q, .. }: Place<'_, S>, row: &mut [S]) {
        for term in &self.terms {
            row[term.coordinate] += term.slope(q);
        }
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { q, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        for term in &self.terms {
            entry(term.coordinate, term.coordinate, term.curvature(q));
        }
    }
}

impl Polynomial {
    fn value<S: Scalar>(&self, q: &[S]) -> S {
        let q = q[self.coordinate];
        self.coefficients.iter().rev().fold(S::ZERO, |sum, c| (sum + *c) * q)
    }

    fn slope<S: Scalar>(&self, q: &[S]) -> S {
        let q = q[self.coordinate];
        let terms = self.coefficients.iter().enumerate().rev();
        terms.fold(S::ZERO, |sum, (k, c)| sum * q + c * (k + 1) as f64)
    }

    fn curvature<S: Scalar>(&self, q: &[S]) -> S {
        let q = q[self.coordinate];
        let terms = self.coefficients.iter().enumerate().skip(1).rev();
        terms.fold(S::ZERO, |sum, (k, c)| sum * q + c * (k * (k + 1)) as f64)
    }
}
