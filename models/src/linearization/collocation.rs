//! The exact linearization of a step of collocation, from all stages at once.
//!
//! With the residuals `R_i` and impulses `P_i` of the stages, and `θ = (q, p, u, k)`,
//!
//! ```text
//! Y' = −(∂R/∂Y)⁻¹ R_θ        x' = Σ Y_i'        p[k+1]' = p' + Σ P_i,θ + (Σ ∂P_i/∂Y) Y'
//! ```
//!
//! With constraints `h = 0` and their impulses `Λ` ([`closures`](crate::integrator::collocation::closures)),
//! `J = ∂R/∂Y`, `B = ∂R/∂Λ`, `G = ∂h/∂Y` and `S = G J⁻¹ B`,
//!
//! ```text
//! S Λ' = h_θ − G J⁻¹ R_θ        Y' = −J⁻¹ (R_θ + B Λ')        λ' = Σ Λ_j'
//! p[k+1]' = p' + Σ P_i,θ − Σ Λ_j·D²h q' + (Σ ∂P_i/∂Y − Σ Λ_j·D²h κ_j) Y' − Σ Dhᵀ Λ_j'
//! ```
//!
//! Costs O((s n)³) for `s` stages of `n` dynamic coordinates.

use plantd_math::rotation::Turn;
use plantd_math::rows::{add_product, add_rows};
use plantd_math::spatial::{Mat3, three};

use crate::integrator::collocation::closures::Closures;
use crate::integrator::collocation::slopes::{Closing, Slopes};
use crate::integrator::collocation::system::System;
use crate::integrator::collocation::{Collocation, with_stages};
use crate::integrator::parameters::Parameters;
use crate::integrator::report::StepError;
use crate::integrator::scheme::Tableau;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::lagrangian::turning::Turning;
use crate::linearization::linearize::{Linearization, NodeTangents, StageTangents};

impl Collocation {
    /// Linearizes at the solution of the last step.
    pub(crate) fn linearize(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) -> Result<(), StepError> {
        let Self { tableau, inputs, stages, .. } = self;
        with_stages!(stages, system => system.linearize(workspace, at, tableau, inputs, out))
    }
}

impl<const N: usize> System<N> {
    /// [`Collocation::linearize`].
    fn linearize(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        tableau: &Tableau,
        inputs: &[f64],
        out: &mut Linearization,
    ) -> Result<(), StepError> {
        let model = at.model;
        let d = model.dimensions;
        let (count, n, nd) = (tableau.nodes.len(), d.coordinates(), d.dynamic);
        let h = at.settings.time_step_s;
        let theta = Parameters::new(model);
        let stride = theta.stride;
        self.make_dense(model, tableau);
        let mut tangents = out.take_stages().unwrap_or_else(|| {
            Box::new(StageTangents {
                time_step_s: h,
                tableau: tableau.clone(),
                q: vec![0.0; count * n],
                velocity: vec![0.0; count * n],
                inputs: vec![0.0; count * d.inputs],
                tangent: vec![0.0; count * nd * stride],
                impulses: vec![0.0; count * nd * stride],
                slopes: vec![0.0; nd * count * nd],
                matrix: self.matrix.clone(),
                terms: Vec::new(),
                momentum: vec![0.0; nd],
                orientations: vec![Mat3::IDENTITY; model.orientations.len()],
                nodes: self.closures.as_deref().map(|closures| NodeTangents::new(closures, &theta)),
            })
        });
        self.evaluate(workspace, at, inputs);
        self.differentiate(workspace, at, inputs);
        for i in 0..count {
            self.place(workspace, i);
            tangents.q[i * n..][..n].copy_from_slice(&workspace.mid.q);
            tangents.velocity[i * n..][..n].copy_from_slice(&workspace.mid.velocity);
            self.take_rates(i, &mut tangents.velocity[i * n..][..n]);
        }
        tangents.inputs.copy_from_slice(inputs);
        workspace.prepare(at);
        if let Some(closures) = &mut self.closures {
            closures.curve(model, true);
        }
        self.fill_matrix(at);
        if !self.matrix.invert() {
            return Err(StepError::NotFinite { iterations: 0 });
        }
        let closing = self.slopes.as_ref().and_then(|slopes| slopes.closing.as_deref());
        if let Some(closures) = &mut self.closures {
            closures.factor(at, &mut self.matrix, closing)?;
        }
        if self.slopes.is_some() {
            tangents.take(self, at.state);
        } else {
            tangents.fill(self, tableau, &theta, h);
        }
        let StageTangents { tangent, impulses, slopes, terms, nodes, .. } = &mut *tangents;
        let mut curvature = vec![0.0; if nodes.is_some() { nd * stride } else { 0 }];
        if let (Some(closures), None) = (&self.closures, closing) {
            closures.add_slopes(&theta, tangent, &mut curvature, slopes);
        }
        self.matrix.solve_rows(tangent, stride);
        out.begin_collocation(h);
        if let (Some(closures), Some(nodes)) = (&mut self.closures, nodes.as_mut()) {
            closures.close(model, &theta, tangent, &mut nodes.tangent, closing);
            nodes.take(closures, closing);
            let mut lambda = vec![0.0; stride];
            for c in 0..d.constraints {
                lambda.fill(0.0);
                terms.clear();
                terms.extend((0..count).map(|j| (1.0, j * d.constraints + c)));
                add_rows(&mut lambda, &nodes.tangent, stride, terms);
                out.set_multiplier(c, &lambda);
            }
        }
        tangent.iter_mut().for_each(|entry| *entry = -*entry);
        let turned = self.slopes.as_deref();
        for &c in &model.orientations {
            let turn = three(&workspace.step.increment, c);
            out.ends.turnings.push(Turning::new(model, c, Turn::new(turn), h));
        }
        let [mut increment, mut moved] = [0; 2].map(|_| vec![0.0; stride]);
        for a in 0..nd {
            increment.fill(0.0);
            terms.clear();
            terms.extend((0..count).map(|i| (1.0, a * count + i)));
            add_rows(&mut increment, tangent, stride, terms);
            moved.fill(0.0);
            if let Some(Slopes { next_by: [_, by_theta], .. }) = turned {
                moved.copy_from_slice(&by_theta[a * stride..][..stride]);
            } else {
                moved[n + a] = 1.0;
                add_rows(&mut moved, impulses, stride, terms);
            }
            let slopes = slopes[a * count * nd..][..count * nd].iter().copied();
            add_product(&mut moved, tangent, stride, slopes, terms);
            if let Some(nodes) = nodes {
                moved.iter_mut().zip(&curvature[a * stride..]).for_each(|(m, by)| *m += by);
                let impulses = count * d.constraints;
                terms.clear();
                match closing {
                    Some(closing) => {
                        terms.extend(
                            closing.next[a * impulses..][..impulses].iter().copied().zip(0..),
                        );
                    }
                    None => {
                        let pulls = nodes.jacobians[..impulses * n].chunks_exact(n);
                        terms.extend(pulls.map(|row| -row[a]).zip(0..));
                    }
                }
                add_rows(&mut moved, &nodes.tangent, stride, terms);
            }
            out.set_rows(a, [&increment, &moved]);
        }

        tangents.time_step_s = h;
        tangents.matrix.take_inverse_of(&self.matrix);
        out.keep_stages(tangents);
        Ok(())
    }
}

impl NodeTangents {
    fn new<const N: usize>(closures: &Closures<N>, theta: &Parameters) -> Self {
        let zeros = |len: usize| vec![0.0; len];
        Self {
            q: zeros(closures.q.len()),
            jacobians: zeros(closures.jacobians.len()),
            multipliers: zeros(closures.multipliers.len()),
            tangent: zeros(closures.multipliers.len() * theta.stride),
            responses: zeros(closures.responses.len()),
            schur: closures.schur.clone(),
            closing: None,
        }
    }

    /// Takes the nodes of the solution.
    fn take<const N: usize>(&mut self, closures: &Closures<N>, closing: Option<&Closing>) {
        self.closing = closing.map(|closing| Box::new(closing.clone()));
        self.q.copy_from_slice(&closures.q);
        self.jacobians.copy_from_slice(&closures.jacobians);
        self.multipliers.copy_from_slice(&closures.multipliers);
        self.responses.copy_from_slice(&closures.responses);
        self.schur.take_factors_of(&closures.schur);
    }
}

impl StageTangents {
    /// Takes the derivatives of a step with ball joints, where they have been found.
    fn take<const N: usize>(&mut self, system: &System<N>, state: &PreciseState) {
        let Some(slopes) = system.slopes.as_deref() else { return };
        let Slopes { residual: [_, by_theta], next_by: [by_unknowns, _], .. } = slopes;
        self.tangent.copy_from_slice(by_theta);
        self.slopes.copy_from_slice(by_unknowns);
        self.momentum.copy_from_slice(&slopes.start);
        for (to, orientation) in self.orientations.iter_mut().zip(&state.orientations) {
            *to = orientation.matrix();
        }
    }

    /// Writes `∂P_j/∂θ`, `Σ ∂P_j/∂Y`, and into `tangent` the derivatives `R_θ` of the residuals.
    fn fill<const N: usize>(
        &mut self,
        system: &System<N>,
        tableau: &Tableau,
        theta: &Parameters,
        h: f64,
    ) {
        let &Parameters { nd, ni, stride, .. } = theta;
        let (n, inputs, next, count) =
            (theta.n(), theta.inputs(), theta.next(), tableau.nodes.len());
        let (hessian, width) = system.hessian();
        let Self { tangent, impulses, slopes, terms, .. } = self;
        let coupling = &tableau.coupling;
        tangent.fill(0.0);
        impulses.fill(0.0);
        slopes.fill(0.0);
        for (j, (node, weight)) in tableau.nodes.iter().zip(&tableau.weights).enumerate() {
            let length = h * weight;
            for a in 0..nd {
                let row = &mut impulses[(a * count + j) * stride..][..stride];
                let own = &mut tangent[(a * count + j) * stride..][..stride];
                for b in 0..n {
                    let entry = (a * n + b) * width + j;
                    let (q, v) = (length * hessian.qq[entry], hessian.qv[entry]);
                    let (p_q, p_v) = (hessian.vq[entry], hessian.vv[entry]);
                    if b < nd {
                        row[b] = q;
                        own[b] = -p_q;
                        let slopes = &mut slopes[(a * nd + b) * count..][..count];
                        slopes[j] += v;
                        for (slope, coupling) in slopes.iter_mut().zip(&coupling[j * count..]) {
                            *slope += q * coupling;
                        }
                    } else {
                        row[b] = (1.0 - node) * q - weight * v;
                        row[next + b - nd] = node * q + weight * v;
                        own[b] = p_v / h - (1.0 - node) * p_q;
                        own[next + b - nd] = -p_v / h - node * p_q;
                    }
                }
                for (input, entry) in row[inputs..next].iter_mut().enumerate() {
                    *entry = length * hessian.qu[(a * ni + input) * width + j];
                }
                own[n + a] = 1.0;
            }
        }
        for i in 0..count {
            for a in 0..nd {
                terms.clear();
                terms.extend((0..count).map(|j| (coupling[i * count + j], a * count + j)));
                let target = &mut tangent[(a * count + i) * stride..][..stride];
                add_rows(target, impulses, stride, terms);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use plantd_math::simd::{AVX2, AVX512, PORTABLE, within};
    use plantd_scene::builtin;

    use super::*;
    use crate::integrator::settings::Settings;
    use crate::lagrangian::samples;
    use crate::model::mechanism::Model;
    use crate::plant::facade::Plant;
    use crate::plant::initial::Initial;

    /// Four stages side by side and eight: hinges and ball joints, with constraints and without.
    #[test]
    fn all_registers_give_the_same_motion() {
        let named = |name: &str| Model::compile(&builtin::scene(name).unwrap()).unwrap();
        let elements = samples::models().into_iter().filter(|model| {
            let d = model.dimensions;
            d.prescribed == 0 && d.constraints > 0 && !model.orientations.is_empty()
        });
        let builtins = ["chain-4", "spherical-pendulum", "tree-15", "four-bar", "balls-3"];
        for model in builtins.map(named).into_iter().chain(elements).map(Arc::new) {
            for order in [12, 16] {
                let settings = Settings { order, time_step_s: 0.01, ..Settings::new(&model) };
                let motion = |registers| {
                    within(registers, || {
                        let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
                        let q = plant.q().to_vec();
                        let v = vec![0.0; q.len()];
                        plant.initialize(&Initial::Velocity { q, v }).unwrap();
                        let mut linear = Linearization::new(&model);
                        let u = vec![0.3; model.dimensions.input()];
                        for _ in 0..5 {
                            plant.step_and_linearize(&u, &mut linear).unwrap();
                        }
                        (plant.q().to_vec(), plant.p().to_vec(), linear.a(), linear.b())
                    })
                };
                let widest = motion(AVX512);
                assert!(
                    widest == motion(AVX2) && widest == motion(PORTABLE),
                    "{}, order {order}",
                    model.scene.name
                );
            }
        }
    }
}
