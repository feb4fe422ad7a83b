//! The Newton matrices `K` and `S`: filled and factored.

use super::Workspace;
use crate::Model;
use crate::model::{Forces, Solver};
use crate::plant::closure::Closure;
use crate::plant::pivoted_lu::PivotedLu;
use crate::plant::planar::{self, Of};
use crate::plant::rows::padded;
use crate::plant::tree_lu::{SmallestPivot, TreeLu};
use crate::plant::{Settings, StepError, potentials};

/// The Newton matrix `K`, factored.
#[derive(Clone, Debug)]
pub(crate) struct Factors {
    /// Entry by entry.
    pub(crate) matrix: TreeLu,
    /// By its generators, where that is faster.
    pub(crate) generators: Option<Box<planar::Elimination>>,
}

impl Factors {
    pub(crate) fn new(model: &Model) -> Self {
        let is_generated = model.solver == Solver::Generators;
        let joints = model.dimensions.dynamic;
        Self {
            matrix: TreeLu::new(&model.elimination),
            generators: is_generated.then(|| Box::new(planar::Elimination::new(joints))),
        }
    }

    /// Solves `K x = b` in place.
    pub(crate) fn solve(&mut self, model: &Model, x: &mut [f64]) {
        match (&mut self.generators, &model.planar) {
            (Some(generators), Some(joints)) => generators.solve(joints, x),
            _ => self.matrix.solve(&model.elimination, x),
        }
    }
}

impl Workspace {
    /// Factors `K` and `S` at the last evaluation.
    pub(super) fn factor(&mut self, model: &Model, settings: &Settings) -> Result<(), StepError> {
        self.factor_generators(model, settings)?;
        if model.dimensions.constraints > 0 {
            self.end.differentiate(model, &self.q_end);
            if !model.orientations.is_empty() {
                self.turn_end_jacobian(model);
            }
            self.factor_schur(model, settings)?;
        }
        Ok(())
    }

    /// Fills `K` at the last evaluation.
    pub(crate) fn fill_newton_matrix(&mut self, model: &Model, settings: &Settings) {
        if !model.orientations.is_empty() {
            self.fill_turned_newton_matrix(model, settings);
            return;
        }
        let h = settings.time_step_s;
        if model.potentials.couple_branches || model.forces.is_some() {
            self.factors.matrix.clear();
        }
        self.mechanics.differentiate(model);
        if let (Some(planar), Some(joints)) = (&mut self.mechanics.planar, &model.planar) {
            planar.fill_newton_matrix(joints, &model.pairs, h, &mut self.factors.matrix);
        } else {
            self.mechanics.curvature.fill_newton_matrix(
                &model.pairs,
                &self.mechanics.momenta,
                model.gravity,
                h,
                &mut self.factors.matrix,
            );
        }
        if model.potentials.any {
            potentials::add_to_newton_matrix(
                &model.potentials,
                &model.dynamics,
                &self.mechanics.poses,
                &self.q_mid,
                h,
                &model.elimination,
                &mut self.factors.matrix,
            );
        }
        for (i, c) in model.damping.iter().enumerate() {
            let slot = model.elimination.offsets[i + 1] - 1;
            self.factors.matrix.add_to_diagonal(slot, -settings.force_split.at_start() * c);
        }
        if let Some(forces) = &model.forces {
            self.add_forces_to_newton_matrix(model, forces, settings);
        }
    }

    /// Factors `K` at the last evaluation.
    pub(crate) fn factor_newton_matrix(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<(), StepError> {
        self.fill_newton_matrix(model, settings);
        let inertia = &model.conditioning.inertia;
        let pivot = self.factors.matrix.factor(
            &model.elimination,
            inertia,
            1.0 / settings.time_step_s.abs(),
        );
        self.accept_pivot(model, settings, pivot)
    }

    /// Factors the generators of `K` at the last evaluation.
    pub(crate) fn factor_generators(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<(), StepError> {
        let (Some(planar), Some(joints), Some(generators)) =
            (&mut self.mechanics.planar, &model.planar, &mut self.factors.generators)
        else {
            return self.factor_newton_matrix(model, settings);
        };
        let h = settings.time_step_s;
        planar.differentiate(joints);
        let diagonal = &mut self.diagonal;
        diagonal.fill(0.0);
        if model.potentials.any {
            potentials::for_each_second_derivative(
                &model.potentials,
                &model.dynamics,
                &self.mechanics.poses,
                &self.q_mid,
                |i, _, value| diagonal[i] -= 0.25 * h * value,
            );
        }
        let a = settings.force_split.at_start();
        for (entry, c) in diagonal.iter_mut().zip(&model.damping) {
            *entry -= a * c;
        }
        let inertia = &model.conditioning.inertia;
        let pivot = generators.factor(planar, joints, diagonal, inertia, h, Of::Motion);
        self.accept_pivot(model, settings, pivot)
    }

    /// Takes note of the smallest pivot; refuses one that is too small.
    fn accept_pivot(
        &mut self,
        model: &Model,
        settings: &Settings,
        pivot: SmallestPivot,
    ) -> Result<(), StepError> {
        self.estimates.matrix = pivot.relative;
        if pivot.relative >= settings.singular_below {
            return Ok(());
        }
        let coordinate = model.coordinates[pivot.row].name.clone();
        Err(StepError::Singular { coordinate, pivot: pivot.relative })
    }

    /// Adds the part `a (½h f_q + f_v)` of forces to the Newton matrix.
    fn add_forces_to_newton_matrix(&mut self, model: &Model, forces: &Forces, settings: &Settings) {
        let (a, half) = (settings.force_split.at_start(), 0.5 * settings.time_step_s);
        let dynamic = model.dimensions.dynamic;
        let mut matrix = std::mem::take(&mut self.factors.matrix);
        forces.for_each_derivative(&self.instant(model), |i, j, by_q, by_v| {
            if i < dynamic && j < dynamic {
                matrix.add(&model.elimination, i, j, a * (half * by_q + by_v));
            }
        });
        self.factors.matrix = matrix;
    }

    /// Factors `S = A1 K⁻¹ A0ᵀ` with the Jacobians in `start` and `end`.
    pub(crate) fn factor_schur(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<(), StepError> {
        self.find_responses(model);
        fill_schur(model, &self.end, &self.responses, &mut self.schur);
        self.schur.factor();
        let rank = model.constraint_rank();
        self.estimates.constraints =
            self.schur.reciprocal_condition(rank, settings.time_step_s.abs());
        self.estimates.redundant = self.schur.deficiency() as u32;
        if self.estimates.constraints >= settings.singular_below {
            return Ok(());
        }
        fill_schur(model, &self.end, &self.responses, &mut self.schur);
        Err(model.singular_constraints(&self.schur.matrix, self.estimates.constraints))
    }

    /// Solves for the responses `K⁻¹ A0ᵀ` with the matrix that is factored.
    pub(crate) fn find_responses(&mut self, model: &Model) {
        let (n, nc) = (model.dimensions.coordinates(), model.dimensions.constraints);
        let stride = padded(nc);
        for i in 0..model.dimensions.dynamic {
            for c in 0..nc {
                self.responses[i * stride + c] = self.start.jacobian[c * n + i];
            }
        }
        self.factors.matrix.solve_rows(&model.elimination, &mut self.responses, stride, stride);
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
