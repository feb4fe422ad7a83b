//! The exact second-order linearization of a step, as full tensors or contracted with weights.
//!
//! The equations of a step are `R(θ, y) = 0` for the unknowns `y = (x, λ)` with the parameters
//! `θ = (q, p, inputs, k)`; `k` are the next prescribed positions, `O(θ, y)` is `p[k+1]`. The tangent
//! of parameter `a` is `W_a = (e_a, y'_a)`, from the first-order linearization. One more derivative:
//!
//! ```text
//! E y''_ab = −(D_a R_y y'_b + D_a R_θ,b)        E = R_y = [K  −A0ᵀ; A1  0]
//! p''_ab   = D_a O_y y'_b + D_a O_θ,b + O_y y''_ab
//! ```
//!
//! where `D_a` is the derivative of a block along `W_a`: its dual part when the block is evaluated in
//! [`Dual`] numbers seeded with `W_a`.
//!
//! A sum `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c` needs no tensor. With `μ = −E⁻ᵀ (z_y + O_yᵀ z_p)` it is the
//! Hessian of the scalar `μ·R + z_p·O`, congruent with `W`:
//!
//! ```text
//! G = Wᵀ ∇²(μ·R + z_p·O) W
//! Lagrangian     D_(α,β) ∇²L,   α = h (½μ₁ + z_p) along q,  β = −μ₁ along v: one directional derivative
//! constraints    −(μ₁ + z_p)·(Dhᵀλ)'' at q[k],   μ₂·D²h at q[k+1]
//! forces         direction by direction: they are no gradient
//! ```

use nalgebra::DMatrix;

use crate::Model;
use crate::plant::balls::{Turning, three};
use crate::plant::blocks::{StepBlocks, non_zero};
use crate::plant::linearize::Linearization;
use crate::plant::newton::Workspace;
use crate::plant::rows::{Term, add_rows, padded};
use crate::plant::{Plant, StepError, StepReport};
use crate::rotation;
use crate::scalar::Dual;
use crate::spatial::{Mat3, Vec3};

/// Full tensors with more numbers than this are refused: 1 GiB.
const ENTRIES_MAX: usize = 1 << 27;

/// The full second-order linearization would be too large.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the full second-order linearization of {parameters} parameters has {entries} entries, more than {ENTRIES_MAX}; contract it instead"
)]
pub struct TooLarge {
    /// Parameters: coordinates, momenta, inputs, next prescribed positions.
    pub parameters: usize,
    /// Numbers it would hold.
    pub entries: usize,
}

/// Sizes, and where things stand among the parameters `θ = (q, p, inputs, k)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Layout {
    nd: usize,
    nk: usize,
    ni: usize,
    nc: usize,
    /// Length of a row over the parameters, padded.
    stride: usize,
}

impl Layout {
    fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (nd, nk, ni, nc) = (d.dynamic, d.prescribed, d.inputs, d.constraints);
        Self { nd, nk, ni, nc, stride: padded((2 * (nd + nk) + ni).max(1)) }
    }

    /// Coordinates.
    fn n(&self) -> usize {
        self.nd + self.nk
    }

    /// First column of the inputs.
    fn inputs(&self) -> usize {
        self.n() + self.nd
    }

    /// First column of the next prescribed positions.
    fn next(&self) -> usize {
        self.inputs() + self.ni
    }

    fn parameters(&self) -> usize {
        self.next() + self.nk
    }

    /// Which of the six numbers that turn the ends of a prescribed ball joint a parameter is.
    fn end_of(&self, coordinate: usize, parameter: usize) -> Option<usize> {
        let ends = [coordinate, self.next() + coordinate.wrapping_sub(self.nd)];
        let first = ends.iter().position(|end| (*end..*end + 3).contains(&parameter))?;
        Some(3 * first + parameter - ends[first])
    }
}

/// What both forms compute with.
#[derive(Clone, Debug)]
struct Scratch {
    layout: Layout,
    blocks: StepBlocks<Dual>,
    /// `x'` and `λ'` by all parameters, row-major, nd + nc rows.
    tangent: Vec<f64>,
    terms: Vec<Term>,
    /// Entries of `u` that signals replace: they have no effect.
    replaced: Vec<usize>,
}

/// The exact second-order linearization of one step, preallocated.
///
/// One symmetric matrix of second derivatives for each entry of `x[k+1] = (q, p, v)` and for each
/// multiplier; the rows and columns of `v`, and the outputs of prescribed coordinates, are zero.
#[derive(Clone, Debug)]
pub struct SecondOrder {
    scratch: Scratch,
    /// One block for each parameter `a`: rows `x''` (nd), `λ''` (nc), `p''` (nd), columns `b ≤ a`.
    tensor: Vec<f64>,
    /// Velocities of prescribed ball joints, `ξ/h`, by both ends of the step.
    spins: Vec<Spin>,
}

/// Second derivatives of the velocity of a prescribed ball joint.
#[derive(Clone, Debug)]
struct Spin {
    /// First of its coordinates.
    coordinate: usize,
    /// For each component, by the start and by the end of the step.
    tensor: [DMatrix<f64>; 3],
}

/// Where the second derivatives of an output stand.
#[derive(Clone, Copy, Debug)]
enum Output {
    /// Nowhere: they are zero.
    Linear,
    /// In a row of the blocks.
    Row(usize),
    /// A component of a spin.
    Spin(usize, usize),
}

impl SecondOrder {
    /// Room for the second-order linearization of a model: `(2 nd + nc) N²` numbers for
    /// `N = 2 nd + 2 nk + ni` parameters.
    ///
    /// # Errors
    ///
    /// If these are more than 2²⁷, which is 1 GiB. [`Contraction`] has no such limit.
    pub fn new(model: &Model) -> Result<Self, TooLarge> {
        let layout = Layout::new(model);
        let parameters = layout.parameters();
        let entries = parameters * layout.stride * (2 * layout.nd + layout.nc);
        if entries > ENTRIES_MAX {
            return Err(TooLarge { parameters, entries });
        }
        let spin =
            |&coordinate: &usize| Spin { coordinate, tensor: [0; 3].map(|_| DMatrix::zeros(6, 6)) };
        let spins = model.orientations.iter().filter(|i| **i >= layout.nd).map(spin).collect();
        Ok(Self { scratch: Scratch::new(model), tensor: vec![0.0; entries], spins })
    }

    /// `∂²x_i[k+1]/∂x∂x` of output `i`, square of `2 nd + 2 nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn xx(&self, output: usize) -> DMatrix<f64> {
        self.state_block(self.output_row(output))
    }

    /// `∂²x_i[k+1]/∂x∂u` of output `i`, `2 nd + 2 nk` by `ni + nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn xu(&self, output: usize) -> DMatrix<f64> {
        self.mixed_block(self.output_row(output))
    }

    /// `∂²x_i[k+1]/∂u∂u` of output `i`, square of `ni + nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn uu(&self, output: usize) -> DMatrix<f64> {
        self.input_block(self.output_row(output))
    }

    /// `∂²λ_c/∂x∂x`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_xx(&self, c: usize) -> DMatrix<f64> {
        self.state_block(self.multiplier_row(c))
    }

    /// `∂²λ_c/∂x∂u`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_xu(&self, c: usize) -> DMatrix<f64> {
        self.mixed_block(self.multiplier_row(c))
    }

    /// `∂²λ_c/∂u∂u`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_uu(&self, c: usize) -> DMatrix<f64> {
        self.input_block(self.multiplier_row(c))
    }

    fn output_row(&self, output: usize) -> Output {
        let Layout { nd, nc, .. } = self.scratch.layout;
        let n = self.scratch.layout.n();
        assert!(output < 2 * n, "output {output} of {}", 2 * n);
        match output {
            i if i < nd => Output::Row(i),
            i if i < n => Output::Linear,
            i if i < n + nd => Output::Row(nd + nc + i - n),
            i => {
                let coordinate = i - n;
                let holds =
                    |spin: &Spin| (spin.coordinate..spin.coordinate + 3).contains(&coordinate);
                match self.spins.iter().position(holds) {
                    Some(spin) => Output::Spin(spin, coordinate - self.spins[spin].coordinate),
                    None => Output::Linear,
                }
            }
        }
    }

    fn multiplier_row(&self, c: usize) -> Output {
        let Layout { nd, nc, .. } = self.scratch.layout;
        assert!(c < nc, "constraint {c} of {nc}");
        Output::Row(nd + c)
    }

    fn entry(&self, output: Output, a: usize, b: usize) -> f64 {
        let layout = self.scratch.layout;
        let Layout { nd, nc, stride, .. } = layout;
        match output {
            Output::Linear => 0.0,
            Output::Row(row) => self.tensor[((a.max(b)) * (2 * nd + nc) + row) * stride + a.min(b)],
            Output::Spin(spin, component) => {
                let Spin { coordinate, tensor } = &self.spins[spin];
                match (layout.end_of(*coordinate, a), layout.end_of(*coordinate, b)) {
                    (Some(a), Some(b)) => tensor[component][(a, b)],
                    _ => 0.0,
                }
            }
        }
    }

    fn state_block(&self, row: Output) -> DMatrix<f64> {
        let (n, moving) = (self.scratch.layout.n(), self.scratch.layout.inputs());
        DMatrix::from_fn(2 * n, 2 * n, |a, b| {
            if a < moving && b < moving { self.entry(row, a, b) } else { 0.0 }
        })
    }

    fn mixed_block(&self, row: Output) -> DMatrix<f64> {
        let layout = self.scratch.layout;
        let moving = layout.inputs();
        let mut block = DMatrix::from_fn(2 * layout.n(), layout.ni + layout.nk, |a, b| {
            if a < moving { self.entry(row, a, moving + b) } else { 0.0 }
        });
        self.scratch.drop_replaced_columns(&mut block);
        block
    }

    fn input_block(&self, row: Output) -> DMatrix<f64> {
        let layout = self.scratch.layout;
        let (moving, size) = (layout.inputs(), layout.ni + layout.nk);
        let mut block =
            DMatrix::from_fn(size, size, |a, b| self.entry(row, moving + a, moving + b));
        self.scratch.drop_replaced_columns(&mut block);
        self.scratch.drop_replaced_rows(&mut block);
        block
    }
}

/// A weighted sum of second derivatives, `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c`, preallocated.
#[derive(Clone, Debug)]
pub struct Contraction {
    /// By `x` twice, square of `2 nd + 2 nk`.
    pub xx: DMatrix<f64>,
    /// By `x` and `u`, `2 nd + 2 nk` by `ni + nk`.
    pub xu: DMatrix<f64>,
    /// By `u` twice, square of `ni + nk`.
    pub uu: DMatrix<f64>,
    scratch: Scratch,
    /// `μ₁` (nd) and `μ₂` (nc).
    adjoint: Vec<f64>,
    /// What `x'` and `λ'` are multiplied with, nd + nc rows.
    cofactor: Vec<f64>,
    /// The sum over all parameters, row-major, and the products it is made of.
    sum: Vec<f64>,
    product: Vec<f64>,
    /// `μ₂·D²h(q[k+1])`, n by n.
    end_hessian: Vec<f64>,
    /// Direction along which the Hessian of the Lagrangian is differentiated: `α` along `q`, `β` along
    /// `v`.
    alpha: Vec<f64>,
    beta: Vec<f64>,
    /// `μ₁ + z_p`, with zeros for the prescribed coordinates.
    impulse: Vec<f64>,
}

impl Contraction {
    /// Room for the contraction of a model: `O((2 nd + 2 nk + ni)²)` numbers.
    pub fn new(model: &Model) -> Self {
        let layout = Layout::new(model);
        let (n, rows) = (layout.n(), layout.nd + layout.nc);
        let (size, inputs) = (layout.parameters(), layout.ni + layout.nk);
        Self {
            xx: DMatrix::zeros(2 * n, 2 * n),
            xu: DMatrix::zeros(2 * n, inputs),
            uu: DMatrix::zeros(inputs, inputs),
            scratch: Scratch::new(model),
            adjoint: vec![0.0; rows],
            cofactor: vec![0.0; rows * layout.stride],
            sum: vec![0.0; size * layout.stride],
            product: vec![0.0; size * layout.stride],
            end_hessian: vec![0.0; n * n],
            alpha: vec![0.0; n],
            beta: vec![0.0; n],
            impulse: vec![0.0; n],
        }
    }
}

impl Plant {
    /// Linearizes the map at the current state and `u` to second order, and stays there. `first` gets
    /// what [`Plant::linearize`] writes.
    ///
    /// Costs, for `N` parameters, `N` evaluations of the derivative blocks in dual numbers and
    /// O(N² nd·depth).
    ///
    /// # Panics
    ///
    /// If `first` or `second` was made for a model of other dimensions.
    pub fn linearize_second_order(
        &mut self,
        u: &[f64],
        first: &mut Linearization,
        second: &mut SecondOrder,
    ) -> Result<StepReport, StepError> {
        let report = self.linearize(u, first)?;
        assert_layout(&self.model, &second.scratch);
        let effective = std::mem::take(&mut self.workspace.effective_input);
        let u = if effective.is_empty() { u } else { &effective };
        self.differentiate_linearization(u, first, second);
        self.workspace.effective_input = effective;
        Ok(report)
    }

    /// Weighted second derivatives of the map at the current state and `u`,
    /// `Σ z_i ∂²x_i[k+1] + Σ w_c ∂²λ_c` with `z = weights_x` (2 nd + 2 nk) and
    /// `w = weights_multipliers` (nc), without the tensors; stays there. `first` gets what
    /// [`Plant::linearize`] writes.
    ///
    /// Costs one adjoint solution, one evaluation of the derivative blocks in dual numbers (with
    /// nonlinear forces: one of theirs for each parameter), and O(N² nd).
    ///
    /// # Errors
    ///
    /// Those of a step, and [`StepError::Dimension`] for weights of the wrong length.
    ///
    /// # Panics
    ///
    /// If `first` or `out` was made for a model of other dimensions.
    pub fn contract_second_order(
        &mut self,
        u: &[f64],
        weights_x: &[f64],
        weights_multipliers: &[f64],
        first: &mut Linearization,
        out: &mut Contraction,
    ) -> Result<StepReport, StepError> {
        let d = self.model.dimensions;
        for (weights, expected) in [(weights_x, d.state()), (weights_multipliers, d.constraints)] {
            if weights.len() != expected {
                return Err(StepError::Dimension { expected, actual: weights.len() });
            }
        }
        let report = self.linearize(u, first)?;
        assert_layout(&self.model, &out.scratch);
        first.write_tangent(out.scratch.layout.stride, &mut out.scratch.tangent);
        self.find_adjoint(weights_x, weights_multipliers, out);
        let effective = std::mem::take(&mut self.workspace.effective_input);
        let u = if effective.is_empty() { u } else { &effective };
        if self.model.orientations.is_empty() && self.model.forces.is_none() {
            self.contract_gradients(u, out);
        } else {
            self.contract_directions(u, weights_x, out);
        }
        self.workspace.effective_input = effective;
        out.finish();
        Ok(report)
    }

    /// Fills the tensor at the solution in the workspace, whose factors `first` left there.
    fn differentiate_linearization(
        &mut self,
        u: &[f64],
        first: &Linearization,
        second: &mut SecondOrder,
    ) {
        let model = &*self.model;
        let SecondOrder { scratch, tensor, spins } = second;
        let Layout { nd, nc, stride, .. } = scratch.layout;
        let n = scratch.layout.n();
        let workspace = &mut self.workspace;
        workspace.schur.reserve(stride);
        first.write_tangent(stride, &mut scratch.tangent);
        let rows = (2 * nd + nc) * stride;
        if rows == 0 {
            return;
        }
        for (a, block) in tensor.chunks_exact_mut(rows).enumerate() {
            scratch.seed(a, &self.state.q, u, &workspace.increment, &workspace.multipliers);
            scratch.seed_orientations(a, model, workspace);
            scratch.blocks.evaluate(model, &self.settings);
            let Scratch { layout, blocks, tangent, terms, .. } = scratch;
            // Columns beyond `a` follow from symmetry, which ball joints reach only in the end.
            let columns = if blocks.turnings.is_empty() { padded(a + 1) } else { stride };
            let (solved, momentum) = block.split_at_mut((nd + nc) * stride);
            let (residual, closing) = solved.split_at_mut(nd * stride);

            // What the change of the blocks makes of the tangents.
            for (i, row) in residual.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                let by = [&blocks.residual_start[..], &blocks.residual_next[..]];
                layout.place(row, i, by, &blocks.residual_inputs);
                blocks.terms(i, &blocks.residual_next, terms);
                add_rows(row, tangent, stride, terms);
            }
            for (i, row) in momentum.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                let by = [&blocks.momentum_start[..], &blocks.momentum_next[..]];
                layout.place(row, i, by, &blocks.momentum_inputs);
                blocks.terms(i, &blocks.momentum_next, terms);
                add_rows(row, tangent, stride, terms);
            }
            for (c, row) in closing.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                let [by_start, by_next] =
                    blocks.end_jacobians().map(|jacobian| &jacobian[c * n..][..n]);
                layout.place_end(row, by_start, by_next);
                terms.clear();
                terms.extend(non_zero(by_next[..nd].iter().map(|entry| entry.eps)));
                add_rows(row, tangent, stride, terms);
            }

            // x'' and λ'' = −E⁻¹ (…).
            workspace.matrix.solve_rows(&model.elimination, residual, stride, columns);
            for (c, row) in closing.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                row.iter_mut().for_each(|entry| *entry = -*entry);
                let jacobian = &workspace.end.jacobian[c * n..][..nd];
                terms.clear();
                terms.extend(non_zero(jacobian.iter().copied()));
                add_rows(row, residual, stride, terms);
            }
            if nc > 0 {
                workspace.schur.solve_rows(closing, stride);
            }
            for (i, row) in residual.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                row.iter_mut().for_each(|entry| *entry = -*entry);
                let responses = &workspace.responses[i * padded(nc)..][..nc];
                terms.clear();
                terms.extend(responses.iter().enumerate().map(|(c, response)| (*response, c)));
                add_rows(row, closing, stride, terms);
            }

            // What these make of the momentum.
            for (i, row) in momentum.chunks_exact_mut(stride).enumerate() {
                let slopes = blocks.momentum_next[i * n..][..nd].iter().map(|entry| entry.re);
                let impulses = (0..nc).map(|c| -workspace.start.jacobian[c * n + i]);
                terms.clear();
                terms.extend(non_zero(slopes.chain(impulses)));
                add_rows(&mut row[..columns], solved, stride, terms);
            }
            for t in blocks.turnings.iter().filter(|t| t.coordinate < nd) {
                layout.turn_rows(t, tangent, solved);
            }
            let prescribed = blocks.turnings.iter().filter(|t| t.coordinate >= nd);
            for (spin, t) in spins.iter_mut().zip(prescribed) {
                if let Some(a) = layout.end_of(t.coordinate, a) {
                    let change = spin_change(t, self.settings.time_step_s);
                    for (tensor, row) in spin.tensor.iter_mut().zip(change) {
                        tensor.row_mut(a).iter_mut().zip(row).for_each(|(to, from)| *to = from);
                    }
                }
            }
        }
        if !model.orientations.is_empty() {
            symmetrise(tensor, rows, stride);
            for tensor in spins.iter_mut().flat_map(|spin| &mut spin.tensor) {
                *tensor = (&*tensor + tensor.transpose()) * 0.5;
            }
        }
    }

    /// `μ = −E⁻ᵀ (z_y + O_yᵀ z_p)`.
    fn find_adjoint(&mut self, z: &[f64], w: &[f64], out: &mut Contraction) {
        let (model, workspace) = (&*self.model, &mut self.workspace);
        let Layout { nd, nc, .. } = out.scratch.layout;
        let n = out.scratch.layout.n();
        let z_p = &z[n..n + nd];
        let (first, second) = out.adjoint.split_at_mut(nd);
        first.copy_from_slice(&z[..nd]);
        for &i in model.orientations.iter().filter(|i| **i < nd) {
            let to_end = rotation::dexp(three(&workspace.increment, i));
            let turned = to_end.apply_transposed(three(z, i));
            first[i..i + 3].copy_from_slice(&turned.0);
        }
        for (row, z) in workspace.end_slopes.chunks_exact(nd.max(1)).zip(z_p) {
            first.iter_mut().zip(row).for_each(|(entry, slope)| *entry += slope * z);
        }
        // Kᵀ μ₁ + A1ᵀ μ₂ = first, −A0 μ₁ = second.
        if nc > 0 {
            workspace.residual.copy_from_slice(first);
            workspace.matrix.solve_transposed(&model.elimination, &mut workspace.residual);
            for (c, (entry, weight)) in second.iter_mut().zip(w).enumerate() {
                let jacobian = &workspace.start.jacobian[c * n..][..nd];
                let moved = workspace.residual.iter().zip(z_p).map(|(r, z)| r - z);
                *entry = weight + jacobian.iter().zip(moved).map(|(a, x)| a * x).sum::<f64>();
            }
            workspace.schur.solve_transposed(second);
            for (c, weight) in second.iter().enumerate() {
                let jacobian = &workspace.end.jacobian[c * n..][..nd];
                first.iter_mut().zip(jacobian).for_each(|(entry, a)| *entry -= a * weight);
            }
        }
        workspace.matrix.solve_transposed(&model.elimination, first);
        out.adjoint.iter_mut().for_each(|entry| *entry = -*entry);
        let h = self.settings.time_step_s;
        for (i, (mu, z)) in out.adjoint[..nd].iter().zip(z_p).enumerate() {
            out.alpha[i] = h * (0.5 * mu + z);
            out.beta[i] = -mu;
            out.impulse[i] = mu + z;
        }
    }

    /// The sum with ball joints, whose tangent spaces do not commute: one evaluation of all blocks for
    /// each parameter.
    fn contract_directions(&mut self, u: &[f64], z: &[f64], out: &mut Contraction) {
        let (model, workspace) = (&*self.model, &mut self.workspace);
        let Contraction { scratch, adjoint, impulse, cofactor, sum, product, .. } = out;
        let Layout { nd, nc, ni, stride, .. } = scratch.layout;
        let (n, inputs, next) =
            (scratch.layout.n(), scratch.layout.inputs(), scratch.layout.next());
        sum.fill(0.0);
        // What `x'` and `λ'` are multiplied with.
        let by_unknown = &mut cofactor[..nd + nc];
        for (a, row) in product.chunks_exact_mut(stride).enumerate() {
            scratch.seed(a, &self.state.q, u, &workspace.increment, &workspace.multipliers);
            scratch.seed_orientations(a, model, workspace);
            scratch.blocks.evaluate(model, &self.settings);
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
                for (z, change) in z.iter().zip(spin_change(t, self.settings.time_step_s)) {
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
            terms.clear();
            terms.extend(non_zero(by_unknown.iter().copied()));
            add_rows(row, tangent, stride, terms);
            row.iter_mut().for_each(|entry| *entry *= 0.5);
        }
    }

    /// Starts the sum with what comes from the Lagrangian and the constraints.
    fn contract_gradients(&mut self, u: &[f64], out: &mut Contraction) {
        let (model, workspace) = (&*self.model, &mut self.workspace);
        let h = self.settings.time_step_s;
        let Contraction { scratch, adjoint, cofactor, sum, product, end_hessian, .. } = out;
        let Scratch { layout, blocks, tangent, terms, .. } = scratch;
        let Layout { nd, nc, stride, .. } = *layout;
        let n = layout.n();
        let dual = |re: &f64, eps: &f64| Dual::new(*re, *eps);
        for i in 0..n {
            blocks.q_mid[i] = dual(&workspace.q_mid[i], &out.alpha[i]);
            blocks.velocity[i] = dual(&workspace.velocity[i], &out.beta[i]);
            blocks.q_start[i] = dual(&self.state.q[i], &out.impulse[i]);
        }
        for (dual, value) in blocks.inputs.iter_mut().zip(u) {
            *dual = Dual::new(*value, 0.0);
        }
        blocks.evaluate_mid(model);
        if nc > 0 {
            for (dual, lambda) in blocks.multipliers.iter_mut().zip(&workspace.multipliers) {
                *dual = Dual::new(*lambda, 0.0);
            }
            blocks.evaluate_start(model);
            workspace.end.hessian(model, &workspace.q_end, &adjoint[nd..], end_hessian);
        }

        // Second derivatives by the start and by what is next: `x` or `k`.
        let second = |i: usize, j: usize, (c_i, d_i): (f64, f64), (c_j, d_j): (f64, f64)| {
            let (qq, vv) = (blocks.mid.l_qq[i * n + j].eps, blocks.mid.l_vv[i * n + j].eps);
            let (qv, vq) = (blocks.mid.l_qv[i * n + j].eps, blocks.mid.l_qv[j * n + i].eps);
            c_i * (c_j * qq + d_j * qv) + d_i * (c_j * vq + d_j * vv)
        };
        let at_start = |i: usize| if i < nd { (1.0, 0.0) } else { (0.5, -1.0 / h) };
        let at_next = (0.5, 1.0 / h);
        sum.fill(0.0);
        cofactor.fill(0.0);
        for i in 0..n {
            for j in 0..n {
                let mut start_start = second(i, j, at_start(i), at_start(j));
                let mut start_next = second(i, j, at_start(i), at_next);
                let mut next_next = second(i, j, at_next, at_next);
                if nc > 0 {
                    let end = end_hessian[i * n + j];
                    start_start -= blocks.hessian[i * n + j].eps;
                    if i < nd {
                        start_next += end;
                    }
                    if i < nd && j < nd {
                        start_start += end;
                    }
                    next_next += end;
                }
                sum[i * stride + j] += start_start;
                // The products are added with their transposes: what stands on both sides is halved.
                match (i < nd, j < nd) {
                    (_, true) => cofactor[j * stride + i] += start_next,
                    (_, false) => {
                        sum[i * stride + layout.next() + j - nd] += start_next;
                        sum[(layout.next() + j - nd) * stride + i] += start_next;
                    }
                }
                match (i < nd, j < nd) {
                    (true, true) => product[i * stride + j] = 0.5 * next_next,
                    (true, false) => cofactor[i * stride + layout.next() + j - nd] += next_next,
                    (false, false) => {
                        let (i, j) = (layout.next() + i - nd, layout.next() + j - nd);
                        sum[i * stride + j] += next_next;
                    }
                    (false, true) => {}
                }
            }
        }
        for i in 0..nd {
            terms.clear();
            terms.extend(non_zero(product[i * stride..][..nd].iter().copied()));
            add_rows(&mut cofactor[i * stride..][..stride], tangent, stride, terms);
        }
        for c in 0..nc {
            let row = &mut cofactor[(nd + c) * stride..][..n];
            let turned = &blocks.start.jacobian[c * n..][..n];
            row.iter_mut().zip(turned).for_each(|(entry, turned)| *entry = -turned.eps);
        }
        // (x', λ')ᵀ times the cofactor.
        product.fill(0.0);
        for (b, row) in product.chunks_exact_mut(stride).enumerate() {
            terms.clear();
            terms.extend(non_zero((0..nd + nc).map(|i| tangent[i * stride + b])));
            add_rows(row, cofactor, stride, terms);
        }
    }
}

fn assert_layout(model: &Model, scratch: &Scratch) {
    assert!(
        scratch.layout == Layout::new(model),
        "the second-order linearization belongs to another model"
    );
}

impl Layout {
    /// Writes the dual parts of row `i` of a block by start, next, and inputs into the columns of the
    /// parameters that these are; the columns of `x` are for the tangents.
    fn place(&self, row: &mut [f64], i: usize, by: [&[Dual]; 2], by_inputs: &[Dual]) {
        let [start, next] = by.map(|block| &block[i * self.n()..][..self.n()]);
        row.fill(0.0);
        put(row, 0, start);
        put(row, self.inputs(), &by_inputs[i * self.ni..][..self.ni]);
        put(row, self.next(), &next[self.nd..]);
    }

    /// The same for a row of the constraint Jacobian at the end: a shift of the start moves both ends.
    fn place_end(&self, row: &mut [f64], by_start: &[Dual], by_next: &[Dual]) {
        row.fill(0.0);
        put(row, 0, &by_start[..self.nd]);
        put(row, self.next(), &by_next[self.nd..]);
    }

    /// From `ξ''` of a ball joint to the second derivative of how its end turns, `dexp₋ξ ξ' + exp(−ξ) η`
    /// once more along the direction of the duals.
    fn turn_rows(&self, t: &Turning<Dual>, tangent: &[f64], rows: &mut [f64]) {
        let (i, stride) = (t.coordinate, self.stride);
        let entry = |m: &Mat3<Dual>, a: usize, b: usize| m.0[b][a];
        for column in 0..stride {
            let at = |b: usize| (i + b) * stride + column;
            let second = [0, 1, 2].map(|b| rows[at(b)]);
            for a in 0..3 {
                let turned = (0..3).map(|b| {
                    let to_end = entry(&t.to_end, a, b);
                    to_end.re * second[b] + to_end.eps * tangent[at(b)]
                });
                rows[at(a)] = turned.sum();
                if (i..i + 3).contains(&column) {
                    rows[at(a)] += entry(&t.carried, a, column - i).eps;
                }
            }
        }
    }
}

/// How the derivatives of the velocity of a prescribed ball joint by the ends of the step,
/// `(N⁻ η₁ − N⁺ η₀) / h`, change along the direction of the duals.
fn spin_change(t: &Turning<Dual>, time_step_s: f64) -> [[f64; 6]; 3] {
    [0, 1, 2].map(|row| {
        [0, 1, 2, 3, 4, 5].map(|column| {
            let entry = if column < 3 {
                -t.momentum.0[row][column].eps
            } else {
                t.momentum.0[column - 3][row].eps
            };
            entry / time_step_s
        })
    })
}

/// Replaces the derivative along `a` of the tangent `b` by its mean with that along `b` of the tangent
/// `a`: the second derivative in the chart `exp` of each ball joint. Their difference is a commutator.
fn symmetrise(tensor: &mut [f64], rows: usize, stride: usize) {
    let parameters = tensor.len() / rows;
    for a in 0..parameters {
        for b in 0..a {
            for row in 0..rows / stride {
                let lower = a * rows + row * stride + b;
                tensor[lower] = 0.5 * (tensor[lower] + tensor[b * rows + row * stride + a]);
            }
        }
    }
}

/// Writes dual parts from a column on, as far as the row goes.
fn put(row: &mut [f64], column: usize, entries: &[Dual]) {
    for (target, entry) in row.iter_mut().skip(column).zip(entries) {
        *target = entry.eps;
    }
}

impl Scratch {
    fn new(model: &Model) -> Self {
        let layout = Layout::new(model);
        let rows = layout.nd + layout.nc;
        Self {
            layout,
            blocks: StepBlocks::new(model),
            tangent: vec![0.0; rows * layout.stride],
            terms: Vec::with_capacity(layout.nd * layout.n() + layout.nc),
            replaced: model.replaced_inputs().collect(),
        }
    }

    /// Zeroes the columns of the entries of `u` that signals replace.
    fn drop_replaced_columns(&self, by_u: &mut DMatrix<f64>) {
        self.replaced.iter().for_each(|&column| by_u.column_mut(column).fill(0.0));
    }

    /// Zeroes the rows of the entries of `u` that signals replace.
    fn drop_replaced_rows(&self, by_u: &mut DMatrix<f64>) {
        self.replaced.iter().for_each(|&row| by_u.row_mut(row).fill(0.0));
    }

    /// Places the blocks at the solution, with the tangent of parameter `a`.
    fn seed(&mut self, a: usize, q: &[f64], u: &[f64], increment: &[f64], multipliers: &[f64]) {
        let Layout { nd, ni, stride, .. } = self.layout;
        let (inputs, next) = (self.layout.inputs(), self.layout.next());
        let unit = |is: bool| if is { 1.0 } else { 0.0 };
        let tangent = |row: usize| self.tangent[row * stride + a];
        for (i, q) in q.iter().enumerate() {
            self.blocks.q_start[i] = Dual::new(*q, unit(a == i));
        }
        for (i, x) in increment.iter().enumerate() {
            self.blocks.next[i] = Dual::new(*x, tangent(i));
        }
        for (k, value) in u[ni..].iter().enumerate() {
            self.blocks.next[nd + k] = Dual::new(*value, unit(a == next + k));
        }
        for (c, lambda) in multipliers.iter().enumerate() {
            self.blocks.multipliers[c] = Dual::new(*lambda, tangent(nd + c));
        }
        for (i, value) in u[..ni].iter().enumerate() {
            self.blocks.inputs[i] = Dual::new(*value, unit(a == inputs + i));
        }
    }
}

impl Scratch {
    /// Places the ball joints at the solution, with the tangent of parameter `a`.
    fn seed_orientations(&mut self, a: usize, model: &Model, workspace: &Workspace) {
        let next = self.layout.next();
        for (o, &i) in model.orientations.iter().enumerate() {
            let axis = |first: usize| {
                let mut axis = Vec3::ZERO;
                if (first..first + 3).contains(&a) {
                    axis.0[a - first] = 1.0;
                }
                axis
            };
            let (start, by_start) = (workspace.orientations_start[o], axis(i));
            let along = |v: Vec3, rate: Vec3| Vec3([0, 1, 2].map(|k| Dual::new(v[k], rate[k])));
            let rate = [0, 1, 2].map(|k| start.apply(by_start.cross(Mat3::IDENTITY.0[k])));
            self.blocks.orientations[0][o] = Mat3([0, 1, 2].map(|k| along(start.0[k], rate[k])));
            if i >= self.layout.nd {
                let turn = workspace.turns[o];
                let momentum = rotation::momentum_at_start(turn);
                let rate = momentum.apply(axis(next + i - self.layout.nd))
                    - momentum.apply_transposed(by_start);
                self.blocks.next[i..i + 3].copy_from_slice(&along(turn, rate).0);
            }
        }
    }
}

impl Contraction {
    /// Symmetrises the products, adds them to the sum, and hands it out.
    fn finish(&mut self) {
        let layout = self.scratch.layout;
        let (moving, stride) = (layout.inputs(), layout.stride);
        let entry = |a: usize, b: usize| {
            self.sum[a * stride + b] + (self.product[a * stride + b] + self.product[b * stride + a])
        };
        self.xx.fill(0.0);
        self.xu.fill(0.0);
        for a in 0..moving {
            for b in 0..moving {
                self.xx[(a, b)] = entry(a, b);
            }
            for b in 0..layout.ni + layout.nk {
                self.xu[(a, b)] = entry(a, moving + b);
            }
        }
        for a in 0..layout.ni + layout.nk {
            for b in 0..layout.ni + layout.nk {
                self.uu[(a, b)] = entry(moving + a, moving + b);
            }
        }
        self.scratch.drop_replaced_columns(&mut self.xu);
        self.scratch.drop_replaced_columns(&mut self.uu);
        self.scratch.drop_replaced_rows(&mut self.uu);
    }
}
