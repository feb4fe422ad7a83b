//! The Newton matrices `K` and `S`: filled and factored.

use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::kkt::factors::Generators;
use crate::kkt::loops;
use crate::kkt::planar::MatrixKind;
use crate::kkt::schur::fill_schur;
use crate::lagrangian::planar::PlanarTree;
use crate::lagrangian::potentials;
use crate::math::rows::padded;
use crate::math::tree_lu::SmallestPivot;
use crate::model::mechanism::{Forces, Model};

/// Pivots of loops, relative to what they are compared with, from which on they are taken.
const SAFE: f64 = 1e-6;

impl Workspace {
    /// Factors `K` and `S` at the last evaluation.
    pub(crate) fn factor(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> Result<(), StepError> {
        self.in_loops = false;
        if model.loops.is_some() {
            self.end.place_in_plane(model, &self.q_end);
            if self.factor_loops(model, settings) {
                return Ok(());
            }
            // By all joints together what is singular may not be, and if it is it gets its name.
            self.start.differentiate(model, &state.q);
            self.start.place_in_plane(model, &state.q);
        }
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

    /// Whether the pivots of loops are sound at rest, where the constraints are known to be regular.
    pub(crate) fn can_eliminate_loops(&mut self, model: &Model) -> bool {
        let q = &model.conditioning.regular;
        for (closure, q_there) in
            [(&mut self.start, &mut self.q_mid), (&mut self.end, &mut self.q_end)]
        {
            q_there.copy_from_slice(q);
            closure.evaluate(model, q, &[]);
            closure.place_in_plane(model, q);
        }
        self.angles.copy_from_slice(q);
        self.evaluate_lagrangian(model);
        self.factor_loops(model, &Settings::new(model))
    }

    /// Factors `K` and the constraints of loops, which are in the plane; whether the pivots allow it.
    pub(crate) fn factor_loops(&mut self, model: &Model, settings: &Settings) -> bool {
        self.fill_diagonal(model, settings);
        self.factor_loops_of(model, settings, MatrixKind::Newton)
    }

    /// The same with what is in `diagonal`. With masses alone, constraints are those at the start.
    pub(super) fn factor_loops_of(
        &mut self,
        model: &Model,
        settings: &Settings,
        kind: MatrixKind,
    ) -> bool {
        self.in_loops = false;
        let end = if kind == MatrixKind::Mass { &self.start } else { &self.end };
        let (Some(loops), Some(joints)) = (&model.loops, &model.planar) else { return false };
        let (Some(start), Some(end)) = (&self.start.in_plane, &end.in_plane) else {
            return false;
        };
        let Some(PlanarTree::Many(tree)) = self.mechanics.planar.as_deref_mut() else {
            return false;
        };
        let Some(Generators::Loops(generators)) = self.factors.generators.as_deref_mut() else {
            return false;
        };
        tree.differentiate(joints);
        let at = loops::Mechanism { loops, joints, tree, start, end };
        let conditioning = &model.conditioning;
        let scales = loops::Scales { inertia: &conditioning.inertia, weight: &conditioning.weight };
        let pivots = generators.factor(at, &self.diagonal, scales, settings.time_step_s, kind);
        if pivots.joints.relative < SAFE
            || pivots.equations < SAFE
            || pivots.steepness < settings.singular_below
        {
            return false;
        }
        self.in_loops = true;
        self.estimates.matrix = pivots.joints.relative;
        self.estimates.constraints = pivots.equations.min(pivots.steepness);
        self.estimates.redundant = (model.constraints.len() - loops.equations.len()) as u32;
        true
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
        if self.factors.generators.is_none() {
            return self.factor_newton_matrix(model, settings);
        }
        self.fill_diagonal(model, settings);
        let (h, diagonal) = (settings.time_step_s, &self.diagonal);
        match self.factors.generate(model, &mut self.mechanics, diagonal, h, MatrixKind::Newton) {
            Some(pivot) => self.accept_pivot(model, settings, pivot),
            None => self.factor_newton_matrix(model, settings),
        }
    }

    /// What springs and dampers of coordinates add to the diagonal of `K`.
    fn fill_diagonal(&mut self, model: &Model, settings: &Settings) {
        let h = settings.time_step_s;
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
