//! How the gradient of the Lagrangian changes with a small change of the motion: its second derivatives times
//! one vector, in O(n).
//!
//! With a change `a` of the coordinates and `b` of their velocities, and the rows of
//! [`curvature`](crate::lagrangian::curvature),
//!
//! ```text
//! root to leaf:  E_i = E_parent + rate_i a_i + axis_i b_i
//! leaf to root:  G_i = slope_i a_i + force_i b_i + Σ G_child
//!                δL_q,i = slope_i·E_parent + rate_i·G_i
//! ```
//!
//! The axes of a ball joint turn with it. Of the sums over its own `a` and `b` they have `Σ rate a` among what is
//! above them and `Σ force b` among what is below, and of its momentum
//!
//! ```text
//! δL_v,i = force_i·(E_parent + Σ rate a + Σ axis b) + axis_i·Σ G_child
//! ```

use plantd_math::scalar::{Beside, Scalar, Wide};

use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::Model;
use crate::model::slots::Slots;
use crate::model::tree::WORLD;

/// A small change of the motion, and what it makes of the gradient.
#[derive(Clone, Debug, Default)]
pub(crate) struct Nudge<S: Scalar = f64> {
    /// `a`: changes of the dynamic coordinates, of ball joints turns in their own axes. In planes those of prescribed
    /// coordinates follow, which are zero, here and in `b`.
    pub(crate) position: Vec<S>,
    /// `b`.
    pub(crate) velocity: Vec<S>,
    /// `δL_q`.
    pub(crate) l_q: Vec<S>,
    /// `δL_v`, of ball joints alone.
    pub(crate) l_v: Vec<S>,
    /// `E` and `G` of each link.
    above: Vec<S::Row>,
    below: Vec<S::Row>,
}

/// What [`Nudge::find`] does in space.
struct Find<'a, S: Planar> {
    nudge: &'a mut Nudge<S>,
    model: &'a Model,
    curvature: &'a Curvature<S>,
}

impl<S: Planar> Beside<S> for Find<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<S>>(self) {
        let Self { nudge, model, curvature } = self;
        let slots = &model.dynamics.slots;
        if model.orientations.is_empty() {
            nudge.descend::<W, false>(slots, curvature);
            nudge.ascend::<W, false>(slots, curvature);
        } else {
            nudge.descend::<W, true>(slots, curvature);
            nudge.ascend::<W, true>(slots, curvature);
        }
    }
}

/// `a x + b y`.
#[inline(always)]
fn sum_of<S: Scalar, W: Wide<S>>([a, b]: [&S::Row; 2], [x, y]: [S; 2]) -> W::Line {
    W::sum(W::scaled(W::row(a), x), W::scaled(W::row(b), y))
}

impl<S: Planar> Nudge<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let nd = model.dimensions.dynamic;
        let (changes, links) = match &model.planar {
            Some(_) => (model.dimensions.coordinates(), 0),
            None => (nd, model.dynamics.slots.parents.len()),
        };
        let zeros = |count: usize| vec![S::ZERO; count];
        Self {
            position: zeros(changes),
            velocity: zeros(changes),
            l_q: zeros(nd),
            l_v: zeros(if model.orientations.is_empty() { 0 } else { nd }),
            above: vec![S::Row::default(); links],
            below: vec![S::Row::default(); links],
        }
    }

    /// Finds the changes of `L_q` and `L_v`, of the bodies alone, at the last second derivatives.
    #[inline(always)]
    pub(crate) fn find(&mut self, model: &Model, mechanics: &mut Mechanics<S>) {
        match (&mut mechanics.planar, &model.planar) {
            (Some(planar), Some(joints)) => {
                planar.nudge(joints, &self.position, &self.velocity, &mut self.l_q);
            }
            _ => self.find_in_space(model, &mechanics.curvature),
        }
    }

    /// About 100 flops an axis.
    #[inline(never)]
    fn find_in_space(&mut self, model: &Model, curvature: &Curvature<S>) {
        S::beside(model.dynamics.joints.len(), Find { nudge: self, model, curvature });
    }

    /// How a coordinate changes; prescribed ones do not.
    #[inline(always)]
    fn own(&self, coordinate: usize) -> [S; 2] {
        match (self.position.get(coordinate), self.velocity.get(coordinate)) {
            (Some(a), Some(b)) => [*a, *b],
            _ => [S::ZERO; 2],
        }
    }

    /// `E`, from the roots to the leaves; `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn descend<W: Wide<S>, const BALLS: bool>(&mut self, slots: &Slots, curvature: &Curvature<S>) {
        let Curvature { axis, rate, .. } = curvature;
        let zero = W::row(&S::Row::default());
        let mut last = zero;
        for (link, &parent) in slots.parents.iter().enumerate() {
            let above = match parent {
                WORLD => zero,
                parent if parent + 1 == link => last,
                parent => W::row(&self.above[parent]),
            };
            let (i, coordinate) = (slots.joints[link], slots.coordinates[0][link]);
            let mut own = sum_of::<S, W>([&rate[i], &axis[i]], self.own(coordinate));
            if BALLS && slots.is_ball(link) {
                let [first, second] = [self.own(coordinate - 2), self.own(coordinate - 1)];
                let first = sum_of::<S, W>([&rate[i - 2], &axis[i - 2]], first);
                let second = sum_of::<S, W>([&rate[i - 1], &axis[i - 1]], second);
                own = W::sum(own, W::sum(first, second));
            }
            last = W::sum(above, own);
            W::put_row(last, &mut self.above[link]);
            self.below[link] = S::Row::default();
        }
    }

    /// `G` and the changes, from the leaves to the roots.
    #[inline(always)]
    fn ascend<W: Wide<S>, const BALLS: bool>(&mut self, slots: &Slots, curvature: &Curvature<S>) {
        let Curvature { rate, force, slope, .. } = curvature;
        let zero = W::row(&S::Row::default());
        // What the link after this one passes on to it stays in registers.
        let mut next = zero;
        for (link, &parent) in slots.parents.iter().enumerate().rev() {
            let (i, coordinate) = (slots.joints[link], slots.coordinates[0][link]);
            let children = W::sum(W::row(&self.below[link]), next);
            if BALLS && slots.is_ball(link) {
                let moved = W::row(&self.above[link]);
                let first = [i - 2, coordinate - 2];
                next = self.ascend_ball::<W>(first, [moved, children], curvature);
            } else {
                let own = self.own(coordinate);
                next = W::sum(children, sum_of::<S, W>([&slope[i], &force[i]], own));
                if let Some(l_q) = self.l_q.get_mut(coordinate) {
                    let above = match parent {
                        WORLD => zero,
                        parent => W::row(&self.above[parent]),
                    };
                    *l_q = W::dots([W::row(&slope[i]), above], [W::row(&rate[i]), next]);
                }
            }
            if parent.wrapping_add(1) == link && link > 0 {
                continue;
            }
            if parent != WORLD {
                let all = &mut self.below[parent];
                W::put_row(W::sum(W::row(all), next), all);
            }
            next = zero;
        }
    }

    /// The same for a ball joint, whose axes begin with the joint `first` and the coordinate `own`, from its own `E` and
    /// from what its children pass on; returns what goes on to its parent.
    #[inline(always)]
    fn ascend_ball<W: Wide<S>>(
        &mut self,
        [first, own]: [usize; 2],
        [moved, children]: [W::Line; 2],
        curvature: &Curvature<S>,
    ) -> W::Line {
        let Curvature { axis, rate, force, slope, .. } = curvature;
        let (mut above, mut below, mut all) = (moved, children, children);
        for k in 0..3 {
            let [a, b] = self.own(own + k);
            // Of what they have added, what comes of their speed.
            above = W::sum(above, W::scaled(W::row(&axis[first + k]), -b));
            below = W::sum(below, W::scaled(W::row(&force[first + k]), b));
            all = W::sum(all, sum_of::<S, W>([&slope[first + k], &force[first + k]], [a, b]));
        }
        for (k, i) in (own..own + 3).enumerate() {
            let (axis, rate) = (W::row(&axis[first + k]), W::row(&rate[first + k]));
            let (force, slope) = (W::row(&force[first + k]), W::row(&slope[first + k]));
            if let (Some(l_q), Some(l_v)) = (self.l_q.get_mut(i), self.l_v.get_mut(i)) {
                *l_q = W::dots([slope, above], [rate, below]);
                *l_v = W::dots([force, moved], [axis, children]);
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagrangian::derivatives::Derivatives;
    use crate::lagrangian::samples::{self, assert_close, configuration, random_models};
    use plantd_scene::builtin;

    /// What comes of one pass is what the matrices make of the change.
    #[test]
    fn changes_are_products_with_the_second_derivatives() {
        let names = ["tree-7", "walker-3", "balls-7", "spherical-pendulum"];
        let built_in = names.map(|name| Model::compile(&builtin::scene(name).unwrap()).unwrap());
        let random = random_models(40).into_iter().map(|mut model| {
            // Of bodies alone.
            model.potentials.springs.clear();
            model.armature = Default::default();
            model.planar = None;
            model
        });
        built_in.into_iter().chain(random).for_each(|model| check(&model));
    }

    /// The same in planes: one joint, chains, sliders, branches, prescribed joints, each way that joints lie.
    #[test]
    fn in_planes_too() {
        let names = ["pendulum", "double-pendulum", "cart-pole", "chain-4", "chain-7"];
        let built_in = names.map(|name| Model::compile(&builtin::scene(name).unwrap()).unwrap());
        let planes = [(12, ""), (3, ""), (7, ""), (12, "kind = \"prescribed\"")];
        for model in built_in.into_iter().chain(planes.map(|(n, extra)| samples::oblique(n, extra)))
        {
            assert!(model.planar.is_some(), "{} joints", model.dynamics.joints.len());
            check(&model);
        }
    }

    fn check(model: &Model) {
        let (nd, n) = (model.dimensions.dynamic, model.dimensions.coordinates());
        let (at, velocity) = configuration(model, 1);
        let mut mechanics = Mechanics::new(model);
        let [mut l_q, mut l_v] = [0; 2].map(|_| vec![0.0; nd]);
        let gradient = [&mut l_q[..], &mut l_v[..]];
        mechanics.gradient(model, &at.q, &at.orientations, &velocity, gradient);
        mechanics.differentiate(model);
        let mut dense = Derivatives::new(model);
        let inputs = vec![0.0; model.dimensions.inputs];
        dense.evaluate(model, (&at.q, &at.orientations), &velocity, &inputs);

        let mut nudge = Nudge::new(model);
        for i in 0..nd {
            nudge.position[i] = (0.7 * i as f64 + 0.2).sin();
            nudge.velocity[i] = (1.1 * i as f64 + 0.4).cos();
        }
        nudge.find(model, &mut mechanics);
        let Nudge { position: a, velocity: b, .. } = &nudge;
        let sum = |i: usize, entry: &dyn Fn(usize, usize) -> [f64; 2]| -> f64 {
            (0..nd).map(|j| entry(i, j)[0] * a[j] + entry(i, j)[1] * b[j]).sum()
        };
        let of = |i: usize| sum(i, &|i, j| [dense.l_qq[i * n + j], dense.l_qv[i * n + j]]);
        let expected: Vec<f64> = (0..nd).map(of).collect();
        assert_close("torque", &nudge.l_q, &expected);
        let of = |i: usize| sum(i, &|i, j| [dense.l_qv[j * n + i], dense.l_vv[i * n + j]]);
        for &i in model.orientations.iter().filter(|i| **i < nd) {
            let expected: Vec<f64> = (i..i + 3).map(of).collect();
            assert_close("momentum", &nudge.l_v[i..i + 3], &expected);
        }
    }
}
