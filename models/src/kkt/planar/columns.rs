//! The derivatives of a step of a planar tree, eight columns at a time, in whole registers.
//!
//! A column of `G = ½h L_qq − L_vq` and of `h L_qq` has a wrench that goes up from its joint, and a twist that goes
//! down from it: an entry is a product with each, so that a pass up and one down write eight columns. The solution
//! and the momentum take a pass up and one down each as well. What a joint passes on to the next one in the list
//! stays in registers; only branches go through memory.

use plantd_math::eights::{Eight, UNITS};
use plantd_math::rows::{Block, LANES};

use crate::kkt::planar::{Diagonals, Elimination, Passage};
use crate::lagrangian::arrangement::Fours;
use crate::lagrangian::planar::Joints;
use crate::lagrangian::plane::{Vec2, Vec3, cross};
use crate::model::planar_tree::PlanarJoint;

/// What a joint gives to the derivative of the momentum.
#[derive(Clone, Copy, Debug, Default)]
struct Slope {
    edge: Vec2,
    plus: Vec3,
    /// `P + ½h γ e`, about the parent.
    slope: Vec3,
    /// Linear parts of `½h P + F`, after `½h γ`, and of `J̇`.
    push: Vec3,
    rate: Vec2,
}

/// Eight columns of the derivatives, and what finds them.
#[derive(Clone, Debug)]
pub(in crate::kkt) struct Columns {
    pub(in crate::kkt) step: f64,
    slopes: Vec<Slope>,
    /// What branches pass up, zero but within a pass, and what joints pass down to them.
    flows: Vec<[Block; 4]>,
    motions: Vec<[Block; 3]>,
    pub(in crate::kkt) increment: Vec<Block>,
    pub(in crate::kkt) momentum: Vec<Block>,
}

#[inline(always)]
fn product<E: Eight>(vector: Vec3, [n, fx, fy]: [E; 3]) -> E {
    n.scaled(vector[0]).plus(fx.scaled(vector[1])).plus(fy.scaled(vector[2]))
}

/// `matrix · flow + drive · b`: a product and three sums behind the flow.
#[inline(always)]
fn passed<E: Eight>([r, s, t]: &[Vec3; 3], flow: [E; 3], b: E, drive: Vec3) -> [E; 3] {
    let [n, fx, fy] = flow;
    let first = n.scaled(r[0]).plus(fx.scaled(r[1])).plus(fy.scaled(r[2]).plus(b.scaled(drive[0])));
    let second =
        n.scaled(s[0]).plus(fx.scaled(s[1])).plus(fy.scaled(s[2]).plus(b.scaled(drive[1])));
    let third = n.scaled(t[0]).plus(fx.scaled(t[1])).plus(fy.scaled(t[2]).plus(b.scaled(drive[2])));
    [first, second, third]
}

/// What reaches a joint from those below it.
#[inline(always)]
fn from_below<E: Eight, const N: usize>(
    joint: &PlanarJoint,
    below: [E; N],
    branches: &mut [Block; 4],
) -> [E; N] {
    let mut flow = if joint.is_followed { below } else { [E::ZERO; N] };
    if joint.has_branches {
        for (flow, branch) in flow.iter_mut().zip(&mut *branches) {
            *flow = flow.plus(E::of(branch));
            *branch = Block::ZERO;
        }
    }
    flow
}

/// Passes it on to the parent.
#[inline(always)]
fn pass_up<E: Eight, const N: usize>(
    i: usize,
    joint: &PlanarJoint,
    up: [E; N],
    below: &mut [E; N],
    flows: &mut [[Block; 4]],
) {
    match joint.parent {
        0 => {}
        parent if parent == i => *below = up,
        parent => {
            for (branch, up) in flows[parent - 1].iter_mut().zip(&up) {
                E::of(branch).plus(*up).put(branch);
            }
        }
    }
}

/// What reaches a joint from its parent.
#[inline(always)]
fn from_above<E: Eight>(
    i: usize,
    joint: &PlanarJoint,
    above: [E; 3],
    motions: &[[Block; 3]],
) -> [E; 3] {
    match joint.parent {
        0 => [E::ZERO; 3],
        parent if parent == i => above,
        parent => {
            let [turn, x, y] = &motions[parent - 1];
            [E::of(turn), E::of(x), E::of(y)]
        }
    }
}

/// Passes it on to branches.
#[inline(always)]
fn pass_down<E: Eight>(joint: &PlanarJoint, [turn, x, y]: [E; 3], motion: &mut [Block; 3]) {
    if joint.has_branches {
        turn.put(&mut motion[0]);
        x.put(&mut motion[1]);
        y.put(&mut motion[2]);
    }
}

impl Columns {
    pub(in crate::kkt) fn new(joints: usize) -> Self {
        Self {
            step: 0.0,
            slopes: vec![Slope::default(); joints],
            flows: vec![[Block::ZERO; 4]; joints],
            motions: vec![[Block::ZERO; 3]; joints],
            increment: vec![Block::ZERO; joints],
            momentum: vec![Block::ZERO; joints],
        }
    }

    /// At the second derivatives of the last factorization.
    #[inline(always)]
    pub(in crate::kkt) fn find_slopes(&mut self, tree: &Joints<Fours>, joints: &[PlanarJoint]) {
        let half = 0.5 * self.step;
        for (i, (joint, to)) in joints.iter().zip(&mut self.slopes).enumerate() {
            let link = tree.link(i);
            let ([dx, dy], [rx, ry]) = (link.slide, link.rate);
            let (weight, [turn, px, py]) = (half * link.weight, link.slope);
            *to = Slope {
                edge: link.edge,
                plus: [joint.body.turn, half * rx + dx, half * ry + dy],
                slope: [turn + weight + cross(link.edge, [px, py]), px, py],
                push: [weight, link.force[1] + half * px, link.force[2] + half * py],
                rate: link.rate,
            };
        }
    }

    /// Columns of `[G 1]` from the first one on, and of what the momentum has beside the increment's part.
    #[inline(always)]
    pub(in crate::kkt) fn start<E: Eight>(
        &mut self,
        tree: &Joints<Fours>,
        joints: &[PlanarJoint],
        diagonal: &Diagonals,
        first: usize,
    ) {
        let n = joints.len();
        for (x, p) in self.increment.iter_mut().zip(&mut self.momentum) {
            E::ZERO.put(x);
            E::ZERO.put(p);
        }
        if first < n {
            self.go_down_from::<E>(tree, joints, first);
            self.go_up_from::<E>(tree, joints, diagonal, first);
        }
        for (lane, unit) in UNITS.iter().enumerate() {
            if let Some(row) = (first + lane).checked_sub(n)
                && row < n
            {
                for to in [&mut self.increment[row], &mut self.momentum[row]] {
                    E::of(to).plus(E::of(unit)).put(to);
                }
            }
        }
    }

    /// Rows of joints below those of the columns.
    #[inline(always)]
    fn go_down_from<E: Eight>(
        &mut self,
        tree: &Joints<Fours>,
        joints: &[PlanarJoint],
        first: usize,
    ) {
        let step = self.step;
        let own = &joints[first..joints.len().min(first + LANES)];
        let end = own.iter().zip(first..).map(|(joint, i)| i + 1 + joint.descendants).max();
        let mut above = [E::ZERO; 3];
        for (i, joint) in joints.iter().enumerate().take(end.unwrap_or_default()).skip(first) {
            let link = tree.link(i);
            let twist = if joint.parent > first {
                from_above(i, joint, above, &self.motions)
            } else {
                [E::ZERO; 3]
            };
            let [turn, x, y] = twist;
            let stiffness = x
                .scaled(link.slope[1])
                .plus(y.scaled(link.slope[2]))
                .plus(turn.scaled(link.weight))
                .scaled(step);
            let force = x.scaled(link.force[1]).plus(y.scaled(link.force[2]));
            stiffness.scaled(0.5).minus(force).put(&mut self.increment[i]);
            stiffness.put(&mut self.momentum[i]);
            above = twist;
            if let Some(unit) = UNITS.get(i - first) {
                let unit = E::of(unit);
                above = [
                    turn.plus(unit.scaled(joint.body.turn)),
                    x.plus(unit.scaled(link.rate[0])),
                    y.plus(unit.scaled(link.rate[1])),
                ];
            }
            pass_down(joint, above, &mut self.motions[i]);
        }
    }

    /// Rows of joints above those of the columns, and of these themselves.
    #[inline(always)]
    fn go_up_from<E: Eight>(
        &mut self,
        tree: &Joints<Fours>,
        joints: &[PlanarJoint],
        diagonal: &Diagonals,
        first: usize,
    ) {
        let step = self.step;
        let mut below = [E::ZERO; 4];
        for i in (0..joints.len().min(first + LANES)).rev() {
            let (joint, link) = (&joints[i], tree.link(i));
            let mut flow = from_below(joint, below, &mut self.flows[i]);
            let [mut by_start, mut of_momentum] = [E::ZERO; 2];
            if let Some(unit) = i.checked_sub(first).and_then(|lane| UNITS.get(lane)) {
                let unit = E::of(unit);
                let own = [link.slope[0], link.slope[1], link.slope[2], link.weight];
                for (flow, own) in flow.iter_mut().zip(own) {
                    *flow = flow.plus(unit.scaled(own));
                }
                by_start = unit.scaled(diagonal.residual[i]);
                of_momentum = unit.scaled(diagonal.by_start[i]);
            }
            let ([n, x, y, weight], s) = (flow, joint.body.turn);
            let stiffness = x
                .scaled(link.rate[0])
                .plus(y.scaled(link.rate[1]))
                .plus(weight.scaled(s))
                .scaled(step);
            let force = n.scaled(s).plus(x.scaled(link.slide[0])).plus(y.scaled(link.slide[1]));
            let (by_x, by_p) = (&mut self.increment[i], &mut self.momentum[i]);
            let own = stiffness.scaled(0.5).minus(force).plus(by_start);
            E::of(by_x).plus(own).put(by_x);
            let own = stiffness.plus(of_momentum);
            E::of(by_p).plus(own).put(by_p);
            let [ex, ey] = link.edge;
            let up = [n.plus(y.scaled(ex)).minus(x.scaled(ey)), x, y, weight];
            pass_up(i, joint, up, &mut below, &mut self.flows);
        }
    }

    /// From the leaves to the root, with the right-hand side taken away.
    #[inline(always)]
    pub(super) fn eliminate<E: Eight>(
        &mut self,
        elimination: &Elimination,
        joints: &[PlanarJoint],
        first: usize,
    ) {
        // Below the joints of unit columns there is nothing.
        let n = joints.len();
        let end = if first < n { n } else { n.min(first - n + LANES) };
        let mut below = [E::ZERO; 3];
        for i in (0..end).rev() {
            let (joint, row) = (&joints[i], &mut self.increment[i]);
            let (generator, passage) = (&elimination.generators[i], &elimination.passages[i]);
            let flow = from_below(joint, below, &mut self.flows[i]);
            let right = E::of(row).scaled(-1.0);
            let pulled = product(generator.minus, flow);
            E::of(row).plus(pulled).scaled(-generator.inverse_d).put(row);
            let up = passed(&passage.up, flow, right, passage.u_over_d);
            pass_up(i, joint, up, &mut below, &mut self.flows);
        }
    }

    /// From the root to the leaves: the solution, and what joints above add to the momentum.
    #[inline(always)]
    pub(super) fn substitute<E: Eight>(
        &mut self,
        passages: &[Passage],
        joints: &[PlanarJoint],
        diagonal: &Diagonals,
    ) {
        let mut above = [E::ZERO; 3];
        for (i, joint) in joints.iter().enumerate() {
            let Slope { plus, slope, .. } = self.slopes[i];
            let (row, momentum) = (&mut self.increment[i], &mut self.momentum[i]);
            let flow = from_above(i, joint, above, &self.motions);
            let right = E::of(row);
            let x = right.minus(product(passages[i].w_over_d, flow));
            x.put(row);
            let moved = E::of(momentum).plus(product(slope, flow));
            moved.plus(x.scaled(diagonal.by_increment[i])).put(momentum);
            above = passed(&passages[i].down, flow, right, plus);
            pass_down(joint, above, &mut self.motions[i]);
        }
    }

    /// From the root to the leaves: what joints above add to the momentum, with increments that are known.
    #[inline(always)]
    pub(in crate::kkt) fn carry_down<E: Eight>(
        &mut self,
        joints: &[PlanarJoint],
        diagonal: &Diagonals,
    ) {
        let mut above = [E::ZERO; 3];
        for (i, joint) in joints.iter().enumerate() {
            let Slope { edge: [ex, ey], plus: [n, px, py], slope, .. } = self.slopes[i];
            let (x, momentum) = (E::of(&self.increment[i]), &mut self.momentum[i]);
            let flow = from_above(i, joint, above, &self.motions);
            let moved = E::of(momentum).plus(product(slope, flow));
            moved.plus(x.scaled(diagonal.by_increment[i])).put(momentum);
            let [turn, vx, vy] = flow;
            above = [
                turn.plus(x.scaled(n)),
                vx.minus(turn.scaled(ey)).plus(x.scaled(px)),
                vy.plus(turn.scaled(ex)).plus(x.scaled(py)),
            ];
            pass_down(joint, above, &mut self.motions[i]);
        }
    }

    /// From the leaves to the root: what joints below add to the momentum.
    #[inline(always)]
    pub(in crate::kkt) fn gather<E: Eight>(&mut self, joints: &[PlanarJoint]) {
        let mut below = [E::ZERO; 3];
        for (i, joint) in joints.iter().enumerate().rev() {
            let Slope { plus, push, rate, .. } = self.slopes[i];
            let (x, momentum) = (E::of(&self.increment[i]), &mut self.momentum[i]);
            let [n, fx, fy] = from_below(joint, below, &mut self.flows[i]);
            let up =
                [n.plus(x.scaled(push[0])), fx.plus(x.scaled(push[1])), fy.plus(x.scaled(push[2]))];
            let moved = product([plus[0], rate[0], rate[1]], up);
            E::of(momentum).plus(moved).put(momentum);
            pass_up(i, joint, up, &mut below, &mut self.flows);
        }
    }

    /// Writes the columns from the first one on into rows, `stride` apart.
    #[inline(always)]
    pub(in crate::kkt) fn write<E: Eight>(
        &self,
        increment: &mut [f64],
        momentum: &mut [f64],
        first: usize,
        stride: usize,
    ) {
        let rows = increment.chunks_exact_mut(stride).zip(momentum.chunks_exact_mut(stride));
        for ((by_x, by_p), (x, p)) in rows.zip(self.increment.iter().zip(&self.momentum)) {
            E::of(x).put_list(&mut by_x[first..][..LANES]);
            E::of(p).put_list(&mut by_p[first..][..LANES]);
        }
    }
}
