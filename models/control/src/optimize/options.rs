//! How to search.

use crate::optimize::error::OptimizeError;
use crate::weights::Weights;

/// Which quadratic model of the cost gives the direction of descent; see the [module](super).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// Identity in place of second derivatives, but for those of bounds.
    Steepest,
    /// Second derivatives of the cost, first derivatives of the map.
    QuasiNewton,
    /// Second derivatives of the cost and of the map.
    #[default]
    Newton,
}

/// How to search.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Method.
    pub method: Method,
    /// Method of the first iterations; none means `method`.
    pub first_method: Option<Method>,
    /// How many iterations use it.
    pub first_iterations: u32,
    /// Iterations at most; 200.
    pub max_iterations: u32,
    /// Directional derivative at which the search has converged; none means 1e-9 times the cost with
    /// which it began.
    pub tolerance: Option<f64>,
    /// `α` of Armijo's rule, between 0 and 1; 1e-5.
    pub alpha: f64,
    /// `β` of Armijo's rule, between 0 and 1; 0.7.
    pub beta: f64,
    /// Shortenings of a step at most; 30.
    pub max_backtracks: u32,
    /// Looks for a step from the one of the iteration before: fewer trials where steps are short again
    /// and again. Misses a longer one beyond steps that fail. False.
    pub near_last_step: bool,
    /// Weights of a regulator to project with, of its own; none means the law of the descent.
    pub projection: Option<Weights>,
    /// Error of a bound, in the unit of its entry, that counts as none; 1e-6.
    pub bound_tolerance: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            method: Method::default(),
            first_method: None,
            first_iterations: 0,
            max_iterations: 200,
            tolerance: None,
            alpha: 1e-5,
            beta: 0.7,
            max_backtracks: 30,
            near_last_step: false,
            projection: None,
            bound_tolerance: 1e-6,
        }
    }
}

impl Options {
    /// Refuses numbers that are out of their range.
    pub(super) fn check(&self) -> Result<(), OptimizeError> {
        let fraction = |value: f64| value > 0.0 && value < 1.0;
        let finite = |value: f64| value >= 0.0 && value.is_finite();
        let tolerance = self.tolerance.unwrap_or(0.0);
        let checks = [
            ("alpha", self.alpha, fraction(self.alpha), "between 0 and 1"),
            ("beta", self.beta, fraction(self.beta), "between 0 and 1"),
            ("tolerance", tolerance, finite(tolerance), "finite and not less than zero"),
            (
                "bound_tolerance",
                self.bound_tolerance,
                finite(self.bound_tolerance) && self.bound_tolerance > 0.0,
                "finite and greater than zero",
            ),
            (
                "max_iterations",
                f64::from(self.max_iterations),
                self.max_iterations > 0,
                "greater than zero",
            ),
        ];
        match checks.into_iter().find(|(_, _, good, _)| !good) {
            Some((name, value, _, range)) => Err(OptimizeError::Option { name, value, range }),
            None => Ok(()),
        }
    }
}
