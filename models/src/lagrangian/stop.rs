//! One-sided springs and dampers at the ends of a range, of a coordinate or of the length of a path.
//!
//! At a depth `x` beyond the range, with `t = x / transition` and `δ = transition`,
//!
//! ```text
//! V = k δ² G(t)    V' = k δ F(t)    V'' = k w(t)    c = d w(t)
//! w = t³ (10 − 15 t + 6 t²),  F = t⁴ (5/2 − 3 t + t²),   G = t⁵ (1/2 − t/2 + t²/7)     t < 1
//! w = 1,                      F = t − 1/2,               G = t²/2 − t/2 + 1/7          t ≥ 1
//! ```
//!
//! `G' = F`, `F' = w`, and `w` is twice continuously differentiable; `c` is the resistance of the damper.

use plantd_math::scalar::Scalar;

use crate::model::mechanism::Stop;

impl Stop {
    /// `t`, and the sign of the way out of the range.
    fn depth<S: Scalar>(&self, s: S) -> (S, f64) {
        let [low, high] = self.range;
        let inverse = 1.0 / self.transition;
        if s.value() > high {
            ((s - high) * inverse, 1.0)
        } else if s.value() < low {
            ((s - low) * -inverse, -1.0)
        } else {
            (S::ZERO, 1.0)
        }
    }

    /// `V`, J.
    pub(crate) fn energy<S: Scalar>(&self, s: S) -> S {
        let (t, _) = self.depth(s);
        let square = t * t;
        let g = if t.value() < 1.0 {
            square * square * t * (square * (1.0 / 7.0) - t * 0.5 + 0.5)
        } else {
            square * 0.5 - t * 0.5 + 1.0 / 7.0
        };
        g * (self.stiffness * self.transition * self.transition)
    }

    /// `V'` by `s`.
    pub(crate) fn slope<S: Scalar>(&self, s: S) -> S {
        let (t, sign) = self.depth(s);
        let square = t * t;
        let f = if t.value() < 1.0 { square * square * (square - t * 3.0 + 2.5) } else { t - 0.5 };
        f * (sign * self.stiffness * self.transition)
    }

    /// `V''` by `s`.
    pub(crate) fn curvature<S: Scalar>(&self, s: S) -> S {
        self.share(s).0 * self.stiffness
    }

    /// `c` and its derivative by `s`.
    pub(crate) fn resistance<S: Scalar>(&self, s: S) -> (S, S) {
        let (w, slope) = self.share(s);
        (w * self.damping, slope * self.damping)
    }

    /// Bounds of `w` and of its first two derivatives, near `s`.
    pub(crate) fn steepness(&self, s: f64) -> [f64; 3] {
        let ([low, high], inverse) = (self.range, 1.0 / self.transition);
        if s > low + self.transition && s < high - self.transition {
            return [0.0; 3];
        }
        // 30 t² (1 − t)² is largest at ½, and its derivative at (1 − 1/√3)/2.
        [1.0, 1.875 * inverse, 10.0 / 3.0_f64.sqrt() * inverse * inverse]
    }

    /// `w`, and its derivative by `s`.
    fn share<S: Scalar>(&self, s: S) -> (S, S) {
        let (t, sign) = self.depth(s);
        if t.value() >= 1.0 {
            return (S::ONE, S::ZERO);
        }
        let rest = S::ONE - t;
        let w = t * t * t * (t * t * 6.0 - t * 15.0 + 10.0);
        (w, t * t * rest * rest * (30.0 * sign / self.transition))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use plantd_math::scalar::Dual;

    const STOP: Stop = Stop { range: [-1.0, 2.0], stiffness: 7.0, damping: 3.0, transition: 0.5 };

    /// Each is the derivative of the one before, and continuous where the pieces meet.
    #[test]
    fn derivatives_are_those_of_the_energy_and_continuous() {
        for s in [-2.1, -1.4, -1.001, 0.3, 2.2, 2.499, 2.6] {
            let x = Dual::new(s, 1.0);
            let resistance = STOP.resistance(x);
            for (found, expected) in [
                (STOP.energy(x).eps, STOP.slope(s)),
                (STOP.slope(x).eps, STOP.curvature(s)),
                (resistance.0.eps, STOP.resistance(s).1),
            ] {
                assert!((found - expected).abs() < 1e-13, "{s}: {found} {expected}");
            }
        }
        for s in [-1.5, -1.0, 2.0, 2.5] {
            let at = |s: f64| {
                let [x, y] =
                    [STOP.curvature(Dual::new(s, 1.0)), STOP.resistance(Dual::new(s, 1.0)).1];
                [STOP.energy(s), STOP.slope(s), x.re, x.eps, y.re, y.eps]
            };
            for (before, behind) in at(s - 1e-9).into_iter().zip(at(s + 1e-9)) {
                assert!((before - behind).abs() < 1e-5, "{s}: {before} {behind}");
            }
        }
    }

    /// Far beyond the range it is a linear spring about half the transition, which pushes back.
    #[test]
    fn beyond_its_transition_it_is_a_linear_spring() {
        assert!((STOP.slope(4.0) - 7.0 * (2.0 - 0.25)).abs() < 1e-14);
        assert!((STOP.slope(-3.0) + 7.0 * (2.0 - 0.25)).abs() < 1e-14);
        assert_eq!((STOP.slope(0.5), STOP.energy(0.5), STOP.resistance(0.5).0), (0.0, 0.0, 0.0));
        assert_eq!(STOP.resistance(4.0), (3.0, 0.0));
    }
}
