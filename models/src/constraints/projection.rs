//! The projection onto the constraints: Newton's method with a correction of the caller's choice.
//!
//! ```text
//! A dq = −h(q)      A: the columns of Dh(q) that may move      q ← q ⊕ dq
//! ```
//!
//! Corrections have least norm, each caller's by its own inner product.

use plantd_math::norms::larger;

use crate::constraints::closure::Closure;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;

/// When a projection ends.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Corrections before it is given up.
    pub(crate) corrections: usize,
    /// Violations that are small enough, in units of round-off.
    pub(crate) enough: f64,
    /// Violations that are small enough where a correction did not halve them.
    pub(crate) floor: f64,
    /// No correction moves a coordinate by more than this, m or rad.
    pub(crate) longest: f64,
    /// A correction shorter than this leads nowhere, m or rad.
    pub(crate) shortest: f64,
    /// The round-off of the coordinates is taken from the Jacobian at hand, not from the one before.
    pub(crate) round_off_is_fresh: bool,
}

/// Where corrections towards the constraints lead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reached {
    Satisfied,
    /// To where no correction reduces the violation.
    Violated,
    /// Nowhere.
    Lost,
}

/// Corrects `q`; returns the sum of all corrections, too. `correction` finds one, nd or nd + nk entries,
/// from values and Jacobian. Leaves these at the last configuration that was corrected.
pub(crate) fn project(
    model: &Model,
    closure: &mut Closure,
    q: &mut Vec<f64>,
    limits: &Limits,
    mut correction: impl FnMut(&Closure) -> Option<Vec<f64>>,
) -> (Reached, Vec<f64>) {
    let (mut total, mut best) = (vec![0.0; q.len()], f64::INFINITY);
    for _ in 0..limits.corrections {
        let turned = orientations(model, q);
        closure.evaluate(model, q, &turned);
        closure.differentiate(model, q);
        if limits.round_off_is_fresh {
            closure.evaluate(model, q, &turned);
        }
        let violation = closure.violation();
        if violation <= limits.enough || (violation <= limits.floor && violation >= 0.5 * best) {
            return (Reached::Satisfied, total);
        }
        best = best.min(violation);
        let Some(mut step) = correction(closure) else { return (Reached::Lost, total) };
        step.resize(q.len(), 0.0);
        let longest = step.iter().copied().fold(0.0, larger);
        if !longest.is_finite() {
            return (Reached::Lost, total);
        }
        if longest < limits.shortest {
            return (Reached::Violated, total);
        }
        if longest > limits.longest {
            let scale = limits.longest / longest;
            step.iter_mut().for_each(|x| *x *= scale);
        }
        *q = model.retract(q, &step);
        total.iter_mut().zip(&step).for_each(|(total, x)| *total += x);
    }
    (Reached::Lost, total)
}

impl Model {
    /// Name and value of the equation that is violated most, in units of round-off.
    pub(crate) fn worst_equation(&self, closure: &Closure) -> (String, f64) {
        let relative = |c: &usize| (closure.value[*c] / closure.round_off[*c]).abs();
        let worst = (0..closure.value.len())
            .max_by(|a, b| relative(a).total_cmp(&relative(b)))
            .unwrap_or_default();
        (self.constraint_names[worst].clone(), closure.value[worst])
    }
}
