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
//! d_j = K_jj + minus_jᵀ A_j plus_j      above_j = upper_j + A_j plus_j      across_j = lower_j + A_jᵀ minus_j
//! A_parent += A_j − above_j across_jᵀ / d_j
//! ```
//!
//! and `d_j` are the pivots of an elimination from the leaves to the root. As each sum is about its own
//! joint, long chains lose no digits.

use super::{PlanarTree, Vec2, Vec3, cross, dot, linear, spun};
use crate::planar::PlanarJoint;
use crate::plant::rows::{Block, LANES};
use crate::plant::tree_lu::SmallestPivot;
use crate::wide::wide;

/// What a joint gives to the matrix, and what is left of it when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
struct Generator {
    edge: Vec2,
    minus: Vec3,
    plus: Vec3,
    above: Vec3,
    /// Divided by the pivot.
    across: Vec3,
    inverse_pivot: f64,
    /// For the derivative of the momentum: `P + ½h γ e`, and linear parts of `½h P + F`, after `½h γ`, and of
    /// `J̇`.
    slope: Vec3,
    push: Vec3,
    rate: Vec2,
}

/// What springs and dampers of coordinates add: `−½h V_ii` to the derivative of the residual by the
/// configuration, and to that of the momentum by the increment this and `−c`.
pub(crate) struct Diagonal<'a> {
    pub(crate) residual: &'a [f64],
    pub(crate) momentum: &'a [f64],
}

/// What a matrix is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Of {
    /// Second derivatives by positions and velocities: the Newton matrix.
    Motion,
    /// Those by velocities.
    Masses,
}

/// The matrix. The first entry of lists of joints is the world.
#[derive(Clone, Debug)]
pub(crate) struct Elimination {
    generators: Vec<Generator>,
    step: f64,
    /// `A` of each joint.
    sums: Vec<[Vec3; 3]>,
    /// The same for right-hand sides, and twists that belong to solutions: one, and a block of them.
    flow: Vec<Vec3>,
    flows: Vec<[Block; 3]>,
    /// A block of columns of the derivatives.
    increment: Vec<Block>,
    momentum: Vec<Block>,
}

#[inline(always)]
fn dot3(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn scaled(s: f64, a: Vec3) -> Vec3 {
    [s * a[0], s * a[1], s * a[2]]
}

#[inline(always)]
fn add_scaled(a: Vec3, s: f64, b: Vec3) -> Vec3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

impl Elimination {
    pub(crate) fn new(joints: usize) -> Self {
        Self {
            generators: vec![Generator::default(); joints + 1],
            step: 0.0,
            sums: vec![[[0.0; 3]; 3]; joints + 1],
            flow: vec![[0.0; 3]; joints + 1],
            flows: vec![[Block::ZERO; 3]; joints + 1],
            increment: vec![Block::ZERO; joints],
            momentum: vec![Block::ZERO; joints],
        }
    }

    wide! {
        /// Factors the matrix that belongs to the second derivatives of `tree`; all joints are dynamic, in
        /// the order of their coordinates. Each pivot is compared with the larger of its diagonal entry
        /// and the inertia of its row over the step. Of masses alone it is `−M/h`. About 90 flops a joint.
        #[inline(never)]
        pub(crate) fn factor(
            mut self,
            tree: &PlanarTree,
            joints: &[PlanarJoint],
            diagonal: &[f64],
            inertia: &[f64],
            step: f64,
            of: Of,
        ) -> SmallestPivot = factor_portable, factor_avx2;

        /// Solves `K x = b` in place, about 30 flops a joint.
        #[inline(never)]
        pub(crate) fn solve(mut self, joints: &[PlanarJoint], x: &mut [f64])
            = solve_portable, solve_avx2;

        /// Writes the derivatives of the increment, `X = −K⁻¹ [G 1]` with `G = ½h L_qq − L_vq`, and of the
        /// momentum, `[h L_qq 1] + (½h L_qq + L_qv) X`, by configuration and momentum; springs and dampers
        /// of coordinates are added by `diagonal`s. Rows are those of coordinates, `stride` apart and whole
        /// blocks. Four passes over the joints for each block of columns, about 75 flops a joint and
        /// column.
        #[inline(never)]
        pub(crate) fn linearize(
            mut self,
            tree: &PlanarTree,
            joints: &[PlanarJoint],
            diagonal: &Diagonal<'_>,
            increment: &mut [f64],
            momentum: &mut [f64],
            stride: usize,
        ) = linearize_portable, linearize_avx2;
    }

    #[inline(always)]
    fn factor_portable(
        &mut self,
        tree: &PlanarTree,
        joints: &[PlanarJoint],
        diagonal: &[f64],
        inertia: &[f64],
        step: f64,
        of: Of,
    ) -> SmallestPivot {
        let motion = if of == Of::Masses { 0.0 } else { 1.0 };
        let (half, inverse) = (0.5 * step * motion, 1.0 / step);
        self.step = step;
        let mut smallest = SmallestPivot::NONE;
        for ((row, joint), (added, inertia)) in
            joints.iter().enumerate().zip(diagonal.iter().zip(inertia)).rev()
        {
            let link = &tree.links[row + 1];
            let [a, b, c] = std::mem::take(&mut self.sums[row + 1]);
            let ([dx, dy], [rx, ry]) = (link.slide, [half * link.rate[0], half * link.rate[1]]);
            let plus = [joint.turn, rx + dx, ry + dy];
            let minus = [-joint.turn, rx - dx, ry - dy];
            let (weight, slope) = (half * link.weight, link.slope);
            let mut upper = add_scaled(scaled(0.5 * motion, slope), inverse, link.force);
            let mut lower = add_scaled(upper, -2.0 * inverse, link.force);
            upper[0] -= 0.5 * weight;
            lower[0] += 0.5 * weight;

            let pushed = [dot3(a, plus), dot3(b, plus), dot3(c, plus)];
            let own = dot3(minus, upper) + added;
            let pivot = own + dot3(minus, pushed);
            smallest.see(row, pivot, own.abs().max(inertia * inverse));
            let inverse_pivot = 1.0 / pivot;
            let above = add_scaled(upper, 1.0, pushed);
            let across = add_scaled(lower, minus[0], a);
            let across = add_scaled(add_scaled(across, minus[1], b), minus[2], c);
            let across = scaled(inverse_pivot, across);
            if joint.parent > 0 {
                let a = add_scaled(a, -above[0], across);
                let b = add_scaled(b, -above[1], across);
                let c = add_scaled(c, -above[2], across);
                let [ex, ey] = link.edge;
                let a = add_scaled(add_scaled(a, ex, c), -ey, b);
                let sums = &mut self.sums[joint.parent];
                for (sum, row) in sums.iter_mut().zip([a, b, c]) {
                    sum[0] += row[0] + cross(link.edge, linear(row));
                    sum[1] += row[1];
                    sum[2] += row[2];
                }
            }
            self.generators[row + 1] = Generator {
                edge: link.edge,
                minus,
                plus,
                above,
                across,
                inverse_pivot,
                slope: [slope[0] + weight, slope[1], slope[2]],
                push: [weight, link.force[1] + half * slope[1], link.force[2] + half * slope[2]],
                rate: link.rate,
            };
        }
        smallest
    }

    #[inline(always)]
    fn solve_portable(&mut self, joints: &[PlanarJoint], x: &mut [f64]) {
        let (generators, flows) = (&self.generators[1..], &mut self.flow[..]);
        flows.fill([0.0; 3]);
        for (i, ((joint, generator), x)) in
            joints.iter().zip(generators).zip(&mut *x).enumerate().rev()
        {
            let flow = flows[i + 1];
            *x = (*x - dot3(generator.minus, flow)) * generator.inverse_pivot;
            if joint.parent > 0 {
                let flow = add_scaled(flow, *x, generator.above);
                let parent = &mut flows[joint.parent];
                parent[0] += flow[0] + cross(generator.edge, linear(flow));
                parent[1] += flow[1];
                parent[2] += flow[2];
            }
        }
        for (i, ((joint, generator), x)) in joints.iter().zip(generators).zip(x).enumerate() {
            let mut flow = flows[joint.parent];
            if joint.parent > 0 {
                let moved = spun(flow[0], generator.edge);
                flow = [flow[0], flow[1] + moved[0], flow[2] + moved[1]];
            }
            *x -= dot3(generator.across, flow);
            flows[i + 1] = add_scaled(flow, *x, generator.plus);
        }
    }

    #[inline(always)]
    fn linearize_portable(
        &mut self,
        tree: &PlanarTree,
        joints: &[PlanarJoint],
        diagonal: &Diagonal<'_>,
        increment: &mut [f64],
        momentum: &mut [f64],
        stride: usize,
    ) {
        let n = joints.len();
        for first in (0..stride).step_by(LANES) {
            self.increment.fill(Block::ZERO);
            self.momentum.fill(Block::ZERO);
            for lane in 0..LANES {
                match first + lane {
                    column if column < n => {
                        self.by_configuration(tree, joints, diagonal, column, lane)
                    }
                    column if column < 2 * n => {
                        self.increment[column - n].0[lane] = 1.0;
                        self.momentum[column - n].0[lane] = 1.0;
                    }
                    _ => {}
                }
            }
            self.eliminate(joints);
            self.substitute(joints, diagonal);
            self.gather(joints);
            let rows = increment.chunks_exact_mut(stride).zip(momentum.chunks_exact_mut(stride));
            for ((by_x, by_p), (x, p)) in rows.zip(self.increment.iter().zip(&self.momentum)) {
                by_x[first..][..LANES].copy_from_slice(&x.0);
                by_p[first..][..LANES].copy_from_slice(&p.0);
            }
        }
    }

    /// A column of `G` and of `h L_qq`.
    #[inline(always)]
    fn by_configuration(
        &mut self,
        tree: &PlanarTree,
        joints: &[PlanarJoint],
        diagonal: &Diagonal<'_>,
        column: usize,
        lane: usize,
    ) {
        let (step, own, turn) = (self.step, &tree.links[column + 1], joints[column].turn);
        // Rows of joints above, with the wrench moved to each of them, and of the joint itself.
        let (mut wrench, push, mut i) = (own.slope, linear(own.slope), column + 1);
        while i > 0 {
            let (link, s) = (&tree.links[i], joints[i - 1].turn);
            let stiffness = step * (dot(link.rate, push) + s * own.weight);
            self.increment[i - 1].0[lane] =
                0.5 * stiffness - (s * wrench[0] + dot(link.slide, push));
            self.momentum[i - 1].0[lane] = stiffness;
            wrench[0] += cross(link.edge, push);
            i = joints[i - 1].parent;
        }
        // Rows of joints below.
        let below = column + 1..column + 1 + joints[column].descendants;
        let rows = self.increment[below.clone()].iter_mut().zip(&mut self.momentum[below.clone()]);
        for ((x, p), link) in rows.zip(&tree.links[column + 2..]) {
            let stiffness = step * (dot(own.rate, linear(link.slope)) + turn * link.weight);
            x.0[lane] = 0.5 * stiffness - dot(own.rate, linear(link.force));
            p.0[lane] = stiffness;
        }
        self.increment[column].0[lane] += diagonal.residual[column];
        self.momentum[column].0[lane] += 2.0 * diagonal.residual[column];
    }

    /// From the leaves to the root, with the right-hand side taken away.
    #[inline(always)]
    fn eliminate(&mut self, joints: &[PlanarJoint]) {
        self.flows.fill([Block::ZERO; 3]);
        for (i, (joint, row)) in joints.iter().zip(&mut self.increment).enumerate().rev() {
            let Generator { edge, minus, above, inverse_pivot, .. } = self.generators[i + 1];
            let [n, fx, fy] = self.flows[i + 1];
            let pulled = n.times(minus[0]).plus(fx.times(minus[1])).plus(fy.times(minus[2]));
            let x = row.plus(pulled).times(-inverse_pivot);
            *row = x;
            if joint.parent > 0 {
                let (fx, fy) = (fx.plus(x.times(above[1])), fy.plus(x.times(above[2])));
                let n = n.plus(x.times(above[0])).plus(fy.times(edge[0])).plus(fx.times(-edge[1]));
                add_to(&mut self.flows[joint.parent], [n, fx, fy]);
            }
        }
    }

    /// From the root to the leaves: the solution, and what joints above add to the momentum.
    #[inline(always)]
    fn substitute(&mut self, joints: &[PlanarJoint], diagonal: &Diagonal<'_>) {
        let rows = self.increment.iter_mut().zip(&mut self.momentum);
        for (i, ((joint, (row, momentum)), own)) in
            joints.iter().zip(rows).zip(diagonal.momentum).enumerate()
        {
            let Generator { edge, plus, across, slope, .. } = self.generators[i + 1];
            let [w, vx, vy] = self.flows[joint.parent];
            let (vx, vy) = (vx.plus(w.times(-edge[1])), vy.plus(w.times(edge[0])));
            let taken = w.times(across[0]).plus(vx.times(across[1])).plus(vy.times(across[2]));
            let x = row.plus(taken.times(-1.0));
            let moved = w.times(slope[0]).plus(vx.times(slope[1])).plus(vy.times(slope[2]));
            *row = x;
            *momentum = momentum.plus(moved).plus(x.times(*own));
            self.flows[i + 1] =
                [w.plus(x.times(plus[0])), vx.plus(x.times(plus[1])), vy.plus(x.times(plus[2]))];
        }
    }

    /// From the leaves to the root: what joints below add to the momentum.
    #[inline(always)]
    fn gather(&mut self, joints: &[PlanarJoint]) {
        self.flows.fill([Block::ZERO; 3]);
        let rows = self.increment.iter().zip(&mut self.momentum);
        for (i, (joint, (x, momentum))) in joints.iter().zip(rows).enumerate().rev() {
            let Generator { plus, push, rate, .. } = self.generators[i + 1];
            let [n, fx, fy] = self.flows[i + 1];
            let (n, fx, fy) =
                (n.plus(x.times(push[0])), fx.plus(x.times(push[1])), fy.plus(x.times(push[2])));
            let moved = n.times(plus[0]).plus(fx.times(rate[0])).plus(fy.times(rate[1]));
            *momentum = momentum.plus(moved);
            if joint.parent > 0 {
                add_to(&mut self.flows[joint.parent], [n, fx, fy]);
            }
        }
    }
}

#[inline(always)]
fn add_to(sum: &mut [Block; 3], part: [Block; 3]) {
    let [n, fx, fy] = *sum;
    *sum = [n.plus(part[0]), fx.plus(part[1]), fy.plus(part[2])];
}
