//! The Schur complement of `K` in the KKT system: `S = A1 K⁻¹ A0ᵀ`.

use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::padded;
use plantd_math::tree_lu::TreeLu;

use crate::constraints::closure::Closure;
use crate::kkt::closing::Closing;
use crate::model::mechanism::Model;

/// `S`, factored, with what it is made of.
#[derive(Clone, Debug)]
pub(crate) struct SchurComplement {
    /// `K⁻¹ A0ᵀ`, row-major, nd by padded nc.
    pub(crate) responses: Vec<f64>,
    pub(crate) lu: PivotedLu,
    /// A row of the Jacobian, of dynamic coordinates.
    row: Vec<f64>,
}

impl SchurComplement {
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let d = model.dimensions;
        let responses = vec![0.0; d.dynamic * padded(d.constraints)];
        Self { responses, lu: room_for_schur(model, stride), row: vec![0.0; d.dynamic] }
    }

    /// Room for products.
    pub(crate) fn new_closing(model: &Model) -> Closing {
        let d = model.dimensions;
        Closing::new(d.dynamic, 2 * d.coordinates(), room_for_schur(model, 1), d.constraints)
    }

    /// Finds `K⁻¹ A0ᵀ` with what solves, and the Jacobian at the start.
    pub(crate) fn respond(
        &mut self,
        model: &Model,
        start: &Closure,
        mut solve: impl FnMut(&mut [f64]),
    ) {
        let (n, nc) = (model.dimensions.coordinates(), model.dimensions.constraints);
        let Self { responses, row, .. } = self;
        for c in 0..nc {
            let jacobian = &start.jacobian[c * n..];
            row.copy_from_slice(&jacobian[..model.dimensions.dynamic]);
            solve(row);
            let column = responses.iter_mut().skip(c).step_by(padded(nc));
            column.zip(&*row).for_each(|(response, x)| *response = *x);
        }
    }

    /// The same by a tree LU.
    pub(crate) fn respond_by_tree(&mut self, model: &Model, tree: &mut TreeLu, start: &Closure) {
        let (n, nc) = (model.dimensions.coordinates(), model.dimensions.constraints);
        let stride = padded(nc);
        for i in 0..model.dimensions.dynamic {
            for c in 0..nc {
                self.responses[i * stride + c] = start.jacobian[c * n + i];
            }
        }
        tree.solve_rows(&model.elimination, &mut self.responses, stride, stride);
    }

    /// Factors `S` by `K⁻¹ A0ᵀ`, with the Jacobian at the end.
    pub(crate) fn factor(&mut self, model: &Model, end: &Closure) {
        fill_schur(model, end, &self.responses, &mut self.lu);
        self.lu.factor();
    }

    /// From `K⁻¹ r1` in `x` and `r2` in `lambda`: `dλ = S⁻¹ (A1 K⁻¹ r1 − r2)` and `K⁻¹ (r1 − A0ᵀ dλ)`.
    pub(crate) fn close(
        &mut self,
        model: &Model,
        end: &Closure,
        x: &mut [f64],
        lambda: &mut [f64],
    ) {
        let n = model.dimensions.coordinates();
        for (c, constraint) in model.constraints.iter().enumerate() {
            let row = &end.jacobian[c * n..][..n];
            let mut value = -lambda[c];
            for &i in constraint.dynamic_coordinates() {
                value += row[i] * x[i];
            }
            lambda[c] = value;
        }
        self.lu.solve(lambda);
        self.subtract_responses(lambda, x);
    }

    /// `x −= K⁻¹ A0ᵀ λ`.
    pub(crate) fn subtract_responses(&self, lambda: &[f64], x: &mut [f64]) {
        let stride = padded(lambda.len());
        for (i, x) in x.iter_mut().enumerate() {
            for (response, lambda) in self.responses[i * stride..].iter().zip(lambda) {
                *x -= response * lambda;
            }
        }
    }
}

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
