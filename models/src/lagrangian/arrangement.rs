//! How the numbers of joints lie, in planar trees: four joints side by side, or one after the other.

use std::fmt::Debug;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut, Mul};

use plantd_math::scalar::{Compared, Lanes, LanesOf, Scalar, Side};

use crate::lagrangian::plane::{Vec2, Vec3};
use crate::model::planar_tree::{Body, PlanarJoint, PlanarJoints};

/// How numbers of joints lie: those of several side by side, or one after the other.
pub(crate) trait Arrangement: Clone + Debug {
    type Number: Scalar;
    type Several: Scalar + Mul<Self::Constant, Output = Self::Several>;
    type Constant: Copy;
    /// Joints of a block.
    const COUNT: usize;
    /// Whether each block goes through a whole pass by itself; else all go through a part of it together.
    const ALONE: bool;
    /// What hangs on what.
    type Order: Order;
    /// What is fixed to the joints of a block.
    fn body(joints: &PlanarJoints, block: usize) -> &Body<Self::Constant>;
    fn one(several: &Self::Several, lane: usize) -> Self::Number;
    fn put(number: Self::Number, several: &mut Self::Several, lane: usize);
    /// The numbers of a block from a list of those of coordinates.
    fn gather(joints: &PlanarJoints, block: usize, list: &[Self::Number]) -> Self::Several;
    /// The way back, but for what is beyond the list.
    fn scatter(
        joints: &PlanarJoints,
        block: usize,
        several: Self::Several,
        list: &mut [Self::Number],
    );
    /// The numbers of a block, those of each joint together.
    fn spread(numbers: [Self::Several; 4], joints: &mut [[Self::Number; 4]]);
    /// The way back.
    fn collect(joints: &[[Self::Number; 4]]) -> [Self::Several; 4];
}

/// What hangs on what, and the lists of numbers that go with it.
pub(crate) trait Order: Clone + Debug {
    /// A list of numbers of joints.
    type List<T: Copy + Debug>: Clone + Debug + DerefMut<Target = [T]>;
    /// A list of so many.
    fn list<T: Copy + Debug>(number: T, count: usize) -> Self::List<T>;
    /// What a joint of that index hangs on, and what on it.
    fn ties(joint: &PlanarJoint, index: usize) -> Ties;
    /// The coordinate of a joint of that index.
    fn coordinate(joints: &PlanarJoints, index: usize) -> usize;
}

/// A list of numbers of joints.
pub(crate) type List<A, T> = <<A as Arrangement>::Order as Order>::List<T>;

/// What a joint hangs on, and what on it; as in [`PlanarJoint`].
#[derive(Clone, Copy)]
pub(crate) struct Ties {
    pub(crate) parent: usize,
    pub(crate) is_followed: bool,
    pub(crate) has_branches: bool,
    pub(crate) is_anchor: bool,
}

/// Any trees.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InTrees;

impl Order for InTrees {
    type List<T: Copy + Debug> = Vec<T>;

    fn list<T: Copy + Debug>(number: T, count: usize) -> Vec<T> {
        vec![number; count]
    }

    #[inline(always)]
    fn ties(joint: &PlanarJoint, _: usize) -> Ties {
        let PlanarJoint { parent, is_followed, has_branches, anchor, .. } = *joint;
        Ties { parent, is_followed, has_branches, is_anchor: anchor }
    }

    #[inline(always)]
    fn coordinate(joints: &PlanarJoints, index: usize) -> usize {
        joints[index].coordinate
    }
}

/// So many joints, each on the one before it and in the order of their coordinates ([`PlanarJoints::are_in_a_row`]): lists
/// of known length, which may stay in registers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InARow<const N: usize>;

impl<const N: usize> Order for InARow<N> {
    type List<T: Copy + Debug> = Known<T, N>;

    #[inline(always)]
    fn list<T: Copy + Debug>(number: T, _: usize) -> Known<T, N> {
        Known([number; N])
    }

    #[inline(always)]
    fn ties(_: &PlanarJoint, index: usize) -> Ties {
        Ties { parent: index, is_followed: index + 1 < N, has_branches: false, is_anchor: false }
    }

    #[inline(always)]
    fn coordinate(_: &PlanarJoints, index: usize) -> usize {
        index
    }
}

/// A list of known length.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Known<T, const N: usize>([T; N]);

impl<T, const N: usize> Deref for Known<T, N> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        &self.0
    }
}

impl<T, const N: usize> DerefMut for Known<T, N> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.0
    }
}

/// Four joints side by side.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fours;

impl Arrangement for Fours {
    type Number = f64;
    type Several = Lanes;
    type Constant = Lanes;
    type Order = InTrees;
    const COUNT: usize = Lanes::COUNT;
    const ALONE: bool = false;

    #[inline(always)]
    fn body(joints: &PlanarJoints, block: usize) -> &Body<Lanes> {
        &joints.fours[block]
    }

    #[inline(always)]
    fn one(several: &Lanes, lane: usize) -> f64 {
        several.0[lane]
    }

    #[inline(always)]
    fn put(number: f64, several: &mut Lanes, lane: usize) {
        several.0[lane] = number;
    }

    #[inline(always)]
    fn gather(joints: &PlanarJoints, block: usize, list: &[f64]) -> Lanes {
        let first = Self::COUNT * block;
        let four = list.get(first..).and_then(|list| list.first_chunk());
        if let (Some(four), true) = (four, joints.are_in_order) {
            return LanesOf(*four);
        }
        let mut lanes = Lanes::ZERO;
        for (lane, joint) in lanes.0.iter_mut().zip(&joints[first..]) {
            *lane = list[joint.coordinate];
        }
        lanes
    }

    #[inline(always)]
    fn scatter(joints: &PlanarJoints, block: usize, lanes: Lanes, list: &mut [f64]) {
        let first = Self::COUNT * block;
        match list.get_mut(first..first + Self::COUNT) {
            Some(four) if joints.are_in_order => four.copy_from_slice(&lanes.0),
            _ => {
                for (lane, joint) in lanes.0.iter().zip(&joints[first..]) {
                    if let Some(entry) = list.get_mut(joint.coordinate) {
                        *entry = *lane;
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn spread([a, b, c, d]: [Lanes; 4], joints: &mut [[f64; 4]]) {
        for (lane, joint) in joints[..4].iter_mut().enumerate() {
            *joint = [a.0[lane], b.0[lane], c.0[lane], d.0[lane]];
        }
    }

    #[inline(always)]
    fn collect(joints: &[[f64; 4]]) -> [Lanes; 4] {
        let mut numbers = [Lanes::ZERO; 4];
        for (lane, joint) in joints[..4].iter().enumerate() {
            for (number, to) in joint.iter().zip(&mut numbers) {
                to.0[lane] = *number;
            }
        }
        numbers
    }
}

/// One joint after the other.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ones<S, O = InTrees>(PhantomData<(S, O)>);

impl<S: Scalar, O: Order> Arrangement for Ones<S, O> {
    type Number = S;
    type Several = S;
    type Constant = f64;
    type Order = O;
    const COUNT: usize = 1;
    const ALONE: bool = true;

    #[inline(always)]
    fn body(joints: &PlanarJoints, block: usize) -> &Body {
        &joints[block].body
    }

    #[inline(always)]
    fn one(several: &S, _: usize) -> S {
        *several
    }

    #[inline(always)]
    fn put(number: S, several: &mut S, _: usize) {
        *several = number;
    }

    #[inline(always)]
    fn gather(joints: &PlanarJoints, block: usize, list: &[S]) -> S {
        list[O::coordinate(joints, block)]
    }

    #[inline(always)]
    fn scatter(joints: &PlanarJoints, block: usize, several: S, list: &mut [S]) {
        if let Some(entry) = list.get_mut(O::coordinate(joints, block)) {
            *entry = several;
        }
    }

    #[inline(always)]
    fn spread(numbers: [S; 4], joints: &mut [[S; 4]]) {
        joints[0] = numbers;
    }

    #[inline(always)]
    fn collect(joints: &[[S; 4]]) -> [S; 4] {
        joints[0]
    }
}

/// Numbers of which planar trees are computed.
pub(crate) trait Planar: Compared + Side {
    /// Of many joints.
    type Many: Arrangement<Number = Self>;
}

impl Planar for f64 {
    type Many = Fours;
}

impl<const N: usize> Planar for LanesOf<N> {
    type Many = Ones<Self>;
}

#[inline(always)]
pub(crate) fn one2<A: Arrangement>(v: &Vec2<A::Several>, lane: usize) -> Vec2<A::Number> {
    [A::one(&v[0], lane), A::one(&v[1], lane)]
}

#[inline(always)]
pub(crate) fn one3<A: Arrangement>(v: &Vec3<A::Several>, lane: usize) -> Vec3<A::Number> {
    [A::one(&v[0], lane), A::one(&v[1], lane), A::one(&v[2], lane)]
}

#[inline(always)]
pub(crate) fn put2<A: Arrangement>(v: Vec2<A::Number>, to: &mut Vec2<A::Several>, lane: usize) {
    A::put(v[0], &mut to[0], lane);
    A::put(v[1], &mut to[1], lane);
}
