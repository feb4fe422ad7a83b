//! Weighted second derivatives of collocation, and of periods of several steps.

use plantd_math::rows::{Term, add_product, add_rows};
use plantd_math::scalar::Dual;

use crate::integrator::report::StepError;
use crate::linearization::linearize::{Linearization, Part, StageTangents};
use crate::linearization::second_order::contraction::Contraction;
use crate::model::mechanism::Model;

/// `sum += leftᵀ right`, all with rows of `stride` numbers.
fn add_transposed_product(
    sum: &mut [f64],
    left: &[f64],
    right: &[f64],
    stride: usize,
    terms: &mut Vec<Term>,
) {
    for (a, row) in sum.chunks_exact_mut(stride).enumerate() {
        let column = left.iter().skip(a).step_by(stride).copied();
        add_product(row, right, stride, column, terms);
    }
}

impl Contraction {
    /// The sum over the steps of a period: with the tangent `T_j` of the parameters of step `j`, and the
    /// weights `z_j = A_jᵀ z_j+1 + (∂λ_j/∂x_j)ᵀ w` of where it begins,
    ///
    /// ```text
    /// G = Σ T_jᵀ G_j T_j
    /// ```
    pub(super) fn contract_period(
        &mut self,
        model: &Model,
        parts: &[Part],
        weights_x: &[f64],
        weights_multipliers: &[f64],
    ) -> Result<(), StepError> {
        let layout = self.scratch.layout;
        let (stride, size, n, nd) = (layout.stride, layout.count(), layout.n(), layout.nd);
        let rows = size * stride;
        let [mut total, mut tangent, mut product] = [0; 3].map(|_| vec![0.0; rows]);
        let mut z = nalgebra::DVector::from_column_slice(weights_x);
        let w = nalgebra::DVector::from_column_slice(weights_multipliers);
        for part in parts.iter().rev() {
            // What is prescribed is linear in the parameters.
            z.rows_mut(nd, n - nd).fill(0.0);
            z.rows_mut(n + nd, n - nd).fill(0.0);
            self.contract_step(model, &part.step, z.as_slice(), weights_multipliers)?;
            self.quadratic.mirror();
            tangent.fill(0.0);
            let moving = layout.inputs() * stride;
            tangent[..moving].copy_from_slice(&part.tangent[..moving]);
            for input in layout.inputs()..layout.next() {
                tangent[input * stride + input] = 1.0;
            }
            tangent[layout.next() * stride..].copy_from_slice(&part.tangent[moving..]);
            let terms = &mut self.scratch.terms;
            product.fill(0.0);
            for (source, row) in
                self.quadratic.sum.chunks_exact(stride).zip(product.chunks_exact_mut(stride))
            {
                add_product(row, &tangent, stride, source[..size].iter().copied(), terms);
            }
            add_transposed_product(&mut total, &tangent, &product, stride, terms);
            z = part.step.a().tr_mul(&z) + part.step.multipliers_x().tr_mul(&w);
        }
        self.quadratic.sum[..rows].copy_from_slice(&total);
        Ok(())
    }

    /// The sum for a step of collocation. With the adjoint `μ = −(∂R/∂Y)⁻ᵀ (z_x + (Σ ∂P/∂Y)ᵀ z_p)` and
    /// the weights `w_j = z_p + Σ_i μ_ij μ_i` of the impulses, stage `j` contributes the derivative of the
    /// Hessian of `L` along `(h_j w_j, −μ_j)`, and of its forces what `h_j w_j` weighs.
    pub(super) fn contract_stages(&mut self, model: &Model, stages: &StageTangents, z: &[f64]) {
        let layout = self.scratch.layout;
        let (nd, n, ni, stride) = (layout.nd, layout.n(), layout.ni, layout.stride);
        let (size, count) = (layout.count(), stages.weights.len());
        let z_p = &z[n..][..nd];
        let mut adjoint = vec![0.0; count * nd];
        for (k, mu) in adjoint.iter_mut().enumerate() {
            let slopes = z_p.iter().enumerate().map(|(a, z)| z * stages.slopes[a * count * nd + k]);
            *mu = -(z[k / count] + slopes.sum::<f64>());
        }
        stages.matrix.solve_transposed(&mut adjoint);

        self.quadratic.clear();
        let [mut tangent, mut product] = [0; 2].map(|_| vec![0.0; 2 * n * stride]);
        for j in 0..count {
            let length = stages.weights[j] * stages.time_step_s;
            self.place_tangent(stages, j, &mut tangent);
            let weight = |a: usize| {
                let coupled = |i: usize| stages.coupling[i * count + j] * adjoint[a * count + i];
                length * (z_p[a] + (0..count).map(coupled).sum::<f64>())
            };
            let weights: Vec<f64> = (0..nd).map(weight).collect();

            let blocks = &mut self.scratch.blocks;
            for i in 0..n {
                let (alpha, beta) =
                    if i < nd { (weights[i], -adjoint[i * count + j]) } else { (0.0, 0.0) };
                blocks.q_mid[i] = Dual::new(stages.q[j * n + i], alpha);
                blocks.velocity[i] = Dual::new(stages.velocity[j * n + i], beta);
            }
            for (i, input) in blocks.inputs.iter_mut().enumerate() {
                *input = Dual::new(stages.inputs[j * ni + i], 0.0);
            }
            blocks.evaluate_mid(model);
            product.fill(0.0);
            let terms = &mut self.scratch.terms;
            for (row, target) in product.chunks_exact_mut(stride).enumerate() {
                let mid = &self.scratch.blocks.mid;
                let hessian = |c: usize| match (row < n, c < n) {
                    (true, true) => mid.l_qq[row * n + c].eps,
                    (true, false) => mid.l_qv[row * n + c - n].eps,
                    (false, true) => mid.l_qv[c * n + row - n].eps,
                    (false, false) => mid.l_vv[(row - n) * n + c - n].eps,
                };
                add_product(target, &tangent, stride, (0..2 * n).map(hessian), terms);
            }
            let sum = &mut self.quadratic.sum[..size * stride];
            add_transposed_product(sum, &tangent, &product, stride, terms);
            if model.forces.is_none() {
                continue;
            }
            for a in 0..size {
                let Self { scratch, quadratic, .. } = self;
                let blocks = &mut scratch.blocks;
                for i in 0..n {
                    let along = |row: usize| tangent[row * stride + a];
                    blocks.q_mid[i] = Dual::new(stages.q[j * n + i], along(i));
                    blocks.velocity[i] = Dual::new(stages.velocity[j * n + i], along(n + i));
                }
                for (i, input) in blocks.inputs.iter_mut().enumerate() {
                    let along = if a == layout.inputs() + i { 1.0 } else { 0.0 };
                    *input = Dual::new(stages.inputs[j * ni + i], along);
                }
                blocks.evaluate_mid(model);
                let mid = &blocks.mid;
                let of = |entries: &[Dual], width: usize, c: usize| -> f64 {
                    weights.iter().enumerate().map(|(i, w)| w * entries[i * width + c].eps).sum()
                };
                let by_midpoint =
                    |c| if c < n { of(&mid.f_q, n, c) } else { of(&mid.f_v, n, c - n) };
                let row = &mut quadratic.sum[a * stride..][..stride];
                for i in 0..ni {
                    row[layout.inputs() + i] += of(&mid.f_u, ni, i);
                }
                let factors = (0..2 * n).map(by_midpoint);
                add_product(row, &tangent, stride, factors, &mut scratch.terms);
            }
        }
    }

    /// Writes the derivatives of `Q_j` and `V_j`, 2 n rows.
    fn place_tangent(&self, stages: &StageTangents, j: usize, tangent: &mut [f64]) {
        let layout = self.scratch.layout;
        let (nd, n, stride) = (layout.nd, layout.n(), layout.stride);
        let count = stages.weights.len();
        let (node, h) = (stages.nodes[j], stages.time_step_s);
        tangent.fill(0.0);
        let (by_q, by_v) = tangent.split_at_mut(n * stride);
        for a in 0..n {
            let (q, v) = (&mut by_q[a * stride..][..stride], &mut by_v[a * stride..][..stride]);
            if a < nd {
                q[a] = 1.0;
                let coupled = (0..count).map(|k| (stages.coupling[j * count + k], a * count + k));
                add_rows(q, &stages.tangent, stride, &coupled.collect::<Vec<_>>());
                let rate = 1.0 / (stages.weights[j] * h);
                add_rows(v, &stages.tangent, stride, &[(rate, a * count + j)]);
            } else {
                let next = layout.next() + a - nd;
                (q[a], q[next]) = (1.0 - node, node);
                (v[a], v[next]) = (-1.0 / h, 1.0 / h);
            }
        }
    }

    /// Contracts a step or a period, without handing the sum out.
    pub(super) fn contract_any(
        &mut self,
        model: &Model,
        first: &Linearization,
        weights_x: &[f64],
        weights_multipliers: &[f64],
    ) -> Result<(), StepError> {
        match first.parts()? {
            Some(parts) => self.contract_period(model, parts, weights_x, weights_multipliers),
            None => self.contract_step(model, first, weights_x, weights_multipliers),
        }
    }

    /// The sum of second derivatives by two parameters, of which the first is not the smaller.
    pub(super) fn entry(&self, a: usize, b: usize) -> f64 {
        self.quadratic.sum[b * self.scratch.layout.stride + a]
    }
}
