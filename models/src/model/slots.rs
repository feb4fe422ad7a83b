//! Where the joints of a tree lie side by side.
//!
//! What moves as one is a *link*: a hinge, a slide, a screw, or a whole ball joint, which its last axis stands for, as
//! that has the body and carries what hangs from it. Links come first, in the order of their joints, so that what
//! sums up along a tree goes by links; behind them come the first two axes of the ball joints. Without ball joints
//! slots are joints.

use plantd_math::rows::LANES;

use crate::model::tree::{Joint, JointKind, WORLD};

/// No coordinate.
const NONE: usize = usize::MAX;

/// The slots of the joints of a tree. Lists by slot go on to a multiple of [`LANES`].
#[derive(Clone, Debug, Default)]
pub(crate) struct Slots {
    /// What carries each link, or [`WORLD`].
    pub(crate) parents: Vec<usize>,
    /// The joint of each slot; beyond the last, the slot itself.
    pub(crate) joints: Vec<usize>,
    /// At which joint the pose of each joint is, and which of its axes that of the joint is.
    pub(crate) lines: Vec<[usize; 2]>,
    /// The link of each slot.
    pub(crate) links: Vec<usize>,
    /// The link that carries the axis of each slot, or [`Slots::nothing`]: an axis turns with what a ball joint hangs
    /// from, and with its own link of any other kind.
    pub(crate) carriers: Vec<usize>,
    /// The coordinate of each slot, and those of the first two axes of each link that is a ball joint; beyond all
    /// coordinates where there is none.
    pub(crate) coordinates: [Vec<usize>; 3],
    /// The slot of each joint.
    of: Vec<usize>,
    /// Slots, joints and coordinates are the same.
    pub(crate) are_in_order: bool,
}

impl Slots {
    pub(crate) fn new(joints: &[Joint]) -> Self {
        let is_link = |i: &usize| !matches!(joints[*i].kind, JointKind::Ball(0 | 1));
        let mut order: Vec<usize> = (0..joints.len()).filter(is_link).collect();
        let links = order.len();
        order.extend((0..joints.len()).filter(|i| !is_link(i)));
        let mut of = vec![0; joints.len()];
        order.iter().enumerate().for_each(|(slot, joint)| of[*joint] = slot);

        let above = |joint: usize| match joints[joints[joint].first_axis(joint)].parent {
            WORLD => WORLD,
            parent => of[parent],
        };
        let padded = |mut list: Vec<usize>, beyond: &dyn Fn(usize) -> usize| {
            list.extend((list.len()..list.len().next_multiple_of(LANES)).map(beyond));
            list
        };
        let nothing = links.next_multiple_of(LANES);
        let link = |joint: usize| of[joints[joint].last_axis(joint)];
        let carrier = |joint: usize| match joints[joint].kind {
            JointKind::Ball(_) if above(joint) == WORLD => nothing,
            JointKind::Ball(_) => above(joint),
            _ => of[joint],
        };
        let turn = |joint: usize, axis: usize| match joints[joint].kind {
            JointKind::Ball(2) => joints[joint].coordinate - 2 + axis,
            _ => NONE,
        };
        let by_slot = |f: &dyn Fn(usize) -> usize| order.iter().map(|joint| f(*joint)).collect();
        let line = |(i, joint): (usize, &Joint)| match joint.kind {
            JointKind::Ball(axis) => [joint.last_axis(i), axis],
            _ => [i, 2],
        };
        Self {
            lines: joints.iter().enumerate().map(line).collect(),
            parents: order[..links].iter().map(|joint| above(*joint)).collect(),
            links: padded(by_slot(&link), &|_| 0),
            carriers: padded(by_slot(&carrier), &|_| nothing),
            coordinates: [
                padded(by_slot(&|joint| joints[joint].coordinate), &|_| NONE),
                padded(by_slot(&|joint| turn(joint, 0)), &|_| NONE),
                padded(by_slot(&|joint| turn(joint, 1)), &|_| NONE),
            ],
            are_in_order: order.iter().enumerate().all(|(i, joint)| joints[*joint].coordinate == i),
            joints: padded(order, &|slot| slot),
            of,
        }
    }

    /// The slot of a joint.
    #[inline(always)]
    pub(crate) fn of(&self, joint: usize) -> usize {
        self.of[joint]
    }

    /// The slot of what a joint moves with.
    #[inline(always)]
    pub(crate) fn link(&self, joint: usize) -> usize {
        self.links[self.of[joint]]
    }

    /// Whether a link is a ball joint.
    #[inline(always)]
    pub(crate) fn is_ball(&self, link: usize) -> bool {
        self.coordinates[1][link] != NONE
    }

    /// The slots of the first two axes of a ball joint.
    #[inline(always)]
    pub(crate) fn others(&self, link: usize) -> [usize; 2] {
        let joint = self.joints[link];
        [self.of[joint - 2], self.of[joint - 1]]
    }

    /// Where a list of links has zeros, for what the world carries.
    #[inline(always)]
    pub(crate) fn nothing(&self) -> usize {
        self.parents.len().next_multiple_of(LANES)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::mechanism::Model;
    use plantd_scene::builtin;

    /// Every joint has a slot of its own, those that carry something come first, and each link hangs from the link of
    /// the joint that its first axis hangs from.
    #[test]
    fn joints_have_one_slot_each_and_links_come_first() {
        for name in ["tree-7", "walker-3", "balls-7"] {
            let model = Model::compile(&builtin::scene(name).unwrap()).unwrap();
            let (joints, slots) = (&model.dynamics.joints, &model.dynamics.slots);
            let mut seen = vec![false; joints.len()];
            for (i, joint) in joints.iter().enumerate() {
                let slot = slots.of(i);
                assert!(!std::mem::replace(&mut seen[slot], true), "{name}: slot {slot}");
                assert_eq!(slots.joints[slot], i, "{name}");
                assert_eq!(slots.coordinates[0][slot], joint.coordinate, "{name}");
                let link = slots.link(i);
                assert!(link < slots.parents.len(), "{name}");
                assert_eq!(slots.joints[link], joint.last_axis(i), "{name}");
                let above = joints[joint.first_axis(i)].parent;
                let expected = if above == WORLD { WORLD } else { slots.link(above) };
                assert_eq!(slots.parents[link], expected, "{name}");
            }
            let balls = joints.iter().filter(|joint| joint.kind == JointKind::Ball(0)).count();
            assert_eq!(slots.parents.len() + 2 * balls, joints.len(), "{name}");
            assert_eq!(slots.are_in_order, balls == 0, "{name}");
        }
    }
}
