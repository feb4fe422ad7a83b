//! Second derivatives at the state of a plant.

use plantd_math::rows::{add_product, add_rows, padded};

use crate::integrator::parameters::Parameters;
use crate::integrator::report::{StepError, StepReport};
use crate::linearization::linearize::Linearization;
use crate::linearization::second_order::contraction::{Contraction, check_weights};
use crate::linearization::second_order::tensors::{SecondOrder, symmetrise};
use crate::linearization::second_order::{Scratch, assert_layout, spin_change};
use crate::plant::facade::Plant;

impl Plant {
    /// [`Plant::linearize`] into `first`, then [`Contraction::contract`] with `weights_x` and
    /// `weights_multipliers` into `out`.
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
        check_weights(&self.model, weights_x, weights_multipliers)?;
        let report = self.linearize(u, first)?;
        out.contract(&self.model, first, weights_x, weights_multipliers)?;
        Ok(report)
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
        if !first.is_midpoint_step() {
            second.gather(&self.model, first)?;
            return Ok(report);
        }
        self.workspace.factor_tree(&self.model, &self.settings, &self.state)?;
        self.differentiate_linearization(first, second);
        Ok(report)
    }

    /// Fills the tensor at the solution in the workspace, whose factors `first` left there.
    pub(crate) fn differentiate_linearization(
        &mut self,
        first: &Linearization,
        second: &mut SecondOrder,
    ) {
        let model = &*self.model;
        let SecondOrder { scratch, tensor, spins } = second;
        let Parameters { nd, nc, stride, .. } = scratch.layout;
        let n = scratch.layout.n();
        let workspace = &mut self.workspace;
        workspace.kkt.schur.lu.reserve(stride);
        first.write_tangent(stride, &mut scratch.tangent);
        let rows = (2 * nd + nc) * stride;
        if rows == 0 {
            return;
        }
        for (a, block) in tensor.chunks_exact_mut(rows).enumerate() {
            scratch.seed(a, model, first.solved_step());
            scratch.blocks.evaluate(model, &self.settings);
            let Scratch { layout, blocks, tangent, terms, .. } = scratch;
            // Columns beyond `a` follow from symmetry, which ball joints reach only in the end.
            let columns = if blocks.turnings.is_empty() { padded(a + 1) } else { stride };
            let (solved, momentum) = block.split_at_mut((nd + nc) * stride);
            let (residual, closing) = solved.split_at_mut(nd * stride);

            // What the change of the blocks makes of the tangents.
            let residual_by =
                [&blocks.residual_start, &blocks.residual_next, &blocks.residual_inputs];
            let momentum_by =
                [&blocks.momentum_start, &blocks.momentum_next, &blocks.momentum_inputs];
            for (rows, [start, next, inputs]) in
                [(&mut *residual, residual_by), (&mut *momentum, momentum_by)]
            {
                for (i, row) in rows.chunks_exact_mut(stride).enumerate() {
                    let row = &mut row[..columns];
                    layout.place(row, i, [start, next], inputs);
                    add_product(row, tangent, stride, blocks.by_unknowns(i, next), terms);
                }
            }
            for (c, row) in closing.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                let [by_start, by_next] =
                    blocks.end_jacobians().map(|jacobian| &jacobian[c * n..][..n]);
                layout.place_end(row, by_start, by_next);
                let by_increment = by_next[..nd].iter().map(|entry| entry.eps);
                add_product(row, tangent, stride, by_increment, terms);
            }

            // x'' and λ'' = −E⁻¹ (…).
            workspace.kkt.factored.tree.solve_rows(&model.elimination, residual, stride, columns);
            for (c, row) in closing.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                row.iter_mut().for_each(|entry| *entry = -*entry);
                let jacobian = &workspace.constraints.end.jacobian[c * n..][..nd];
                add_product(row, residual, stride, jacobian.iter().copied(), terms);
            }
            if nc > 0 {
                workspace.kkt.schur.lu.solve_rows(closing, stride);
            }
            for (i, row) in residual.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..columns];
                row.iter_mut().for_each(|entry| *entry = -*entry);
                let responses = &workspace.kkt.schur.responses[i * padded(nc)..][..nc];
                terms.clear();
                terms.extend(responses.iter().enumerate().map(|(c, response)| (*response, c)));
                add_rows(row, closing, stride, terms);
            }

            // What these make of the momentum.
            for (i, row) in momentum.chunks_exact_mut(stride).enumerate() {
                let slopes = blocks.momentum_next[i * n..][..nd].iter().map(|entry| entry.re);
                let impulses = (0..nc).map(|c| -workspace.constraints.start.jacobian[c * n + i]);
                add_product(&mut row[..columns], solved, stride, slopes.chain(impulses), terms);
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
}
