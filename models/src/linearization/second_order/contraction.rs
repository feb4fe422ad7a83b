//! Weighted sums of second derivatives, without the tensors.
//!
//! `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c` with `μ = −E⁻ᵀ (z_y + O_yᵀ z_p)` is the Hessian of the scalar
//! `μ·R + z_p·O`, congruent with `W`:
//!
//! ```text
//! G = Wᵀ ∇²(μ·R + z_p·O) W
//! Lagrangian     D_(α,β) ∇²L,   α = h (½μ₁ + z_p) along q,  β = −μ₁ along v: one directional derivative
//! constraints    −(μ₁ + z_p)·(Dhᵀλ)'' at q[k],   μ₂·D²h at q[k+1]
//! forces         direction by direction: they are no gradient
//! ```
//!
//! The first-order linearization holds the adjoint: with `R_p = O_p = 1`, `μ₁ + z_p` is the derivative
//! of the weighted sum by `p[k]`. What is left needs the factors of the constraints alone:
//! `Sᵀ μ₂ = −(K⁻¹A0ᵀ)ᵀ (z_x + O_xᵀ z_p) − A0 μ₁`.

use nalgebra::DMatrix;
use plantd_math::gemm::{Into, Operand, mirror_head, product};
use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rotation;
use plantd_math::rows::{Term, add_product, padded};
use plantd_math::scalar::Dual;
use plantd_math::spatial::three;
use plantd_math::tree_lu::TreeLu;

use crate::constraints::closure::Closure;
use crate::integrator::blocks::StepBlocks;
use crate::integrator::parameters::Parameters;
use crate::integrator::report::StepError;
use crate::kkt::schur::{fill_schur, room_for_schur};
use crate::lagrangian::kinematics::Place;
use crate::linearization::linearize::{Linearization, SolvedStep};
use crate::linearization::second_order::{Scratch, assert_layout, spin_change};
use crate::model::mechanism::Model;

/// A weighted sum of second derivatives, `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c`, preallocated.
#[derive(Clone, Debug)]
pub struct Contraction {
    /// By `x` twice, square of `2 nd + 2 nk`.
    pub xx: DMatrix<f64>,
    /// By `x` and `u`, `2 nd + 2 nk` by `ni + nk`.
    pub xu: DMatrix<f64>,
    /// By `u` twice, square of `ni + nk`.
    pub uu: DMatrix<f64>,
    pub(super) scratch: Scratch,
    /// `z_x`, by what the increments of the dynamic coordinates are.
    weights: Vec<f64>,
    /// `μ₁` (nd) and `μ₂` (nc).
    adjoint: Vec<f64>,
    /// `μ₁ + z_p`, with zeros for the prescribed coordinates.
    impulse: Vec<f64>,
    pub(super) quadratic: Quadratic,
    schur: PivotedLu,
    /// Where constraints are eliminated with joints: what a linearization of them leaves out.
    dense: Option<Dense>,
    /// Constraints at `q[k+1]`.
    end: Closure,
    q_end: Vec<f64>,
    /// Pairs of coordinates that the Lagrangian couples, both ways round.
    pattern: Vec<(usize, usize)>,
}

/// The Newton matrix, and `K⁻¹ A0ᵀ`, row-major, nd by padded nc.
#[derive(Clone, Debug)]
struct Dense {
    matrix: TreeLu,
    responses: Vec<f64>,
}

/// A quadratic form in the start of a step and in what is next, in terms of the parameters `θ` and the
/// unknowns `y`: `½ θᵀ sum θ + yᵀ C θ + ½ xᵀ Y x`. With `y' = W θ` its Hessian is
///
/// ```text
/// sum + Wᵀ (C + Y W) + Cᵀ W
/// ```
///
/// which is symmetric: in the order of rows the upper triangle is computed. `Y` has few entries.
#[derive(Clone, Debug)]
pub(super) struct Quadratic {
    layout: Parameters,
    /// Row-major over all parameters, square with the padding; the upper triangle counts.
    pub(super) sum: Vec<f64>,
    /// `C`, row-major, nd + nc rows.
    mixed: Vec<f64>,
    /// `C + Y W`.
    cofactor: Vec<f64>,
    /// `Y`, nd by nd.
    increments: Vec<f64>,
    /// Where the rows of `C` and `W` begin.
    rows: Vec<usize>,
}

impl Quadratic {
    fn new(layout: Parameters) -> Self {
        let rows = layout.nd + layout.nc;
        Self {
            layout,
            sum: vec![0.0; layout.stride * layout.stride],
            mixed: vec![0.0; rows * layout.stride],
            cofactor: vec![0.0; rows * layout.stride],
            increments: vec![0.0; layout.nd * layout.nd],
            rows: (0..rows).map(|row| row * layout.stride).collect(),
        }
    }

    pub(super) fn clear(&mut self) {
        self.sum.fill(0.0);
        self.mixed.fill(0.0);
        self.increments.fill(0.0);
    }

    /// Adds to `sum`: the starts of coordinates, and next positions, are parameters.
    fn add(&mut self, row: usize, column: usize, value: f64) {
        self.sum[row * self.layout.stride + column] += value;
    }

    /// Adds to `C`, unknown by parameter.
    fn add_mixed(&mut self, unknown: usize, parameter: usize, value: f64) {
        self.mixed[unknown * self.layout.stride + parameter] += value;
    }

    /// At the start of `i` and what is next of `j`, and the other way round.
    fn add_start_next(&mut self, i: usize, j: usize, value: f64) {
        let Parameters { nd, .. } = self.layout;
        if j < nd {
            self.add_mixed(j, i, value);
        } else {
            // The upper triangle alone: next positions come after all starts.
            self.add(i, self.layout.next() + j - nd, value);
        }
    }

    /// At what is next of `i` and of `j`; comes for `(j, i)` again.
    fn add_nexts(&mut self, i: usize, j: usize, value: f64) {
        let (Parameters { nd, .. }, next) = (self.layout, self.layout.next());
        match (i < nd, j < nd) {
            (true, true) => self.increments[i * nd + j] += value,
            (true, false) => self.add_mixed(i, next + j - nd, value),
            (false, false) => self.add(next + i - nd, next + j - nd, value),
            (false, true) => {}
        }
    }

    /// Puts the Hessian into the upper triangle of `sum`; `tangent` is `W`, row-major.
    fn substitute(&mut self, tangent: &[f64], terms: &mut Vec<Term>) {
        let Parameters { nd, stride, .. } = self.layout;
        let size = self.layout.count();
        let Self { sum, mixed, cofactor, increments, rows, .. } = self;
        cofactor.copy_from_slice(mixed);
        let by_increment = increments.chunks_exact(nd.max(1));
        for (row, by) in cofactor.chunks_exact_mut(stride).zip(by_increment) {
            add_product(row, tangent, stride, by.iter().copied(), terms);
        }
        let operand = |numbers| Operand { numbers, terms: rows, stride: 1 };
        for (left, right) in [(tangent, &cofactor[..]), (&mixed[..], tangent)] {
            let (left, right) = (operand(left), operand(right));
            product(sum, stride, left, right, (size, size), Into::AddLower, 0);
        }
    }

    /// Fills the lower triangle of `sum` with the upper one.
    pub(super) fn mirror(&mut self) {
        mirror_head(&mut self.sum, self.layout.stride, self.layout.count());
    }
}

impl Contraction {
    /// Room for the contraction of a model: `O((2 nd + 2 nk + ni)²)` numbers.
    pub fn new(model: &Model) -> Self {
        let layout = Parameters::new(model);
        let (n, rows) = (layout.n(), layout.nd + layout.nc);
        let inputs = layout.ni + layout.nk;
        let scratch = Scratch::new(model);
        Self {
            xx: DMatrix::zeros(2 * n, 2 * n),
            xu: DMatrix::zeros(2 * n, inputs),
            uu: DMatrix::zeros(inputs, inputs),
            weights: vec![0.0; layout.nd],
            adjoint: vec![0.0; rows],
            impulse: vec![0.0; n],
            quadratic: Quadratic::new(layout),
            schur: room_for_schur(model, 1),
            dense: (model.loops.is_some() || model.held.is_some()).then(|| Dense {
                matrix: TreeLu::new(&model.elimination),
                responses: vec![0.0; layout.nd * padded(layout.nc)],
            }),
            end: Closure::new(model),
            q_end: vec![0.0; n],
            pattern: scratch.blocks.mid.coupled_coordinates(model),
            scratch,
        }
    }

    /// Weighted second derivatives of the map at the step that `first` linearizes,
    /// `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c` with `z = weights_x` (2 nd + 2 nk) and
    /// `w = weights_multipliers` (nc). Solves no step: `first` holds all that is needed.
    ///
    /// Costs, for each step and each stage of collocation, one evaluation of the derivative blocks in dual numbers (with nonlinear forces or ball
    /// joints: one of them for each parameter), and O(N² nd).
    ///
    /// # Errors
    ///
    /// [`StepError::Dimension`] for weights of the wrong length.
    ///
    /// # Panics
    ///
    /// If `first` or `self` was made for a model of other dimensions.
    pub fn contract(
        &mut self,
        model: &Model,
        first: &Linearization,
        weights_x: &[f64],
        weights_multipliers: &[f64],
    ) -> Result<(), StepError> {
        check_weights(model, weights_x, weights_multipliers)?;
        assert_layout(model, &self.scratch);
        self.contract_any(model, first, weights_x, weights_multipliers)?;
        self.finish();
        Ok(())
    }

    /// The sum for one step.
    pub(super) fn contract_step(
        &mut self,
        model: &Model,
        first: &Linearization,
        weights_x: &[f64],
        weights_multipliers: &[f64],
    ) -> Result<(), StepError> {
        if let Some(stages) = first.stages() {
            self.contract_stages(model, stages, weights_x, weights_multipliers);
            return Ok(());
        }
        first.write_tangent(self.scratch.layout.stride, &mut self.scratch.tangent);
        self.find_impulse(model, first, weights_x, weights_multipliers);
        let step = first.solved_step();
        if model.orientations.is_empty() && model.forces.is_none() {
            self.contract_gradients(model, step, weights_x);
        } else {
            self.contract_directions(model, step, weights_x);
        }
        Ok(())
    }

    /// `μ₁`, from the derivatives by the momentum.
    fn find_impulse(&mut self, model: &Model, first: &Linearization, z: &[f64], w: &[f64]) {
        let (nd, n) = self.scratch.layout.coordinates();
        let z_p = &z[n..][..nd];
        self.weights.copy_from_slice(&z[..nd]);
        for &i in model.orientations.iter().filter(|i| **i < nd) {
            let to_end = rotation::dexp(three(&first.solved_step().increment, i));
            let turned = to_end.apply_transposed(three(z, i));
            self.weights[i..i + 3].copy_from_slice(&turned.0);
        }
        first.pull_back_to_momentum([&self.weights, w, z_p], &mut self.impulse[..nd]);
        for ((mu, impulse), z) in self.adjoint.iter_mut().zip(&self.impulse).zip(z_p) {
            *mu = impulse - z;
        }
    }

    /// `K⁻¹ A0ᵀ` and the factors of `S`, where constraints were eliminated without them: of the entries of `K`, and
    /// the Jacobian at the end.
    fn find_responses(
        &mut self,
        model: &Model,
        step: &SolvedStep,
        entry: impl Fn(&StepBlocks<Dual>, usize, usize) -> f64,
    ) {
        let Some(Dense { matrix, responses }) = &mut self.dense else { return };
        let Parameters { nd, nc, .. } = self.scratch.layout;
        let (n, stride) = (self.scratch.layout.n(), padded(nc));
        let h = step.settings.time_step_s;
        let blocks = &self.scratch.blocks;
        let elimination = &model.elimination;
        matrix.clear();
        for i in 0..nd {
            for (_, j) in elimination.entries_of(i) {
                matrix.add(elimination, i, j, entry(blocks, i, j));
                if i != j {
                    matrix.add(elimination, j, i, entry(blocks, j, i));
                }
            }
            for c in 0..nc {
                responses[i * stride + c] = blocks.start.jacobian[c * n + i].re;
            }
        }
        matrix.factor(elimination, &model.conditioning.inertia, 1.0 / h.abs());
        matrix.solve_rows(elimination, responses, stride, stride);
        fill_schur(model, &self.end, responses, &mut self.schur);
        self.schur.factor();
    }

    /// `μ₂`, with the blocks at the solution: `slopes` are `O_x`, row-major, with rows of `n`.
    fn find_multipliers(
        &mut self,
        step: &SolvedStep,
        z: &[f64],
        slope: impl Fn(&StepBlocks<Dual>, usize, usize) -> f64,
    ) {
        let Parameters { nd, nc, .. } = self.scratch.layout;
        let (n, stride) = (self.scratch.layout.n(), padded(nc));
        let blocks = &self.scratch.blocks;
        let z_p = &z[n..][..nd];
        let responses = match &self.dense {
            Some(dense) if step.without_schur => &dense.responses,
            _ => {
                self.schur.take_factors_of(&step.schur);
                &step.responses
            }
        };
        let (first, second) = self.adjoint.split_at_mut(nd);
        second.fill(0.0);
        for (i, mu) in first.iter().enumerate() {
            let moved: f64 = z_p.iter().enumerate().map(|(j, z)| z * slope(blocks, j, i)).sum();
            let pull = self.weights[i] + moved;
            for (c, entry) in second.iter_mut().enumerate() {
                let jacobian = blocks.start.jacobian[c * n + i].re;
                *entry -= responses[i * stride + c] * pull + jacobian * mu;
            }
        }
        self.schur.solve_transposed(second);
    }

    /// The sum with ball joints, whose tangent spaces do not commute, or with forces: one evaluation of
    /// all blocks for each parameter.
    fn contract_directions(&mut self, model: &Model, step: &SolvedStep, z: &[f64]) {
        let layout = self.scratch.layout;
        let Parameters { nd, nc, ni, stride, .. } = layout;
        let (n, size) = (layout.n(), layout.count());
        let (inputs, next) = (layout.inputs(), layout.next());
        if nc > 0 {
            self.scratch.seed(0, model, step);
            self.scratch.blocks.evaluate(model, &step.settings);
            if step.without_schur {
                let [_, by_next] = self.scratch.blocks.end_jacobians();
                for (to, from) in self.end.jacobian.iter_mut().zip(by_next) {
                    *to = from.re;
                }
                self.find_responses(model, step, |blocks, i, j| blocks.residual_next[i * n + j].re);
            }
            self.find_multipliers(step, z, |blocks, i, j| blocks.momentum_next[i * n + j].re);
        }
        self.quadratic.clear();
        let time_step_s = step.settings.time_step_s;
        let Self { scratch, adjoint, impulse, quadratic, .. } = self;
        let Quadratic { sum, cofactor, .. } = quadratic;
        // What `x'` and `λ'` are multiplied with.
        let by_unknown = &mut cofactor[..nd + nc];
        for (a, row) in sum.chunks_exact_mut(stride).enumerate().take(size) {
            scratch.seed(a, model, step);
            scratch.blocks.evaluate(model, &step.settings);
            let Scratch { blocks, tangent, terms, .. } = &mut *scratch;
            row.fill(0.0);
            by_unknown.fill(0.0);
            let mut add_next = |row: &mut [f64], j: usize, value: f64| {
                if j < nd {
                    by_unknown[j] += value;
                } else {
                    row[next + j - nd] += value;
                }
            };
            for i in 0..nd {
                let (mu, z_p) = (adjoint[i], impulse[i] - adjoint[i]);
                for j in 0..n {
                    let at = i * n + j;
                    row[j] +=
                        mu * blocks.residual_start[at].eps + z_p * blocks.momentum_start[at].eps;
                    let value =
                        mu * blocks.residual_next[at].eps + z_p * blocks.momentum_next[at].eps;
                    add_next(row, j, value);
                }
                for j in 0..ni {
                    let at = i * ni + j;
                    row[inputs + j] +=
                        mu * blocks.residual_inputs[at].eps + z_p * blocks.momentum_inputs[at].eps;
                }
            }
            let [by_start, by_next] = blocks.end_jacobians();
            for (c, mu) in adjoint[nd..].iter().enumerate() {
                for j in 0..n {
                    if j < nd {
                        row[j] += mu * by_start[c * n + j].eps;
                    }
                    add_next(row, j, mu * by_next[c * n + j].eps);
                }
            }
            for t in blocks.turnings.iter().filter(|t| t.coordinate < nd) {
                for (b, i) in (t.coordinate..t.coordinate + 3).enumerate() {
                    for k in 0..3 {
                        let z = z[t.coordinate + k];
                        row[i] += z * t.carried.0[b][k].eps;
                        add_next(row, i, z * t.to_end.0[b][k].eps);
                    }
                }
            }
            for t in blocks.turnings.iter().filter(|t| t.coordinate >= nd) {
                let z = &z[n + t.coordinate..][..3];
                for (z, change) in z.iter().zip(spin_change(t, time_step_s)) {
                    for b in 0..3 {
                        row[t.coordinate + b] += z * change[b];
                        row[next + t.coordinate - nd + b] += z * change[3 + b];
                    }
                }
            }
            for c in 0..nc {
                let turned = (0..nd).map(|i| impulse[i] * blocks.start.jacobian[c * n + i].eps);
                by_unknown[nd + c] = -turned.sum::<f64>();
            }
            add_product(row, tangent, stride, by_unknown.iter().copied(), terms);
        }
        // Both orders of derivatives count the same.
        for a in 1..size {
            for b in 0..a {
                sum[b * stride + a] = 0.5 * (sum[a * stride + b] + sum[b * stride + a]);
            }
        }
    }

    /// The sum where everything is the gradient of something: the Lagrangian and the constraints.
    fn contract_gradients(&mut self, model: &Model, step: &SolvedStep, z: &[f64]) {
        let h = step.settings.time_step_s;
        let ((nd, n), nc) = (self.scratch.layout.coordinates(), self.scratch.layout.nc);
        let blocks = &mut self.scratch.blocks;
        for i in 0..n {
            let (start, mid, velocity) = if i < nd {
                let x = step.increment[i];
                (step.q[i], step.q[i] + 0.5 * x, x / h)
            } else {
                let next = step.next[i - nd];
                (step.q[i], 0.5 * (step.q[i] + next), (next - step.q[i]) / h)
            };
            let (alpha, beta) = if i < nd {
                let mu = self.adjoint[i];
                (h * (self.impulse[i] - 0.5 * mu), -mu)
            } else {
                (0.0, 0.0)
            };
            blocks.q_mid[i] = Dual::new(mid, alpha);
            blocks.velocity[i] = Dual::new(velocity, beta);
            blocks.q_start[i] = Dual::new(start, self.impulse[i]);
        }
        for (dual, value) in blocks.inputs.iter_mut().zip(&step.inputs) {
            *dual = Dual::new(*value, 0.0);
        }
        blocks.evaluate_mid(model);
        self.quadratic.clear();
        self.add_lagrangian(h);
        if nc > 0 {
            self.add_constraints(model, step, z);
        }

        let Scratch { tangent, terms, .. } = &mut self.scratch;
        self.quadratic.substitute(tangent, terms);
    }

    /// The derivative of the Hessian of the Lagrangian along `(α, β)`.
    fn add_lagrangian(&mut self, h: f64) {
        let (nd, n) = self.scratch.layout.coordinates();
        let mid = &self.scratch.blocks.mid;
        let at_start = |i: usize| if i < nd { (1.0, 0.0) } else { (0.5, -1.0 / h) };
        let at_next = (0.5, 1.0 / h);
        for &(i, j) in &self.pattern {
            let (ij, ji) = (i * n + j, j * n + i);
            let (qq, vv) = (mid.l_qq[ij].eps, mid.l_vv[ij].eps);
            let (qv, vq) = (mid.l_qv[ij].eps, mid.l_qv[ji].eps);
            let second = |(c_i, d_i): (f64, f64), (c_j, d_j): (f64, f64)| {
                c_i * (c_j * qq + d_j * qv) + d_i * (c_j * vq + d_j * vv)
            };
            self.quadratic.add(i, j, second(at_start(i), at_start(j)));
            self.quadratic.add_start_next(i, j, second(at_start(i), at_next));
            self.quadratic.add_nexts(i, j, second(at_next, at_next));
        }
    }

    /// What constraints add: their impulses turn with the start, their values with the end.
    fn add_constraints(&mut self, model: &Model, step: &SolvedStep, z: &[f64]) {
        let (nd, n) = self.scratch.layout.coordinates();
        let h = step.settings.time_step_s;
        let blocks = &mut self.scratch.blocks;
        blocks.start.evaluate(model, &blocks.q_start, &[]);
        blocks.start.differentiate(model, &blocks.q_start);
        for (i, q) in step.q.iter().enumerate() {
            self.q_end[i] = if i < nd { q + step.increment[i] } else { step.next[i - nd] };
        }
        if step.without_schur {
            self.end.evaluate(model, &self.q_end, &[]);
            self.end.differentiate(model, &self.q_end);
            let a = step.settings.force_split.at_start();
            self.find_responses(model, step, |StepBlocks { mid, .. }, i, j| {
                let (ij, ji) = (i * n + j, j * n + i);
                let turning = 0.5 * (mid.l_qv[ij].re - mid.l_qv[ji].re);
                let force = if i == j { a * mid.f_v[ij].re } else { 0.0 };
                0.25 * h * mid.l_qq[ij].re - mid.l_vv[ij].re / h + turning + force
            });
        }
        self.find_multipliers(step, z, |blocks, i, j| {
            let slope = 0.5 * h * blocks.mid.l_qq[i * n + j].re + blocks.mid.l_qv[i * n + j].re;
            if i == j { slope + blocks.mid.f_v[i * n + i].re } else { slope }
        });
        let Self { scratch, quadratic, adjoint, end, q_end, .. } = self;
        let start = &scratch.blocks.start;
        end.poses.evaluate(&model.closure, q_end, &[]);
        let equations = model.constraints.iter().zip(&step.multipliers).zip(&adjoint[nd..]);
        for (c, ((constraint, lambda), mu)) in equations.enumerate() {
            let at =
                Place { tree: &model.closure, poses: &start.poses, q: &scratch.blocks.q_start };
            constraint.for_each_second_derivative(at, &mut |i, j, value| {
                quadratic.add(i, j, -lambda * value.eps);
            });
            let at = Place { tree: &model.closure, poses: &end.poses, q: q_end };
            constraint.for_each_second_derivative(at, &mut |i, j, value| {
                let value = mu * value;
                if i < nd {
                    quadratic.add_start_next(i, j, value);
                    if j < nd {
                        quadratic.add(i, j, value);
                    }
                }
                quadratic.add_nexts(i, j, value);
            });
            for &i in &constraint.coordinates {
                quadratic.add_mixed(nd + c, i, -start.jacobian[c * n + i].eps);
            }
        }
    }

    /// Hands the sum out.
    fn finish(&mut self) {
        let layout = self.scratch.layout;
        let (moving, stride, size) = (layout.inputs(), layout.stride, layout.count());
        self.quadratic.mirror();
        let sum = &self.quadratic.sum;
        let row = |a: usize| &sum[a * stride..][..size];
        for a in 0..moving {
            self.xx.column_mut(a).rows_mut(0, moving).copy_from_slice(&row(a)[..moving]);
        }
        for a in 0..size - moving {
            let (by_x, by_u) = row(moving + a).split_at(moving);
            self.xu.column_mut(a).rows_mut(0, moving).copy_from_slice(by_x);
            self.uu.column_mut(a).copy_from_slice(by_u);
        }
        self.scratch.drop_replaced_columns(&mut self.xu);
        self.scratch.drop_replaced_columns(&mut self.uu);
        self.scratch.drop_replaced_rows(&mut self.uu);
    }
}

pub(crate) fn check_weights(
    model: &Model,
    x: &[f64],
    multipliers: &[f64],
) -> Result<(), StepError> {
    let d = model.dimensions;
    for (weights, expected) in [(x, d.state()), (multipliers, d.constraints)] {
        if weights.len() != expected {
            return Err(StepError::Dimension { expected, actual: weights.len() });
        }
    }
    Ok(())
}
