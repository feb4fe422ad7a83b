//! The gradient of the Lagrangian at a configuration and velocity, by momentum recursion: O(n).
//!
//! ```text
//! root to leaf:  V_i = V_parent + J_i v_i      J̇_i = V_parent × J_i      H_i = I_i V_i
//! leaf to root:  H_parent += H_i
//!                ∂L/∂v_i = J_i · H_i
//!                ∂L/∂q_i = J̇_i · H_i + J_i · W_i      W_i: weight of the subtree
//! ```

use plantd_math::scalar::{Scalar, in_registers};
use plantd_math::spatial::{Force, Motion, Sym3, Vec3};

use crate::lagrangian::kinematics::Poses;
use crate::model::tree::{Body, JointKind, Rotational, Tree, WORLD};

/// Twists and momenta of the joints of a tree.
#[derive(Clone, Debug)]
pub(crate) struct Momenta<S = f64> {
    /// Joint axes `J` as twists.
    pub(crate) axis: Vec<Motion<S>>,
    /// Their rates `J̇`.
    pub(crate) axis_rate: Vec<Motion<S>>,
    /// Twists `V`.
    pub(crate) twist: Vec<Motion<S>>,
    /// Momentum `H` of each subtree.
    pub(crate) momentum: Vec<Force<S>>,
    /// First moment of mass of each subtree.
    pub(crate) moment: Vec<Vec3<S>>,
}

impl<S: Scalar> Momenta<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        Self {
            axis: vec![Motion::default(); n],
            axis_rate: vec![Motion::default(); n],
            twist: vec![Motion::default(); n],
            momentum: vec![Force::default(); n],
            moment: vec![Vec3::ZERO; n],
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
        in_registers!(S, {
            if tree.has_other_joints {
                self.forward::<true>(tree, poses, velocity);
            } else {
                self.forward::<false>(tree, poses, velocity);
            }
            let (axes, rates) = (&self.axis[..], &self.axis_rate[..]);
            let (momenta, moments) = (&mut self.momentum[..], &mut self.moment[..]);
            for (i, joint) in tree.joints.iter().enumerate().rev() {
                let (momentum, moment) = (momenta[i], moments[i]);
                if joint.parent != WORLD {
                    let parent = joint.parent;
                    momenta[parent] = momenta[parent].plus(momentum);
                    moments[parent] += moment;
                }
                if let Some(l_v) = l_v.get_mut(joint.coordinate) {
                    let axis = axes[i];
                    *l_v = axis.dot(momentum);
                    l_q[joint.coordinate] = rates[i].dot(momentum)
                        + gravity.map_or(S::ZERO, |g| {
                            let (g, mass) = (Vec3::lift(g), joint.subtree_mass);
                            axis.dot(Force { n: moment.cross(g), f: g.scaled(mass) })
                        });
                }
            }
        })
    }

    /// `OTHER`: some joint is neither revolute nor prismatic.
    #[inline(always)]
    fn forward<const OTHER: bool>(&mut self, tree: &Tree, poses: &Poses<S>, velocity: &[S]) {
        let (axes, rates, twists) =
            (&mut self.axis[..], &mut self.axis_rate[..], &mut self.twist[..]);
        let (momenta, moments) = (&mut self.momentum[..], &mut self.moment[..]);
        for (i, joint) in tree.joints.iter().enumerate() {
            let direction = poses.axis(i);
            let turning = |v| Motion { w: direction, v };
            let axis = match joint.kind {
                JointKind::Revolute => turning(poses.position[i].cross(direction)),
                JointKind::Ball(_) if OTHER => turning(poses.position[i].cross(direction)),
                JointKind::Screw(pitch) if OTHER => {
                    turning(poses.position[i].cross(direction) + direction.scaled(pitch))
                }
                _ => Motion { w: Vec3::ZERO, v: direction },
            };
            let twist_of = |joint| if joint == WORLD { Motion::default() } else { twists[joint] };
            let parent = twist_of(joint.parent);
            let twist = parent.add_scaled(velocity[joint.coordinate], axis);
            rates[i] = match joint.kind {
                // The axes of a ball are carried by what the whole joint hangs from.
                JointKind::Ball(entry) if OTHER => {
                    twist_of(tree.joints[i - entry].parent).cross(axis)
                }
                _ => parent.cross(axis),
            };
            axes[i] = axis;
            twists[i] = twist;
            (momenta[i], moments[i]) = body_momentum(&joint.body, poses, i, twist);
        }
    }

    /// Twice the kinetic energy, `Σ v_i J_i·H_i`, of the last [`Momenta::gradient`].
    pub(crate) fn twice_kinetic_energy(&self, tree: &Tree, velocity: &[S]) -> S {
        let mut sum = S::ZERO;
        for (i, joint) in tree.joints.iter().enumerate() {
            sum += velocity[joint.coordinate] * self.axis[i].dot(self.momentum[i]);
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
            let (Force { n, f }, origin) = (self.momentum[i], poses.origin[i]);
            totals.momentum = totals.momentum.plus(Force { n: n + origin.cross(f), f });
            totals.moment += self.moment[i] + origin * joint.subtree_mass;
            totals.mass += joint.subtree_mass;
        }
        totals
    }
}

/// Momentum and first moment of mass of one body.
#[inline(always)]
fn body_momentum<S: Scalar>(
    body: &Body,
    poses: &Poses<S>,
    joint: usize,
    twist: Motion<S>,
) -> (Force<S>, Vec3<S>) {
    let rotation = &poses.rotation[joint];
    let spin = match &body.inertia {
        Rotational::None => return (Force::default(), Vec3::ZERO),
        Rotational::Point => Vec3::ZERO,
        Rotational::Isotropic(i) => twist.w.scaled(*i),
        Rotational::Full(tensor) => {
            rotation.apply(Sym3::lift(*tensor).apply(rotation.apply_transposed(twist.w)))
        }
    };
    let center = poses.position[joint] + rotation.apply(Vec3::lift(body.center));
    let linear = (twist.v + twist.w.cross(center)).scaled(body.mass);
    (Force { n: center.cross(linear) + spin, f: linear }, center.scaled(body.mass))
}
