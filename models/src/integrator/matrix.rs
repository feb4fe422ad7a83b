//! The Newton matrices `K` and `S`: filled and factored.

use crate::constraints::closure::Closure;
use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::kkt::schur::{SchurComplement, fill_schur};
use crate::kkt::system::{Factors, KktSystem, Linearized};
use crate::lagrangian::fields::OwnTorque;
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::turning::Weights;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;

impl Workspace {
    /// Factors the KKT system at the last evaluation: by a recursion where that is sound, else by the tree LU of
    /// `K` with the Schur complement `S`.
    pub(crate) fn factor(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> Result<(), StepError> {
        let has_loops = self.constraints.end.in_plane.is_some();
        if has_loops {
            self.constraints.end.place_in_plane(model, &self.step.q_end);
        } else if model.dimensions.constraints > 0 {
            self.differentiate_end(model);
        }
        if self.factor_recursion(model, settings)? {
            if self.kkt.has_schur() && model.dimensions.constraints > 0 {
                self.factor_schur(model, settings)?;
            }
            return Ok(());
        }
        if has_loops {
            // By all joints together what is singular may not be, and if it is it gets its name.
            self.constraints.start.differentiate(model, &state.q);
            self.constraints.start.place_in_plane(model, &state.q);
            self.differentiate_end(model);
        }
        self.factor_newton_matrix(model, settings)?;
        if model.dimensions.constraints > 0 {
            self.factor_schur(model, settings)?;
        }
        Ok(())
    }

    /// The constraint Jacobian at the end, by the increment.
    fn differentiate_end(&mut self, model: &Model) {
        self.constraints.end.differentiate(model, &self.step.q_end);
        if !model.orientations.is_empty() {
            self.turn_end_jacobian(model);
        }
    }

    /// Whether the pivots of constraints are sound at rest, where they are known to be regular.
    pub(crate) fn can_eliminate_constraints(&mut self, model: &Model) -> bool {
        let q = &model.conditioning.regular;
        let orientations = orientations(model, q);
        for (closure, q_there) in [
            (&mut self.constraints.start, &mut self.mid.q),
            (&mut self.constraints.end, &mut self.step.q_end),
        ] {
            q_there.copy_from_slice(q);
            closure.complete(model, q, &orientations);
        }
        self.mid.orientations.copy_from_slice(&orientations);
        self.mid.angles.copy_from_slice(q);
        self.mid.evaluate(model);
        matches!(self.factor_recursion(model, &Settings::new(model)), Ok(true))
    }

    /// Factors `K`, and the constraints of loops, by the recursion at the last evaluation; whether there is one
    /// and its pivots are sound.
    pub(crate) fn factor_recursion(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<bool, StepError> {
        if !self.kkt.has_recursion() {
            return Ok(false);
        }
        if model.held.is_some() {
            self.fill_newton_matrix(model, settings);
        } else {
            self.weigh_coordinates(model, settings);
        }
        let constraints = [&self.constraints.start, &self.constraints.end];
        let at = linearized(model, settings, &mut self.mid.mechanics, constraints);
        self.kkt
            .factor_recursion(at, MatrixKind::Newton)
            .map_err(|pivot| model.singular_matrix(pivot))
    }

    /// What recursions need of coordinates at the last evaluation, beside the bodies.
    pub(crate) fn weigh_coordinates(&mut self, model: &Model, settings: &Settings) {
        self.mid.fill_diagonal(model, settings, &mut self.kkt.diagonal);
        let weight = 2.0 * settings.force_split.at_start();
        self.kkt.evaluate_elements(model, &self.mid.instant(model), weight);
        if !model.orientations.is_empty() {
            self.weigh_balls(model, settings);
            let (h, Self { mid, kkt, .. }) = (settings.time_step_s, &mut *self);
            let weights = &mut kkt.balls;
            mid.for_each_own_torque(
                model,
                (kkt.fields.as_deref(), weight),
                |o, OwnTorque { by_turn, by_velocity }| {
                    let Weights { torque, column, own, .. } = &mut weights[o];
                    let turned = by_turn.times(column).scaled(0.25 * h);
                    *own = own.plus(&torque.times(&turned.plus(&by_velocity.scaled(0.5))));
                },
            );
        }
        let KktSystem { tied, balls, .. } = &mut self.kkt;
        if let Some(tied) = tied {
            tied.weigh(model, balls, settings.time_step_s);
        }
    }

    /// Factors the mass matrix by the recursion, with the constraints at the start; whether that went well.
    pub(super) fn factor_masses(&mut self, model: &Model, settings: &Settings) -> bool {
        self.kkt.diagonal.fill(0.0);
        self.kkt.balls.fill(Weights::REST);
        for &(i, inertia) in &model.armature.own {
            let added = -inertia / settings.time_step_s;
            match self.balls.of(i) {
                Some((o, axis)) => self.kkt.balls[o].own.0[axis].0[axis] = added,
                None => self.kkt.diagonal[i] = added,
            }
        }
        let constraints = [&self.constraints.start, &self.constraints.start];
        let at = linearized(model, settings, &mut self.mid.mechanics, constraints);
        matches!(self.kkt.factor_recursion(at, MatrixKind::Mass), Ok(true))
    }

    /// Fills `K` at the last evaluation.
    pub(crate) fn fill_newton_matrix(&mut self, model: &Model, settings: &Settings) {
        self.kkt.factored.tree.make_room(&model.elimination);
        if model.orientations.is_empty() {
            self.mid.fill_newton_matrix(model, settings, &mut self.kkt.factored.tree);
        } else {
            self.fill_turned_newton_matrix(model, settings);
        }
    }

    /// Factors `K` at the last evaluation.
    pub(crate) fn factor_newton_matrix(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<(), StepError> {
        self.fill_newton_matrix(model, settings);
        self.kkt
            .factor_tree(model, settings.time_step_s, settings.singular_below)
            .map_err(|pivot| model.singular_matrix(pivot))
    }

    /// Factors by the tree what a recursion has factored last, for those that need `K⁻¹` and `S` apart.
    pub(crate) fn factor_tree(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) -> Result<(), StepError> {
        if self.kkt.factored.valid == Factors::Tree {
            return Ok(());
        }
        self.prepare_start(model, state);
        self.factor_newton_matrix(model, settings)?;
        if model.dimensions.constraints > 0 {
            self.factor_schur(model, settings)?;
        }
        Ok(())
    }

    /// Factors `S = A1 K⁻¹ A0ᵀ` with the Jacobians in `start` and `end`.
    pub(crate) fn factor_schur(
        &mut self,
        model: &Model,
        settings: &Settings,
    ) -> Result<(), StepError> {
        let Settings { time_step_s, singular_below, .. } = *settings;
        let constraints = [&self.constraints.start, &self.constraints.end];
        let is_regular = self.kkt.factor_schur(model, constraints, time_step_s, singular_below);
        self.check_schur(model, is_regular)
    }

    /// Names the constraints where `S` is not regular.
    pub(crate) fn check_schur(&mut self, model: &Model, is_regular: bool) -> Result<(), StepError> {
        if is_regular {
            return Ok(());
        }
        let SchurComplement { responses, lu, .. } = &mut self.kkt.schur;
        fill_schur(model, &self.constraints.end, responses, lu);
        Err(model.singular_constraints(&lu.matrix, self.kkt.estimates.constraints))
    }
}

/// Where the KKT system is factored.
pub(crate) fn linearized<'a>(
    model: &'a Model,
    settings: &Settings,
    mechanics: &'a mut Mechanics,
    constraints: [&'a Closure; 2],
) -> Linearized<'a> {
    let Settings { time_step_s, singular_below, .. } = *settings;
    Linearized { model, mechanics, constraints, time_step_s, singular_below }
}
