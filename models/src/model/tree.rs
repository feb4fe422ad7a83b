//! The joint tree as a step walks it: depth first, fixed joints merged into their parents, every
//! joint turned so that its axis is its own z axis.

use plantd_math::rows::{Block, LANES};
use plantd_math::scalar::{Scalar, Wide};
use plantd_math::sided::Composite;
use plantd_math::spatial::{Mat3, Sym3, Vec3};

use crate::model::slots::Slots;

/// "No parent": the joint hangs from the world.
pub(crate) const WORLD: usize = usize::MAX;

/// Kind of a moving joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum JointKind {
    /// Turns about its z axis.
    Revolute,
    /// Slides along its z axis.
    Prismatic,
    /// Turns about its z axis and slides along it, by so many metres a radian.
    Screw(f64),
    /// Turns about all axes. A ball joint is three entries in a row, numbered 0, 1, 2, with the pose of
    /// the whole joint, turned so that the z axis of entry `a` is the joint's own axis `a`. Their
    /// velocities are the components of the angular velocity in the joint's own axes.
    Ball(usize),
}

impl JointKind {
    /// Whether its coordinate is an angle about its z axis.
    #[inline(always)]
    pub(crate) fn turns_about_axis(self) -> bool {
        matches!(self, Self::Revolute | Self::Screw(_))
    }
}

/// A moving joint with everything that is fixed to it.
#[derive(Clone, Debug)]
pub(crate) struct Joint {
    /// Index of the parent joint, smaller than the joint's own, or [`WORLD`].
    pub(crate) parent: usize,
    /// Index of the root of the joint's tree.
    pub(crate) root: usize,
    pub(crate) kind: JointKind,
    /// Pose of the joint at zero in the parent joint's frame.
    pub(crate) rotation: Mat3,
    pub(crate) translation: Vec3,
    /// Index of the coordinate.
    pub(crate) coordinate: usize,
    /// Index of the orientation of a ball joint; meaningless for others.
    pub(crate) orientation: usize,
    /// Bodies fixed to the joint, lumped, in the joint's frame.
    pub(crate) body: Body,
    /// Mass of the joint's subtree.
    pub(crate) subtree_mass: f64,
    /// The evaluation's origin moves to this joint (see [`Tree`]).
    pub(crate) anchor: bool,
}

/// A lumped rigid body in its joint's frame.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Body {
    pub(crate) mass: f64,
    pub(crate) center: Vec3,
    /// About the centre of mass.
    pub(crate) inertia: Rotational,
}

/// The rotational inertia of a body, by what its evaluation costs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) enum Rotational {
    /// No body at all.
    #[default]
    None,
    /// A point mass.
    Point,
    /// One moment of inertia about every axis.
    Isotropic(f64),
    /// Anything else.
    Full(Sym3),
}

/// A forest of joints, parents first.
///
/// Positions are measured from one origin per tree of the forest: the root joint's frame, or, where
/// the root is carried by massless joints (a floating base), the first joint with mass. Far from the
/// world's origin this keeps all digits.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tree {
    pub(crate) joints: Vec<Joint>,
    /// Some joint is neither revolute nor prismatic.
    pub(crate) has_other_joints: bool,
    /// Some joint is a ball joint.
    pub(crate) has_balls: bool,
    /// Some body is more than a point mass.
    has_spin: bool,
    /// Where joints lie side by side.
    pub(crate) slots: Slots,
    /// What is fixed to the joints of eight slots.
    eights: Vec<Fixed<Block>>,
}

/// What is fixed to a joint, of several side by side: what the passes over a tree compute with.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Fixed<S> {
    /// How the joint turns about its z axis, and slides along it, with its coordinate: 1 and 0 of a hinge.
    pub(crate) turns: S,
    pub(crate) slides: S,
    pub(crate) mass: S,
    pub(crate) center: Vec3<S>,
    /// About the centre of mass.
    pub(crate) inertia: Sym3<S>,
    pub(crate) subtree_mass: S,
}

impl Fixed<Block> {
    fn of(joints: &[Joint], slots: &[usize]) -> Self {
        let mut fixed = Self::default();
        let joints = slots.iter().map(|slot| joints.get(*slot));
        for (lane, joint) in joints.enumerate() {
            let Some(joint) = joint else { continue };
            let (turns, slides) = match joint.kind {
                JointKind::Prismatic => (0.0, 1.0),
                JointKind::Screw(pitch) => (1.0, pitch),
                JointKind::Revolute | JointKind::Ball(_) => (1.0, 0.0),
            };
            let Body { mass, center, inertia } = joint.body;
            let inertia = match inertia {
                Rotational::None | Rotational::Point => Sym3::default(),
                Rotational::Isotropic(i) => Sym3 { xx: i, yy: i, zz: i, ..Sym3::default() },
                Rotational::Full(tensor) => tensor,
            };
            turns.put(&mut fixed.turns, lane);
            slides.put(&mut fixed.slides, lane);
            mass.put(&mut fixed.mass, lane);
            fixed.center.zip(center, |numbers, number: f64| number.put(numbers, lane));
            fixed.inertia.zip(inertia, |numbers, number: f64| number.put(numbers, lane));
            joint.subtree_mass.put(&mut fixed.subtree_mass, lane);
        }
        fixed
    }
}

impl Joint {
    /// Whether it hangs from the one before it, where it is the one at `i`.
    pub(crate) fn follows(&self, i: usize) -> bool {
        self.parent.checked_add(1) == Some(i)
    }

    /// The first axis of the joint that it is, or belongs to, where it is the one at `i`.
    #[inline(always)]
    pub(crate) fn first_axis(&self, i: usize) -> usize {
        if let JointKind::Ball(axis) = self.kind { i - axis } else { i }
    }

    /// The last one, which has the body and carries others.
    #[inline(always)]
    pub(crate) fn last_axis(&self, i: usize) -> usize {
        if let JointKind::Ball(axis) = self.kind { i + 2 - axis } else { i }
    }
}

impl Tree {
    /// What is fixed to the joints of the slots that begin with `i`.
    #[inline(always)]
    pub(crate) fn fixed<S: Scalar, W: Wide<S>>(&self, i: usize) -> Fixed<W> {
        let (eight, lane) = (&self.eights[i / LANES], i % LANES);
        let of = |numbers: &Block| W::constants(numbers, lane);
        Fixed {
            turns: of(&eight.turns),
            slides: of(&eight.slides),
            mass: of(&eight.mass),
            center: eight.center.map(of),
            inertia: eight.inertia.map(of),
            subtree_mass: of(&eight.subtree_mass),
        }
    }

    /// What there is to know of the rotational inertia in the slots that begin with `i`: of several, the most that any
    /// has.
    #[inline(always)]
    pub(crate) fn rotational<S: Scalar>(&self, i: usize) -> Rotational {
        match self.joints[self.slots.joints[i]].body.inertia {
            inertia if S::BESIDE == 1 => inertia,
            _ if self.has_spin => Rotational::Full(Sym3::default()),
            _ => Rotational::Point,
        }
    }

    /// The joints of `all` for which `keep` holds, re-indexed, and the map from old to new indices.
    /// `keep` must hold for the parent of every kept joint.
    pub(crate) fn pruned(all: &[Joint], keep: &[bool]) -> (Self, Vec<usize>) {
        let mut index = vec![WORLD; all.len()];
        let mut joints: Vec<Joint> = Vec::new();
        for (old, joint) in all.iter().enumerate().filter(|(old, _)| keep[*old]) {
            index[old] = joints.len();
            let parent = if joint.parent == WORLD { WORLD } else { index[joint.parent] };
            let root = if parent == WORLD { joints.len() } else { joints[parent].root };
            joints.push(Joint { parent, root, ..joint.clone() });
        }
        let simple =
            |joint: &Joint| matches!(joint.kind, JointKind::Revolute | JointKind::Prismatic);
        let has_other_joints = !joints.iter().all(simple);
        let has_balls = joints.iter().any(|joint| matches!(joint.kind, JointKind::Ball(_)));
        let has_spin = joints.iter().any(|joint| {
            matches!(joint.body.inertia, Rotational::Isotropic(_) | Rotational::Full(_))
        });
        let slots = Slots::new(&joints);
        let eights = slots.joints.chunks(LANES).map(|slots| Fixed::of(&joints, slots)).collect();
        let mut tree = Self { joints, has_other_joints, has_balls, has_spin, slots, eights };
        tree.place_anchors();
        (tree, index)
    }

    /// Proper ancestors of a joint and the joint itself, root first.
    pub(crate) fn path(&self, joint: usize) -> Vec<usize> {
        let mut path: Vec<usize> = self.ascend(joint).collect();
        path.reverse();
        path
    }

    /// A joint and its proper ancestors, root last; none of the world.
    #[inline]
    pub(crate) fn ascend(&self, joint: usize) -> impl Iterator<Item = usize> {
        let is_joint = |joint: &usize| *joint != WORLD;
        let parent = move |joint: &usize| Some(self.joints[*joint].parent).filter(is_joint);
        std::iter::successors(Some(joint).filter(is_joint), parent)
    }

    /// Whether two joints are axes of one ball joint.
    #[inline]
    pub(crate) fn one_ball(&self, i: usize, j: usize) -> bool {
        let first = |joint: usize| self.joints[joint].first_axis(joint);
        self.has_balls && i != j && first(i) == first(j)
    }

    fn place_anchors(&mut self) {
        for root in 0..self.joints.len() {
            if self.joints[root].parent != WORLD {
                continue;
            }
            let mut anchor = root;
            while matches!(self.joints[anchor].body.inertia, Rotational::None) {
                let mut children =
                    (anchor + 1..self.joints.len()).filter(|&j| self.joints[j].parent == anchor);
                match (children.next(), children.next()) {
                    (Some(only), None) => anchor = only,
                    _ => break,
                }
            }
            self.joints[anchor].anchor = anchor != root;
        }
    }
}

/// A point fixed to a joint of a tree, or to the world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Attachment {
    /// Index of the joint, or [`WORLD`].
    pub(crate) joint: usize,
    /// Position in the joint's frame.
    pub(crate) point: Vec3,
}
