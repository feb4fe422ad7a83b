//! The Lagrangian of a planar tree: momentum recursion and second derivatives with vectors of three
//! numbers, a small part of what [`Momenta`] and [`Curvature`] cost.
//!
//! A twist is `(w, v)`, a wrench `(n, f)`: an angular part and two linear ones, in world axes and about
//! the joint that they belong to. From a joint to its parent, `e` away, a wrench moves by `n += e × f`,
//! and back a twist by `v += w ẑ×e`. About its own joint, with the velocity `v` of the parent's body there,
//!
//! ```text
//! hinge   J = (s, 0)     J̇ = (0, −s ẑ×v)             s = ±1
//! slider  J = (0, d)     J̇ = (0, w_parent ẑ×d)
//!
//! ∂L/∂v = J·H      ∂L/∂q = J̇·H + J·(S×g, m g)       H, S, m: momentum, moment and mass of the subtree
//! F = I J          P = J ×* H + I J̇                 I: inertia of the subtree
//! ```
//!
//! and second derivatives are products of these as in space. Turning by an angle is a complex number.
//!
//! [`Momenta`]: crate::plant::momenta::Momenta
//! [`Curvature`]: crate::plant::curvature::Curvature

mod elimination;

pub(crate) use self::elimination::{Diagonal, Elimination, Of};

use crate::model::Pair;
use crate::planar::PlanarJoint;
use crate::plant::curvature::SecondDerivatives;
use crate::plant::tree_lu::TreeLu;
use crate::scalar::Scalar;
use crate::wide::wide;

/// A vector in the plane.
type Vec2<S = f64> = [S; 2];
/// A twist or a wrench: the angular part first.
type Vec3<S = f64> = [S; 3];

/// A joint at a configuration and velocity.
#[derive(Clone, Copy, Debug, Default)]
struct Link<S = f64> {
    /// From the parent joint to this one.
    edge: Vec2<S>,
    /// Where the joint is, from the origin of the tree; set by [`PlanarTree::differentiate`].
    position: Vec2<S>,
    /// `d` of a slider; zero for a hinge.
    slide: Vec2<S>,
    /// Linear part of `J̇`.
    rate: Vec2<S>,
    /// Twist of the body.
    twist: Vec3<S>,
    /// Momentum of the subtree, and its first moment of mass.
    momentum: Vec3<S>,
    moment: Vec2<S>,
    /// Inertia of the body, and a sum over what hangs from it.
    inertia: S,
    inertia_below: S,
    /// `F`.
    force: Vec3<S>,
    /// `P`.
    slope: Vec3<S>,
    /// `f × g` for the linear part `f` of `F`.
    weight: S,
}

/// A planar tree at a configuration and velocity. The first entry of each list is the world.
#[derive(Clone, Debug)]
pub(crate) struct PlanarTree<S = f64> {
    links: Vec<Link<S>>,
    angles: Vec<S>,
    /// Sine and cosine of the angle of each body.
    directions: Vec<Vec2<S>>,
}

#[inline(always)]
fn cross<S: Scalar>(a: Vec2<S>, b: Vec2<S>) -> S {
    a[0] * b[1] - a[1] * b[0]
}

#[inline(always)]
fn dot<S: Scalar>(a: Vec2<S>, b: Vec2<S>) -> S {
    a[0] * b[0] + a[1] * b[1]
}

#[inline(always)]
fn add<S: Scalar>(a: Vec2<S>, b: Vec2<S>) -> Vec2<S> {
    [a[0] + b[0], a[1] + b[1]]
}

/// `ẑ × v`, times `w`.
#[inline(always)]
fn spun<S: Scalar>(w: S, v: Vec2<S>) -> Vec2<S> {
    [-w * v[1], w * v[0]]
}

/// `v` turned by the angle of which sine and cosine are given.
#[inline(always)]
fn turned<S: Scalar>([s, c]: Vec2<S>, v: Vec2) -> Vec2<S> {
    [c * v[0] - s * v[1], s * v[0] + c * v[1]]
}

/// One turn after the other.
#[inline(always)]
fn combined<S: Scalar>([s, c]: Vec2<S>, [s1, c1]: Vec2<S>) -> Vec2<S> {
    [s * c1 + c * s1, c * c1 - s * s1]
}

#[inline(always)]
fn linear<S: Scalar>(v: Vec3<S>) -> Vec2<S> {
    [v[1], v[2]]
}

impl<S: Scalar> PlanarTree<S> {
    pub(crate) fn new(joints: &[PlanarJoint]) -> Self {
        let n = joints.len() + 1;
        Self {
            links: vec![Link::default(); n],
            angles: vec![S::ZERO; joints.len()],
            directions: vec![[S::ZERO, S::ONE]; n],
        }
    }

    wide! {
        /// Writes `∂L/∂q` and `∂L/∂v` of the dynamic coordinates, the first `l_q.len()` ones, without
        /// springs: two passes over the joints, about 60 flops each beside a sine and a cosine.
        #[inline(never)]
        pub(crate) fn gradient(
            mut self,
            joints: &[PlanarJoint],
            q: &[S],
            velocity: &[S],
            l_q: &mut [S],
            l_v: &mut [S],
        ) = gradient_portable, gradient_avx2;
    }

    #[inline(always)]
    fn gradient_portable(
        &mut self,
        joints: &[PlanarJoint],
        q: &[S],
        velocity: &[S],
        l_q: &mut [S],
        l_v: &mut [S],
    ) {
        for (i, joint) in joints.iter().enumerate() {
            self.angles[i] = q[joint.coordinate] * joint.turn;
        }
        S::sin_cos_of_all(&self.angles, &mut self.directions[1..]);
        let (links, directions) = (&mut self.links[..], &mut self.directions[..]);
        for (i, joint) in joints.iter().enumerate() {
            let (parent, above) = (links[joint.parent].twist, directions[joint.parent]);
            let direction = combined(above, directions[i + 1]);
            directions[i + 1] = direction;
            let (w, rate) = (parent[0], velocity[joint.coordinate]);
            let link = &mut links[i + 1];
            let twist;
            if joint.turn == 0.0 {
                let slide = turned(above, joint.slide);
                let slid = slide.map(|d| d * q[joint.coordinate]);
                link.edge = add(turned(above, joint.offset), slid);
                let v = add(linear(parent), spun(w, link.edge));
                (link.slide, link.rate) = (slide, spun(w, slide));
                twist = [w, v[0] + slide[0] * rate, v[1] + slide[1] * rate];
            } else {
                link.edge = turned(above, joint.offset);
                let v = add(linear(parent), spun(w, link.edge));
                link.rate = spun(S::constant(-joint.turn), v);
                twist = [w + rate * joint.turn, v[0], v[1]];
            }
            let arm = turned(direction, joint.center);
            let f = add(linear(twist), spun(twist[0], arm)).map(|v| v * joint.mass);
            link.twist = twist;
            link.momentum = [twist[0] * joint.inertia + cross(arm, f), f[0], f[1]];
            link.moment = arm.map(|x| x * joint.mass);
            link.inertia = dot(arm, arm) * joint.mass + joint.inertia;
        }
        for (i, joint) in joints.iter().enumerate().rev() {
            let Link { edge, momentum, moment, slide, rate, .. } = links[i + 1];
            let (f, mass) = (linear(momentum), joint.subtree_mass);
            if joint.parent > 0 {
                let parent = &mut links[joint.parent];
                parent.momentum[0] += momentum[0] + cross(edge, f);
                parent.momentum[1] += f[0];
                parent.momentum[2] += f[1];
                parent.moment[0] += moment[0] + edge[0] * mass;
                parent.moment[1] += moment[1] + edge[1] * mass;
            }
            if let (Some(l_q), Some(l_v)) =
                (l_q.get_mut(joint.coordinate), l_v.get_mut(joint.coordinate))
            {
                let (s, g) = (joint.turn, joint.gravity.map(S::constant));
                *l_v = momentum[0] * s + dot(slide, f);
                *l_q = dot(rate, f) + cross(moment, g) * s + dot(slide, g) * mass;
            }
        }
    }

    /// Computes `F` and `P` of each joint at the last gradient.
    #[inline(never)]
    pub(crate) fn differentiate(&mut self, joints: &[PlanarJoint]) {
        let links = &mut self.links[..];
        for (i, joint) in joints.iter().enumerate().rev() {
            let link = &mut links[i + 1];
            let inertia = link.inertia + std::mem::take(&mut link.inertia_below);
            let (edge, moment, slide, rate) = (link.edge, link.moment, link.slide, link.rate);
            let (s, mass, f) = (joint.turn, joint.subtree_mass, linear(link.momentum));
            let turn = S::constant(s);
            let push = add(spun(turn, moment), slide.map(|d| d * mass));
            link.force = [inertia * s + cross(moment, slide), push[0], push[1]];
            let pull = add(spun(turn, f), rate.map(|a| a * mass));
            link.slope = [cross(slide, f) + cross(moment, rate), pull[0], pull[1]];
            link.weight = cross(push, joint.gravity.map(S::constant));
            if joint.parent > 0 {
                links[joint.parent].inertia_below +=
                    inertia + dot(edge, moment) * 2.0 + dot(edge, edge) * mass;
            }
        }
    }

    /// Places the joints, for [`PlanarTree::pair`] and [`PlanarTree::fill_newton_matrix`].
    #[inline(never)]
    pub(crate) fn place(&mut self, joints: &[PlanarJoint]) {
        let links = &mut self.links[..];
        for (i, joint) in joints.iter().enumerate() {
            // The root of a tree is its origin, unless that moves on.
            links[i + 1].position = match joint.parent {
                0 => [S::ZERO; 2],
                parent => add(links[parent].position, links[i + 1].edge),
            };
            if joint.anchor {
                // All joints placed so far in its tree are its ancestors.
                links[i + 1].position = [S::ZERO; 2];
                let mut below = i + 1;
                while joints[below - 1].parent > 0 {
                    let parent = joints[below - 1].parent;
                    let Link { position, edge, .. } = links[below];
                    links[parent].position = [position[0] - edge[0], position[1] - edge[1]];
                    below = parent;
                }
            }
        }
    }

    /// Second derivatives of a pair of joints on one path to the root.
    #[inline(always)]
    pub(crate) fn pair(
        &self,
        joints: &[PlanarJoint],
        ancestor: usize,
        descendant: usize,
    ) -> SecondDerivatives<S> {
        let (above, below) = (&self.links[ancestor + 1], &self.links[descendant + 1]);
        let s = joints[ancestor].turn;
        let arm = [below.position[0] - above.position[0], below.position[1] - above.position[1]];
        let along = |wrench: Vec3<S>| {
            let f = linear(wrench);
            (wrench[0] + cross(arm, f)) * s + dot(above.slide, f)
        };
        SecondDerivatives {
            qq: dot(above.rate, linear(below.slope)) + below.weight * s,
            v_above_q_below: along(below.slope),
            q_above_v_below: dot(above.rate, linear(below.force)),
            vv: along(below.force),
        }
    }
}

impl PlanarTree {
    /// Writes the Jacobian of the residual by the increment, without springs and forces, entry by entry.
    #[inline(never)]
    pub(crate) fn fill_newton_matrix(
        &mut self,
        joints: &[PlanarJoint],
        pairs: &[Pair],
        step: f64,
        matrix: &mut TreeLu,
    ) {
        let (quarter, inverse) = (0.25 * step, 1.0 / step);
        for pair in pairs {
            let second = self.pair(joints, pair.ancestor as usize, pair.descendant as usize);
            let (common, slot) = (quarter * second.qq - inverse * second.vv, pair.slot as usize);
            let skew = 0.5 * (second.q_above_v_below - second.v_above_q_below);
            matrix.upper[slot] = common + skew;
            matrix.lower[slot] = common - skew;
        }
    }
}

#[cfg(test)]
mod tests;
