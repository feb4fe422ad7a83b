//! How the gradient of the Lagrangian changes with a small change of the motion: its second derivatives times
//! one vector, in O(n).
//!
//! With a change `a` of the coordinates and `b` of their velocities, and the vectors of
//! [`curvature`](crate::lagrangian::curvature),
//!
//! ```text
//! root to leaf:  E_i = E_parent + J̇_i a_i + J_i b_i      Z_i = Z_parent + w_i a_i
//! leaf to root:  G_i = P_i a_i + F_i b_i + Σ G_child      N_i = f_i a_i + Σ N_child
//!                δL_q,i = P_i·E_parent + (f_i × g)·Z_parent + J̇_i·G_i + w_i·(N_i × g)
//! ```
//!
//! The axes of a ball joint turn with it. Of its own `a` and `b` they have `J̇ a` and `w a` among what is above
//! them and `F b` among what is below, and of its momentum
//!
//! ```text
//! δL_v,i = F_i·(E_parent + Σ J̇ a + Σ J b) + J_i·Σ G_child
//! ```

use plantd_math::scalar::{Scalar, in_registers};
use plantd_math::spatial::{Force, Motion, Vec3};

use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::Model;
use crate::model::tree::{Joint, JointKind, WORLD};

/// What a joint passes on to those that it carries: `E` and `Z`.
type Above<S> = (Motion<S>, Vec3<S>);
/// What it passes on to its parent: `G` and `N`.
type Below<S> = (Force<S>, Vec3<S>);

/// A small change of the motion, and what it makes of the gradient.
#[derive(Clone, Debug, Default)]
pub(crate) struct Nudge<S = f64> {
    /// `a`: changes of the dynamic coordinates, of ball joints turns in their own axes. In planes those of prescribed
    /// coordinates follow, which are zero, here and in `b`.
    pub(crate) position: Vec<S>,
    /// `b`.
    pub(crate) velocity: Vec<S>,
    /// `δL_q`.
    pub(crate) l_q: Vec<S>,
    /// `δL_v`, of ball joints alone.
    pub(crate) l_v: Vec<S>,
    above: Vec<Above<S>>,
    below: Vec<Below<S>>,
}

impl<S: Planar> Nudge<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let nd = model.dimensions.dynamic;
        let (changes, joints) = match &model.planar {
            Some(_) => (model.dimensions.coordinates(), 0),
            None => (nd, model.dynamics.joints.len()),
        };
        let zeros = |count: usize| vec![S::ZERO; count];
        Self {
            position: zeros(changes),
            velocity: zeros(changes),
            l_q: zeros(nd),
            l_v: zeros(if model.orientations.is_empty() { 0 } else { nd }),
            above: vec![Above::default(); joints],
            below: vec![Below::default(); joints],
        }
    }

    /// Finds the changes of `L_q` and `L_v`, of the bodies alone, at the last second derivatives.
    #[inline(always)]
    pub(crate) fn find(&mut self, model: &Model, mechanics: &mut Mechanics<S>) {
        match (&mut mechanics.planar, &model.planar) {
            (Some(planar), Some(joints)) => {
                planar.nudge(joints, &self.position, &self.velocity, &mut self.l_q);
            }
            _ => self.find_in_space(model, mechanics),
        }
    }

    /// About 75 flops an axis.
    #[inline(never)]
    fn find_in_space(&mut self, model: &Model, mechanics: &Mechanics<S>) {
        in_registers!(S, {
            self.ascend(&model.dynamics.joints, mechanics);
            if model.orientations.is_empty() {
                self.descend::<false>(model, mechanics);
            } else {
                self.descend::<true>(model, mechanics);
            }
        });
    }

    /// From the roots to the leaves.
    #[inline(always)]
    fn ascend(&mut self, joints: &[Joint], mechanics: &Mechanics<S>) {
        let momenta = &mechanics.momenta;
        let (axes, rates) = (&momenta.axis[..], &momenta.axis_rate[..]);
        let (above, below) = (&mut self.above[..], &mut self.below[..]);
        for (i, joint) in joints.iter().enumerate() {
            let (mut motion, mut turn) = over(above, joint.parent);
            if let Some(&a) = self.position.get(joint.coordinate) {
                let b = self.velocity[joint.coordinate];
                motion = motion.add_scaled(a, rates[i]).add_scaled(b, axes[i]);
                turn += axes[i].w * a;
            }
            above[i] = (motion, turn);
            below[i] = Below::default();
        }
    }

    /// From the leaves to the roots; `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn descend<const BALLS: bool>(&mut self, model: &Model, mechanics: &Mechanics<S>) {
        let Mechanics { momenta, curvature, .. } = mechanics;
        let gravity = Vec3::lift(model.gravity.unwrap_or_default());
        let (above, below) = (&self.above[..], &mut self.below[..]);
        for (i, joint) in model.dynamics.joints.iter().enumerate().rev() {
            let axes = match joint.kind {
                JointKind::Ball(0) if BALLS => i..i + 3,
                JointKind::Ball(_) if BALLS => continue,
                _ => i..i + 1,
            };
            let is_ball = BALLS && axes.len() == 3;
            let children = below[axes.end - 1];
            let (mut motion, mut turn) = over(above, joint.parent);
            let (mut force, mut load) = children;
            for k in axes.clone() {
                let coordinate = joint.coordinate + (k - i);
                let Some(&a) = self.position.get(coordinate) else { continue };
                let b = self.velocity[coordinate];
                force = force.add_scaled(b, curvature.force[k]);
                if is_ball {
                    motion = motion.add_scaled(a, momenta.axis_rate[k]);
                    turn += momenta.axis[k].w * a;
                } else {
                    force = force.add_scaled(a, curvature.rate[k]);
                    load += curvature.force[k].f * a;
                }
            }
            let moved = above[axes.end - 1].0;
            let (mut passed, mut passed_load) = (force, load);
            for k in axes {
                let coordinate = joint.coordinate + (k - i);
                let Some(&a) = self.position.get(coordinate) else { continue };
                let (axis, rate) = (momenta.axis[k], momenta.axis_rate[k]);
                let (own, slope) = (curvature.force[k], curvature.rate[k]);
                self.l_q[coordinate] = (motion.dot(slope) + rate.dot(force))
                    + (own.f.cross(gravity).dot(turn) + axis.w.dot(load.cross(gravity)));
                if is_ball {
                    self.l_v[coordinate] = moved.dot(own) + axis.dot(children.0);
                    passed = passed.add_scaled(a, slope);
                    passed_load += own.f * a;
                }
            }
            if joint.parent != WORLD {
                let (force, load) = below[joint.parent];
                below[joint.parent] = (force.plus(passed), load + passed_load);
            }
        }
    }
}

#[inline(always)]
fn over<S: Scalar>(above: &[Above<S>], parent: usize) -> Above<S> {
    if parent == WORLD { Above::default() } else { above[parent] }
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
            model.armature.clear();
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
