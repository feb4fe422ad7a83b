//! Weighted second derivatives of collocation, and of periods of several steps.

use plantd_math::rotation::{self, Chart, Turn};
use plantd_math::rows::{Term, add_product, add_rows, padded};
use plantd_math::scalar::{Dual, Scalar};
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::constraints::closure::Closure;
use crate::integrator::blocks::StepBlocks;
use crate::integrator::collocation::slopes::{Closing, Slopes};
use crate::integrator::report::StepError;
use crate::integrator::scheme::Tableau;
use crate::linearization::linearize::{Linearization, NodeTangents, Part, StageTangents};
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

impl StageTangents {
    /// How a ball joint turns in the step.
    fn turn(&self, c: usize) -> Vec3 {
        let n = self.q.len() / self.tableau.weights.len();
        let stages = self.velocity.chunks_exact(n).zip(&self.tableau.weights);
        let turned = |sum: Vec3, (v, b): (&[f64], &f64)| sum + three(v, c) * (b * self.time_step_s);
        stages.fold(Vec3::ZERO, turned)
    }

    /// `Y` of a stage of a coordinate, with the tangent of parameter `a`.
    fn increment(&self, b: usize, k: usize, a: usize, stride: usize) -> Dual {
        let Tableau { weights, .. } = &self.tableau;
        let n = self.q.len() / weights.len();
        let by = self.tangent[(b * weights.len() + k) * stride + a];
        Dual::new(self.time_step_s * weights[k] * self.velocity[k * n + b], by)
    }

    /// Orientation half-way of the ball joint with coordinate `c`, with the tangent of parameter `a`.
    fn center(&self, o: usize, c: usize, a: usize, increment: &[Dual]) -> Mat3<Dual> {
        let unit = |k: usize| if a == c + k { 1.0 } else { 0.0 };
        let axis = Vec3([0, 1, 2].map(|k| Dual::new(0.0, unit(k))));
        let turned = Mat3::lift(self.orientations[o]).times(&rotation::exp(axis));
        turned.times(&Turn::new(three(increment, c)).half())
    }

    /// Places a step with ball joints, with the tangent of parameter `a`.
    fn seed(
        &self,
        a: usize,
        model: &Model,
        slopes: &mut Slopes<Dual>,
        blocks: &mut StepBlocks<Dual>,
    ) {
        let theta = slopes.theta;
        let (nd, n, ni, stride) = (theta.nd, theta.n(), theta.ni, theta.stride);
        let Tableau { nodes, weights, coupling, .. } = &self.tableau;
        let (count, h) = (nodes.len(), self.time_step_s);
        let unit = |is: bool| if is { 1.0 } else { 0.0 };
        let increment = |b: usize, k: usize| self.increment(b, k, a, stride);
        for b in 0..nd {
            slopes.increment[b] = (0..count).fold(Dual::ZERO, |sum, k| sum + increment(b, k));
            slopes.start[b] = Dual::new(self.momentum[b], unit(a == n + b));
        }
        for (i, input) in blocks.inputs.iter_mut().enumerate() {
            input.eps = unit(a == theta.inputs() + i);
        }
        for i in 0..count {
            let rate = 1.0 / (h * weights[i]);
            for b in 0..n {
                let q = self.q[i * n + b];
                (blocks.q_mid[b], blocks.velocity[b]) = if b < nd {
                    let by = (0..count).map(|k| coupling[i * count + k] * increment(b, k).eps);
                    let by = unit(a == b) + by.sum::<f64>();
                    (Dual::new(q, by), increment(b, i) * rate)
                } else {
                    let [start, next] = [unit(a == b), unit(a == theta.next() + b - nd)];
                    let by = (1.0 - nodes[i]) * start + nodes[i] * next;
                    let v = self.velocity[i * n + b];
                    (Dual::new(q, by), Dual::new(v, (next - start) / h))
                };
            }
            for (o, &c) in model.orientations.iter().enumerate() {
                let center = self.center(o, c, a, &slopes.increment);
                let offset = Vec3([0, 1, 2].map(|b| {
                    let skew = &self.tableau.skew[i * count..][..count];
                    let along = skew.iter().enumerate().map(|(k, s)| increment(c + b, k) * *s);
                    along.fold(Dual::ZERO, |sum, x| sum + x)
                }));
                let (chart, v) = (Chart::new(offset), three(&blocks.velocity, c));
                slopes.offset[i * nd + c..][..3].copy_from_slice(&offset.0);
                slopes.rate[i * nd + c..][..3].copy_from_slice(&v.0);
                blocks.orientations[1][o] = center.times(&chart.exp());
                blocks.velocity[c..c + 3].copy_from_slice(&chart.dexp().apply(v).0);
            }
            for (input, value) in blocks.inputs.iter_mut().zip(&self.inputs[i * ni..]) {
                input.re = *value;
            }
            blocks.evaluate_mid(model);
            let mid = &blocks.mid;
            let [qq, qv, vq, vv] =
                slopes.second.each_mut().map(|table| &mut table[i * nd * n..][..nd * n]);
            for (row, column) in (0..nd).flat_map(|r| (0..n).map(move |c| (r, c))) {
                let (at, mirrored) = (row * n + column, column * n + row);
                qq[at] = mid.l_qq[at] + mid.f_q[at];
                qv[at] = mid.l_qv[at] + mid.f_v[at];
                vq[at] = mid.l_qv[mirrored];
                vv[at] = mid.l_vv[at];
            }
            slopes.by_input[i * nd * ni..][..nd * ni].copy_from_slice(&mid.f_u);
            for b in 0..nd {
                slopes.torque[i * nd + b] = mid.l_q[b] + mid.force[b];
                slopes.momentum[i * nd + b] = mid.l_v[b];
            }
        }
    }
}

impl NodeTangents {
    /// Places the nodes of a step with ball joints, with the tangent of parameter `a`; the stages are placed.
    fn seed(
        &self,
        a: usize,
        model: &Model,
        stages: &StageTangents,
        slopes: &mut Slopes<Dual>,
        closure: &mut Closure<Dual>,
    ) {
        let theta = slopes.theta;
        let (nd, n, nc, stride) = (theta.nd, theta.n(), theta.nc, theta.stride);
        let Tableau { weights, reach, reach_from_middle, ends, .. } = &stages.tableau;
        let count = weights.len();
        for j in 0..=count {
            let [reach, offsets] =
                [reach, reach_from_middle].map(|rows| &rows[j * count..][..count]);
            let mut q = vec![Dual::ZERO; n];
            for (b, q) in q.iter_mut().enumerate() {
                let moves = theta.moves(b, ends[j]).filter(|(parameter, _)| *parameter == a);
                let given: f64 = moves.map(|(_, part)| part).sum();
                let of = |(k, kappa): (usize, &f64)| {
                    kappa * stages.tangent[(b * count + k) * stride + a]
                };
                let found: f64 = if b < nd { reach.iter().enumerate().map(of).sum() } else { 0.0 };
                *q = Dual::new(self.q[j * n + b], given + found);
            }
            let mut orientations = vec![Mat3::IDENTITY; model.orientations.len()];
            for (o, &c) in model.orientations.iter().enumerate() {
                let offset = Vec3([0, 1, 2].map(|b| {
                    let parts = offsets.iter().enumerate();
                    let along =
                        parts.map(|(k, part)| stages.increment(c + b, k, a, stride) * *part);
                    along.fold(Dual::ZERO, |sum, x| sum + x)
                }));
                let center = stages.center(o, c, a, &slopes.increment);
                orientations[o] = center.times(&Chart::new(offset).exp());
                slopes.offset[(count + j) * nd + c..][..3].copy_from_slice(&offset.0);
            }
            closure.evaluate(model, &q, &orientations);
            closure.differentiate(model, &q);
            if let Some(closing) = &mut slopes.closing {
                closing.jacobians[j * nc * n..][..nc * n].copy_from_slice(&closure.jacobian);
            }
            if j == count {
                continue;
            }
            let multipliers: Vec<Dual> = (j * nc..(j + 1) * nc)
                .map(|at| Dual::new(self.multipliers[at], self.tangent[at * stride + a]))
                .collect();
            let push = &mut slopes.torque[(count + j) * nd..][..nd];
            push.fill(Dual::ZERO);
            closure.subtract_impulses(model, &multipliers, push);
            let mut hessian = vec![Dual::ZERO; n * n];
            closure.hessian(model, &q, &multipliers, &mut hessian);
            let curvature = slopes.second[0][(count + j) * nd * n..].iter_mut();
            curvature.zip(&hessian[..nd * n]).for_each(|(to, from)| *to = -*from);
        }
    }

    /// Finds `ν` from `−o_Y`, and adds `−Gᵀ ν` to that.
    fn add_adjoint(
        &self,
        model: &Model,
        stages: &StageTangents,
        [z_p, weights_multipliers]: [&[f64]; 2],
        adjoint: &mut [f64],
    ) -> Vec<f64> {
        let (count, nc) = (stages.tableau.weights.len(), model.dimensions.constraints);
        let n = model.dimensions.coordinates();
        let width = padded(count * nc);
        let row = |j: usize, c: usize| &self.jacobians[(j * nc + c) * n..][..n];
        let each = || (0..count).flat_map(|j| (0..nc).map(move |c| (j, c)));
        let direct = |(j, c): (usize, usize)| {
            let pushed: f64 = match &self.closing {
                Some(closing) => {
                    let column = closing.next.iter().skip(j * nc + c).step_by(count * nc);
                    z_p.iter().zip(column).map(|(z, entry)| z * entry).sum()
                }
                None => -z_p.iter().zip(row(j, c)).map(|(z, entry)| z * entry).sum::<f64>(),
            };
            weights_multipliers[c] + pushed
        };
        let mut nu: Vec<f64> = each().map(direct).collect();
        for (k, o) in adjoint.iter().enumerate() {
            let responses = &self.responses[k * width..][..count * nc];
            nu.iter_mut().zip(responses).for_each(|(nu, response)| *nu += response * o);
        }
        let mut schur = self.schur.clone();
        schur.solve_transposed(&mut nu);
        if let Some(Closing { equations: [by_y, _], .. }) = self.closing.as_deref() {
            for (row, nu) in by_y.chunks_exact(adjoint.len()).zip(&nu) {
                adjoint.iter_mut().zip(row).for_each(|(o, entry)| *o -= nu * entry);
            }
            return nu;
        }
        for ((j, c), nu) in each().zip(&nu) {
            let reach = &stages.tableau.reach[(j + 1) * count..][..count];
            for (own, entry) in adjoint.chunks_exact_mut(count).zip(row(j + 1, c)) {
                own.iter_mut().zip(reach).for_each(|(o, kappa)| *o -= nu * entry * kappa);
            }
        }
        nu
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
    ///
    /// With constraints there are weights `ν` of the equations at the nodes, too: of `o_Y`, what is in brackets
    /// above, and of `o_Λ = z_λ − Dh z_p`
    ///
    /// ```text
    /// Sᵀ ν = o_Λ − (J⁻¹ B)ᵀ o_Y        μ = −J⁻ᵀ (o_Y + Gᵀ ν)
    /// ```
    pub(super) fn contract_stages(
        &mut self,
        model: &Model,
        stages: &StageTangents,
        z: &[f64],
        weights_multipliers: &[f64],
    ) {
        let layout = self.scratch.layout;
        let (nd, n, ni, stride) = (layout.nd, layout.n(), layout.ni, layout.stride);
        let (size, count) = (layout.count(), stages.tableau.weights.len());
        let z_p = &z[n..][..nd];
        let mut weights = z[..nd].to_vec();
        for &c in &model.orientations {
            let turned = rotation::dexp(stages.turn(c)).apply_transposed(three(z, c));
            weights[c..c + 3].copy_from_slice(&turned.0);
        }
        let mut adjoint = vec![0.0; count * nd];
        for (k, mu) in adjoint.iter_mut().enumerate() {
            let slopes = z_p.iter().enumerate().map(|(a, z)| z * stages.slopes[a * count * nd + k]);
            *mu = -(weights[k / count] + slopes.sum::<f64>());
        }
        let nu = match &stages.nodes {
            Some(nodes) => {
                nodes.add_adjoint(model, stages, [z_p, weights_multipliers], &mut adjoint)
            }
            None => Vec::new(),
        };
        stages.matrix.solve_transposed(&mut adjoint);
        if !model.orientations.is_empty() {
            self.contract_turned_stages(model, stages, [&adjoint, &nu], z);
            return;
        }

        self.quadratic.clear();
        if let Some(nodes) = &stages.nodes {
            self.contract_nodes(model, stages, nodes, z_p, [&adjoint, &nu]);
        }
        let [mut tangent, mut product] = [0; 2].map(|_| vec![0.0; 2 * n * stride]);
        for j in 0..count {
            let length = stages.tableau.weights[j] * stages.time_step_s;
            self.place_tangent(stages, j, &mut tangent);
            let weight = |a: usize| {
                let coupled =
                    |i: usize| stages.tableau.coupling[i * count + j] * adjoint[a * count + i];
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

    /// What constraints add. At a node the impulses are weighed by `β_j = z_p + Σ_i (1 − κ_ji) μ_i`, and
    ///
    /// ```text
    /// q̃'ᵀ (ν_j·D²h − Λ_j·D³h β_j) q̃' − (Λ_j'·D²h β_j q̃' + its transpose)
    /// ```
    ///
    /// are dual parts of `Dh` and of its derivative along `β_j`.
    fn contract_nodes(
        &mut self,
        model: &Model,
        stages: &StageTangents,
        nodes: &NodeTangents,
        z_p: &[f64],
        [adjoint, nu]: [&[f64]; 2],
    ) {
        let layout = self.scratch.layout;
        let (nd, n, nc, stride) = (layout.nd, layout.n(), layout.nc, layout.stride);
        let (size, count) = (layout.count(), stages.tableau.weights.len());
        let mut closure = Closure::<Dual>::new(model);
        let mut hessian = vec![Dual::ZERO; n * n];
        let [mut tangent, mut product] = [0; 2].map(|_| vec![0.0; (n + nc) * stride]);
        for j in 0..=count {
            let reach = &stages.tableau.reach[j * count..][..count];
            tangent.fill(0.0);
            for b in 0..n {
                let row = &mut tangent[b * stride..][..stride];
                for (column, part) in layout.moves(b, stages.tableau.ends[j]) {
                    row[column] = part;
                }
                if b < nd {
                    let moved = reach.iter().enumerate().map(|(k, m)| (*m, b * count + k));
                    add_rows(row, &stages.tangent, stride, &moved.collect::<Vec<_>>());
                }
            }
            let own = |numbers: &[f64], c: usize| -> f64 {
                if j < count { numbers[j * nc + c] } else { 0.0 }
            };
            let q: Vec<Dual> = (0..n)
                .map(|a| {
                    let coupled = |i: usize| (1.0 - reach[i]) * adjoint[a * count + i];
                    let along = || z_p[a] + (0..count).map(coupled).sum::<f64>();
                    let beta = if a < nd && j < count { along() } else { 0.0 };
                    Dual::new(nodes.q[j * n + a], beta)
                })
                .collect();
            let multipliers: Vec<Dual> = (0..nc)
                .map(|c| {
                    let nu = if j > 0 { nu[(j - 1) * nc + c] } else { 0.0 };
                    Dual::new(own(&nodes.multipliers, c), -nu)
                })
                .collect();
            closure.evaluate(model, &q, &[]);
            closure.differentiate(model, &q);
            closure.hessian(model, &q, &multipliers, &mut hessian);
            if j < count {
                let from = &nodes.tangent[j * nc * stride..][..nc * stride];
                tangent[n * stride..].copy_from_slice(from);
            }
            product.fill(0.0);
            let terms = &mut self.scratch.terms;
            for (row, target) in product.chunks_exact_mut(stride).enumerate() {
                let weight = |c: usize| match (row < n, c < n) {
                    (true, true) => -hessian[row * n + c].eps,
                    (true, false) => -closure.jacobian[(c - n) * n + row].eps,
                    (false, true) => -closure.jacobian[(row - n) * n + c].eps,
                    (false, false) => 0.0,
                };
                add_product(target, &tangent, stride, (0..n + nc).map(weight), terms);
            }
            let sum = &mut self.quadratic.sum[..size * stride];
            add_transposed_product(sum, &tangent, &product, stride, terms);
        }
    }

    /// The sum with ball joints: all derivatives of the step in dual numbers, for each parameter.
    fn contract_turned_stages(
        &mut self,
        model: &Model,
        stages: &StageTangents,
        [adjoint, nu]: [&[f64]; 2],
        z: &[f64],
    ) {
        let layout = self.scratch.layout;
        let (nd, n, stride, size) = (layout.nd, layout.n(), layout.stride, layout.count());
        let count = stages.tableau.weights.len();
        let mut slopes = Slopes::<Dual>::new(model, &stages.tableau);
        slopes.time_step_s = stages.time_step_s;
        self.quadratic.clear();
        let Self { scratch, quadratic, .. } = self;
        let mut by_unknown = vec![0.0; count * nd];
        let mut closure = stages.nodes.as_ref().map(|_| Closure::<Dual>::new(model));
        for (a, row) in quadratic.sum.chunks_exact_mut(stride).enumerate().take(size) {
            stages.seed(a, model, &mut slopes, &mut scratch.blocks);
            if let (Some(nodes), Some(closure)) = (&stages.nodes, &mut closure) {
                nodes.seed(a, model, stages, &mut slopes, closure);
            }
            slopes.find();
            by_unknown.fill(0.0);
            row.fill(0.0);
            let mut add = |weight: f64, [unknowns, parameters]: [&[Dual]; 2]| {
                by_unknown.iter_mut().zip(unknowns).for_each(|(to, by)| *to += weight * by.eps);
                row.iter_mut().zip(parameters).for_each(|(to, by)| *to += weight * by.eps);
            };
            for (weights, [unknowns, parameters]) in
                [(adjoint, &slopes.residual), (&z[n..][..nd], &slopes.next_by)]
            {
                let unknowns = unknowns.chunks_exact(count * nd);
                let rows = unknowns.zip(parameters.chunks_exact(stride));
                weights.iter().zip(rows).for_each(|(weight, (y, theta))| add(*weight, [y, theta]));
            }
            let closing = slopes.closing.as_deref();
            if let Some(Closing { equations: [unknowns, parameters], .. }) = closing {
                let unknowns = unknowns.chunks_exact(count * nd);
                let rows = unknowns.zip(parameters.chunks_exact(stride));
                nu.iter().zip(rows).for_each(|(weight, (y, theta))| add(*weight, [y, theta]));
            }
            for &c in &model.orientations {
                let turn = three(&slopes.increment, c);
                let (to_end, carried) = (rotation::dexp(turn), rotation::exp(-turn));
                for b in 0..3 {
                    let of =
                        |m: &Mat3<Dual>| -> f64 { (0..3).map(|k| z[c + k] * m.0[b][k].eps).sum() };
                    row[c + b] += of(&carried);
                    let by = of(&to_end);
                    let own = &mut by_unknown[(c + b) * count..][..count];
                    own.iter_mut().for_each(|entry| *entry += by);
                }
            }
            let weights = by_unknown.iter().copied();
            add_product(row, &stages.tangent, stride, weights, &mut scratch.terms);
            if let (Some(nodes), Some(Closing { residual, next, .. })) = (&stages.nodes, closing) {
                let mut by_impulse = vec![0.0; nu.len()];
                let pushed = [(adjoint, residual), (&z[n..][..nd], next)];
                for (weights, rows) in pushed {
                    for (weight, row) in weights.iter().zip(rows.chunks_exact(nu.len())) {
                        by_impulse.iter_mut().zip(row).for_each(|(to, by)| *to += weight * by.eps);
                    }
                }
                let weights = by_impulse.into_iter();
                add_product(row, &nodes.tangent, stride, weights, &mut scratch.terms);
            }
        }
        // Both orders of derivatives count the same.
        let sum = &mut quadratic.sum;
        for a in 1..size {
            for b in 0..a {
                sum[b * stride + a] = 0.5 * (sum[a * stride + b] + sum[b * stride + a]);
            }
        }
    }

    /// Writes the derivatives of `Q_j` and `V_j`, 2 n rows.
    fn place_tangent(&self, stages: &StageTangents, j: usize, tangent: &mut [f64]) {
        let layout = self.scratch.layout;
        let (nd, n, stride) = (layout.nd, layout.n(), layout.stride);
        let count = stages.tableau.weights.len();
        let (node, h) = (stages.tableau.nodes[j], stages.time_step_s);
        tangent.fill(0.0);
        let (by_q, by_v) = tangent.split_at_mut(n * stride);
        for a in 0..n {
            let (q, v) = (&mut by_q[a * stride..][..stride], &mut by_v[a * stride..][..stride]);
            if a < nd {
                q[a] = 1.0;
                let coupled =
                    (0..count).map(|k| (stages.tableau.coupling[j * count + k], a * count + k));
                add_rows(q, &stages.tangent, stride, &coupled.collect::<Vec<_>>());
                let rate = 1.0 / (stages.tableau.weights[j] * h);
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
