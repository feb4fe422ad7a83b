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

use plantd_math::dense_inverse::DenseInverse;
use plantd_math::norms::larger;
use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::{Term, add_rows, padded};
use plantd_math::spatial::Mat3;

use crate::constraints::closure::Closure;
use crate::integrator::collocation::balls::Balls;
use crate::integrator::collocation::slopes::{Closing, Slopes};
use crate::integrator::parameters::Parameters;
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::scheme::Tableau;
use crate::integrator::workspace::StepContext;
use crate::model::mechanism::Model;

/// The constraints of a step.
#[derive(Clone, Debug)]
pub(crate) struct Closures {
    /// Stages.
    count: usize,
    /// `c̃_j`, `κ_ji` node after node, and shares of the impulses.
    nodes: Vec<f64>,
    reach: Vec<f64>,
    shares: Vec<f64>,
    /// The equations at the nodes.
    pub(crate) at: Vec<Closure>,
    /// `Q̃_j`, one after the other.
    pub(crate) q: Vec<f64>,
    /// `Λ_j`, one after the other.
    pub(crate) multipliers: Vec<f64>,
    /// `Σ_c Λ_jc D²h_c` at all nodes but the end, square.
    hessians: Vec<f64>,
    /// `−Dhᵀ Λ_j`, of ball joints in their charts.
    pushes: Vec<f64>,
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

impl Closures {
    pub(crate) fn new(model: &Model, tableau: &Tableau) -> Self {
        let d = model.dimensions;
        let (count, nc, nd, n) = (tableau.nodes.len(), d.constraints, d.dynamic, d.coordinates());
        let zeros = |len: usize| vec![0.0; len];
        let stride = padded(count * nc);
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
            at: vec![Closure::new(model); count + 1],
            q: zeros((count + 1) * n),
            multipliers: zeros(count * nc),
            hessians: zeros(count * n * n),
            pushes: zeros(count * nd),
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
        for (node, q) in self.nodes.iter().zip(self.q.chunks_exact_mut(n)) {
            for (k, q) in q[nd..].iter_mut().enumerate() {
                let (start, next) = (state.q[nd + k], u[d.inputs + k]);
                *q = if *node == 1.0 { next } else { start + node * (next - start) };
            }
        }
        self.q[..nd].copy_from_slice(&state.q[..nd]);
        let [start, others @ ..] = &mut self.at[..] else { return };
        start.evaluate(model, &self.q[..n], orientations);
        start.differentiate(model, &self.q[..n]);
        others.iter_mut().for_each(|node| node.expect_round_off_of(start));
        self.turned.fill(0.0);
        let nodes = self.multipliers.chunks_exact_mut(d.constraints);
        for (multipliers, share) in nodes.zip(&self.shares) {
            let pairs = multipliers.iter_mut().zip(&state.multipliers);
            pairs.for_each(|(lambda, total)| *lambda = share * total);
        }
    }

    /// Evaluates the constraints where the increments `Y` lead, numbers of a coordinate `width` apart; returns what
    /// impulses are the sums of, at most.
    pub(super) fn evaluate<const N: usize>(
        &mut self,
        StepContext { model, state, .. }: StepContext<'_>,
        increments: &[f64],
        width: usize,
        mut balls: Option<&mut Balls<N>>,
    ) -> f64 {
        let d = model.dimensions;
        let (nd, n, count) = (d.dynamic, d.coordinates(), self.count);
        for j in 1..=count {
            let q = &mut self.q[j * n..][..n];
            let reach = &self.reach[j * count..][..count];
            for (a, own) in increments.chunks_exact(width).enumerate() {
                let moved: f64 = own.iter().zip(reach).map(|(y, kappa)| y * kappa).sum();
                q[a] = state.q[a] + (state.q_low[a] + moved);
            }
            let orientations =
                balls.as_mut().map_or(&[][..], |balls| balls.move_to_node(increments, j));
            self.at[j].evaluate(model, q, orientations);
            if j < count {
                self.at[j].differentiate(model, q);
            }
        }
        self.pushes.fill(0.0);
        let mut largest = 0.0;
        let nodes = self.pushes.chunks_exact_mut(nd.max(1)).zip(&self.at);
        for ((pushes, at), multipliers) in nodes.zip(self.multipliers.chunks_exact(d.constraints)) {
            let sizes = &mut self.moved[..nd];
            sizes.fill(0.0);
            for (c, (constraint, lambda)) in model.constraints.iter().zip(multipliers).enumerate() {
                let row = &at.jacobian[c * n..][..n];
                for &a in constraint.dynamic_coordinates() {
                    let push = row[a] * lambda;
                    pushes[a] -= push;
                    sizes[a] += push.abs();
                }
            }
            largest = sizes.iter().copied().fold(largest, larger);
        }
        if let Some(balls) = balls {
            balls.move_to_node(increments, 0);
            for (j, pushes) in self.pushes.chunks_exact_mut(nd.max(1)).enumerate() {
                balls.take_pushes(j, pushes);
            }
        }
        largest
    }

    /// Largest violation in units of its round-off.
    pub(super) fn violation(&self) -> f64 {
        self.at[1..].iter().map(Closure::violation).fold(0.0, larger)
    }

    /// Adds the impulses to the residuals of the stages.
    pub(super) fn add_pushes(&self, residual: &mut [f64]) {
        let count = self.count;
        let nd = self.pushes.len() / count;
        let rows = residual.chunks_exact_mut(count).zip(&self.whole);
        for (a, (residual, whole)) in rows.enumerate() {
            for (pushes, reach) in
                self.pushes.chunks_exact(nd.max(1)).zip(self.reach.chunks_exact(count))
            {
                let stages = residual.iter_mut().zip(reach);
                stages.for_each(|(r, kappa)| *r += (whole - kappa) * pushes[a]);
            }
        }
    }

    /// Second derivatives at the last evaluation, of the start too where derivatives by it are asked for, and the
    /// Jacobian at the end.
    pub(crate) fn curve(&mut self, model: &Model, with_start: bool) {
        let n = model.dimensions.coordinates();
        self.at[self.count].differentiate(model, &self.q[self.count * n..]);
        let nc = self.equations();
        for j in usize::from(!with_start)..self.count {
            let (q, lambda) = (&self.q[j * n..][..n], &self.multipliers[j * nc..][..nc]);
            self.at[j].hessian(model, q, lambda, &mut self.hessians[j * n * n..][..n * n]);
        }
    }

    /// Hands out what is known of the nodes.
    pub(super) fn place(&self, model: &Model, slopes: &mut Slopes) {
        let (nd, n, count) = (model.dimensions.dynamic, model.dimensions.coordinates(), self.count);
        let nc = self.equations();
        for (j, at) in self.at.iter().enumerate() {
            if let Some(closing) = &mut slopes.closing {
                closing.jacobians[j * nc * n..][..nc * n].copy_from_slice(&at.jacobian);
            }
            if j == count {
                continue;
            }
            let curvature = slopes.second[0][(count + j) * nd * n..].iter_mut();
            curvature.zip(&self.hessian(j)[..nd * n]).for_each(|(to, from)| *to = -from);
            let push = &mut slopes.torque[(count + j) * nd..][..nd];
            push.fill(0.0);
            at.subtract_impulses(model, &self.multipliers[j * nc..][..nc], push);
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
        for (j, at) in self.at[..count].iter().enumerate() {
            let reach = &self.reach[j * count..][..count];
            for (c, constraint) in model.constraints.iter().enumerate() {
                for &a in constraint.dynamic_coordinates() {
                    let entry = at.jacobian[c * n + a];
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
            let Self { reach, responses, moved, schur, terms, at, .. } = &mut *self;
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
                    let entry = at[j].jacobian[c * n + a];
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
            let at = &self.at[j];
            for (c, constraint) in model.constraints.iter().enumerate() {
                let dynamic = constraint.dynamic_coordinates().iter();
                let along: f64 = dynamic.map(|&a| at.jacobian[c * n + a] * self.moved[a]).sum();
                self.correction[(j - 1) * nc + c] = along - at.value[c];
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
        let Self { reach, nodes, at, terms, .. } = self;
        multipliers.fill(0.0);
        for (row, (j, c)) in multipliers
            .chunks_exact_mut(stride)
            .zip((1..=count).flat_map(|j| (0..nc).map(move |c| (j, c))))
        {
            let reach = &reach[j * count..][..count];
            let jacobian = &at[j].jacobian[c * n..][..n];
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
        multipliers.fill(0.0);
        impulse.iter_mut().zip(&self.turned).for_each(|(sum, turned)| *sum += turned);
        for j in 0..self.count {
            if redundant > 0 {
                self.remove_null(model, j);
            }
            let own = &self.multipliers[j * nc..][..nc];
            self.at[j].subtract_impulses(model, own, impulse);
            multipliers.iter_mut().zip(own).for_each(|(sum, lambda)| *sum += lambda);
        }
    }

    /// Takes from the multipliers of a node what exerts no force.
    fn remove_null(&mut self, model: &Model, j: usize) {
        let (n, nc) = (model.dimensions.coordinates(), self.equations());
        let jacobian = &self.at[j].jacobian;
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
