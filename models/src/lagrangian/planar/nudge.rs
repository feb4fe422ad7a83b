//! The second derivatives of a planar tree times one vector, by the formulas of [`nudge`](crate::lagrangian::nudge).
//!
//! `J̇` has no angular part and no entry needs the angular part of `G`: from leaf to root four numbers are summed up,
//! and from root to leaf four are passed on, `Z`, and `E` about the joint.
//!
//! It is what lets a step in planes end without another look ([`foresight`](crate::integrator::foresight)): a quiet
//! step takes 0.78 (one joint) to 0.97 (chains of 8 and 32 that whip) of the time that it took before.

use plantd_math::scalar::{Scalar, in_registers};

use crate::lagrangian::arrangement::{Arrangement, Order, Planar, one2};
use crate::lagrangian::planar::{Below, Joints, PlanarTree, group};
use crate::lagrangian::plane::{add, add4, cross, dot, spun, times};
use crate::model::planar_tree::PlanarJoints;

impl<S: Planar> PlanarTree<S> {
    /// Writes the change of `∂L/∂q` of the dynamic coordinates, the first `l_q.len()` ones, with changes of all
    /// coordinates and velocities, at the last [`PlanarTree::differentiate`].
    pub(crate) fn nudge(
        &mut self,
        joints: &PlanarJoints,
        position: &[S],
        velocity: &[S],
        l_q: &mut [S],
    ) {
        match self {
            Self::Few(tree) => tree.nudge(joints, position, velocity, l_q),
            Self::Many(tree) => tree.nudge(joints, position, velocity, l_q),
        }
    }
}

impl<A: Arrangement> Joints<A> {
    /// About 45 flops a joint.
    #[inline(never)]
    fn nudge(
        &mut self,
        joints: &PlanarJoints,
        position: &[A::Number],
        velocity: &[A::Number],
        l_q: &mut [A::Number],
    ) {
        in_registers!(A::Number, { self.nudge_here(joints, [position, velocity], l_q) })
    }

    /// The same in the code of the caller.
    #[inline(always)]
    pub(crate) fn nudge_here(
        &mut self,
        joints: &PlanarJoints,
        [position, velocity]: [&[A::Number]; 2],
        l_q: &mut [A::Number],
    ) {
        self.pass_on(joints, position, velocity);
        self.sum_up(joints, position, velocity, l_q);
    }

    /// From the roots to the leaves: what the parent's `Z` and `E` make of the torque of each joint.
    #[inline(always)]
    fn pass_on(&mut self, joints: &PlanarJoints, position: &[A::Number], velocity: &[A::Number]) {
        let Self { links, from_above, sums, .. } = self;
        let mut last = [A::Number::ZERO; 4];
        for (block, (link, from_above)) in links.iter().zip(&mut from_above[..]).enumerate() {
            let (first, body) = (A::COUNT * block, A::body(joints, block));
            let a = A::gather(joints, block, position);
            let b = A::gather(joints, block, velocity);
            let [x, y] = add(times(link.rate, a), times(link.slide, b));
            let own = [a * body.turn, b * body.turn, x, y];
            let mut above = [A::Several::ZERO; 4];
            for (lane, joint) in group::<A>(joints, block).iter().enumerate() {
                let joint = A::Order::ties(joint, first + lane);
                match joint.parent {
                    0 => last = [A::Number::ZERO; 4],
                    parent if parent == first + lane => {}
                    parent => last = sums[parent - 1],
                }
                let [x, y] = spun(one2::<A>(&link.edge, lane), last[1]);
                (last[2], last[3]) = (last[2] + x, last[3] + y);
                above.iter_mut().zip(last).for_each(|(above, last)| A::put(last, above, lane));
                last = add4(last, own.each_ref().map(|own| A::one(own, lane)));
                if joint.has_branches {
                    sums[first + lane] = last;
                }
            }
            let ([turn, spin, x, y], [n, px, py]) = (above, link.slope);
            *from_above = n * spin + (px * x + py * y) + link.weight * turn;
        }
    }

    /// From the leaves to the roots: what the linear part of `G`, and `N`, make of the torque of each joint.
    #[inline(always)]
    fn sum_up(
        &mut self,
        joints: &PlanarJoints,
        position: &[A::Number],
        velocity: &[A::Number],
        l_q: &mut [A::Number],
    ) {
        let Self { links, from_above, branches, .. } = self;
        let mut below = [A::Number::ZERO; 4];
        for (block, (link, from_above)) in links.iter().zip(&from_above[..]).enumerate().rev() {
            let (first, body) = (A::COUNT * block, A::body(joints, block));
            let a = A::gather(joints, block, position);
            let b = A::gather(joints, block, velocity);
            let ([_, fx, fy], [_, px, py]) = (link.force, link.slope);
            let mut all = [px * a + fx * b, py * a + fy * b, fx * a, fy * a];
            for (lane, joint) in group::<A>(joints, block).iter().enumerate().rev() {
                let joint = A::Order::ties(joint, first + lane);
                let mut sum = all.each_ref().map(|own| A::one(own, lane));
                if joint.is_followed {
                    sum = add4(sum, below);
                }
                if joint.has_branches {
                    let others = &mut branches[first + lane].sums;
                    sum = add4(sum, std::mem::replace(others, Below::NONE.sums));
                }
                all.iter_mut().zip(sum).for_each(|(all, sum)| A::put(sum, all, lane));
                match joint.parent {
                    0 => {}
                    parent if parent == first + lane => below = sum,
                    parent => {
                        let others = &mut branches[parent - 1].sums;
                        *others = add4(*others, sum);
                    }
                }
            }
            let [fx, fy, nx, ny] = all;
            let from_below = dot(link.rate, [fx, fy]) + cross([nx, ny], body.gravity) * body.turn;
            A::scatter(joints, block, *from_above + from_below, l_q);
        }
    }
}
