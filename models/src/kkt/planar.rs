//! The Newton matrix of a planar tree as products of vectors, and its elimination in O(n).
//!
//! For joint `i` on the path from `j` to the root (or `i = j`), all moved to the same point,
//!
//! ```text
//! K_ij = minus_i · upper_j      minus_i = ½h J̇_i − J_i      upper_j = ½P_j + F_j/h − ¼h γ_j e
//! K_ji = plus_i · lower_j       plus_i = ½h J̇_i + J_i       lower_j = ½P_j − F_j/h + ¼h γ_j e
//! ```
//!
//! with the weight `γ_j = f_j × g` on the angular part `e`, because that part of `J̇` is zero. Eliminating
//! a leaf changes the matrix of the others by a product of the same form: what is eliminated below a
//! joint is summed in a 3 by 3 matrix `A`,
//!
//! ```text
//! D_j = K_jj + minus_jᵀ A_j plus_j      U_j = upper_j + A_j plus_j      W_j = lower_j + A_jᵀ minus_j
//! A_parent += A_j − U_j W_jᵀ / D_j
//! ```
//!
//! This is the articulated recursion: `A` stands for the articulated inertia, and for masses alone, where
//! `K` is symmetric, `W` is the `U` of the literature with another sign. The pivots of an elimination from
//! the leaves to the root are `D_j`. As each sum is about its own
//! joint, long chains lose no digits.

pub(super) mod columns;

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rows::LANES;
use plantd_math::scalar::{Compared, Scalar, in_registers};
use plantd_math::tree_lu::SmallestPivot;

use crate::kkt::planar::columns::Columns;
use crate::lagrangian::arrangement::{Fours, Planar};
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::planar::{Joints, Link};
use crate::lagrangian::plane::{Vec3, cross, linear};
use crate::model::planar_tree::PlanarJoint;

/// What a joint gives to the matrix, and what is left of it when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Generator<S = f64> {
    pub(super) minus: Vec3<S>,
    pub(super) plus: Vec3<S>,
    inverse_d: S,
}

/// How right-hand sides pass a joint when it has been eliminated: what is below reaches the parent as
/// `up · flow + U/D · b`, and what is above the children as `down · flow + plus · x`. These wait for one
/// product each, not for the solution.
#[derive(Clone, Copy, Debug, Default)]
struct Passage<S = f64> {
    up: [Vec3<S>; 3],
    u_over_d: Vec3<S>,
    down: [Vec3<S>; 3],
    /// `W/D`: what the flow from the parent takes from the solution.
    w_over_d: Vec3<S>,
}

/// What springs, dampers and forces of coordinates give to the derivatives of a step: of the residual by the start, and
/// of the momentum by the start and by the increment.
#[derive(Clone, Debug)]
pub(crate) struct Diagonals {
    pub(crate) residual: Vec<f64>,
    pub(crate) by_start: Vec<f64>,
    pub(crate) by_increment: Vec<f64>,
}

impl Diagonals {
    /// Zeros.
    pub(crate) fn new(coordinates: usize) -> Self {
        let zeros = || vec![0.0; coordinates];
        Self { residual: zeros(), by_start: zeros(), by_increment: zeros() }
    }
}

/// The matrix of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Method {
    /// 1, or 0 for masses alone.
    motion: f64,
    half: f64,
    pub(super) inverse: f64,
}

impl Method {
    #[inline(always)]
    pub(super) fn new(step: f64, kind: MatrixKind) -> Self {
        let motion = if kind == MatrixKind::Mass { 0.0 } else { 1.0 };
        Self { motion, half: 0.5 * step * motion, inverse: 1.0 / step }
    }

    /// What a joint gives to the matrix, `upper` and `lower` first, without a pivot.
    #[inline(always)]
    pub(super) fn generator<S: Compared>(
        &self,
        link: &Link<S>,
        joint: &PlanarJoint,
    ) -> ([Vec3<S>; 2], Generator<S>) {
        let Self { motion, half, inverse } = *self;
        let ([dx, dy], [rx, ry]) = (link.slide, [link.rate[0] * half, link.rate[1] * half]);
        let turn = S::constant(joint.body.turn);
        let [motion, inverse] = [0.5 * motion, inverse].map(S::constant);
        let plus = [turn, rx + dx, ry + dy];
        let minus = [-turn, rx - dx, ry - dy];
        let weight = link.weight * half * 0.5;
        let mut upper = add_scaled(scaled(motion, link.slope), inverse, link.force);
        let mut lower = add_scaled(upper, inverse * -2.0, link.force);
        upper[0] -= weight;
        lower[0] += weight;
        let generator = Generator { minus, plus, inverse_d: S::ZERO };
        ([upper, lower], generator)
    }
}

/// The Newton matrix of a planar tree, factored: of one, or of several side by side.
#[derive(Clone, Debug)]
pub(crate) struct Elimination<S = f64> {
    generators: Vec<Generator<S>>,
    passages: Vec<Passage<S>>,
    /// `A` of joints that do not follow their parent, summed for that; zero but within a pass.
    branches: Vec<[Vec3<S>; 3]>,
    /// What branches pass of a right-hand side, and what joints with several children pass down to them.
    flows_of_branches: Vec<Vec3<S>>,
    flow: Vec<Vec3<S>>,
}

/// The Newton matrix of a planar tree, factored, with room for a linearization.
#[derive(Clone, Debug)]
pub(crate) struct PlanarRecursion {
    pub(crate) elimination: Elimination,
    columns: Columns,
}

#[inline(always)]
pub(super) fn dot3<S: Scalar>(a: Vec3<S>, b: Vec3<S>) -> S {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn plus3<S: Scalar>(a: Vec3<S>, b: Vec3<S>) -> Vec3<S> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// `matrix · flow + b · drive`: a product and two sums behind the flow.
#[inline(always)]
fn passed<S: Scalar>(matrix: &[Vec3<S>; 3], flow: Vec3<S>, b: S, drive: Vec3<S>) -> Vec3<S> {
    let [r, s, t] = matrix;
    let of = |row: &Vec3<S>, drive: S| {
        (row[0] * flow[0] + row[1] * flow[1]) + (row[2] * flow[2] + drive * b)
    };
    [of(r, drive[0]), of(s, drive[1]), of(t, drive[2])]
}

#[inline(always)]
fn plus33<S: Scalar>([a, b, c]: [Vec3<S>; 3], [d, e, f]: [Vec3<S>; 3]) -> [Vec3<S>; 3] {
    [plus3(a, d), plus3(b, e), plus3(c, f)]
}

#[inline(always)]
fn scaled<S: Scalar>(s: S, a: Vec3<S>) -> Vec3<S> {
    [s * a[0], s * a[1], s * a[2]]
}

#[inline(always)]
fn add_scaled<S: Scalar>(a: Vec3<S>, s: S, b: Vec3<S>) -> Vec3<S> {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

impl<S: Planar> Elimination<S> {
    pub(crate) fn new(joints: usize) -> Self {
        Self {
            generators: vec![Generator::default(); joints],
            passages: vec![Passage::default(); joints],
            branches: vec![[[S::ZERO; 3]; 3]; joints],
            flows_of_branches: vec![[S::ZERO; 3]; joints],
            flow: vec![[S::ZERO; 3]; joints],
        }
    }

    /// Factors the matrix that belongs to the second derivatives of `tree`; all joints are dynamic, in
    /// the order of their coordinates. Each pivot is compared with the larger of its diagonal entry
    /// and the inertia of its row over the step. Of masses alone it is `−M/h`. About 150 flops a joint.
    #[inline(never)]
    pub(crate) fn factor(
        &mut self,
        tree: &Joints<S::Many>,
        joints: &[PlanarJoint],
        diagonal: &[S],
        inertia: &[f64],
        step: f64,
        kind: MatrixKind,
    ) -> SmallestPivot<S> {
        in_registers!(S, {
            let (method, n) = (Method::new(step, kind), joints.len());
            let (diagonal, inertia) = (&diagonal[..n], &inertia[..n]);
            let (generators, passages) = (&mut self.generators[..n], &mut self.passages[..n]);
            let branches = &mut self.branches[..n];
            let mut smallest = SmallestPivot::NONE;
            // `A` of the joint that follows, about its parent.
            let mut below = [[S::ZERO; 3]; 3];
            for row in (0..n).rev() {
                let joint = &joints[row];
                let mut sum = if joint.is_followed { below } else { [[S::ZERO; 3]; 3] };
                if joint.has_branches {
                    sum = plus33(sum, std::mem::take(&mut branches[row]));
                }
                let [a, b, c] = sum;
                let link = tree.link(row);
                let ([upper, lower], mut generator) = method.generator(&link, joint);
                let Generator { minus, plus, .. } = generator;

                // D = K_jj + minusᵀ A plus,  U = upper + A plus,  W = lower + Aᵀ minus.
                let a_plus = [dot3(a, plus), dot3(b, plus), dot3(c, plus)];
                let k_jj = dot3(minus, upper) + diagonal[row];
                let d = k_jj + dot3(minus, a_plus);
                let inertia = S::constant(inertia[row] * method.inverse);
                smallest.see(row, d, k_jj.abs().max(inertia));
                let inverse_d = d.recip();
                let a_minus = add_scaled(add_scaled(scaled(minus[0], a), minus[1], b), minus[2], c);
                let (u, w) = (plus3(upper, a_plus), plus3(lower, a_minus));
                // A, U and W / D about the parent: all that can be done before D is known.
                let edge = link.edge;
                let [ex, ey] = edge;
                let moved = |v: Vec3<S>| [v[0] + cross(edge, linear(v)), v[1], v[2]];
                let (a, b, c) =
                    (moved(add_scaled(add_scaled(a, ex, c), -ey, b)), moved(b), moved(c));
                let (u, w_over_d) = (moved(u), scaled(inverse_d, moved(w)));
                // A − U Wᵀ / D, for the parent.
                let sum = [
                    add_scaled(a, -u[0], w_over_d),
                    add_scaled(b, -u[1], w_over_d),
                    add_scaled(c, -u[2], w_over_d),
                ];
                match joint.parent {
                    0 => {}
                    parent if parent == row => below = sum,
                    parent => branches[parent - 1] = plus33(branches[parent - 1], sum),
                }
                // Right-hand sides pass by 1 − U minusᵀ / D up, and by 1 − plus Wᵀ / D down.
                let (u_over_d, wrench) = (scaled(inverse_d, u), [S::ONE, -ey, ex]);
                let (o, l) = (S::ZERO, S::ONE);
                let unit = [[l, o, o], [o, l, o], [o, o, l]];
                passages[row] = Passage {
                    up: [
                        add_scaled(wrench, -u_over_d[0], minus),
                        add_scaled(unit[1], -u_over_d[1], minus),
                        add_scaled(unit[2], -u_over_d[2], minus),
                    ],
                    u_over_d,
                    down: [
                        add_scaled(unit[0], -plus[0], w_over_d),
                        add_scaled([-ey, l, o], -plus[1], w_over_d),
                        add_scaled([ex, o, l], -plus[2], w_over_d),
                    ],
                    w_over_d,
                };
                generator.inverse_d = inverse_d;
                generators[row] = generator;
            }
            smallest
        })
    }

    /// Solves `K x = b` in place, about 55 flops a joint.
    #[inline(never)]
    pub(crate) fn solve(&mut self, joints: &[PlanarJoint], x: &mut [S]) {
        in_registers!(S, {
            let n = joints.len();
            let (generators, passages) = (&self.generators[..n], &self.passages[..n]);
            let (branches, flows) = (&mut self.flows_of_branches[..n], &mut self.flow[..n]);
            let x = &mut x[..n];
            let mut below = [S::ZERO; 3];
            for i in (0..n).rev() {
                let joint = &joints[i];
                let (Generator { minus, inverse_d, .. }, passage) = (&generators[i], &passages[i]);
                let mut flow = if joint.is_followed { below } else { [S::ZERO; 3] };
                if joint.has_branches {
                    flow = plus3(flow, std::mem::take(&mut branches[i]));
                }
                let b = x[i];
                x[i] = (b - dot3(*minus, flow)) * *inverse_d;
                let up = passed(&passage.up, flow, b, passage.u_over_d);
                match joint.parent {
                    0 => {}
                    parent if parent == i => below = up,
                    parent => branches[parent - 1] = plus3(branches[parent - 1], up),
                }
            }
            let mut above = [S::ZERO; 3];
            for i in 0..n {
                let joint = &joints[i];
                let flow = match joint.parent {
                    0 => [S::ZERO; 3],
                    parent if parent == i => above,
                    parent => flows[parent - 1],
                };
                let (own, passage) = (x[i], &passages[i]);
                x[i] = own - dot3(passage.w_over_d, flow);
                above = passed(&passage.down, flow, own, generators[i].plus);
                if joint.has_branches {
                    flows[i] = above;
                }
            }
        })
    }
}

impl<S: Planar> Elimination<S> {
    /// Takes the factors of others where that is said.
    #[inline(always)]
    pub(crate) fn take_where(&mut self, truth: S::Truth, others: &Self) {
        let choose = |own: &mut S, other: &S| *own = S::choose(truth, *other, *own);
        let choose3 = |own: &mut Vec3<S>, other: &Vec3<S>| {
            own.iter_mut().zip(other).for_each(|(own, other)| choose(own, other));
        };
        for (own, other) in self.generators.iter_mut().zip(&others.generators) {
            choose3(&mut own.minus, &other.minus);
            choose3(&mut own.plus, &other.plus);
            choose(&mut own.inverse_d, &other.inverse_d);
        }
        for (own, other) in self.passages.iter_mut().zip(&others.passages) {
            own.up.iter_mut().zip(&other.up).for_each(|(own, other)| choose3(own, other));
            own.down.iter_mut().zip(&other.down).for_each(|(own, other)| choose3(own, other));
            choose3(&mut own.u_over_d, &other.u_over_d);
            choose3(&mut own.w_over_d, &other.w_over_d);
        }
    }
}

impl PlanarRecursion {
    pub(crate) fn new(joints: usize) -> Self {
        Self { elimination: Elimination::new(joints), columns: Columns::new(joints) }
    }

    /// [`Elimination::factor`], for a linearization, too.
    pub(crate) fn factor(
        &mut self,
        tree: &Joints<Fours>,
        joints: &[PlanarJoint],
        diagonal: &[f64],
        inertia: &[f64],
        step: f64,
        kind: MatrixKind,
    ) -> SmallestPivot {
        self.columns.step = step;
        self.elimination.factor(tree, joints, diagonal, inertia, step, kind)
    }

    /// Writes the derivatives of the increment, `X = −K⁻¹ [G 1]` with `G = ½h L_qq − L_vq`, and of the
    /// momentum, `[h L_qq 1] + (½h L_qq + L_qv) X`, by configuration and momentum; springs and dampers
    /// of coordinates are added by `diagonal`s. Rows are those of coordinates, `stride` apart and whole
    /// blocks. Five passes over the joints for each block of columns, about 95 flops a joint and
    /// column.
    pub(crate) fn linearize(
        &mut self,
        tree: &Joints<Fours>,
        joints: &[PlanarJoint],
        diagonal: &Diagonals,
        increment: &mut [f64],
        momentum: &mut [f64],
        stride: usize,
    ) {
        in_eights(Linearize {
            recursion: self,
            tree,
            joints,
            diagonal,
            increment,
            momentum,
            stride,
        });
    }
}

struct Linearize<'a> {
    recursion: &'a mut PlanarRecursion,
    tree: &'a Joints<Fours>,
    joints: &'a [PlanarJoint],
    diagonal: &'a Diagonals,
    increment: &'a mut [f64],
    momentum: &'a mut [f64],
    stride: usize,
}

impl InEights for Linearize<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { recursion, tree, joints, diagonal, increment, momentum, stride } = self;
        let PlanarRecursion { elimination, columns } = recursion;
        columns.find_slopes(tree, joints);
        for first in (0..stride).step_by(LANES) {
            columns.start::<E>(tree, joints, diagonal, first);
            columns.eliminate::<E>(elimination, joints, first);
            columns.substitute::<E>(&elimination.passages, joints, diagonal);
            columns.gather::<E>(joints);
            columns.write::<E>(increment, momentum, first, stride);
        }
    }
}

#[cfg(test)]
mod tests;
