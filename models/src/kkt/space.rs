//! The Newton matrix of a tree in space as products of vectors, and its elimination in O(n).
//!
//! With `e1`, `e2` and gravity `g = |g| e3` along three right-handed axes, and for joint `i` on the path from
//! `j` to the root (or `i = j`), all about the origin of the tree,
//!
//! ```text
//! K_ij = minus_i · upper_j      minus_i = [½h J̇_i − J_i   w_i·e1   w_i·e2]      upper_j = [½P_j + F_j/h   weight_j]
//! K_ji = plus_i · lower_j       plus_i = [½h J̇_i + J_i   w_i·e1   w_i·e2]       lower_j = [½P_j − F_j/h   weight_j]
//!
//! weight_j = ¼h |g| [f_j·e2   −f_j·e1]
//! ```
//!
//! with the angular part `w` of `J` and the force part `f` of `F`: eight numbers, as what turns about the
//! vertical changes nothing of a weight. Eliminating a leaf changes the matrix of the others by a product of
//! the same form: what is eliminated below a joint is summed in an 8 by 8 matrix `A`,
//!
//! ```text
//! D_j = K_jj + minus_jᵀ A_j plus_j      U_j = upper_j + A_j plus_j      W_j = lower_j + A_jᵀ minus_j
//! A_parent += A_j − U_j W_jᵀ / D_j
//! ```
//!
//! as in [`planar`](crate::kkt::planar), and `D_j` are the pivots of an elimination from the leaves to the root. As all sums are about one origin,
//! the solution loses digits in long chains (up to 1e-11 of it in one of 64 hinges), which the next correction
//! makes good.

#[cfg(test)]
mod tests;

use crate::kkt::planar::MatrixKind;
use crate::lagrangian::mechanics::Mechanics;
use crate::math::rows::Block;
use crate::math::simd::wide;
use crate::math::spatial::{Mat3, Vec3};
use crate::math::tree_lu::SmallestPivot;
use crate::model::tree::Tree;

/// What is left of a joint when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
struct Generator {
    minus: Block,
    plus: Block,
    u: Block,
    w_over_d: Block,
}

/// The Newton matrix of a tree in space, factored.
#[derive(Clone, Debug)]
pub(crate) struct SpatialRecursion {
    generators: Vec<Generator>,
    inverse_d: Vec<f64>,
    /// Where the sums of each joint are.
    places: Vec<usize>,
    /// `A` by rows; zero but for joints whose elimination has begun.
    sums: Vec<[Block; 8]>,
    /// Flows of right-hand sides, and twists that belong to solutions.
    flows: Vec<Block>,
    /// `e1` and `e2`.
    horizontal: [Vec3; 2],
    /// `|g|`.
    gravity: f64,
}

/// Places of sums: an only child takes that of its parent, others the next one. As trees are walked depth
/// first, there are few, which stay in the nearest cache.
fn places(tree: &Tree) -> Vec<usize> {
    let mut children = vec![0; tree.joints.len()];
    for joint in &tree.joints {
        if let Some(count) = children.get_mut(joint.parent) {
            *count += 1;
        }
    }
    let mut places = Vec::with_capacity(children.len());
    for joint in &tree.joints {
        places.push(match children.get(joint.parent) {
            Some(1) => places[joint.parent],
            Some(_) => places[joint.parent] + 1,
            None => 0,
        });
    }
    places
}

#[inline(always)]
fn dot(a: &Block, b: &Block) -> f64 {
    let (a, b) = (&a.0, &b.0);
    let pair = |k: usize| a[k] * b[k] + a[k + 4] * b[k + 4];
    (pair(0) + pair(1)) + (pair(2) + pair(3))
}

#[inline(always)]
fn lanes(a: Vec3, b: Vec3, [c, d]: [f64; 2]) -> Block {
    Block([a[0], a[1], a[2], b[0], b[1], b[2], c, d])
}

impl SpatialRecursion {
    pub(crate) fn new(tree: &Tree, gravity: Option<Vec3>) -> Self {
        let joints = tree.joints.len();
        let places = places(tree);
        let most = places.iter().max().map_or(0, |most| most + 1);
        let size = gravity.map_or(0.0, Vec3::norm);
        let [e1, e2, _] = match gravity {
            Some(g) => Mat3::with_z_along(g * (1.0 / size)).0,
            None => Mat3::ZERO.0,
        };
        Self {
            generators: vec![Generator::default(); joints],
            inverse_d: vec![0.0; joints],
            places,
            sums: vec![[Block::ZERO; 8]; most],
            flows: vec![Block::ZERO; most],
            horizontal: [e1, e2],
            gravity: size,
        }
    }

    /// Factors the matrix that belongs to the second derivatives of `mechanics`; all joints are dynamic,
    /// in the order of their coordinates. Each pivot is compared with the larger of its diagonal entry
    /// and the inertia of its row over the step. Of masses alone it is `−M/h`. About 450 flops a joint.
    #[inline(never)]
    pub(crate) fn factor(
        &mut self,
        tree: &Tree,
        mechanics: &Mechanics,
        diagonal: &[f64],
        inertia: &[f64],
        step: f64,
        kind: MatrixKind,
    ) -> SmallestPivot {
        wide!({
            let Mechanics { momenta, curvature, .. } = mechanics;
            let motion = if kind == MatrixKind::Mass { 0.0 } else { 0.5 };
            let (half, inverse) = (step * motion, 1.0 / step);
            let [e1, e2] = self.horizontal;
            let weight = 0.5 * half * self.gravity;
            let mut smallest = SmallestPivot::NONE;
            for (row, joint) in tree.joints.iter().enumerate().rev() {
                let (axis, rate) = (momenta.axis[row], momenta.axis_rate[row]);
                let (force, slope) = (curvature.force[row], curvature.rate[row]);
                let tilt = [axis.w.dot(e1), axis.w.dot(e2)];
                let weight = [weight * force.f.dot(e2), -weight * force.f.dot(e1)];
                let axis = lanes(axis.w, axis.v, [0.0; 2]);
                let rate = lanes(rate.w * half, rate.v * half, tilt);
                let force = lanes(force.n * inverse, force.f * inverse, [0.0; 2]);
                let slope = lanes(slope.n * motion, slope.f * motion, weight);
                let (plus, minus) = (rate.plus(axis), rate.plus(axis.times(-1.0)));
                let (upper, lower) = (slope.plus(force), slope.plus(force.times(-1.0)));

                let place = self.places[row];
                let (sums, own) = self.sums.split_at_mut(place);
                let own = &mut own[0];
                // U = upper + A plus,  W = lower + Aᵀ minus,  D = K_jj + minusᵀ A plus.
                let mut a_plus = Block::ZERO;
                for (a_plus, line) in a_plus.0.iter_mut().zip(&*own) {
                    *a_plus = dot(line, &plus);
                }
                let u = upper.plus(a_plus);
                let mut w = lower;
                for (two, lines) in minus.0.as_chunks::<2>().0.iter().zip(own.as_chunks::<2>().0) {
                    w = w.plus(lines[0].times(two[0]).plus(lines[1].times(two[1])));
                }
                let k_jj = dot(&minus, &upper) + diagonal[row];
                let d = k_jj + dot(&minus, &a_plus);
                smallest.see(row, d, k_jj.abs().max(inertia[row] * inverse.abs()));
                let inverse_d = 1.0 / d;
                let w_over_d = w.times(inverse_d);
                // A −= U Wᵀ / D, and on to the parent.
                for (line, u) in own.iter_mut().zip(u.0) {
                    *line = line.plus(w_over_d.times(-u));
                }
                match self.places.get(joint.parent) {
                    Some(&to) if to == place => {}
                    to => {
                        if let Some(&to) = to {
                            for (target, line) in sums[to].iter_mut().zip(&*own) {
                                *target = target.plus(*line);
                            }
                        }
                        *own = [Block::ZERO; 8];
                    }
                }
                self.generators[row] = Generator { minus, plus, u, w_over_d };
                self.inverse_d[row] = inverse_d;
            }
            smallest
        })
    }

    /// Solves `K x = b` in place, about 65 flops a joint.
    #[inline(never)]
    pub(crate) fn solve(&mut self, tree: &Tree, x: &mut [f64]) {
        wide!({
            let (generators, inverse_d) = (&self.generators[..], &self.inverse_d[..]);
            let (places, flows) = (&self.places[..], &mut self.flows[..]);
            flows.fill(Block::ZERO);
            for (i, joint) in tree.joints.iter().enumerate().rev() {
                let (generator, place) = (&generators[i], places[i]);
                let flow = flows[place];
                let value = (x[i] - dot(&generator.minus, &flow)) * inverse_d[i];
                x[i] = value;
                let flow = flow.plus(generator.u.times(value));
                match places.get(joint.parent) {
                    Some(&to) if to == place => flows[to] = flow,
                    to => {
                        flows[place] = Block::ZERO;
                        if let Some(&to) = to {
                            flows[to] = flows[to].plus(flow);
                        }
                    }
                }
            }
            for (i, joint) in tree.joints.iter().enumerate() {
                let flow = places.get(joint.parent).map_or(Block::ZERO, |&place| flows[place]);
                let value = x[i] - dot(&generators[i].w_over_d, &flow);
                x[i] = value;
                flows[places[i]] = flow.plus(generators[i].plus.times(value));
            }
        })
    }
}
