//! Ball joints: orientations in place of coordinates.
//!
//! A ball joint turns in one step by `R[k+1] = R[k] exp(ξ)`, is at the midpoint at `R[k] exp(ξ/2)`, and
//! its velocity is `ξ/h`. With the momentum `m = L_v` and the torque `τ = L_q` of the midpoint, in its
//! own axes,
//!
//! ```text
//! p[k]   = N⁻ m − T⁻ (½h τ + a h f) + Dh(q[k])ᵀ λ
//! p[k+1] = N⁺ m + T⁺ (½h τ + (1 − a) h f)
//! ```
//!
//! which is what the equations of the other coordinates are with `N = T = 1`. Nothing is singular but
//! a whole turn in one step. See [`crate::math::rotation`] for the maps.

use crate::integrator::blocks::StepBlocks;
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::math::rotation;
use crate::math::rotation::Quaternion;
use crate::math::spatial::{Mat3, Vec3, three};
use crate::model::mechanism::Model;

/// Writes where a step starts and what is next.
fn place(
    blocks: &mut StepBlocks,
    model: &Model,
    increment: &[f64],
    q_end: &[f64],
    (orientations, turns): (&[Mat3], &[Vec3]),
) {
    let nd = model.dimensions.dynamic;
    blocks.orientations[0].copy_from_slice(orientations);
    blocks.next[..nd].copy_from_slice(increment);
    blocks.next[nd..].copy_from_slice(&q_end[nd..]);
    for (&i, turn) in model.orientations.iter().zip(turns) {
        if i >= nd {
            blocks.next[i..i + 3].copy_from_slice(&turn.0);
        }
    }
}

impl Workspace {
    /// Starts at the orientations of the state, and finds how prescribed ones turn.
    pub(crate) fn prepare_orientations(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) {
        for (o, &i) in model.orientations.iter().enumerate() {
            self.balls.start[o] = state.orientations[o].matrix();
            if i >= model.dimensions.dynamic {
                let end = Quaternion::exp(three(&self.step.q_end, i));
                let turn = state.orientations[o].inverse().times(end).log();
                self.balls.turns[o] = turn;
                self.mid.orientations[o] = self.balls.start[o].times(&rotation::exp(turn * 0.5));
                self.balls.end[o] = end.matrix();
                let velocity = turn * (1.0 / settings.time_step_s);
                self.mid.velocity[i..i + 3].copy_from_slice(&velocity.0);
            }
        }
    }

    /// Moves ball joints to the midpoint of the increment.
    pub(crate) fn turn_to_midpoint(&mut self, model: &Model) {
        for (o, &i) in model.orientations.iter().enumerate() {
            if i < model.dimensions.dynamic {
                let turn = three(&self.step.increment, i);
                self.balls.turns[o] = turn;
                self.mid.orientations[o] = self.balls.start[o].times(&rotation::exp(turn * 0.5));
            }
        }
    }

    /// Moves ball joints to the end of the increment.
    pub(crate) fn turn_to_end(&mut self, model: &Model) {
        for (o, &i) in model.orientations.iter().enumerate() {
            if i < model.dimensions.dynamic {
                let turn = three(&self.step.increment, i);
                self.balls.end[o] = self.balls.start[o].times(&rotation::exp(turn));
            }
        }
    }

    /// Evaluates the derivatives of the step at the increment, with multipliers and ends.
    pub(crate) fn evaluate_turned(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) {
        let Some(blocks) = &mut self.balls.blocks else { return };
        blocks.q_start.copy_from_slice(&state.q);
        blocks.multipliers.copy_from_slice(&self.step.multipliers);
        place(
            blocks,
            model,
            &self.step.increment,
            &self.step.q_end,
            (&self.balls.start, &self.balls.turns),
        );
        blocks.inputs.copy_from_slice(&self.mid.inputs);
        blocks.evaluate(model, settings);
    }

    /// Writes the Jacobian of the residual by the increment.
    pub(crate) fn fill_turned_newton_matrix(&mut self, model: &Model, settings: &Settings) {
        let Some(blocks) = &mut self.balls.blocks else { return };
        place(
            blocks,
            model,
            &self.step.increment,
            &self.step.q_end,
            (&self.balls.start, &self.balls.turns),
        );
        blocks.inputs.copy_from_slice(&self.mid.inputs);
        blocks.place_midpoint(model, settings.time_step_s);
        blocks.q_mid.copy_from_slice(&self.mid.q);
        blocks.velocity.copy_from_slice(&self.mid.velocity);
        blocks.evaluate_mid(model);
        blocks.assemble(model, settings);
        let (n, elimination) = (model.dimensions.coordinates(), &model.elimination);
        for row in 0..model.dimensions.dynamic {
            for slot in elimination.offsets[row]..elimination.offsets[row + 1] {
                let ancestor = elimination.ancestors[slot];
                self.kkt.tree.upper[slot] = blocks.residual_next[ancestor * n + row];
                self.kkt.tree.lower[slot] = blocks.residual_next[row * n + ancestor];
            }
        }
    }

    /// Turns the constraint Jacobian at the end into one by the increment.
    pub(crate) fn turn_end_jacobian(&mut self, model: &Model) {
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        for &i in model.orientations.iter().filter(|i| **i < nd) {
            let to_end = rotation::dexp(three(&self.step.increment, i));
            for row in self.constraints.end.jacobian.chunks_exact_mut(n) {
                let turned = to_end.apply_transposed(three(row, i));
                row[i..i + 3].copy_from_slice(&turned.0);
            }
        }
    }

    /// Moves the orientations of a state to the end of the step.
    pub(crate) fn turn(&self, model: &Model, state: &mut PreciseState) {
        for (o, &i) in model.orientations.iter().enumerate() {
            let orientation = &mut state.orientations[o];
            if i < model.dimensions.dynamic {
                let low = &mut state.orientations_low[o];
                (*orientation, *low) = orientation.turned(*low, three(&self.step.increment, i));
                state.q[i..i + 3].copy_from_slice(&orientation.log().0);
                state.q_low[i..i + 3].fill(0.0);
            } else {
                *orientation = Quaternion::exp(three(&self.step.q_end, i));
            }
        }
    }
}
