//! Derivatives of the Lagrangian `L(q, v)` and of the generalized forces `f(q, v, u)` at one point, as
//! dense matrices, for any scalar.
//!
//! All equations of this crate are made of these: the discrete ones of a step by the chain rule of the
//! midpoint, `∂/∂q[k] = ½ ∂/∂q − 1/h ∂/∂v` and `∂/∂q[k+1] = ½ ∂/∂q + 1/h ∂/∂v`, the continuous ones and
//! those of rest as they are.
//!
//! ```text
//! L_q, L_v, f            nd          torque, momentum, force
//! L_qq, L_qv, L_vv       n by n      L_vq = L_qvᵀ
//! f_q, f_v               nd by n
//! f_u                    nd by ni
//! ```
//!
//! with `n` coordinates, `nd` of them dynamic, `ni` inputs; row-major. Springs count as a part of `L`,
//! dampers as forces. Evaluated with [`Dual`](plantd_math::scalar::Dual) numbers, their dual parts are
//! derivatives along a direction: third derivatives of `L`, which second-order linearizations need.
//! Where sparsity counts, [`Mechanics::for_each_second_derivative`] names the entries one by one.
//!
//! [`Mechanics::for_each_second_derivative`]: crate::lagrangian::mechanics::Mechanics::for_each_second_derivative

use plantd_math::scalar::Scalar;
use plantd_math::spatial::Mat3;

use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::mechanism::{CoordinateInput, Forces, Model};
use crate::model::tree::{JointKind, WORLD};

/// Gradient and second derivatives of the Lagrangian, springs included, and forces with their first
/// derivatives, at one configuration and velocity.
///
/// Matrices are row-major.
#[derive(Clone, Debug)]
pub(crate) struct Derivatives<S: Scalar = f64> {
    pub(crate) poses: Poses<S>,
    pub(crate) momenta: Momenta<S>,
    curvature: Curvature<S>,
    /// `∂L/∂q`, nd.
    pub(crate) l_q: Vec<S>,
    /// `∂L/∂v`, nd.
    pub(crate) l_v: Vec<S>,
    /// Generalized force `f`, nd.
    pub(crate) force: Vec<S>,
    /// `∂²L/∂q∂q`, n by n.
    pub(crate) l_qq: Vec<S>,
    /// `∂²L/∂q∂v`, n by n: rows by `q`, columns by `v`; its transpose is `L_vq`.
    pub(crate) l_qv: Vec<S>,
    /// `∂²L/∂v∂v`, n by n.
    pub(crate) l_vv: Vec<S>,
    /// `∂f/∂q`, nd by n.
    pub(crate) f_q: Vec<S>,
    /// `∂f/∂v`, nd by n.
    pub(crate) f_v: Vec<S>,
    /// `∂f/∂u`, nd by ni.
    pub(crate) f_u: Vec<S>,
    /// `n`.
    columns: usize,
    /// Ancestor and descendant of each pair of joints on one path to the root, a joint with itself
    /// included, and their coordinates.
    pairs: Vec<[usize; 4]>,
    /// First joints of ball joints.
    balls: Vec<usize>,
}

impl<S: Scalar> Derivatives<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let (n, nd, ni) =
            (model.dimensions.coordinates(), model.dimensions.dynamic, model.dimensions.inputs);
        let zeros = |len: usize| vec![S::ZERO; len];
        let joints = &model.dynamics.joints;
        let mut pairs = Vec::new();
        for (descendant, joint) in joints.iter().enumerate() {
            let mut ancestor = descendant;
            while ancestor != WORLD {
                let above = &joints[ancestor];
                pairs.push([ancestor, descendant, above.coordinate, joint.coordinate]);
                ancestor = above.parent;
            }
        }
        let is_first = |&j: &usize| joints[j].kind == JointKind::Ball(0);
        Self {
            balls: (0..joints.len()).filter(is_first).collect(),
            poses: Poses::new(&model.dynamics),
            momenta: Momenta::new(&model.dynamics),
            curvature: Curvature::new(&model.dynamics, model.gravity),
            l_q: zeros(nd),
            l_v: zeros(nd),
            force: zeros(nd),
            l_qq: zeros(n * n),
            l_qv: zeros(n * n),
            l_vv: zeros(n * n),
            f_q: zeros(nd * n),
            f_v: zeros(nd * n),
            f_u: zeros(nd * ni),
            columns: n,
            pairs,
        }
    }

    /// Rows and columns at which derivatives of torques, momenta and forces may differ from zero.
    pub(crate) fn dynamic_pattern(&self, model: &Model) -> Vec<(usize, usize)> {
        let forces_couple = model.forces.as_ref().is_some_and(Forces::couple_branches);
        self.pattern(model.dimensions.dynamic, model.potentials.couple_branches || forces_couple)
    }

    /// Pairs of coordinates that the Lagrangian couples, both ways round.
    pub(crate) fn coupled_coordinates(&self, model: &Model) -> Vec<(usize, usize)> {
        self.pattern(model.dimensions.coordinates(), model.potentials.couple_branches)
    }

    /// Pairs of coordinates on one path to the root, both ways round, or all of them, in so many rows.
    fn pattern(&self, rows: usize, all: bool) -> Vec<(usize, usize)> {
        let n = self.columns;
        if all {
            return (0..rows * n).map(|entry| (entry / n, entry % n)).collect();
        }
        let on_paths = self.pairs.iter().flat_map(|&[_, _, i, j]| [(i, j), (j, i)]);
        let mut pattern: Vec<_> =
            on_paths.chain((0..n).map(|i| (i, i))).filter(|(i, _)| *i < rows).collect();
        pattern.sort_unstable();
        pattern.dedup();
        pattern
    }

    /// Evaluates everything at a configuration, with the orientations of ball joints, and a velocity.
    pub(crate) fn evaluate(
        &mut self,
        model: &Model,
        (q, orientations): (&[S], &[Mat3<S>]),
        velocity: &[S],
        inputs: &[S],
    ) {
        self.poses.evaluate(&model.dynamics, q, orientations);
        self.momenta.gradient(
            &model.dynamics,
            &self.poses,
            velocity,
            model.gravity,
            &mut self.l_q,
            &mut self.l_v,
        );
        if model.potentials.any {
            model.add_spring_gradient(&self.poses, q, &mut self.l_q);
            model.armature.add_momentum(velocity, &mut self.l_v);
        }
        self.evaluate_forces(model, q, velocity, inputs);
        self.curvature.evaluate(&model.dynamics, &self.poses, &self.momenta);
        let n = model.dimensions.coordinates();
        self.l_qq.fill(S::ZERO);
        // Where no pair of joints has an entry.
        model.armature.entries().for_each(|a| self.l_vv[a.row * n + a.column] = S::ZERO);
        for &[above, below, i, j] in &self.pairs {
            let second = self.curvature.pair(above, below);
            for (row, column, entry) in second.entries(i, j) {
                let at = row * n + column;
                (self.l_qq[at], self.l_qv[at], self.l_vv[at]) = (entry.qq, entry.qv, entry.vv);
            }
        }
        for &first in &self.balls {
            let within = self.curvature.within_ball(first);
            let i = model.dynamics.joints[first].coordinate;
            for (a, b) in (0..9).map(|entry| (entry / 3, entry % 3)) {
                self.l_qq[(i + a) * n + i + b] = within.tau_z.0[b][a];
                self.l_qv[(i + a) * n + i + b] = within.tau_v.0[b][a];
            }
        }
        if model.potentials.any {
            let l_qq = &mut self.l_qq;
            model
                .for_each_spring_derivative(&self.poses, q, |i, j, value| l_qq[i * n + j] -= value);
            for a in model.armature.entries() {
                self.l_vv[a.row * n + a.column] += S::constant(a.inertia);
            }
        }
    }

    /// Forces and their derivatives; poses and momenta are those of the last [`Self::evaluate`].
    fn evaluate_forces(&mut self, model: &Model, q: &[S], velocity: &[S], inputs: &[S]) {
        let (n, ni) = (model.dimensions.coordinates(), model.dimensions.inputs);
        self.force.fill(S::ZERO);
        if model.forces.is_some() {
            for derivatives in [&mut self.f_q, &mut self.f_v, &mut self.f_u] {
                derivatives.fill(S::ZERO);
            }
        }
        for (i, c) in model.damping.iter().enumerate() {
            self.force[i] -= velocity[i] * *c;
            self.f_v[i * (n + 1)] = S::constant(-c);
        }
        for &CoordinateInput { input, coordinate, gain } in &model.coordinate_inputs {
            self.force[coordinate] += inputs[input] * gain;
            self.f_u[coordinate * ni + input] = S::constant(gain);
        }
        let (Some(forces), nd) = (&model.forces, model.dimensions.dynamic) else { return };
        let at = Instant {
            tree: &model.dynamics,
            poses: &self.poses,
            momenta: &self.momenta,
            q,
            velocity,
            inputs,
        };
        forces.add(&at, &mut self.force);
        forces.for_each_derivative(&at, |i, j, by_q, by_v| {
            if i < nd {
                self.f_q[i * n + j] += by_q;
                self.f_v[i * n + j] += by_v;
            }
        });
        forces.for_each_input_derivative(&at, |i, k, by_u| {
            if i < nd {
                self.f_u[i * ni + k] += by_u;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagrangian::mechanics::Mechanics;
    use plantd_scene::builtin;

    #[test]
    fn entries_one_by_one_are_those_of_the_matrices() {
        for name in ["cart-pole", "spherical-pendulum", "tree-7", "marionette"] {
            let model = Model::compile(&builtin::scene(name).unwrap()).unwrap();
            let d = model.dimensions;
            let n = d.coordinates();
            let [q, v] = [0.3, 0.7]
                .map(|a| -> Vec<f64> { (0..n).map(|i| (a * (i + 1) as f64).sin()).collect() });
            let (mut dense, mut sparse) = (Derivatives::new(&model), Mechanics::new(&model));
            dense.evaluate(&model, (&q, &[]), &v, &vec![0.0; d.inputs]);
            let [mut l_q, mut l_v] = [0; 2].map(|_| vec![0.0; d.dynamic]);
            sparse.gradient(&model, &q, &[], &v, [&mut l_q, &mut l_v]);
            sparse.differentiate(&model);

            let mut rest = dense.clone();
            sparse.for_each_second_derivative(&model, |i, j, entry| {
                let (ij, ji) = (i * n + j, j * n + i);
                let pairs = [
                    (entry.qq, dense.l_qq[ij]),
                    (entry.qv, dense.l_qv[ij]),
                    (entry.vq, dense.l_qv[ji]),
                    (entry.vv, dense.l_vv[ij]),
                ];
                for (sparse, dense) in pairs {
                    assert!(
                        (sparse - dense).abs() <= 1e-11 * (1.0 + dense.abs()),
                        "{name} {i} {j}"
                    );
                }
                (rest.l_qq[ij], rest.l_vv[ij], rest.l_qv[ij], rest.l_qv[ji]) = (0.0, 0.0, 0.0, 0.0);
            });
            for row in 0..d.dynamic {
                let left = |matrix: &[f64]| matrix[row * n..][..n].iter().all(|x| *x == 0.0);
                assert!(left(&rest.l_qq) && left(&rest.l_qv) && left(&rest.l_vv), "{name} {row}");
            }
        }
    }
}
