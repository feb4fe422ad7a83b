//! Linearizes the step that is solved in a workspace.

use plantd_math::rows::{add_rows, add_rows_portable, padded};
use plantd_math::simd::{wide, widest};
use plantd_math::spatial::three;

use crate::integrator::matrix::linearized;
use crate::integrator::report::StepError;
use crate::integrator::settings::{ForceSplit, Settings};
use crate::integrator::workspace::{StepContext, Tangents, Workspace};
use crate::kkt::loops;
use crate::kkt::planar::Diagonals;
use crate::kkt::space::columns::Rows;
use crate::kkt::space::derivatives::Derivatives;
use crate::kkt::space::margins::Own;
use crate::kkt::system::Recursion;
use crate::lagrangian::planar::PlanarTree;
use crate::linearization::ends::Ends;
use crate::linearization::linearize::{Kind, Linearization};
use crate::model::mechanism::Model;

/// Corrections of the increment, `Σ |x'|` in radians and metres, that second derivatives of bodies do not notice: entries
/// of the mass matrix change by at most `Σ |x'| √(I_i I_j)`. In quiet motions of floating robots most guesses are nearer
/// than that, and to take what the step has found there saves a tenth of a step with its linearization.
const UNNOTICED: f64 = 1e-13;

impl Workspace {
    /// Linearizes at the solution in the workspace.
    pub(crate) fn linearize(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) -> Result<(), StepError> {
        let d = at.model.dimensions;
        out.kind = Kind::Step;
        out.ends.time_step_s = at.settings.time_step_s;
        out.ends.at_start = at.settings.force_split.at_start();
        let is_differentiated = self.evaluate_solution(at);
        self.response.save_first(&mut self.kkt);
        let is_done = match self.kkt.factored.recursion {
            Recursion::Planar(_) => self.linearize_planar(at, out)?,
            Recursion::Loops(_) => self.linearize_loops(at, out)?,
            Recursion::Held(_) => self.linearize_held(at, out)?,
            Recursion::None | Recursion::Spatial(_) => {
                self.linearize_space(at, out, is_differentiated)?
            }
        };
        if is_done {
            out.solved.remember(self, at);
            return Ok(());
        }
        self.factor_newton_matrix(at.model, at.settings)?;
        self.fill_right_hand_sides(at, out);
        // Without inertia, springs or forces on prescribed joints, the columns of `k` in r1' are zero.
        let moving = !at.model.mixed_pairs.is_empty()
            || at.model.potentials.couple_branches
            || at.model.forces.is_some();
        let columns = if moving { out.stride } else { padded(out.next_columns()) };
        let units = at.model.dimensions.coordinates();
        let elimination = &at.model.elimination;
        self.kkt.factored.tree.solve_units(
            elimination,
            &mut out.increment,
            out.stride,
            columns,
            units,
        );
        negate(&mut out.increment);
        if d.constraints > 0 {
            self.prepare_start(at.model, at.state);
            self.finish_end(at.model, at.state);
            self.factor_schur(at.model, at.settings)?;
            self.solve_multipliers(at, out);
        }
        self.differentiate_momentum(at, out);
        out.solved.remember(self, at);
        Ok(())
    }

    /// Evaluates the solution, unless it has been, or is next to where the step was factored, of trees in space that
    /// are linearized by generators; whether the second derivatives of bodies are there, too.
    pub(crate) fn evaluate_solution(&mut self, at: StepContext<'_>) -> bool {
        let is_differentiated = self.kkt.in_space.is_some() && self.step.strayed <= UNNOTICED;
        if !self.step.is_evaluated && !is_differentiated {
            self.evaluate(at.model, at.settings, at.state);
        }
        is_differentiated
    }

    /// Linearizes in O(n²), for planar trees without constraints and prescribed coordinates.
    fn linearize_planar(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) -> Result<bool, StepError> {
        let model = at.model;
        if !self.factor_recursion(model, at.settings)? {
            return Ok(false);
        }
        fill_inputs(at, &mut out.ends);
        self.fill_diagonals(model, at.settings);
        let tree = self.mid.mechanics.planar.as_deref().and_then(PlanarTree::many);
        let (Some(tree), Some(joints), Recursion::Planar(recursion)) =
            (tree, &model.planar, &mut self.kkt.factored.recursion)
        else {
            return Ok(false);
        };
        let diagonal = &self.tangents.diagonals;
        let (increment, momentum) = (&mut out.increment, &mut out.momentum);
        recursion.linearize(tree, joints, diagonal, increment, momentum, out.stride);
        Ok(true)
    }

    /// Linearizes in O(n²), for trees in space without constraints and what acts between bodies.
    fn linearize_space(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
        is_differentiated: bool,
    ) -> Result<bool, StepError> {
        if !takes_split(at.model, at.settings) {
            return Ok(false);
        }
        let Some(mut in_space) = self.kkt.in_space.take() else { return Ok(false) };
        if !is_differentiated {
            self.mid.mechanics.differentiate(at.model);
        }
        let result = self.differentiate_in_space(at, &mut out.ends, &mut in_space);
        let (increment, momentum, stride) = (&mut out.increment, &mut out.momentum, out.stride);
        in_space.write(Rows { increment, momentum, stride });
        self.kkt.in_space = Some(in_space);
        if self.kkt.tied.is_some() {
            // A pivot that is too small may be one by the generators alone.
            if result.is_err() || !self.tie(at, out) {
                return Ok(false);
            }
        } else {
            result?;
        }
        if at.model.dimensions.constraints > 0 {
            self.constrain(at, out)?;
        }
        Ok(true)
    }

    /// From the linearization of a tree without its ties, makes that with them; false where they are not sound.
    fn tie(&mut self, at: StepContext<'_>, out: &mut Linearization) -> bool {
        let Tangents { tied: tangents, terms, .. } = &mut self.tangents;
        let (Some(tied), Some(tangents)) = (&mut self.kkt.tied, tangents) else { return false };
        let (increment, momentum, stride) = (&mut out.increment, &mut out.momentum, out.stride);
        let step = (&out.ends.turnings[..], at.settings.time_step_s);
        tied.linearize(step, Rows { increment, momentum, stride }, tangents, terms)
    }

    /// From the linearization of a tree without its constraints, makes that with them. What constraints push acts as
    /// momentum does, so the columns of `p` tell what it makes: `x'` and `p[k+1]'` become
    ///
    /// ```text
    /// x' − X_p (H q' + A0ᵀ λ')      p[k+1]' − P_p (H q' + A0ᵀ λ')      S = −A1 X_p A0ᵀ
    /// ```
    ///
    /// in O(n² nc), with the second derivatives `H` of the constraints as products of vectors.
    fn constrain(&mut self, at: StepContext<'_>, out: &mut Linearization) -> Result<(), StepError> {
        let StepContext { model, settings, state, .. } = at;
        let Settings { time_step_s, singular_below, .. } = *settings;
        self.prepare_start(model, state);
        self.finish_end(model, state);
        let Self { constraints, kkt, tangents, step, .. } = self;
        let Tangents { pushes, bending, terms, .. } = tangents;
        if let Some(bending) = bending {
            constraints.start.bend(model, &state.q, &step.multipliers, &mut bending.bends);
            bending.take();
            bending.take_off(&mut out.increment, terms);
            bending.take_off(&mut out.momentum, terms);
        }
        pushes.take_jacobian(model, &constraints.start);
        pushes.respond(&out.increment, &mut kkt.schur.responses, terms);
        pushes.respond_in_momentum(&out.momentum, terms);
        let is_regular = kkt.close_schur(model, &constraints.end, time_step_s, singular_below);
        self.check_schur(model, is_regular)?;
        self.solve_multipliers(at, out);
        let Tangents { pushes, terms, .. } = &mut self.tangents;
        pushes.add_to_momentum(&mut out.momentum, &out.multipliers, terms);
        Ok(())
    }

    /// Factors by generators at the last second derivatives in space, for derivatives of the step, and finds how
    /// inputs act in it.
    pub(crate) fn differentiate_in_space(
        &mut self,
        at: StepContext<'_>,
        ends: &mut Ends,
        derivatives: &mut Derivatives,
    ) -> Result<(), StepError> {
        let StepContext { model, settings, .. } = at;
        self.weigh_coordinates(model, settings);
        self.fill_diagonals(model, settings);
        ends.turnings.clear();
        if model.orientations.is_empty() {
            fill_inputs(at, ends);
            self.fill_inputs_of_forces(at, ends);
        } else {
            self.find_turnings(at, ends);
            let Self { mid, kkt, tangents, .. } = self;
            // Forces have equal halves: see [`takes_split`].
            mid.for_each_own_torque(model, (kkt.fields.as_deref(), 1.0), |o, own| {
                tangents.balls[o].add_torque(&ends.turnings[o], own, ends.time_step_s);
            });
            self.fill_turned_inputs(model, ends);
        }
        let Self { mid, kkt, constraints, tangents, .. } = self;
        let constraints = [&constraints.start, &constraints.end];
        let at = linearized(model, settings, &mut mid.mechanics, constraints);
        let Tangents { diagonals, balls, .. } = &*tangents;
        let own = Own { diagonals, turnings: &ends.turnings, balls };
        kkt.differentiate_in_space(at, own, derivatives)
            .map_err(|pivot| model.singular_matrix(pivot))
    }

    /// What springs, dampers and forces of coordinates give to the derivatives.
    fn fill_diagonals(&mut self, model: &Model, settings: &Settings) {
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let Self { mid, tangents: Tangents { diagonals, .. }, .. } = self;
        let Diagonals { residual, by_start, by_increment } = diagonals;
        let nd = residual.len();
        residual.fill(0.0);
        by_start.fill(0.0);
        by_increment.fill(0.0);
        if model.potentials.any {
            let poses = &mid.mechanics.poses;
            model.for_each_own_spring_derivative(poses, &mid.q, |i, value| {
                if i < nd {
                    residual[i] -= 0.5 * h * value;
                    by_start[i] -= h * value;
                    by_increment[i] -= 0.5 * h * value;
                }
            });
        }
        for (slope, c) in by_increment.iter_mut().zip(&model.damping) {
            *slope -= c;
        }
        if let Some(forces) = &model.forces {
            forces.for_each_own_derivative(&mid.instant(model), |i, by_q, by_v| {
                if i < nd {
                    residual[i] += a * h * by_q;
                    by_start[i] += h * by_q;
                    by_increment[i] += 0.5 * h * by_q + by_v;
                }
            });
        }
    }

    /// Linearizes with loops, where their pivots allow it: O(n²) where their fronts do not grow.
    fn linearize_loops(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) -> Result<bool, StepError> {
        let StepContext { model, settings, state, .. } = at;
        let (Some(loops), Some(joints)) = (&model.loops, &model.planar) else { return Ok(false) };
        self.finish_end(model, state);
        if !self.factor_recursion(model, settings)? {
            return Ok(false);
        }
        self.constraints.start.hessian(
            model,
            &state.q,
            &self.step.multipliers,
            &mut self.tangents.constraint_hessian,
        );
        fill_inputs(at, &mut out.ends);
        self.fill_diagonals(model, settings);
        let tree = self.mid.mechanics.planar.as_deref().and_then(PlanarTree::many);
        let (Some(tree), Some(start), Some(end), Recursion::Loops(fronts)) = (
            tree,
            &self.constraints.start.in_plane,
            &self.constraints.end.in_plane,
            &mut self.kkt.factored.recursion,
        ) else {
            return Ok(false);
        };
        let diagonal = &self.tangents.diagonals;
        let closures = loops::Closures {
            jacobian: &self.constraints.end.jacobian,
            hessian: &self.tangents.constraint_hessian,
        };
        let derivatives = loops::Derivatives {
            increment: &mut out.increment,
            momentum: &mut out.momentum,
            multipliers: &mut out.multipliers,
            stride: out.stride,
        };
        let mechanism = loops::Mechanism { loops, joints, tree, start, end };
        fronts.linearize(mechanism, diagonal, &closures, derivatives);
        Ok(true)
    }

    /// Linearizes with limbs that are held, where their pivots allow it.
    fn linearize_held(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) -> Result<bool, StepError> {
        let StepContext { model, settings, state, .. } = at;
        self.prepare_start(model, state);
        self.finish_end(model, state);
        if !self.factor_recursion(model, settings)? {
            return Ok(false);
        }
        self.fill_right_hand_sides(at, out);
        self.fill_closing(at, out);
        let (Recursion::Held(limbs), Some(held)) = (&mut self.kkt.factored.recursion, &model.held)
        else {
            return Ok(false);
        };
        let columns = if out.nk > 0 { out.stride } else { padded(out.next_columns()) };
        let lengths = [out.stride, columns];
        limbs.solve_rows(held, &mut out.increment, &mut out.multipliers, lengths);
        negate(&mut out.increment);
        self.differentiate_momentum(at, out);
        Ok(true)
    }

    /// Writes `r1'` into `out.increment` and starts `out.momentum` with what does not depend on `x'`.
    pub(crate) fn fill_right_hand_sides(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        self.tangents.make_room(at.model);
        wide!({
            let model = at.model;
            let h = at.settings.time_step_s;
            let (nd, nk, stride) = (out.nd, out.nk, out.stride);
            out.increment.fill(0.0);
            out.momentum.fill(0.0);
            out.ends.turnings.clear();
            if !model.orientations.is_empty() {
                self.fill_turned_right_hand_sides(at, out);
                self.add_constraint_hessian(at, out);
                add_momenta(out);
                return;
            }
            fill_inputs(at, &mut out.ends);
            self.tangents.end_slopes.fill(0.0);
            for pair in &model.pairs {
                let (i, j) = (pair.row as usize, pair.column as usize);
                let second = self.mid.mechanics.pair(
                    model,
                    pair.ancestor as usize,
                    pair.descendant as usize,
                );
                let half = 0.5 * h * second.qq;
                out.increment[i * stride + j] = half - second.v_above_q_below;
                out.increment[j * stride + i] = half - second.q_above_v_below;
                self.tangents.end_slopes[i * nd + j] = half + second.q_above_v_below;
                self.tangents.end_slopes[j * nd + i] = half + second.v_above_q_below;
                out.momentum[i * stride + j] = h * second.qq;
                out.momentum[j * stride + i] = h * second.qq;
            }
            for pair in &model.mixed_pairs {
                let second = self.mid.mechanics.pair(model, pair.ancestor, pair.descendant);
                let ancestor = model.dynamics.joints[pair.ancestor].coordinate;
                let descendant = model.dynamics.joints[pair.descendant].coordinate;
                // Row of the dynamic coordinate, column of the prescribed one.
                let (row, column, vq, qv) = if ancestor < nd {
                    (ancestor, descendant, second.v_above_q_below, second.q_above_v_below)
                } else {
                    (descendant, ancestor, second.q_above_v_below, second.v_above_q_below)
                };
                let c_q = 0.25 * h * second.qq - 0.5 * vq;
                let c_v = 0.5 * qv - second.vv / h;
                let next = nd + column + nk;
                out.increment[row * stride + column] += c_q - c_v;
                out.increment[row * stride + next] += c_q + c_v;
                out.momentum[row * stride + column] += 0.5 * h * second.qq - qv;
                out.momentum[row * stride + next] += 0.5 * h * second.qq + qv;
            }
            self.add_springs(at, out);
            self.add_forces(at, out);
            self.add_constraint_hessian(at, out);
            add_momenta(out);
        })
    }

    /// Adds what depends on `x'` and `λ'` to `out.momentum`.
    pub(crate) fn differentiate_momentum(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        widest!({
            let model = at.model;
            let d = model.dimensions;
            let (n, nd, stride) = (d.coordinates(), d.dynamic, out.stride);
            if model.orientations.is_empty() {
                for (i, c) in model.damping.iter().enumerate() {
                    self.tangents.end_slopes[i * nd + i] -= c;
                }
            }
            for (i, target) in out.momentum.chunks_exact_mut(stride).enumerate() {
                let slopes = &self.tangents.end_slopes[i * nd..][..nd];
                self.tangents.terms.clear();
                for &j in model.elimination.coupled(i) {
                    if slopes[j] != 0.0 {
                        self.tangents.terms.push((slopes[j], j));
                    }
                }
                add_rows_portable(target, &out.increment, stride, &self.tangents.terms);
                if d.constraints == 0 {
                    continue;
                }
                let column = self.constraints.start.jacobian[i..].iter().step_by(n);
                self.tangents.terms.clear();
                for (c, entry) in column.enumerate() {
                    if *entry != 0.0 {
                        self.tangents.terms.push((-entry, c));
                    }
                }
                add_rows_portable(target, &out.multipliers, stride, &self.tangents.terms);
            }
        })
    }

    /// Springs add `−V_qq` to `L_qq`.
    fn add_springs(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        if !at.model.potentials.any {
            return;
        }
        let model = at.model;
        let h = at.settings.time_step_s;
        let (nd, nk, stride) = (out.nd, out.nk, out.stride);
        let slopes = &mut self.tangents.end_slopes;
        let poses = &self.mid.mechanics.poses;
        model.for_each_spring_derivative(poses, &self.mid.q, |row, column, value| {
            if row >= nd {
                return;
            }
            if column < nd {
                out.increment[row * stride + column] -= 0.5 * h * value;
                slopes[row * nd + column] -= 0.5 * h * value;
                out.momentum[row * stride + column] -= h * value;
            } else {
                for column in [column, nd + column + nk] {
                    out.increment[row * stride + column] -= 0.25 * h * value;
                    out.momentum[row * stride + column] -= 0.5 * h * value;
                }
            }
        });
    }

    /// Forces add `a h f_q` to `C_q`, `a h f_v` to `C_v`, and `h (f_q q' + f_v v')` to `p[k+1]'`.
    fn add_forces(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        let Some(forces) = &at.model.forces else { return };
        let h = at.settings.time_step_s;
        let (nd, nk, stride, a) = (out.nd, out.nk, out.stride, out.ends.at_start);
        let Tangents { end_slopes: slopes, .. } = &mut self.tangents;
        let instant = self.mid.instant(at.model);
        forces.for_each_derivative(&instant, |row, column, by_q, by_v| {
            if row < nd && column < nd {
                out.increment[row * stride + column] += a * h * by_q;
                slopes[row * nd + column] += 0.5 * h * by_q + by_v;
                out.momentum[row * stride + column] += h * by_q;
            } else if row < nd {
                let half = 0.5 * h * by_q;
                for (column, slope) in [(column, half - by_v), (nd + column + nk, half + by_v)] {
                    out.increment[row * stride + column] += a * slope;
                    out.momentum[row * stride + column] += slope;
                }
            }
        });
        self.fill_inputs_of_forces(at, &mut out.ends);
    }

    /// What unit inputs give by forces.
    fn fill_inputs_of_forces(&self, at: StepContext<'_>, ends: &mut Ends) {
        let Some(forces) = &at.model.forces else { return };
        let nd = at.model.dimensions.dynamic;
        let (h, a) = (at.settings.time_step_s, ends.at_start);
        let mut places = ends.inputs[at.model.coordinate_inputs.len()..].iter_mut();
        forces.for_each_input_derivative(&self.mid.instant(at.model), |row, _, by_u| {
            let place = if row < nd { places.next() } else { None };
            if let Some(place) = place {
                (place.residual, place.momentum) = (a * h * by_u, h * by_u);
            }
        });
    }

    /// The constraints' impulses turn with the start configuration.
    fn add_constraint_hessian(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        if at.model.dimensions.constraints == 0 {
            return;
        }
        let model = at.model;
        self.constraints.start.hessian(
            model,
            &at.state.q,
            &self.step.multipliers,
            &mut self.tangents.constraint_hessian,
        );
        let n = model.dimensions.coordinates();
        for i in 0..out.nd {
            let row = &self.tangents.constraint_hessian[i * n..][..n];
            let range = i * out.stride..i * out.stride + n;
            for (entry, value) in out.increment[range.clone()].iter_mut().zip(row) {
                *entry -= value;
            }
            for (entry, value) in out.momentum[range].iter_mut().zip(row) {
                *entry -= value;
            }
        }
    }

    /// Writes `r2'` into `out.multipliers`.
    fn fill_closing(&self, at: StepContext<'_>, out: &mut Linearization) {
        let (n, nd) = (at.model.dimensions.coordinates(), out.nd);
        let rows = out.multipliers.chunks_exact_mut(out.stride.max(1));
        for (target, jacobian) in rows.zip(self.constraints.end.jacobian.chunks_exact(n.max(1))) {
            fill_by_parameters(jacobian, nd, &out.ends, target);
        }
    }

    /// From `x' = −K⁻¹ r1'` in `out.increment`: solves `S λ' = −A1 x' − r2'` and adds `K⁻¹ A0ᵀ λ'`.
    fn solve_multipliers(&mut self, at: StepContext<'_>, out: &mut Linearization) {
        self.fill_closing(at, out);
        let model = at.model;
        let d = model.dimensions;
        let (n, nc, stride) = (d.coordinates(), d.constraints, out.stride);
        for (c, constraint) in model.constraints.iter().enumerate() {
            let jacobian = &self.constraints.end.jacobian[c * n..][..n];
            let target = &mut out.multipliers[c * stride..][..stride];
            negate(target);
            let dynamic = constraint.dynamic_coordinates().iter();
            self.tangents.terms.clear();
            self.tangents.terms.extend(dynamic.map(|&i| (-jacobian[i], i)));
            add_rows(target, &out.increment, stride, &self.tangents.terms);
        }
        self.kkt.schur.lu.solve_rows(&mut out.multipliers, stride);
        for (i, target) in out.increment.chunks_exact_mut(stride).enumerate() {
            let responses = self.kkt.schur.responses[i * padded(nc)..][..nc].iter().enumerate();
            self.tangents.terms.clear();
            self.tangents.terms.extend(responses.map(|(c, r)| (*r, c)));
            add_rows(target, &out.multipliers, stride, &self.tangents.terms);
        }
    }
}

#[inline(always)]
fn negate(numbers: &mut [f64]) {
    numbers.iter_mut().for_each(|x| *x = -*x);
}

/// Whether generators have what forces at poses give to derivatives: they are those of equal halves.
pub(crate) fn takes_split(model: &Model, settings: &Settings) -> bool {
    settings.force_split == ForceSplit::Symmetric
        || !model.has_ties
            && model
                .forces
                .as_ref()
                .is_none_or(|forces| !forces.act_on_balls() && !model.has_fields())
}

/// Writes how an equation at the end changes with the columns `(q, p, k)`, at a fixed increment.
pub(crate) fn fill_by_parameters(jacobian: &[f64], nd: usize, ends: &Ends, row: &mut [f64]) {
    row.fill(0.0);
    row[..nd].copy_from_slice(&jacobian[..nd]);
    for turning in ends.turnings.iter().filter(|turning| turning.coordinate < nd) {
        // From the columns of `ξ`, by dexp₋ξ, to those of the start: exp(−ξ) = dexp₋ξ N⁺.
        let i = turning.coordinate;
        let carried = turning.momentum.apply(three(row, i));
        row[i..i + 3].copy_from_slice(&carried.0);
    }
    let next = row[jacobian.len() + nd..].iter_mut();
    next.zip(&jacobian[nd..]).for_each(|(to, entry)| *to = *entry);
}

/// Impulses of inputs of coordinates.
fn fill_inputs(at: StepContext<'_>, ends: &mut Ends) {
    for (place, input) in ends.inputs.iter_mut().zip(&at.model.coordinate_inputs) {
        place.momentum = at.settings.time_step_s * input.gain;
        place.residual = ends.at_start * place.momentum;
    }
}

/// The momentum at the start is a part of the residual, and of the momentum at the end.
fn add_momenta(out: &mut Linearization) {
    let n = out.nd + out.nk;
    for i in 0..out.nd {
        let momentum = i * out.stride + n + i;
        out.increment[momentum] = 1.0;
        out.momentum[momentum] += 1.0;
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::linearization::matrices::Layout;
    use crate::plant::facade::Plant;
    use crate::plant::initial::Initial;
    use plantd_math::norms::largest;
    use plantd_scene::builtin;

    /// Where the second derivatives of a guess stand for those of the solution, these are the same.
    #[test]
    fn derivatives_next_to_the_solution_are_those_at_it() {
        // How far `A` and `B` go along with a correction grows with the tree.
        for (name, bound) in
            [("walker-4", 1e-13), ("walker-9", 1e-13), ("balls-7", 1e-13), ("balls-31", 1e-11)]
        {
            let model = Arc::new(Model::compile(&builtin::scene(name).unwrap()).unwrap());
            let settings = Settings { time_step_s: 5e-4, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
            let n = model.dimensions.coordinates();
            let v = (0..n).map(|i| 0.3 * (1.7 * i as f64).sin()).collect();
            plant.initialize(&Initial::Velocity { q: plant.q().to_vec(), v }).unwrap();
            let u = vec![0.1; model.dimensions.input()];
            let (mut next_to, mut at) = (Linearization::new(&model), Linearization::new(&model));
            let (states, inputs) = (model.dimensions.state(), model.dimensions.input());
            let [mut a, mut b] = [states, inputs].map(|columns| vec![0.0; 2 * states * columns]);
            let mut taken = 0;
            for _ in 0..100 {
                plant.solve(&u, Some(&mut next_to)).unwrap();
                let Plant { model, settings, state, workspace, period } = &mut plant;
                if workspace.step.strayed <= UNNOTICED {
                    taken += 1;
                    workspace.step.strayed = f64::INFINITY;
                    let h = settings.time_step_s;
                    let u = period.input.of_step(model, state, h, &u, [0.0, 1.0]).unwrap();
                    let context = StepContext { model, settings, state, u };
                    workspace.linearize(context, &mut at).unwrap();
                    for (matrix, columns, of) in [
                        (&mut a, states, Linearization::a_into as fn(&_, &mut [f64], Layout)),
                        (&mut b, inputs, Linearization::b_into),
                    ] {
                        let (one, other) = matrix.split_at_mut(states * columns);
                        of(&next_to, one, Layout::Rows);
                        of(&at, other, Layout::Rows);
                        let size = largest(one);
                        one.iter_mut().zip(other).for_each(|(one, other)| *one -= *other);
                        assert!(largest(one) <= bound * size, "{name}: {}", largest(one) / size);
                    }
                }
                plant.commit();
            }
            assert!(taken > 50, "{name}: {taken}");
        }
    }
}
