//! The Newton matrix of a tree in space as products of vectors, and its elimination in O(n).
//!
//! For joint `i` on the path from `j` to the root (or `i = j`), all about the origin of the tree,
//!
//! ```text
//! K_ij = minus_i · upper_j      K_ji = plus_i · lower_j
//! ```
//!
//! with the vectors of [`generators`](crate::lagrangian::generators). Eliminating a leaf changes the matrix of
//! the others by a product of the same form: what is eliminated below a joint is summed in an 8 by 8 matrix
//! `A`,
//!
//! ```text
//! D_j = K_jj + minus_jᵀ A_j plus_j      U_j = upper_j + A_j plus_j      W_j = lower_j + A_jᵀ minus_j
//! A_parent += A_j − U_j D_j⁻¹ W_jᵀ
//! ```
//!
//! as in [`planar`](crate::kkt::planar), and `D_j` are the pivots of an elimination from the leaves to the root.
//! A ball joint has three of each, and `D_j` is a 3 by 3 matrix. As all sums are about one origin,
//! the solution loses digits in long chains (up to 1e-11 of it in one of 64 hinges), which the next correction
//! makes good.

#[cfg(test)]
mod tests;

use plantd_math::rows::Block;
use plantd_math::simd::{wide, widest};
use plantd_math::spatial::{Mat3, Vec3};
use plantd_math::tree_lu::SmallestPivot;

use crate::lagrangian::generators::{
    Generators, MatrixKind, Step, Vertical, dot, of_ball, rows as times,
};
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::turning::Weights;
use crate::model::mechanism::Model;
use crate::model::tree::{JointKind, Tree};

/// What is left of a joint when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
struct Eliminated {
    minus: Block,
    plus: Block,
    u: Block,
    w_over_d: Block,
}

/// What is added to the second derivatives of the Lagrangian.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Added<'a> {
    /// On the diagonal, but for ball joints.
    pub(crate) diagonal: &'a [f64],
    pub(crate) balls: &'a [Weights],
}

/// The Newton matrix of a tree in space, factored.
#[derive(Clone, Debug)]
pub(crate) struct SpatialRecursion {
    eliminated: Vec<Eliminated>,
    inverse_d: Vec<f64>,
    /// `D⁻¹` of ball joints, by their orientations.
    inverse_blocks: Vec<Mat3>,
    /// Where the sums of each joint are.
    places: Vec<usize>,
    /// Whether a joint carries others: below one that carries none `A` is zero.
    carries: Vec<bool>,
    /// `A` by rows; zero but for joints whose elimination has begun.
    sums: Vec<[Block; 8]>,
    /// Flows of right-hand sides, and twists that belong to solutions.
    flows: Vec<Block>,
    vertical: Vertical,
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

/// `A v`.
#[inline(always)]
fn product(a: &[Block; 8], v: &Block) -> Block {
    let mut out = Block::ZERO;
    for (out, line) in out.0.iter_mut().zip(a) {
        *out = dot(line, v);
    }
    out
}

/// `A` times three vectors, as [`product`] finds them one by one: with its columns side by side once.
#[inline(always)]
fn products(a: &[Block; 8], vectors: [&Block; 3]) -> [Block; 3] {
    let mut columns = [Block::ZERO; 8];
    for (i, line) in a.iter().enumerate() {
        for (column, entry) in columns.iter_mut().zip(line.0) {
            column.0[i] = entry;
        }
    }
    vectors.map(|v| {
        let pair = |k: usize| columns[k].times(v.0[k]).plus(columns[k + 4].times(v.0[k + 4]));
        (pair(0).plus(pair(1))).plus(pair(2).plus(pair(3)))
    })
}

/// `start + Aᵀ v`.
#[inline(always)]
fn transposed(start: Block, a: &[Block; 8], v: &Block) -> Block {
    let mut out = start;
    for (two, lines) in v.0.as_chunks::<2>().0.iter().zip(a.as_chunks::<2>().0) {
        out = out.plus(lines[0].times(two[0]).plus(lines[1].times(two[1])));
    }
    out
}

/// Passes what is eliminated at a place on to that of the parent.
#[inline(always)]
fn pass(sums: &mut [Block; 8], above: &mut [[Block; 8]], place: usize, parent: Option<&usize>) {
    match parent {
        Some(&to) if to == place => {}
        to => {
            if let Some(&to) = to {
                for (target, line) in above[to].iter_mut().zip(&*sums) {
                    *target = target.plus(*line);
                }
            }
            *sums = [Block::ZERO; 8];
        }
    }
}

/// The inverse of a 3 by 3 matrix, with the pivots of its elimination from the last row to the first.
#[inline(always)]
fn inverse(d: &Mat3) -> (Mat3, Vec3) {
    let Mat3([x, y, z]) = *d;
    let [last, middle] = [x.cross(y), x.cross(z)];
    let minor = y[1] * z[2] - z[1] * y[2];
    let determinant = z.dot(last);
    let scale = 1.0 / determinant;
    let rows = [y.cross(z) * scale, middle * -scale, last * scale];
    (Mat3(rows).transpose(), Vec3([determinant / minor, minor / z[2], z[2]]))
}

/// What the axes of a ball joint give to the matrix. Apart from their elimination, with which compilers would
/// mix it number by number.
#[inline(never)]
fn write_generators(
    step: &Step,
    mechanics: &Mechanics,
    first: usize,
    weights: &Weights,
    out: &mut [Generators; 3],
) {
    wide!({
        *out = of_ball(&step.parts_of_ball(mechanics, first), weights);
    });
}

impl SpatialRecursion {
    pub(crate) fn new(model: &Model) -> Self {
        let joints = model.dynamics.joints.len();
        let places = places(&model.dynamics);
        let most = places.iter().max().map_or(0, |most| most + 1);
        let mut carries = vec![false; joints];
        for joint in &model.dynamics.joints {
            if let Some(parent) = carries.get_mut(joint.parent) {
                *parent = true;
            }
        }
        Self {
            carries,
            eliminated: vec![Eliminated::default(); joints],
            inverse_d: vec![0.0; joints],
            inverse_blocks: vec![Mat3::ZERO; model.orientations.len()],
            places,
            sums: vec![[Block::ZERO; 8]; most],
            flows: vec![Block::ZERO; most],
            vertical: Vertical::new(model),
        }
    }

    /// Factors the matrix that belongs to the second derivatives of `mechanics`; all joints are dynamic,
    /// in the order of their coordinates. Each pivot is compared with the larger of its diagonal entry
    /// and the inertia of its row over the step. Of masses alone it is `−M/h`. About 450 flops an axis.
    #[inline(never)]
    pub(crate) fn factor(
        &mut self,
        model: &Model,
        mechanics: &Mechanics,
        added: Added<'_>,
        step: f64,
        kind: MatrixKind,
    ) -> SmallestPivot {
        widest!({
            let step = Step::new(&self.vertical, step, kind);
            if added.balls.is_empty() {
                self.eliminate::<false>(model, mechanics, added, &step)
            } else {
                self.eliminate::<true>(model, mechanics, added, &step)
            }
        })
    }

    /// From the leaves to the root; `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn eliminate<const BALLS: bool>(
        &mut self,
        model: &Model,
        mechanics: &Mechanics,
        added: Added<'_>,
        step: &Step,
    ) -> SmallestPivot {
        let mut smallest = SmallestPivot::NONE;
        for (row, joint) in model.dynamics.joints.iter().enumerate().rev() {
            if let (true, JointKind::Ball(axis)) = (BALLS, joint.kind) {
                if axis == 0 {
                    self.eliminate_ball(model, mechanics, added, step, row, &mut smallest);
                }
                continue;
            }
            let generators = step.parts(mechanics, row).generators();
            let Generators { minus, plus, upper, lower } = generators;
            let place = self.places[row];
            let (sums, own) = self.sums.split_at_mut(place);
            let own = &mut own[0];
            // U = upper + A plus,  W = lower + Aᵀ minus,  D = K_jj + minusᵀ A plus.
            let [mut a_plus, mut w] = [Block::ZERO, lower];
            if self.carries[row] {
                a_plus = product(own, &plus);
                w = transposed(lower, own, &minus);
            }
            let u = upper.plus(a_plus);
            let k_jj = dot(&minus, &upper) + added.diagonal[row];
            let d = k_jj + dot(&minus, &a_plus);
            let inertia = model.conditioning.inertia[row] * step.inverse.abs();
            smallest.see(row, d, k_jj.abs().max(inertia));
            let inverse_d = 1.0 / d;
            let w_over_d = w.times(inverse_d);
            // A −= U Wᵀ / D, and on to the parent.
            for (line, u) in own.iter_mut().zip(u.0) {
                *line = line.plus(w_over_d.times(-u));
            }
            pass(own, sums, place, self.places.get(joint.parent));
            self.eliminated[row] = Eliminated { minus, plus, u, w_over_d };
            self.inverse_d[row] = inverse_d;
        }
        smallest
    }

    /// The same for the three axes of a ball joint.
    #[inline(always)]
    fn eliminate_ball(
        &mut self,
        model: &Model,
        mechanics: &Mechanics,
        added: Added<'_>,
        step: &Step,
        first: usize,
        smallest: &mut SmallestPivot,
    ) {
        let joint = &model.dynamics.joints[first];
        let weights = &added.balls[joint.orientation];
        let generators = &mut [Generators::default(); 3];
        write_generators(step, mechanics, first, weights, generators);
        let place = self.places[first];
        let (sums, own) = self.sums.split_at_mut(place);
        let own = &mut own[0];
        let [p, q, r] = &*generators;
        let [mut a_plus, mut w] = [[Block::ZERO; 3], [p.lower, q.lower, r.lower]];
        let k = step.within_ball(mechanics, model.gravity, first, weights);
        let mut d = k;
        if self.carries[first + 2] {
            a_plus = products(own, [&p.plus, &q.plus, &r.plus]);
            for (w, generators) in w.iter_mut().zip(&*generators) {
                *w = transposed(*w, own, &generators.minus);
            }
            for (column, a_plus) in d.0.iter_mut().zip(&a_plus) {
                for (entry, generators) in column.0.iter_mut().zip(&*generators) {
                    *entry += dot(&generators.minus, a_plus);
                }
            }
        }
        let (inverse_d, pivots) = inverse(&d);
        for a in (0..3).rev() {
            let inertia = model.conditioning.inertia[first + a] * step.inverse.abs();
            smallest.see(first + a, pivots[a], k.0[a][a].abs().max(inertia));
        }
        let w_over_d = times(&inverse_d, &w);
        for a in 0..3 {
            let Generators { minus, plus, upper, .. } = generators[a];
            let u = upper.plus(a_plus[a]);
            for (line, u) in own.iter_mut().zip(u.0) {
                *line = line.plus(w_over_d[a].times(-u));
            }
            self.eliminated[first + a] = Eliminated { minus, plus, u, w_over_d: w_over_d[a] };
        }
        pass(own, sums, place, self.places.get(joint.parent));
        self.inverse_blocks[joint.orientation] = inverse_d;
    }

    /// Solves `K x = b` in place, about 65 flops an axis.
    #[inline(never)]
    pub(crate) fn solve(&mut self, tree: &Tree, x: &mut [f64]) {
        widest!({
            if self.inverse_blocks.is_empty() {
                self.substitute::<false>(tree, x);
            } else {
                self.substitute::<true>(tree, x);
            }
        })
    }

    /// `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn substitute<const BALLS: bool>(&mut self, tree: &Tree, x: &mut [f64]) {
        let (eliminated, inverse_d) = (&self.eliminated[..], &self.inverse_d[..]);
        let (places, flows) = (&self.places[..], &mut self.flows[..]);
        flows.fill(Block::ZERO);
        for (i, joint) in tree.joints.iter().enumerate().rev() {
            let (own, place) = (&eliminated[i], places[i]);
            let mut flow = flows[place];
            match joint.kind {
                JointKind::Ball(0) if BALLS => {
                    let axes = &eliminated[i..i + 3];
                    let b = |a: usize| x[i + a] - dot(&axes[a].minus, &flow);
                    let b = Vec3([b(0), b(1), b(2)]);
                    let value = self.inverse_blocks[joint.orientation].apply(b);
                    for (own, value) in axes.iter().zip(value.0) {
                        flow = flow.plus(own.u.times(value));
                    }
                    x[i..i + 3].copy_from_slice(&value.0);
                }
                JointKind::Ball(_) if BALLS => continue,
                _ => {
                    let value = (x[i] - dot(&own.minus, &flow)) * inverse_d[i];
                    x[i] = value;
                    flow = flow.plus(own.u.times(value));
                }
            }
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
            let axes = match joint.kind {
                JointKind::Ball(0) if BALLS => i..i + 3,
                JointKind::Ball(_) if BALLS => continue,
                _ => i..i + 1,
            };
            let flow = places.get(joint.parent).map_or(Block::ZERO, |&place| flows[place]);
            let mut moved = flow;
            for (x, own) in x[axes.clone()].iter_mut().zip(&eliminated[axes]) {
                *x -= dot(&own.w_over_d, &flow);
                moved = moved.plus(own.plus.times(*x));
            }
            flows[places[i]] = moved;
        }
    }
}
