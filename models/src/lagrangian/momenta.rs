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
use crate::lagrangian::sums::{Sums, firsts};
use crate::model::tree::{Joint, JointKind, Rotational, Tree};

/// Twists and momenta of the joints of a tree.
///
/// Only sums along the tree need one joint after the other: all else is computed for several side by side.
#[derive(Clone, Debug)]
pub(crate) struct Momenta<S: Scalar = f64> {
    /// Joint axes `J` as twists.
    pub(crate) axis: Sided<Motion<S::Several>>,
    /// Their rates `J̇`.
    pub(crate) axis_rate: Sided<Motion<S::Several>>,
    /// Twists `V`.
    pub(crate) twist: Sided<Motion<S::Several>>,
    /// Momentum `H` of each subtree.
    pub(crate) momentum: Sided<Force<S::Several>>,
    /// First moment of mass of each subtree.
    pub(crate) moment: Sided<Vec3<S::Several>>,
    /// Centres of mass of the bodies.
    pub(crate) center: Sided<Vec3<S::Several>>,
    sums: Sums<S>,
    /// Twists of what joints hang from, where ball joints need them.
    carriers: Sums<S>,
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
        for i in firsts::<S>(tree) {
            let (axis, momentum) = (momenta.axis.wide::<S, W>(i), momenta.momentum.wide::<S, W>(i));
            let mut torque = momenta.axis_rate.wide::<S, W>(i).dot(momentum);
            if let Some(g) = gravity {
                let g = Vec3::<W>::lift(g);
                let f = g * tree.fixed::<S, W>(i).subtree_mass;
                torque += axis.dot(Force { n: momenta.moment.wide::<S, W>(i).cross(g), f });
            }
            scatter(tree, i, axis.dot(momentum), l_v);
            scatter(tree, i, torque, l_q);
        }
    }
}

/// Numbers of the joints that begin with `i`, from a list of those of coordinates; zero beyond the list.
#[inline(always)]
fn collect<S: Scalar, W: Wide<S>>(tree: &Tree, i: usize, list: &[S]) -> W {
    let mut several = S::Several::default();
    for (lane, joint) in tree.joints[i..].iter().take(S::BESIDE).enumerate() {
        if let Some(number) = list.get(joint.coordinate) {
            number.put(&mut several, lane);
        }
    }
    W::load(&several)
}

/// The way back, but for what is beyond the list.
#[inline(always)]
fn scatter<S: Scalar, W: Wide<S>>(tree: &Tree, i: usize, wide: W, list: &mut [S]) {
    let mut several = S::Several::default();
    wide.store(&mut several);
    for (lane, joint) in tree.joints[i..].iter().take(S::BESIDE).enumerate() {
        if let Some(number) = list.get_mut(joint.coordinate) {
            *number = S::one(&several, lane);
        }
    }
}

impl<S: Scalar> Momenta<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        Self {
            axis: Sided::zeros::<S>(n),
            axis_rate: Sided::zeros::<S>(n),
            twist: Sided::zeros::<S>(n),
            momentum: Sided::zeros::<S>(n),
            moment: Sided::zeros::<S>(n),
            center: Sided::zeros::<S>(n),
            sums: Sums::new(n),
            carriers: Sums::new(if tree.has_balls { n } else { 0 }),
        }
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

    /// From the roots to the leaves; `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn forward<W: Wide<S>, const BALLS: bool>(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        velocity: &[S],
    ) {
        for i in firsts::<S>(tree) {
            self.place::<W>(tree, poses, velocity, i);
        }
        self.sums.descend::<W, false>(tree);
        if BALLS {
            // The axes of a ball are carried by what the whole joint hangs from.
            self.carriers.copy_from::<W>(&self.sums, |i| match tree.joints.get(i) {
                Some(Joint { kind: JointKind::Ball(axis), .. }) => tree.joints[i - axis].parent,
                _ => i,
            });
        }
        for i in firsts::<S>(tree) {
            self.carry::<W, BALLS>(tree, poses, i);
        }
        self.sums.ascend::<W, true>(tree);
        for i in firsts::<S>(tree) {
            let [n, f, moment] = self.sums.take_vectors::<W>(i);
            self.momentum.store::<S, W>(i, Force { n, f });
            self.moment.store::<S, W>(i, moment);
        }
    }

    /// Axes of the joints that begin with `i`, and how fast they move along them.
    #[inline(always)]
    fn place<W: Wide<S>>(&mut self, tree: &Tree, poses: &Poses<S>, velocity: &[S], i: usize) {
        let (Pose { z, at, .. }, fixed) = (poses.wide::<W>(i), tree.fixed::<S, W>(i));
        let kind = tree.joints[i].kind;
        let axis = match kind {
            // Alone, a joint is of one kind.
            JointKind::Prismatic if S::BESIDE == 1 => Motion { w: Vec3::ZERO, v: z },
            JointKind::Revolute | JointKind::Ball(_) if S::BESIDE == 1 => {
                Motion { w: z, v: at.cross(z) }
            }
            _ => {
                let v = at.cross(z) * fixed.turns + z * fixed.slides;
                Motion { w: z * fixed.turns, v }
            }
        };
        self.axis.store::<S, W>(i, axis);
        let speed = collect::<S, W>(tree, i, velocity);
        let Motion { w: Vec3([p, q, r]), v: Vec3([x, y, z]) } = axis.scaled(speed);
        self.sums.put(i, [p, q, r, x, y, z, W::ZERO, W::ZERO]);
    }

    /// Rates of the axes, and momenta of the bodies, of the joints that begin with `i`.
    #[inline(always)]
    fn carry<W: Wide<S>, const BALLS: bool>(&mut self, tree: &Tree, poses: &Poses<S>, i: usize) {
        let motion =
            |[p, q, r, x, y, z, ..]: [W; 8]| Motion { w: Vec3([p, q, r]), v: Vec3([x, y, z]) };
        let (axis, twist) = (self.axis.wide::<S, W>(i), motion(self.sums.take(i)));
        self.twist.store::<S, W>(i, twist);
        // What an axis adds to the twist does not move it.
        let carrier = if BALLS { motion(self.carriers.take(i)) } else { twist };
        self.axis_rate.store::<S, W>(i, carrier.cross(axis));
        let rotational = tree.rotational::<S>(i);
        if let Rotational::None = rotational {
            self.sums.put_vectors(i, [Vec3::<W>::ZERO; 3]);
            return;
        }
        let (pose, fixed) = (poses.wide::<W>(i), tree.fixed::<S, W>(i));
        let rotation = pose.rotation();
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
        self.sums.put_vectors(i, [angular, linear, center * fixed.mass]);
    }

    /// Twice the kinetic energy, `Σ v_i J_i·H_i`, of the last [`Momenta::gradient`].
    pub(crate) fn twice_kinetic_energy(&self, tree: &Tree, velocity: &[S]) -> S {
        let mut sum = S::ZERO;
        for (i, joint) in tree.joints.iter().enumerate() {
            sum +=
                velocity[joint.coordinate] * self.axis.get::<S>(i).dot(self.momentum.get::<S>(i));
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
            let (Force { n, f }, origin) = (self.momentum.get(i), poses.origin[i]);
            totals.momentum = totals.momentum.plus(Force { n: n + origin.cross(f), f });
            totals.moment += self.moment.get::<f64>(i) + origin * joint.subtree_mass;
            totals.mass += joint.subtree_mass;
        }
        totals
    }
}
