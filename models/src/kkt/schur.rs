//! The matrix of the constraints: S = A1 K⁻¹ A0ᵀ.

use crate::constraints::closure::Closure;
use crate::math::pivoted_lu::PivotedLu;
use crate::math::rows::padded;
use crate::model::mechanism::Model;

/// Writes `A X` for the constraint Jacobian `A` of `closure` and `X`, row-major, nd by padded nc.
pub(crate) fn fill_schur(model: &Model, closure: &Closure, x: &[f64], schur: &mut PivotedLu) {
    let (n, nc) = (model.dimensions.coordinates(), model.dimensions.constraints);
    let stride = padded(nc);
    for (c, constraint) in model.constraints.iter().enumerate() {
        let target = &mut schur.matrix[c * nc..][..nc];
        target.fill(0.0);
        for &i in constraint.dynamic_coordinates() {
            let entry = closure.jacobian[c * n + i];
            for (t, x) in target.iter_mut().zip(&x[i * stride..]) {
                *t += entry * x;
            }
        }
    }
}

/// Room for `S` of a model, each row with its weight, and for solutions of rows `stride` apart.
pub(crate) fn room_for_schur(model: &Model, stride: usize) -> PivotedLu {
    PivotedLu::new(&model.conditioning.weight, stride).with_independent(model.constraint_rank())
}
