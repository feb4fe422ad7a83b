//! The derivative of a step as a map: products with `A`, `B` and their transposes, without the matrices.

use plantd_math::sparse_map::Map;
use plantd_math::spatial::three;

use crate::constraints::bends::{Bends, Sums};
use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::closing::Closing;
use crate::kkt::schur::SchurComplement;
use crate::kkt::space::derivatives::Derivatives;
use crate::kkt::system::KktSystem;
use crate::kkt::tied::Tied;
use crate::lagrangian::fields::Fields;
use crate::linearization::ends::Ends;
use crate::linearization::linearize::Linearization;
use crate::linearization::step::{fill_by_parameters, takes_split};
use crate::model::mechanism::Model;

/// The derivative of a control period as a map, `x[k+1]' = A x[k]' + B u[k]'`, and its transpose: for gradients along
/// motions, and for whoever solves by iteration.
///
/// Of one step of the midpoint rule of a tree it takes O(n) to find and to apply, and O(n) of memory, where `A` and `B`
/// take O(n²). Each of `m` equations of constraints, and of rows of what acts between two bodies of which none is above
/// the other, along paths over several bodies and on sums of coordinates, and of armatures of such sums, takes another
/// O(n) to apply and O(n m) to find, up to one for two dynamic coordinates. Springs, drag and forces at points and
/// frames are taken with equal halves ([`ForceSplit::Symmetric`](crate::ForceSplit)) alone. All else, collocation and
/// several substeps among it, is by the matrices, to the same numbers. The memory is made by the first
/// [`Plant::differentiate`](crate::Plant::differentiate).
///
/// ```
/// use std::sync::Arc;
///
/// use plantd_models::{Model, Plant, Settings, StepDerivative, builtin};
///
/// // How the last angle of a chain changes with the first torque of a motion.
/// let model = Arc::new(Model::compile(&builtin::scene("chain-8").expect("a builtin scene"))?);
/// let mut plant = Plant::new(model.clone(), Settings::new(&model))?;
/// let (states, inputs) = (model.dimensions().state(), model.dimensions().input());
/// let mut steps = Vec::new();
/// for _ in 0..100 {
///     let mut step = StepDerivative::new(&model);
///     plant.step_and_differentiate(&vec![0.0; inputs], &mut step)?;
///     steps.push(step);
/// }
/// let (mut gradient, mut by_x, mut by_u) =
///     (vec![0.0; states], vec![0.0; states], vec![0.0; inputs]);
/// gradient[7] = 1.0;
/// for step in steps.iter_mut().rev() {
///     step.pull_back(&gradient, &mut by_x, &mut by_u);
///     std::mem::swap(&mut gradient, &mut by_x);
/// }
/// assert!(by_u.iter().any(|slope| *slope != 0.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct StepDerivative {
    nd: usize,
    nk: usize,
    ni: usize,
    ends: Ends,
    means: Means,
    generated: Option<Box<Generated>>,
    formed: Option<Box<Formed>>,
    /// Changes of `(q, p, k)`, of the increment, and of `p[k+1]`.
    by: Vec<f64>,
    x: Vec<f64>,
    momentum: Vec<f64>,
}

/// What holds the last derivative.
#[derive(Clone, Copy, Debug)]
enum Means {
    Nothing,
    Generated,
    Formed,
}

/// By generators.
#[derive(Debug)]
struct Generated {
    tree: ClosedTree,
    /// How constraints turn with the start configuration, where there are some.
    bent: Option<Bent>,
    /// What acts on and between bodies, where steps have not that.
    fields: Option<Box<Fields>>,
    tied: Option<Box<Tied>>,
}

/// A tree, and what closes it one after the other: its ties, if it has some, and its constraints.
#[derive(Debug)]
struct ClosedTree {
    derivatives: Derivatives,
    closings: Vec<Closing>,
    /// How many of them do already.
    closed: usize,
}

/// `H = Σ λ D²h`, by the coordinates at the start.
#[derive(Debug)]
struct Bent {
    bends: Bends,
    sums: Sums<1>,
}

/// By matrices.
#[derive(Debug)]
struct Formed {
    linearization: Linearization,
    map: Map,
    packed: Vec<f64>,
}

/// Whether the derivative of one step of the midpoint rule is by generators.
///
/// Each equation that closes the tree is another product. With as many as dynamic coordinates (`scissor-8` to `-64`), matrices
/// are found in the same time or less, and applied in a quarter of it; with three for 16 joints, products are found in
/// 0.7 of the time, with three for 128 in 0.13.
pub(crate) fn is_generated(model: &Model, settings: &Settings) -> bool {
    let d = model.dimensions;
    let is_open = 2 * (d.constraints + model.tied_rows) <= d.dynamic;
    is_open && model.is_generated() && takes_split(model, settings)
}

impl ClosedTree {
    /// Room for those of a model.
    fn new(model: &Model) -> Self {
        let ties = (model.tied_rows > 0).then(|| Tied::new_closing(model));
        let has_constraints = model.dimensions.constraints > 0;
        let constraints = has_constraints.then(|| SchurComplement::new_closing(model));
        Self {
            derivatives: Derivatives::new(model),
            closings: ties.into_iter().chain(constraints).collect(),
            closed: 0,
        }
    }

    /// What closes it next, and what finds the increment and the momentum at the end that belong to a push, in its
    /// place, until then. `by` is memory.
    fn close_next<'a>(
        &'a mut self,
        by: &'a mut [f64],
    ) -> (&'a mut Closing, impl FnMut(&mut [f64], &mut [f64])) {
        let Self { derivatives, closings, closed } = self;
        let (before, after) = closings.split_at_mut(*closed);
        *closed += 1;
        let respond = move |row: &mut [f64], momentum: &mut [f64]| {
            let pushed = by.len() / 2;
            by.fill(0.0);
            by[pushed..].iter_mut().zip(&*row).for_each(|(by, entry)| *by = -entry);
            derivatives.push_forward(by, row, momentum);
            before.iter_mut().for_each(|closing| closing.close(by, row, momentum));
        };
        (&mut after[0], respond)
    }

    fn push_forward(&mut self, by: &[f64], x: &mut [f64], momentum: &mut [f64]) {
        self.derivatives.push_forward(by, x, momentum);
        self.closings.iter_mut().for_each(|closing| closing.close(by, x, momentum));
    }

    fn pull_back(&mut self, x: &mut [f64], momentum: &[f64], by: &mut [f64]) {
        self.closings.iter_mut().rev().for_each(|closing| closing.weigh(x, momentum));
        self.derivatives.pull_back(x, momentum, by);
        self.closings.iter().for_each(|closing| closing.add_weighed(by));
    }
}

impl Bent {
    fn new(model: &Model) -> Self {
        Self { bends: Bends::new(model), sums: Sums::new(model.closure.joints.len()) }
    }
}

impl StepDerivative {
    /// Room for the derivative of a model's steps. Until a plant is differentiated, it is zero; and after that failed.
    pub fn new(model: &Model) -> Self {
        let d = model.dimensions();
        Self {
            nd: d.dynamic,
            nk: d.prescribed,
            ni: d.inputs,
            ends: Ends::new(model),
            means: Means::Nothing,
            generated: None,
            formed: None,
            by: vec![0.0; 2 * d.coordinates()],
            x: vec![0.0; d.dynamic],
            momentum: vec![0.0; d.dynamic],
        }
    }

    /// Whether there is one.
    pub(crate) fn is_there(&self) -> bool {
        !matches!(self.means, Means::Nothing)
    }

    /// Forgets the last step. Panics if it was made for a model of other dimensions.
    pub(crate) fn begin(&mut self, model: &Model) {
        let d = model.dimensions;
        assert!(
            self.nd == d.dynamic
                && self.nk == d.prescribed
                && self.ni == d.inputs
                && self.ends.inputs.len() == model.impulses,
            "the derivative belongs to another model"
        );
        self.means = Means::Nothing;
    }

    /// Differentiates by matrices, as `linearize` finds them.
    pub(crate) fn form<T, E>(
        &mut self,
        model: &Model,
        linearize: impl FnOnce(&mut Linearization) -> Result<T, E>,
    ) -> Result<T, E> {
        let formed = self.formed.get_or_insert_with(|| {
            let linearization = Linearization::new(model);
            Box::new(Formed { linearization, map: Map::default(), packed: Vec::new() })
        });
        let found = linearize(&mut formed.linearization)?;
        formed.linearization.write_map(&mut formed.map);
        self.means = Means::Formed;
        Ok(found)
    }

    /// `A x + B u`, into `next`.
    ///
    /// # Panics
    ///
    /// If `x` and `next` do not have the `2 nd + 2 nk` entries of a state, or `u` not the `ni + nk` of an input.
    pub fn push_forward(&mut self, x: &[f64], u: &[f64], next: &mut [f64]) {
        let Self { nd, nk, ni, ends, means, generated, formed, by, x: increment, momentum } = self;
        let (nd, nk, ni) = (*nd, *nk, *ni);
        let n = nd + nk;
        assert_eq!((x.len(), u.len(), next.len()), (2 * n, ni + nk, 2 * n), "sizes of x, u, next");
        let Generated { tree, bent, .. } = match (means, generated, formed) {
            (Means::Formed, _, Some(formed)) => {
                let Formed { map, packed, .. } = &mut **formed;
                map.apply(x, u, packed, next);
                return;
            }
            (Means::Generated, Some(generated), _) => &mut **generated,
            _ => {
                next.fill(0.0);
                return;
            }
        };
        let (before, after) = (&x[..n], &u[ni..]);
        by[..n + nd].copy_from_slice(&x[..n + nd]);
        by[n + nd..].copy_from_slice(after);
        for column in &ends.replaced {
            by[n + nd + column - ni] = 0.0;
        }
        for impulse in &ends.inputs {
            by[n + impulse.coordinate] += impulse.residual * u[impulse.input];
        }
        let (start, pushes) = by.split_at_mut(n);
        if let Some(Bent { bends, sums }) = bent {
            bends.subtract_product(sums, start, &mut pushes[..nd]);
        }
        tree.push_forward(by, increment, momentum);
        let rate = 1.0 / ends.time_step_s;
        let (q, p) = next.split_at_mut(n);
        q[..nd].copy_from_slice(increment);
        q[nd..].copy_from_slice(&by[n + nd..]);
        p[..nd].copy_from_slice(momentum);
        q[..nd].iter_mut().zip(before).for_each(|(q, before)| *q += before);
        for k in nd..n {
            p[k] = (q[k] - before[k]) * rate;
        }
        for t in &ends.turnings {
            let (i, start) = (t.coordinate, three(before, t.coordinate));
            if i < nd {
                let end = t.to_end.apply(three(increment, i)) + t.carried.apply(start);
                q[i..i + 3].copy_from_slice(&end.0);
            } else {
                let turned = t.momentum.apply(three(q, i)) - t.momentum.apply_transposed(start);
                p[i..i + 3].copy_from_slice(&(turned * rate).0);
            }
        }
        for impulse in &ends.inputs {
            p[impulse.coordinate] += (impulse.momentum - impulse.residual) * u[impulse.input];
        }
    }

    /// `Aᵀ z` into `by_x` and `Bᵀ z` into `by_u`: the gradient by state and input of whatever has the gradient `z` by
    /// the next state.
    ///
    /// # Panics
    ///
    /// If `z` and `by_x` do not have the `2 nd + 2 nk` entries of a state, or `by_u` not the `ni + nk` of an input.
    pub fn pull_back(&mut self, z: &[f64], by_x: &mut [f64], by_u: &mut [f64]) {
        let Self { nd, nk, ni, ends, means, generated, formed, by, x, momentum } = self;
        let (nd, nk, ni) = (*nd, *nk, *ni);
        let n = nd + nk;
        assert_eq!(
            (z.len(), by_x.len(), by_u.len()),
            (2 * n, 2 * n, ni + nk),
            "sizes of z, by_x, by_u"
        );
        by_x.fill(0.0);
        by_u.fill(0.0);
        let Generated { tree, bent, .. } = match (means, generated, formed) {
            (Means::Formed, _, Some(formed)) => {
                let Formed { map, packed, .. } = &mut **formed;
                map.add_pulled_back(z, packed, by_x, by_u);
                return;
            }
            (Means::Generated, Some(generated), _) => &mut **generated,
            _ => return,
        };
        let rate = 1.0 / ends.time_step_s;
        let (q, p) = z.split_at(n);
        x.copy_from_slice(&q[..nd]);
        momentum.copy_from_slice(&p[..nd]);
        for t in ends.turnings.iter().filter(|t| t.coordinate < nd) {
            let i = t.coordinate;
            x[i..i + 3].copy_from_slice(&t.to_end.apply_transposed(three(q, i)).0);
        }
        tree.pull_back(x, momentum, by);
        let (start, pushes) = by.split_at_mut(n);
        if let Some(Bent { bends, sums }) = bent {
            bends.subtract_transposed(sums, &pushes[..nd], start);
        }
        by_x[..n + nd].copy_from_slice(&by[..n + nd]);
        by_u[ni..].copy_from_slice(&by[n + nd..]);
        by_x[..nd].iter_mut().zip(q).for_each(|(by, q)| *by += q);
        for k in nd..n {
            by_x[k] -= p[k] * rate;
            by_u[ni + k - nd] += q[k] + p[k] * rate;
        }
        for t in &ends.turnings {
            let i = t.coordinate;
            if i < nd {
                let carried = three(by, i) + t.carried.apply_transposed(three(q, i));
                by_x[i..i + 3].copy_from_slice(&carried.0);
            } else {
                let (own, turned) = (three(q, i), three(p, i) * rate);
                let start = three(by, i) - t.momentum.apply(turned);
                let end = three(by, n + i) + own + t.momentum.apply_transposed(turned);
                by_x[i..i + 3].copy_from_slice(&start.0);
                by_u[ni + i - nd..][..3].copy_from_slice(&end.0);
            }
        }
        for impulse in &ends.inputs {
            let i = impulse.coordinate;
            by_u[impulse.input] +=
                impulse.residual * by[n + i] + (impulse.momentum - impulse.residual) * p[i];
        }
        for column in &ends.replaced {
            by_u[*column] = 0.0;
        }
    }
}

impl Workspace {
    /// Differentiates by generators at the solution in the workspace, where [`is_generated`] is true; nothing, where
    /// they are not sound.
    pub(crate) fn differentiate(
        &mut self,
        at: StepContext<'_>,
        out: &mut StepDerivative,
    ) -> Result<(), StepError> {
        let StepContext { model, settings, .. } = at;
        let StepDerivative { ends, generated, by, x, momentum, .. } = out;
        let KktSystem { fields, tied, .. } = &self.kkt;
        let has_fields = fields.is_some() || !model.has_fields();
        let has_ties = tied.is_some() || model.tied_rows == 0;
        let has_constraints = model.dimensions.constraints > 0;
        let generated = &mut **generated.get_or_insert_with(|| {
            Box::new(Generated {
                tree: ClosedTree::new(model),
                bent: has_constraints.then(|| Bent::new(model)),
                fields: (!has_fields).then(|| Box::new(Fields::new(model))),
                tied: (!has_ties).then(|| Box::new(Tied::new(model, 1))),
            })
        });
        ends.time_step_s = settings.time_step_s;
        ends.at_start = settings.force_split.at_start();
        let is_differentiated = self.evaluate_solution(at);
        self.response.save_first(&mut self.kkt);
        if model.planar.is_some() {
            let mid = &mut self.mid;
            let motion = [&mid.angles[..], &mid.velocity];
            mid.mechanics.differentiate_in_space(model, motion, &mid.orientations, [x, momentum]);
        } else if !is_differentiated {
            self.mid.mechanics.differentiate(model);
        }
        let swap = |kkt: &mut KktSystem, generated: &mut Generated| {
            if !has_fields {
                std::mem::swap(&mut kkt.fields, &mut generated.fields);
            }
            if !has_ties {
                std::mem::swap(&mut kkt.tied, &mut generated.tied);
            }
        };
        swap(&mut self.kkt, generated);
        let result = self.differentiate_generated(at, ends, generated, by);
        swap(&mut self.kkt, generated);
        out.means = if result? { Means::Generated } else { Means::Nothing };
        Ok(())
    }

    /// Finds the derivatives of the tree, and closes them; false where ties are not sound. `by` is memory.
    fn differentiate_generated(
        &mut self,
        at: StepContext<'_>,
        ends: &mut Ends,
        generated: &mut Generated,
        by: &mut [f64],
    ) -> Result<bool, StepError> {
        let StepContext { model, settings, state, .. } = at;
        let Settings { time_step_s, singular_below, .. } = *settings;
        let Generated { tree, bent, .. } = generated;
        tree.closed = 0;
        let result = self.differentiate_in_space(at, ends, &mut tree.derivatives);
        if let Some(tied) = &mut self.kkt.tied {
            // A pivot that is too small may be one by the generators alone.
            if result.is_err() {
                return Ok(false);
            }
            let (closing, respond) = tree.close_next(by);
            if !tied.close_products((&ends.turnings, time_step_s), closing, respond) {
                return Ok(false);
            }
        } else {
            result?;
        }
        let Some(bent) = bent else { return Ok(true) };
        self.prepare_start(model, state);
        self.finish_end(model, state);
        let Self { constraints, kkt, step, .. } = self;
        let start = &mut constraints.start;
        start.bend(model, &state.q, &step.multipliers, &mut bent.bends);
        let (closing, respond) = tree.close_next(by);
        kkt.schur.respond(model, start, closing.take_responses(respond));
        let is_regular = kkt.close_schur(model, &constraints.end, time_step_s, singular_below);
        closing.take_factors_of(&kkt.schur.lu);
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        let rows = constraints.end.jacobian.chunks_exact(n).zip(closing.equations());
        for (jacobian, equation) in rows {
            equation.by_increment.copy_from_slice(&jacobian[..nd]);
            fill_by_parameters(jacobian, nd, ends, equation.by_parameters);
        }
        self.check_schur(model, is_regular)?;
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::lagrangian::samples::oblique;
    use crate::plant::facade::Plant;
    use plantd_scene::{Scene, builtin};

    /// Trees in planes and in space go without matrices, with few constraints or none; several steps or stages do not.
    #[test]
    fn trees_need_no_matrices() {
        let builtin = |name: &str| Model::compile(&builtin::scene(name).unwrap()).unwrap();
        let chain = builtin::scene("chain-8").unwrap().to_toml();
        let gears = "[[constraints]]\ntype = \"coupling\"\nname = \"gears\"\nterms = [\
                     { coordinate = \"link1\", coefficients = [1.0] }, \
                     { coordinate = \"link2\", coefficients = [3.0] }]\n";
        let geared = Model::compile(&Scene::from_toml(&(chain + gears)).unwrap()).unwrap();
        for (model, order, is_generated) in [
            (builtin("pendulum"), 2, true),
            (builtin("chain-8"), 2, true),
            (builtin("cart-pole"), 2, true),
            (oblique(5, ""), 2, true),
            (builtin("balls-3"), 2, true),
            (builtin("chain-8"), 4, false),
            (geared, 2, true),
            (builtin("four-bar"), 2, false),
            (builtin("marionette"), 2, true),
        ] {
            let model = Arc::new(model);
            let name = &model.scene.name;
            let settings = Settings { order, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
            let mut u = vec![0.0; model.dimensions.input()];
            plant.hold_input(&mut u);
            let mut out = StepDerivative::new(&model);
            plant.differentiate(&u, &mut out).unwrap();
            assert_eq!(matches!(out.means, Means::Generated), is_generated, "{name}");
            assert_eq!(out.formed.is_none(), is_generated, "{name}");
        }
    }

    /// Where all joints are moved, what acts between branches has nothing to push.
    #[test]
    fn ties_of_moved_joints_alone_are_no_obstacle() {
        let mut text = "format = 1\nname = \"moved\"\ngravity = [1.0, -2.0, -9.0]\n".to_owned();
        for i in 0..10 {
            let parent = if i < 2 { "world".to_owned() } else { format!("f{}", i - 2) };
            text += &format!(
                "[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\ntranslation = [0.1, {}, -0.2]\n\
                 joint = {{ type = \"revolute\", axis = [0.3, 1.0, -0.2] }}\nbody = {{ mass = 1.0 }}\n\
                 [[coordinates]]\nname = \"f{i}\"\nkind = \"prescribed\"\n",
                0.1 * (i % 2) as f64
            );
        }
        text += "[[springs]]\ntype = \"two_point\"\na = { frame = \"f8\" }\nb = { frame = \"f9\" }\nstiffness = 9.0\n";
        let model = Arc::new(Model::compile(&Scene::from_toml(&text).unwrap()).unwrap());
        assert!(model.has_ties && model.dimensions.dynamic == 0);
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        let (mut out, mut next) = (StepDerivative::new(&model), [f64::NAN; 20]);
        plant.differentiate(&[0.1; 10], &mut out).unwrap();
        out.push_forward(&[0.0; 20], &[1.0; 10], &mut next);
        assert_eq!(next[..10], [1.0; 10]);
    }

    /// Before a step was differentiated, and after one could not be.
    #[test]
    fn without_a_step_it_is_zero() {
        let model = Arc::new(oblique(3, ""));
        let mut out = StepDerivative::new(&model);
        let zero_at = |out: &mut StepDerivative| {
            let mut next = [f64::NAN; 6];
            out.push_forward(&[1.0; 6], &[], &mut next);
            next == [0.0; 6]
        };
        assert!(zero_at(&mut out));
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        plant.differentiate(&[], &mut out).unwrap();
        assert!(!zero_at(&mut out));
        assert!(plant.differentiate(&[0.0], &mut out).is_err());
        assert!(zero_at(&mut out));
    }
}
