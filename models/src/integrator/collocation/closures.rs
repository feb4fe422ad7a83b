//! Constraints in collocation: they hold at the nodes of Lobatto.
//!
//! With `s` stages at the nodes of Gauss, `h(q) = 0` is asked for at the `s + 1` nodes of Lobatto
//! `0 = c̃_0 < … < c̃_s = 1` (Jay, SIAM J. Numer. Anal. 33, 1996), each with an impulse `Λ_j`. That at the start
//! belongs to the step, that at the end to the next one, as with the midpoint rule, which this is with `s = 1`:
//!
//! ```text
//! Q̃_j = q + Σ_i κ_ji Y_i                                              κ_ji = (∫ ℓ_i)/b_i from 0 to c̃_j
//! 0 = p + Σ_j μ_ij P_j − Σ_j<s (1 − κ_ji) Dh(Q̃_j)ᵀ Λ_j − L_v(Q_i, V_i)
//! 0 = h(Q̃_j)   j = 1 … s          p[k+1] = p + Σ P_j − Σ_j<s Dh(Q̃_j)ᵀ Λ_j          λ = Σ Λ_j
//! ```
//!
//! which [`balls`](super::balls) has for ball joints. These are the equations of the discrete action
//! `Σ h b_i L(Q_i, V_i) − Σ_j<s Λ_j·h(Q̃_j)`: the method is symplectic, and keeps momenta. Of `J = ∂R/∂Y`,
//! `B = ∂R/∂Λ` and `G = ∂h/∂Y` corrections take the inverse of `J` and the factors of `S = G J⁻¹ B`, whose dependent
//! rows are treated as those of the midpoint rule.

use std::array;

use plantd_math::dense_inverse::DenseInverse;
use plantd_math::norms::larger;
use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::{Term, add_rows, padded};
use plantd_math::scalar::{Compared, LanesOf, Scalar, in_registers};
use plantd_math::spatial::Mat3;

use crate::constraints::closure::{Closure, in_units};
use crate::integrator::collocation::balls::Balls;
use crate::integrator::collocation::slopes::{Closing, Slopes};
use crate::integrator::parameters::Parameters;
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::scheme::Tableau;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::StepContext;
use crate::model::mechanism::Model;

/// The constraints of a step.
#[derive(Clone, Debug)]
pub(crate) struct Closures<const N: usize> {
    /// Stages.
    count: usize,
    /// `c̃_j`, `κ_ji` node after node, and shares of the impulses.
    nodes: Vec<f64>,
    reach: Vec<f64>,
    shares: Vec<f64>,
    /// `κ_ji` of `N` nodes after the start side by side, stage after stage; and of a node, of `N` stages side by side.
    reach_beside: Vec<LanesOf<N>>,
    stages_reached: Vec<LanesOf<N>>,
    /// The equations at the start, and at each `N` nodes after it, side by side.
    start: Closure,
    beside: Vec<Closure<LanesOf<N>>>,
    /// `Q̃_j` of the start, and of each `N` nodes after it.
    start_q: Vec<f64>,
    q_beside: Vec<LanesOf<N>>,
    /// Of all nodes, one after the other, as [`Closures::spread`] finds them: `Q̃_j`, and `Dh`, row-major.
    pub(crate) q: Vec<f64>,
    pub(crate) jacobians: Vec<f64>,
    /// `h` at the nodes after the start, one after the other.
    pub(super) values: Vec<f64>,
    /// `Λ_j`, one after the other; of `N` nodes side by side.
    pub(crate) multipliers: Vec<f64>,
    multipliers_beside: Vec<LanesOf<N>>,
    /// `Σ_c Λ_jc D²h_c` at all nodes but the end, square; of `N` nodes side by side.
    hessians: Vec<f64>,
    hessian_beside: Vec<LanesOf<N>>,
    /// `−Dhᵀ Λ_j`, of ball joints in their charts: of the start, and of each `N` nodes.
    start_pushes: Vec<f64>,
    pushes: Vec<LanesOf<N>>,
    /// `Σ |Dh_i Λ|` of `N` nodes.
    sizes: Vec<LanesOf<N>>,
    /// What stages have of the pushes at the start: 1, and of ball joints, which have half of them at the centre, ½.
    whole: Vec<f64>,
    /// Right-hand side, then the last `−ΔΛ`.
    correction: Vec<f64>,
    /// What the last correction of the increments makes of `−Σ Dhᵀ Λ`, which was evaluated before it.
    turned: Vec<f64>,
    /// `Dh Dhᵀ` of one node, which tells the equations that depend on others.
    gram: PivotedLu,
    /// `J⁻¹ B`, row-major, padded.
    pub(crate) responses: Vec<f64>,
    pub(crate) schur: PivotedLu,
    /// Reciprocal condition of `S`, as it was factored last.
    estimate: f64,
    /// Of the responses, how far each coordinate gets to a node; of a correction, in its first column.
    moved: Vec<f64>,
    terms: Vec<Term>,
}

/// Writes the impulses `−Dhᵀ Λ`, and the magnitudes of what they are the sums of.
#[inline(always)]
fn push<S: Compared>(
    model: &Model,
    jacobian: &[S],
    multipliers: &[S],
    [pushes, sizes]: [&mut [S]; 2],
) {
    pushes.fill(S::ZERO);
    sizes.fill(S::ZERO);
    let rows = jacobian.chunks_exact(model.dimensions.coordinates()).zip(multipliers);
    for (constraint, (row, lambda)) in model.constraints.iter().zip(rows) {
        for &a in constraint.dynamic_coordinates() {
            let push = row[a] * *lambda;
            pushes[a] -= push;
            sizes[a] += push.abs();
        }
    }
}

impl<const N: usize> Closures<N> {
    pub(crate) fn new(model: &Model, tableau: &Tableau) -> Self {
        let d = model.dimensions;
        let (count, nc, nd, n) = (tableau.nodes.len(), d.constraints, d.dynamic, d.coordinates());
        let zeros = |len: usize| vec![0.0; len];
        let stride = padded(count * nc);
        let groups = count.div_ceil(N);
        let lanes = |len: usize| vec![LanesOf::ZERO; len];
        let reach = |j: usize, i: usize| match j <= count && i < count {
            true => tableau.reach[j * count + i],
            false => 0.0,
        };
        let several = |of: &dyn Fn(usize) -> f64| LanesOf(array::from_fn(of));
        let mut whole = vec![1.0; nd];
        for &c in model.orientations.iter().filter(|c| **c < nd) {
            whole[c..c + 3].fill(0.5);
        }
        Self {
            count,
            whole,
            nodes: tableau.ends.clone(),
            reach: tableau.reach.clone(),
            shares: tableau.shares.clone(),
            reach_beside: (0..groups)
                .flat_map(|g| (0..count).map(move |i| (g, i)))
                .map(|(g, i)| several(&|lane| reach(1 + g * N + lane, i)))
                .collect(),
            stages_reached: (0..=count)
                .flat_map(|j| (0..groups).map(move |g| (j, g)))
                .map(|(j, g)| several(&|lane| reach(j, g * N + lane)))
                .collect(),
            start: Closure::new(model),
            beside: vec![Closure::new(model); groups],
            start_q: zeros(n),
            q_beside: lanes(groups * n),
            q: zeros((count + 1) * n),
            jacobians: zeros((count + 1) * nc * n),
            values: zeros(count * nc),
            multipliers: zeros(count * nc),
            multipliers_beside: lanes(nc),
            hessians: zeros(count * n * n),
            hessian_beside: lanes(n * n),
            start_pushes: zeros(nd),
            pushes: lanes(groups * nd),
            sizes: lanes(nd),
            correction: zeros(count * nc),
            turned: zeros(nd),
            gram: room_for_schur(model, 1, 1),
            responses: zeros(nd * count * stride),
            schur: room_for_schur(model, count, 1),
            estimate: 1.0,
            moved: zeros(nd * stride),
            terms: Vec::with_capacity(count * nd.max(nc)),
        }
    }

    /// Numbers of a row of responses.
    pub(crate) fn stride(&self) -> usize {
        padded(self.multipliers.len())
    }

    /// Columns of `S`, for the rows of a matrix.
    fn equations(&self) -> usize {
        self.multipliers.len() / self.count
    }

    /// `κ_ji` of a node.
    pub(crate) fn reach(&self, j: usize) -> &[f64] {
        &self.reach[j * self.count..][..self.count]
    }

    /// `Σ_c Λ_jc D²h_c` at a node.
    pub(crate) fn hessian(&self, j: usize) -> &[f64] {
        let size = self.hessians.len() / self.count;
        &self.hessians[j * size..][..size]
    }

    /// Takes the start, with the orientations of ball joints, prescribed positions, and the last impulses for a guess.
    pub(super) fn begin(
        &mut self,
        StepContext { model, state, u, .. }: StepContext<'_>,
        orientations: &[Mat3],
    ) {
        let d = model.dimensions;
        let (nd, n) = (d.dynamic, d.coordinates());
        for (g, q) in self.q_beside.chunks_exact_mut(n).enumerate() {
            for (k, q) in q[nd..].iter_mut().enumerate() {
                let (start, next) = (state.q[nd + k], u[d.inputs + k]);
                *q = LanesOf(array::from_fn(|lane| match self.nodes.get(1 + g * N + lane) {
                    Some(1.0) => next,
                    Some(node) => start + node * (next - start),
                    None => start,
                }));
            }
        }
        self.start_q.copy_from_slice(&state.q);
        self.start.evaluate(model, &self.start_q, orientations);
        self.start.differentiate(model, &self.start_q);
        self.beside.iter_mut().for_each(|nodes| nodes.expect_round_off_of(&self.start));
        self.turned.fill(0.0);
        let nodes = self.multipliers.chunks_exact_mut(d.constraints);
        for (multipliers, share) in nodes.zip(&self.shares) {
            let pairs = multipliers.iter_mut().zip(&state.multipliers);
            pairs.for_each(|(lambda, total)| *lambda = share * total);
        }
    }

    /// Evaluates the constraints where the increments `Y` lead, numbers of a coordinate `width` apart; returns what
    /// impulses are the sums of, at most.
    pub(super) fn evaluate(
        &mut self,
        StepContext { model, state, .. }: StepContext<'_>,
        increments: &[f64],
        width: usize,
        mut balls: Option<&mut Balls<N>>,
    ) -> f64 {
        let n = model.dimensions.coordinates();
        let mut largest = self.push_at_start(model);
        for g in 0..self.beside.len() {
            self.move_to(state, increments, width, n, g);
            let orientations =
                balls.as_mut().map_or(&[][..], |balls| balls.move_to_nodes(increments, g));
            let q = &self.q_beside[g * n..][..n];
            self.beside[g].evaluate(model, q, orientations);
            self.beside[g].differentiate(model, q);
            largest = larger(largest, self.push(model, g));
        }
        if let Some(balls) = balls {
            balls.move_to_start(increments);
            balls.take_start_pushes(&mut self.start_pushes);
            let nd = self.start_pushes.len();
            for (g, pushes) in self.pushes.chunks_exact_mut(nd.max(1)).enumerate() {
                balls.take_pushes(g, pushes);
            }
        }
        largest
    }

    /// Configurations of `N` nodes.
    fn move_to(
        &mut self,
        state: &PreciseState,
        increments: &[f64],
        width: usize,
        n: usize,
        g: usize,
    ) {
        in_registers!(LanesOf<N>, {
            let reach = &self.reach_beside[g * self.count..][..self.count];
            let q = &mut self.q_beside[g * n..];
            for (a, own) in increments.chunks_exact(width).enumerate() {
                let mut moved = LanesOf::ZERO;
                for (kappa, y) in reach.iter().zip(own) {
                    moved += *kappa * *y;
                }
                q[a] = (moved + state.q_low[a]) + state.q[a];
            }
        })
    }

    /// Impulses of the start; returns what they are the sums of, at most.
    fn push_at_start(&mut self, model: &Model) -> f64 {
        let sizes = &mut self.moved[..self.start_pushes.len()];
        let multipliers = &self.multipliers[..model.constraints.len()];
        push(model, &self.start.jacobian, multipliers, [&mut self.start_pushes, &mut *sizes]);
        sizes.iter().copied().fold(0.0, larger)
    }

    /// Values and impulses of `N` nodes; returns what impulses are the sums of, at most.
    fn push(&mut self, model: &Model, g: usize) -> f64 {
        let (nd, nc) = (self.start_pushes.len(), model.constraints.len());
        self.take_multipliers(g);
        in_registers!(LanesOf<N>, {
            let (at, sizes) = (&self.beside[g], &mut self.sizes[..]);
            let nodes = self.values[g * N * nc..].chunks_exact_mut(nc);
            for (lane, values) in nodes.take(N).enumerate() {
                for (value, several) in values.iter_mut().zip(&at.value) {
                    *value = several.0[lane];
                }
            }
            let pushes = &mut self.pushes[g * nd..][..nd];
            push(model, &at.jacobian, &self.multipliers_beside, [pushes, &mut *sizes]);
            sizes.iter().flat_map(|size| size.0).fold(0.0, larger)
        })
    }

    /// The impulses of `N` nodes side by side; what comes after the step has none.
    fn take_multipliers(&mut self, g: usize) {
        let nc = self.equations();
        for (c, lambda) in self.multipliers_beside.iter_mut().enumerate() {
            *lambda = LanesOf(array::from_fn(|lane| {
                self.multipliers.get((1 + g * N + lane) * nc + c).copied().unwrap_or_default()
            }));
        }
    }

    /// Largest violation in units of its round-off.
    pub(super) fn violation(&self) -> f64 {
        let mut largest = 0.0;
        for (g, at) in self.beside.iter().enumerate() {
            let nodes = N.min(self.count - g * N);
            for (value, round_off) in at.value.iter().zip(&at.round_off) {
                for (h, round_off) in value.0.into_iter().zip(round_off.0).take(nodes) {
                    largest = larger(largest, in_units(h, round_off));
                }
            }
        }
        largest
    }

    /// Adds the impulses to the residuals of the stages.
    pub(super) fn add_pushes(&self, residual: &mut [f64]) {
        in_registers!(LanesOf<N>, {
            let (nd, groups) = (self.start_pushes.len(), self.beside.len());
            for (a, residual) in residual.chunks_exact_mut(self.count).enumerate() {
                let whole = LanesOf::constant(self.whole[a]);
                for (to, residual) in residual.chunks_mut(N).enumerate() {
                    let mut sum = LanesOf::load_some(residual) + whole * self.start_pushes[a];
                    for g in 0..groups {
                        let nodes = self.pushes[g * nd + a].0.iter();
                        let reached = self.stages_reached[(1 + g * N) * groups + to..].iter();
                        for (kappa, push) in reached.step_by(groups).zip(nodes) {
                            sum += (whole - *kappa) * *push;
                        }
                    }
                    sum.store_some(residual);
                }
            }
        })
    }

    /// Writes what is known at the nodes one after the other: configurations and Jacobians.
    fn spread(&mut self) {
        let n = self.start_q.len();
        let size = self.start.jacobian.len();
        self.q[..n].copy_from_slice(&self.start_q);
        self.jacobians[..size].copy_from_slice(&self.start.jacobian);
        for j in 1..=self.count {
            let (g, lane) = ((j - 1) / N, (j - 1) % N);
            let own = self.q[j * n..][..n].iter_mut().zip(&self.q_beside[g * n..]);
            own.for_each(|(q, several)| *q = several.0[lane]);
            let own = self.jacobians[j * size..][..size].iter_mut();
            own.zip(&self.beside[g].jacobian).for_each(|(entry, all)| *entry = all.0[lane]);
        }
    }

    /// `Dh` at a node.
    fn jacobian(&self, j: usize) -> &[f64] {
        let size = self.start.jacobian.len();
        &self.jacobians[j * size..][..size]
    }

    /// `out −= Dhᵀ Λ_j` of a node.
    fn subtract_impulses(&self, j: usize, out: &mut [f64]) {
        let (n, nc) = (self.start_q.len(), self.equations());
        let rows = self.jacobian(j).chunks_exact(n).zip(&self.multipliers[j * nc..]);
        for (row, lambda) in rows {
            out.iter_mut().zip(row).for_each(|(out, entry)| *out -= entry * lambda);
        }
    }

    /// Second derivatives at the last evaluation, of the start too where derivatives by it are asked for, and all that
    /// [`Closures::spread`] writes.
    pub(crate) fn curve(&mut self, model: &Model, with_start: bool) {
        let n = model.dimensions.coordinates();
        let (nc, size) = (self.equations(), n * n);
        self.spread();
        if with_start {
            let (q, lambda) = (&self.start_q, &self.multipliers[..nc]);
            self.start.hessian(model, q, lambda, &mut self.hessians[..size]);
        }
        for g in 0..self.beside.len() {
            self.take_multipliers(g);
            let Self { q_beside, multipliers_beside, hessian_beside, .. } = self;
            let q = &q_beside[g * n..][..n];
            self.beside[g].hessian(model, q, multipliers_beside, hessian_beside);
            for (lane, out) in
                self.hessians[size * (1 + g * N)..].chunks_exact_mut(size).take(N).enumerate()
            {
                out.iter_mut().zip(&*hessian_beside).for_each(|(to, from)| *to = from.0[lane]);
            }
        }
    }

    /// Hands out what is known of the nodes.
    pub(super) fn place(&self, model: &Model, slopes: &mut Slopes) {
        let (nd, n, count) = (model.dimensions.dynamic, model.dimensions.coordinates(), self.count);
        if let Some(closing) = &mut slopes.closing {
            closing.jacobians.copy_from_slice(&self.jacobians);
        }
        for j in 0..count {
            let curvature = slopes.second[0][(count + j) * nd * n..].iter_mut();
            curvature.zip(&self.hessian(j)[..nd * n]).for_each(|(to, from)| *to = -from);
            let push = &mut slopes.torque[(count + j) * nd..][..nd];
            push.fill(0.0);
            self.subtract_impulses(j, push);
        }
    }

    /// Adds `−Σ_j (1 − κ_ji) κ_jk Λ_j·D²h` to `J`.
    pub(crate) fn add_curvature(&self, model: &Model, matrix: &mut DenseInverse) {
        let (nd, n, count) = (model.dimensions.dynamic, model.dimensions.coordinates(), self.count);
        for j in 1..count {
            let (reach, hessian) = (self.reach(j), self.hessian(j));
            for (a, b) in (0..nd).flat_map(|a| (0..nd).map(move |b| (a, b))) {
                let curvature = hessian[a * n + b];
                if curvature == 0.0 {
                    continue;
                }
                for (i, left) in reach.iter().enumerate() {
                    let row = &mut matrix.matrix[(a * count + i) * matrix.stride + b * count..];
                    let weight = (1.0 - left) * curvature;
                    row.iter_mut().zip(reach).for_each(|(entry, right)| *entry -= weight * right);
                }
            }
        }
    }

    /// Factors `S`, at the last evaluation and with the inverse of `J`; with ball joints `closing` has `B` and `G`.
    ///
    /// # Errors
    ///
    /// If it is singular.
    pub(crate) fn factor(
        &mut self,
        at: StepContext<'_>,
        matrix: &mut DenseInverse,
        closing: Option<&Closing>,
    ) -> Result<(), StepError> {
        let StepContext { model, settings, .. } = at;
        let (count, nc, stride) = (self.count, self.equations(), self.stride());
        match closing {
            None => self.fill_columns(model),
            Some(Closing { residual, .. }) => {
                let rows = residual.chunks_exact(count * nc);
                for (to, from) in self.responses.chunks_exact_mut(stride).zip(rows) {
                    to[..count * nc].copy_from_slice(from);
                }
            }
        }
        matrix.solve_rows(&mut self.responses, stride);
        self.fill_schur(model, closing);
        self.schur.factor();
        let rank = count * model.constraint_rank();
        let estimate = self.schur.reciprocal_condition(rank, settings.time_step_s.abs());
        self.estimate = estimate;
        if estimate < settings.singular_below {
            self.fill_schur(model, closing);
            let last = self.schur.matrix.chunks_exact(count * nc).skip((count - 1) * nc);
            let block: Vec<f64> = last.flat_map(|row| &row[(count - 1) * nc..]).copied().collect();
            return Err(model.singular_constraints(&block, estimate));
        }
        Ok(())
    }

    /// Writes `B` in place of the responses.
    fn fill_columns(&mut self, model: &Model) {
        let n = model.dimensions.coordinates();
        let (count, nc, stride) = (self.count, self.equations(), self.stride());
        self.responses.fill(0.0);
        let jacobians = self.jacobians.chunks_exact((nc * n).max(1));
        for (j, (jacobian, reach)) in
            jacobians.zip(self.reach.chunks_exact(count)).enumerate().take(count)
        {
            for (c, constraint) in model.constraints.iter().enumerate() {
                for &a in constraint.dynamic_coordinates() {
                    let entry = jacobian[c * n + a];
                    let rows = self.responses[a * count * stride..].chunks_exact_mut(stride);
                    for (row, kappa) in rows.zip(reach) {
                        row[j * nc + c] = (kappa - 1.0) * entry;
                    }
                }
            }
        }
    }

    pub(super) fn write(&self, report: &mut StepReport) {
        report.constraint_reciprocal_condition = self.estimate;
        report.redundant_constraints = (self.schur.deficiency() / self.count) as u32;
    }

    fn fill_schur(&mut self, model: &Model, closing: Option<&Closing>) {
        let n = model.dimensions.coordinates();
        let (count, nc, stride) = (self.count, self.equations(), self.stride());
        if let Some(Closing { equations: [by_y, _], .. }) = closing {
            let Self { responses, moved, schur, terms, .. } = self;
            let rows = schur.matrix.chunks_exact_mut(count * nc);
            for (row, by_y) in rows.zip(by_y.chunks_exact(responses.len() / stride)) {
                moved[..stride].fill(0.0);
                terms.clear();
                terms.extend(by_y.iter().copied().zip(0..));
                add_rows(&mut moved[..stride], responses, stride, terms);
                row.copy_from_slice(&moved[..count * nc]);
            }
            return;
        }
        for j in 1..=count {
            let Self { reach, responses, moved, schur, terms, jacobians, .. } = &mut *self;
            let jacobian = &jacobians[j * nc * n..][..nc * n];
            let reach = &reach[j * count..][..count];
            moved.fill(0.0);
            for (a, moved) in moved.chunks_exact_mut(stride).enumerate() {
                terms.clear();
                terms.extend(reach.iter().enumerate().map(|(k, kappa)| (*kappa, a * count + k)));
                add_rows(moved, responses, stride, terms);
            }
            let rows = schur.matrix.chunks_exact_mut(count * nc).skip((j - 1) * nc);
            for ((c, constraint), row) in model.constraints.iter().enumerate().zip(rows) {
                row.fill(0.0);
                for &a in constraint.dynamic_coordinates() {
                    let entry = jacobian[c * n + a];
                    let moved = &moved[a * stride..];
                    row.iter_mut().zip(moved).for_each(|(s, x)| *s += entry * x);
                }
            }
        }
    }

    /// From the residuals of the stages to the change `−ΔY`, and on to the next impulses.
    pub(super) fn solve(&mut self, model: &Model, matrix: &mut DenseInverse, x: &mut [f64]) {
        let n = model.dimensions.coordinates();
        let (count, nc, stride) = (self.count, self.equations(), self.stride());
        matrix.solve(x);
        for j in 1..=count {
            let reach = &self.reach[j * count..][..count];
            for (moved, x) in self.moved.iter_mut().zip(x.chunks_exact(count)) {
                *moved = x.iter().zip(reach).map(|(x, kappa)| x * kappa).sum();
            }
            let jacobian = &self.jacobians[j * nc * n..][..nc * n];
            for (c, constraint) in model.constraints.iter().enumerate() {
                let dynamic = constraint.dynamic_coordinates().iter();
                let along: f64 = dynamic.map(|&a| jacobian[c * n + a] * self.moved[a]).sum();
                let own = (j - 1) * nc + c;
                self.correction[own] = along - self.values[own];
            }
        }
        self.schur.solve(&mut self.correction);
        for (x, row) in x.iter_mut().zip(self.responses.chunks_exact(stride)) {
            *x -= row.iter().zip(&self.correction).map(|(r, c)| r * c).sum::<f64>();
        }
        let pairs = self.multipliers.iter_mut().zip(&self.correction);
        pairs.for_each(|(lambda, change)| *lambda -= change);
    }

    /// Adds to the derivatives of the residuals, of `Σ P` and of its slopes by the parameters `(q, p, u, k)` and by
    /// `Y` what the curvature of the constraints makes of them.
    pub(crate) fn add_slopes(
        &self,
        theta: &Parameters,
        residual: &mut [f64],
        momentum: &mut [f64],
        slopes: &mut [f64],
    ) {
        let &Parameters { nd, stride, .. } = theta;
        let (n, count) = (theta.n(), self.count);
        for (j, reach) in self.reach.chunks_exact(count).enumerate().take(count) {
            let hessian = self.hessian(j);
            for (a, b) in (0..nd).flat_map(|a| (0..n).map(move |b| (a, b))) {
                let curvature = hessian[a * n + b];
                for (column, part) in theta.moves(b, self.nodes[j]) {
                    momentum[a * stride + column] -= part * curvature;
                    for (i, kappa) in reach.iter().enumerate() {
                        let entry = &mut residual[(a * count + i) * stride + column];
                        *entry -= (1.0 - kappa) * part * curvature;
                    }
                }
                if b < nd {
                    let slopes = &mut slopes[(a * nd + b) * count..][..count];
                    let pairs = slopes.iter_mut().zip(reach);
                    pairs.for_each(|(slope, kappa)| *slope -= curvature * kappa);
                }
            }
        }
    }

    /// From `J⁻¹ R_θ`, in rows of `stride` numbers, to `−Y'`; and `Λ'`, node after node.
    pub(crate) fn close(
        &mut self,
        model: &Model,
        theta: &Parameters,
        tangent: &mut [f64],
        multipliers: &mut [f64],
        closing: Option<&Closing>,
    ) {
        let &Parameters { nc, stride, .. } = theta;
        let (count, width) = (self.count, self.stride());
        match closing {
            None => self.write_equations(model, theta, tangent, multipliers),
            Some(Closing { equations: [by_y, by_theta], .. }) => {
                multipliers.copy_from_slice(by_theta);
                let rows = by_y.chunks_exact(tangent.len() / stride);
                for (row, by_y) in multipliers.chunks_exact_mut(stride).zip(rows) {
                    self.terms.clear();
                    self.terms.extend(by_y.iter().map(|entry| -entry).zip(0..));
                    add_rows(row, tangent, stride, &self.terms);
                }
            }
        }
        let Self { responses, schur, terms, .. } = self;
        schur.reserve(stride);
        schur.solve_rows(multipliers, stride);
        for (row, responses) in tangent.chunks_exact_mut(stride).zip(responses.chunks_exact(width))
        {
            terms.clear();
            terms.extend(responses[..count * nc].iter().copied().zip(0..));
            add_rows(row, multipliers, stride, terms);
        }
    }

    /// Writes `h_θ − G J⁻¹ R_θ`.
    fn write_equations(
        &mut self,
        model: &Model,
        theta: &Parameters,
        tangent: &[f64],
        multipliers: &mut [f64],
    ) {
        let &Parameters { nc, stride, .. } = theta;
        let (n, count) = (theta.n(), self.count);
        let Self { reach, nodes, jacobians, terms, .. } = self;
        multipliers.fill(0.0);
        for (row, (j, c)) in multipliers
            .chunks_exact_mut(stride)
            .zip((1..=count).flat_map(|j| (0..nc).map(move |c| (j, c))))
        {
            let reach = &reach[j * count..][..count];
            let jacobian = &jacobians[(j * nc + c) * n..][..n];
            for (b, entry) in jacobian.iter().enumerate() {
                for (column, part) in theta.moves(b, nodes[j]) {
                    row[column] += part * entry;
                }
            }
            terms.clear();
            for &a in model.constraints[c].dynamic_coordinates() {
                let stages = reach.iter().enumerate();
                terms.extend(stages.map(|(k, kappa)| (-kappa * jacobian[a], a * count + k)));
            }
            add_rows(row, tangent, stride, terms);
        }
    }

    /// Takes the last correction of the increments into the impulses, which were evaluated before it.
    pub(super) fn follow(&mut self, model: &Model, correction: &[f64]) {
        let (n, count) = (model.dimensions.coordinates(), self.count);
        let nd = self.turned.len();
        self.turned.fill(0.0);
        for j in 1..count {
            let reach = &self.reach[j * count..][..count];
            for (moved, x) in self.moved.iter_mut().zip(correction.chunks_exact(count)) {
                *moved = x.iter().zip(reach).map(|(x, kappa)| x * kappa).sum();
            }
            let hessian = &self.hessians[j * n * n..][..n * n];
            for (turned, row) in self.turned.iter_mut().zip(hessian.chunks_exact(n)) {
                *turned += row.iter().zip(&self.moved[..nd]).map(|(h, x)| h * x).sum::<f64>();
            }
        }
    }

    /// Takes the impulses of all nodes into that of the step, and sums up multipliers, of least norm.
    pub(super) fn finish(
        &mut self,
        model: &Model,
        redundant: u32,
        [impulse, multipliers]: [&mut [f64]; 2],
    ) {
        let nc = self.equations();
        self.spread();
        multipliers.fill(0.0);
        impulse.iter_mut().zip(&self.turned).for_each(|(sum, turned)| *sum += turned);
        for j in 0..self.count {
            if redundant > 0 {
                self.remove_null(model, j);
            }
            self.subtract_impulses(j, impulse);
            let own = &self.multipliers[j * nc..][..nc];
            multipliers.iter_mut().zip(own).for_each(|(sum, lambda)| *sum += lambda);
        }
    }

    /// Takes from the multipliers of a node what exerts no force.
    fn remove_null(&mut self, model: &Model, j: usize) {
        let (n, nc) = (model.dimensions.coordinates(), self.equations());
        let jacobian = &self.jacobians[j * nc * n..][..nc * n];
        for (c, row) in self.gram.matrix.chunks_exact_mut(nc).enumerate() {
            for (other, entry) in row.iter_mut().enumerate() {
                let dynamic = model.constraints[c].dynamic_coordinates().iter();
                let product = |&a: &usize| {
                    let [one, two] = [c, other].map(|c| jacobian[c * n + a]);
                    one * two / model.conditioning.inertia_of(a)
                };
                *entry = dynamic.map(product).sum();
            }
        }
        self.gram.factor();
        self.gram.remove_null(&mut self.multipliers[j * nc..][..nc]);
    }
}

/// Room for `S` of a step, each row with its weight, and for solutions of rows `stride` apart.
pub(crate) fn room_for_schur(model: &Model, stages: usize, stride: usize) -> PivotedLu {
    let scale = model.conditioning.weight.repeat(stages);
    PivotedLu::new(&scale, stride).with_independent(stages * model.constraint_rank())
}
