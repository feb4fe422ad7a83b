//! Corrections of many stages with constraints, by the linear system of the midpoint rule at the middle of the step.
//!
//! Where nothing is stiff, masses and Jacobians of the constraints differ little from stage to stage and from node to
//! node. With those of the middle in all of them, and with `H̃ = κ⁻¹ h` and `Λ̃_i = Σ_j (1 − κ_ji) Λ_j` in place of
//! what belongs to the nodes, the stages have nothing to do with each other:
//!
//! ```text
//! [ K  −Aᵀ ] [  ΔY_i     ]     [ b_i R_i ]
//! [ A   0  ] [ b_i ΔΛ̃_i ] = − [   H̃_i   ]       A = Dh, K ≈ −M/h of the midpoint rule
//! ```
//!
//! One factorization serves all stages and rounds, and costs O(n) where that of the midpoint rule does.

use plantd_math::dense_inverse::DenseInverse;

use crate::integrator::collocation::balls::Balls;
use crate::integrator::collocation::closures::Closures;
use crate::integrator::collocation::secants::Secants;
use crate::integrator::scheme::Tableau;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::model::mechanism::Model;

/// What such corrections need.
#[derive(Clone, Debug)]
pub(crate) struct Middle {
    count: usize,
    weights: Vec<f64>,
    /// `κ⁻¹`, row-major, by nodes from the first after the start on.
    inverse: Vec<f64>,
    /// Right-hand side of a stage.
    dynamics: Vec<f64>,
    constraints: Vec<f64>,
    /// `ΔY`, stages of a coordinate side by side, then `ΔΛ`, node after node.
    correction: Vec<f64>,
    /// What they are weighed with: `√M ΔY` is like `h |Dh| ΔΛ`, with the length of a gradient in the metric
    /// of the inertias.
    scale: Vec<f64>,
    secants: Secants,
}

impl Middle {
    pub(super) fn new(model: &Model, tableau: &Tableau) -> Self {
        let (nd, nc) = (model.dimensions.dynamic, model.dimensions.constraints);
        let count = tableau.nodes.len();
        let mut reach = DenseInverse::new(count, 0);
        for (j, row) in tableau.reach[count..].chunks_exact(count).enumerate() {
            reach.matrix[j * reach.stride..][..count].copy_from_slice(row);
        }
        reach.invert();
        let mut inverse = vec![0.0; count * count];
        for j in 0..count {
            let mut column = vec![0.0; count];
            column[j] = 1.0;
            reach.solve(&mut column);
            (0..count).for_each(|i| inverse[i * count + j] = column[i]);
        }
        Self {
            count,
            weights: tableau.weights.clone(),
            inverse,
            dynamics: vec![0.0; nd],
            constraints: vec![0.0; nc],
            correction: vec![0.0; count * (nd + nc)],
            scale: vec![0.0; count * (nd + nc)],
            secants: Secants::new(count * (nd + nc)),
        }
    }

    /// Finds what corrections are weighed with, in steps of length `h`.
    fn weigh(&mut self, model: &Model, h: f64) {
        let conditioning = &model.conditioning;
        let (increments, multipliers) =
            self.scale.split_at_mut(self.count * model.dimensions.dynamic);
        for (a, scale) in increments.chunks_exact_mut(self.count).enumerate() {
            scale.fill(conditioning.inertia_of(a).sqrt());
        }
        for (i, scale) in multipliers.iter_mut().enumerate() {
            let weight = conditioning.weight[i % conditioning.weight.len()];
            *scale = if weight > 0.0 { h / weight } else { 1.0 };
        }
    }

    /// Factors at the middle of the increments `Y`, numbers of a coordinate `width` apart; false if that is singular.
    /// Ball joints are where they are half-way, and changes of theirs by the axes that they have there.
    pub(super) fn factor<const N: usize>(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        (increments, width): (&[f64], usize),
        balls: Option<&Balls<N>>,
    ) -> bool {
        let StepContext { model, settings, state, .. } = at;
        self.weigh(model, settings.time_step_s.abs());
        workspace.prepare(at);
        let Workspace { step, mid, constraints, balls: turning, .. } = workspace;
        for (x, own) in step.increment.iter_mut().zip(increments.chunks_exact(width)) {
            *x = own.iter().sum();
        }
        mid.go_to(state, &step.increment, 1.0 / settings.time_step_s);
        if let Some(balls) = balls {
            mid.orientations.copy_from_slice(balls.centers());
            turning.stay();
            for &c in &balls.coordinates {
                step.increment[c..c + 3].fill(0.0);
            }
        }
        mid.evaluate(model);
        step.q_end.copy_from_slice(&mid.q);
        constraints.start.complete(model, &mid.q, &mid.orientations);
        constraints.end.evaluate(model, &mid.q, &mid.orientations);
        constraints.forget();
        workspace.factor(model, settings, state).is_ok()
    }

    /// Corrects increments and impulses, from the residuals of the stages and the violations at the nodes.
    pub(super) fn correct<const N: usize>(
        &mut self,
        workspace: &mut Workspace,
        model: &Model,
        closures: &mut Closures<N>,
        residual: &[f64],
        is_first: bool,
    ) -> &[f64] {
        if is_first {
            self.secants.forget();
        }
        let Self { weights, inverse, dynamics, constraints, correction, .. } = self;
        let (count, nc) = (self.count, constraints.len());
        let (increments, multipliers) = correction.split_at_mut(residual.len());
        multipliers.fill(0.0);
        for (i, weight) in weights.iter().enumerate() {
            for (r, residual) in dynamics.iter_mut().zip(residual.chunks_exact(count)) {
                *r = weight * residual[i];
            }
            let row = &inverse[i * count..][..count];
            for (c, r) in constraints.iter_mut().enumerate() {
                let nodes = row.iter().zip(closures.values.chunks_exact(nc));
                *r = nodes.map(|(part, values)| part * values[c]).sum();
            }
            workspace.kkt.solve(model, &workspace.constraints.end, dynamics, constraints);
            for (own, x) in increments.chunks_exact_mut(count).zip(&*dynamics) {
                own[i] = -x;
            }
            // The nodes backward are those of the same step backward: 1 − κ is κ of these.
            let row = &inverse[(count - 1 - i) * count..][..count];
            for (j, multipliers) in multipliers.chunks_exact_mut(nc).enumerate() {
                let part = row[count - 1 - j] / weight;
                let pairs = multipliers.iter_mut().zip(&*constraints);
                pairs.for_each(|(sum, lambda)| *sum += part * lambda);
            }
        }
        for (change, scale) in correction.iter_mut().zip(&self.scale) {
            *change *= scale;
        }
        self.secants.improve(correction);
        for (change, scale) in correction.iter_mut().zip(&self.scale) {
            *change /= scale;
        }
        let (increments, multipliers) = correction.split_at(residual.len());
        let pairs = closures.multipliers.iter_mut().zip(multipliers);
        pairs.for_each(|(lambda, change)| *lambda += change);
        increments
    }
}
