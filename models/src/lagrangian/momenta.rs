//! The gradient of the Lagrangian at a configuration and velocity, by momentum recursion: O(n).
//!
//! ```text
//! root to leaf:  V_i = V_parent + J_i v_i      J̇_i = V_parent × J_i      H_i = I_i V_i
//! leaf to root:  H_parent += H_i
//!                ∂L/∂v_i = J_i · H_i
//!                ∂L/∂q_i = J̇_i · H_i + J_i · W_i      W_i: weight of the subtree
//! ```

use plantd_math::scalar::{Beside, Scalar, Wide};
use plantd_math::sided::Sided;
use plantd_math::spatial::{Force, Motion, Pose, Vec3};

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::sums::{Sums, firsts, firsts_of_links};
use crate::model::slots::Slots;
use crate::model::tree::{JointKind, Rotational, Tree, WORLD};

/// Twists and momenta of a tree.
///
/// Only sums along the tree need one link after the other: all else is computed for several [slots] side by side.
///
/// [slots]: crate::model::slots
#[derive(Clone, Debug)]
pub(crate) struct Momenta<S: Scalar = f64> {
    /// Joint axes `J` as twists, by slot.
    pub(crate) axis: Sided<Motion<S::Several>>,
    /// Their rates `J̇`.
    pub(crate) axis_rate: Sided<Motion<S::Several>>,
    /// Momentum `H` of the subtree of each.
    pub(crate) momentum: Sided<Force<S::Several>>,
    /// First moment of mass of the subtree.
    pub(crate) moment: Sided<Vec3<S::Several>>,
    /// Twists `V` of the links.
    twist: Sided<Motion<S::Several>>,
    /// Centres of mass of their bodies.
    pub(crate) center: Sided<Vec3<S::Several>>,
    sums: Sums<S>,
}

/// What [`Momenta::gradient`] does.
struct Gradient<'a, S: Scalar> {
    momenta: &'a mut Momenta<S>,
    tree: &'a Tree,
    poses: &'a Poses<S>,
    velocity: &'a [S],
    gravity: Option<Vec3>,
    l_q: &'a mut [S],
    l_v: &'a mut [S],
}

impl<S: Scalar> Beside<S> for Gradient<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<S>>(self) {
        let Self { momenta, tree, poses, velocity, gravity, l_q, l_v } = self;
        if tree.has_balls {
            momenta.forward::<W, true>(tree, poses, velocity);
        } else {
            momenta.forward::<W, false>(tree, poses, velocity);
        }
        if l_v.is_empty() {
            return;
        }
        for i in firsts::<S, W>(tree) {
            let (axis, momentum) = (momenta.axis.wide::<S, W>(i), momenta.momentum.wide::<S, W>(i));
            let mut torque = momenta.axis_rate.wide::<S, W>(i).dot(momentum);
            if let Some(g) = gravity {
                let g = Vec3::<W>::lift(g);
                let f = g * tree.fixed::<S, W>(i).subtree_mass;
                torque += axis.dot(Force { n: momenta.moment.wide::<S, W>(i).cross(g), f });
            }
            scatter(&tree.slots, i, axis.dot(momentum), l_v);
            scatter(&tree.slots, i, torque, l_q);
        }
    }
}

/// Numbers of the slots that begin with `i`, from a list of those of coordinates; zero beyond the list.
#[inline(always)]
fn collect<S: Scalar, W: Wide<S>>(slots: &Slots, i: usize, list: &[S]) -> W {
    if !slots.are_in_order {
        return collect_of(&slots.coordinates[0][i..i + W::COUNT], list);
    }
    match list.get(i..i + W::COUNT) {
        Some(numbers) => W::first_of(numbers),
        None => {
            let mut several = S::Several::default();
            for (lane, number) in list.iter().skip(i).take(W::COUNT).enumerate() {
                number.put(&mut several, lane);
            }
            W::load(&several, 0)
        }
    }
}

/// Numbers of coordinates from a list; zero beyond it.
#[inline(always)]
fn collect_of<S: Scalar, W: Wide<S>>(coordinates: &[usize], list: &[S]) -> W {
    let mut several = S::Several::default();
    for (lane, coordinate) in coordinates.iter().enumerate() {
        if let Some(number) = list.get(*coordinate) {
            number.put(&mut several, lane);
        }
    }
    W::load(&several, 0)
}

/// The way back, but for what is beyond the list.
#[inline(always)]
fn scatter<S: Scalar, W: Wide<S>>(slots: &Slots, i: usize, wide: W, list: &mut [S]) {
    let mut several = S::Several::default();
    wide.store(&mut several, 0);
    if slots.are_in_order {
        for (lane, number) in list.iter_mut().skip(i).take(W::COUNT).enumerate() {
            *number = S::one(&several, lane);
        }
        return;
    }
    for (lane, coordinate) in slots.coordinates[0][i..i + W::COUNT].iter().enumerate() {
        if let Some(number) = list.get_mut(*coordinate) {
            *number = S::one(&several, lane);
        }
    }
}

#[inline(always)]
fn motion<W: Copy>([p, q, r, x, y, z, ..]: [W; 8]) -> Motion<W> {
    Motion { w: Vec3([p, q, r]), v: Vec3([x, y, z]) }
}

/// Axes in the slots that begin with `i`.
#[inline(always)]
fn axis_at<S: Scalar, W: Wide<S>>(
    tree: &Tree,
    Pose { z, at, .. }: &Pose<W>,
    i: usize,
) -> Motion<W> {
    let (z, at) = (*z, *at);
    match tree.joints[tree.slots.joints[i]].kind {
        // Alone, a joint is of one kind.
        JointKind::Prismatic if S::BESIDE == 1 => Motion { w: Vec3::ZERO, v: z },
        JointKind::Revolute | JointKind::Ball(_) if S::BESIDE == 1 => {
            Motion { w: z, v: at.cross(z) }
        }
        _ => {
            let fixed = tree.fixed::<S, W>(i);
            let v = at.cross(z) * fixed.turns + z * fixed.slides;
            Motion { w: z * fixed.turns, v }
        }
    }
}

/// How the links that begin with `i` move beside what carries them.
#[inline(always)]
fn own_twist<S: Scalar, W: Wide<S>, const BALLS: bool>(
    slots: &Slots,
    i: usize,
    (pose, axis): (&Pose<W>, Motion<W>),
    velocity: &[S],
) -> Motion<W> {
    let own = axis.scaled(collect(slots, i, velocity));
    if !BALLS || (S::BESIDE == 1 && !slots.is_ball(i)) {
        return own;
    }
    let ([_, first, second], lanes) = (&slots.coordinates, i..i + W::COUNT);
    let first: W = collect_of(&first[lanes.clone()], velocity);
    let second: W = collect_of(&second[lanes], velocity);
    let turn = pose.x * first + pose.y * second;
    Motion { w: own.w + turn, v: own.v + pose.at.cross(turn) }
}

impl<S: Scalar> Momenta<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let (n, links) = (tree.joints.len(), tree.slots.parents.len());
        Self {
            axis: Sided::zeros::<S>(n),
            axis_rate: Sided::zeros::<S>(n),
            momentum: Sided::zeros::<S>(n),
            moment: Sided::zeros::<S>(n),
            twist: Sided::zeros::<S>(links),
            center: Sided::zeros::<S>(links),
            sums: Sums::new(&tree.slots),
        }
    }

    /// `J` of a joint, or of one axis of a ball joint.
    #[inline(always)]
    pub(crate) fn axis_of(&self, tree: &Tree, joint: usize) -> Motion<S> {
        self.axis.get::<S>(tree.slots.of(joint))
    }

    /// `J̇` of a joint, or of one axis of a ball joint.
    #[inline(always)]
    pub(crate) fn axis_rate_of(&self, tree: &Tree, joint: usize) -> Motion<S> {
        self.axis_rate.get::<S>(tree.slots.of(joint))
    }

    /// `V` of what a joint carries.
    #[inline(always)]
    pub(crate) fn twist_of(&self, tree: &Tree, joint: usize) -> Motion<S> {
        self.twist.get::<S>(tree.slots.link(joint))
    }

    /// `H` of what a joint carries.
    #[inline(always)]
    pub(crate) fn momentum_of(&self, tree: &Tree, joint: usize) -> Force<S> {
        self.momentum.get::<S>(tree.slots.of(joint))
    }

    /// The first moment of mass of what a joint carries.
    #[inline(always)]
    pub(crate) fn moment_of(&self, tree: &Tree, joint: usize) -> Vec3<S> {
        self.moment.get::<S>(tree.slots.of(joint))
    }

    /// Writes `∂L/∂q` and `∂L/∂v` of the dynamic coordinates, the first `l_q.len()` ones.
    #[inline(never)]
    pub(crate) fn gradient(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        velocity: &[S],
        gravity: Option<Vec3>,
        l_q: &mut [S],
        l_v: &mut [S],
    ) {
        S::beside(
            tree.joints.len(),
            Gradient { momenta: self, tree, poses, velocity, gravity, l_q, l_v },
        );
    }

    /// From the roots to the leaves, and back; `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn forward<W: Wide<S>, const BALLS: bool>(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        velocity: &[S],
    ) {
        if S::BESIDE == 1 {
            return self.one_by_one::<W, BALLS>(tree, poses, velocity);
        }
        let slots = &tree.slots;
        for i in firsts::<S, W>(tree) {
            let pose = poses.wide::<W, BALLS>(tree, i);
            let axis = axis_at::<S, W>(tree, &pose, i);
            self.axis.store::<S, W>(i, axis);
            if i < slots.parents.len() {
                let own = own_twist::<S, W, BALLS>(slots, i, (&pose, axis), velocity);
                let Motion { w: Vec3([p, q, r]), v: Vec3([x, y, z]) } = own;
                self.sums.put(i, [p, q, r, x, y, z, W::ZERO, W::ZERO]);
            }
        }
        self.sums.descend::<W>(&slots.parents);
        for i in firsts::<S, W>(tree).filter(|_| BALLS) {
            let carrier = motion(self.sums.take_from::<W, BALLS>(i, &slots.carriers));
            self.axis_rate.store::<S, W>(i, carrier.cross(self.axis.wide::<S, W>(i)));
        }
        for i in firsts_of_links::<S, W>(tree) {
            let twist = motion(self.sums.take(i));
            if !BALLS {
                // What an axis adds to the twist does not move it.
                self.axis_rate.store::<S, W>(i, twist.cross(self.axis.wide::<S, W>(i)));
            }
            let own = self.carry(tree, &poses.wide::<W, BALLS>(tree, i), twist, i);
            self.sums.put_vectors(i, own);
        }
        self.sums.ascend::<W, true>(&slots.parents);
        for i in firsts::<S, W>(tree) {
            let [n, f, moment] = self.sums.take_vectors_from::<W, BALLS>(i, &slots.links);
            self.momentum.store::<S, W>(i, Force { n, f });
            self.moment.store::<S, W>(i, moment);
        }
    }

    /// The same where nothing is beside a link: then what it passes on stays in registers.
    #[inline(always)]
    fn one_by_one<W: Wide<S>, const BALLS: bool>(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        velocity: &[S],
    ) {
        let slots = &tree.slots;
        let mut twist = Motion { w: Vec3::<W>::ZERO, v: Vec3::ZERO };
        for (link, &parent) in slots.parents.iter().enumerate() {
            let pose = poses.wide::<W, BALLS>(tree, link);
            let axis = axis_at::<S, W>(tree, &pose, link);
            let own = own_twist::<S, W, BALLS>(slots, link, (&pose, axis), velocity);
            let above = match parent {
                WORLD => Motion { w: Vec3::ZERO, v: Vec3::ZERO },
                parent if parent + 1 == link => twist,
                parent => self.twist.wide::<S, W>(parent),
            };
            twist = Motion { w: above.w + own.w, v: above.v + own.v };
            self.axis.store::<S, W>(link, axis);
            if BALLS && slots.is_ball(link) {
                self.axis_rate.store::<S, W>(link, above.cross(axis));
                for other in slots.others(link) {
                    let pose = poses.wide::<W, BALLS>(tree, other);
                    let axis = axis_at::<S, W>(tree, &pose, other);
                    self.axis.store::<S, W>(other, axis);
                    self.axis_rate.store::<S, W>(other, above.cross(axis));
                }
            } else {
                self.axis_rate.store::<S, W>(link, twist.cross(axis));
            }
            let [n, f, moment] = self.carry(tree, &pose, twist, link);
            self.momentum.store::<S, W>(link, Force { n, f });
            self.moment.store::<S, W>(link, moment);
        }
        for (link, &parent) in slots.parents.iter().enumerate().rev() {
            let momentum = self.momentum.wide::<S, W>(link);
            let moment = self.moment.wide::<S, W>(link);
            if parent != WORLD {
                let all = self.momentum.wide::<S, W>(parent).plus(momentum);
                self.momentum.store::<S, W>(parent, all);
                let all = self.moment.wide::<S, W>(parent) + moment;
                self.moment.store::<S, W>(parent, all);
            }
            if BALLS && slots.is_ball(link) {
                for other in slots.others(link) {
                    self.momentum.store::<S, W>(other, momentum);
                    self.moment.store::<S, W>(other, moment);
                }
            }
        }
    }

    /// Angular and linear momenta and first moments of mass of the bodies of the links that begin with `i`, by their
    /// twists; takes note of these, and of the centres of mass.
    #[inline(always)]
    fn carry<W: Wide<S>>(
        &mut self,
        tree: &Tree,
        pose: &Pose<W>,
        twist: Motion<W>,
        i: usize,
    ) -> [Vec3<W>; 3] {
        self.twist.store::<S, W>(i, twist);
        let rotational = tree.rotational::<S>(i);
        if let Rotational::None = rotational {
            return [Vec3::ZERO; 3];
        }
        let (rotation, fixed) = (pose.rotation(), tree.fixed::<S, W>(i));
        let center = pose.at + rotation.apply(fixed.center);
        let linear = twist.at(center) * fixed.mass;
        let mut angular = center.cross(linear);
        match rotational {
            Rotational::None | Rotational::Point => {}
            Rotational::Isotropic(i) => angular += twist.w.scaled(i),
            Rotational::Full(_) => {
                let own = fixed.inertia.apply(rotation.apply_transposed(twist.w));
                angular += rotation.apply(own);
            }
        }
        self.center.store::<S, W>(i, center);
        [angular, linear, center * fixed.mass]
    }

    /// Twice the kinetic energy, `Σ v_i J_i·H_i`, of the last [`Momenta::gradient`].
    pub(crate) fn twice_kinetic_energy(&self, tree: &Tree, velocity: &[S]) -> S {
        let mut sum = S::ZERO;
        for (i, joint) in tree.joints.iter().enumerate() {
            sum +=
                velocity[joint.coordinate] * self.axis_of(tree, i).dot(self.momentum_of(tree, i));
        }
        sum
    }
}

/// Sums over all bodies that move, about the world's origin.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Totals {
    /// kg.
    pub(crate) mass: f64,
    /// First moment of mass, kg·m.
    pub(crate) moment: Vec3,
    /// Linear and angular momentum.
    pub(crate) momentum: Force,
}

impl Totals {
    /// The centre of mass, m; the origin if nothing has mass.
    pub(crate) fn center(&self) -> Vec3 {
        if self.mass > 0.0 { self.moment * (1.0 / self.mass) } else { Vec3::ZERO }
    }
}

impl Momenta {
    /// The sums of the last [`Momenta::gradient`].
    pub(crate) fn totals(&self, tree: &Tree, poses: &Poses) -> Totals {
        let mut totals = Totals::default();
        for (i, joint) in tree.joints.iter().enumerate().filter(|(i, j)| j.root == *i) {
            let (Force { n, f }, origin) = (self.momentum_of(tree, i), poses.origin[i]);
            totals.momentum = totals.momentum.plus(Force { n: n + origin.cross(f), f });
            totals.moment += self.moment_of(tree, i) + origin * joint.subtree_mass;
            totals.mass += joint.subtree_mass;
        }
        totals
    }
}
