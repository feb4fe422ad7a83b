//! The gradient of the Lagrangian at a configuration and velocity, by momentum recursion: O(n).
//!
//! ```text
//! root to leaf:  V_i = V_parent + J_i v_i      J̇_i = V_parent × J_i      H_i = I_i V_i
//! leaf to root:  H_parent += H_i
//!                ∂L/∂v_i = J_i · H_i
//!                ∂L/∂q_i = J̇_i · H_i + J_i · W_i      W_i: weight of the subtree
//! ```

use crate::plant::kinematics::Poses;
use crate::spatial::{Force, Motion, Vec3};
use crate::tree::{Body, JointKind, Rotational, Tree, WORLD};

/// Twists and momenta of the joints of a tree.
#[derive(Clone, Debug)]
pub(crate) struct Momenta {
    /// Joint axes `J` as twists.
    pub(crate) axis: Vec<Motion>,
    /// Their rates `J̇`.
    pub(crate) axis_rate: Vec<Motion>,
    twist: Vec<Motion>,
    /// Momentum `H` of each subtree.
    pub(crate) momentum: Vec<Force>,
    /// First moment of mass of each subtree.
    pub(crate) moment: Vec<Vec3>,
}

impl Momenta {
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
    pub(crate) fn gradient(
        &mut self,
        tree: &Tree,
        poses: &Poses,
        velocity: &[f64],
        gravity: Option<Vec3>,
        l_q: &mut [f64],
        l_v: &mut [f64],
    ) {
        self.forward(tree, poses, velocity);
        for (i, joint) in tree.joints.iter().enumerate().rev() {
            let (momentum, moment) = (self.momentum[i], self.moment[i]);
            if joint.parent != WORLD {
                let parent = joint.parent;
                self.momentum[parent] = self.momentum[parent].add_scaled(1.0, momentum);
                self.moment[parent] += moment;
            }
            if let Some(l_v) = l_v.get_mut(joint.coordinate) {
                let axis = self.axis[i];
                *l_v = axis.dot(momentum);
                l_q[joint.coordinate] = self.axis_rate[i].dot(momentum)
                    + gravity.map_or(0.0, |g| {
                        axis.dot(Force { n: moment.cross(g), f: g * joint.subtree_mass })
                    });
            }
        }
    }

    fn forward(&mut self, tree: &Tree, poses: &Poses, velocity: &[f64]) {
        for (i, joint) in tree.joints.iter().enumerate() {
            let direction = poses.axis(i);
            let axis = match joint.kind {
                JointKind::Revolute => {
                    Motion { w: direction, v: poses.position[i].cross(direction) }
                }
                JointKind::Prismatic => Motion { w: Vec3::ZERO, v: direction },
            };
            let parent =
                if joint.parent == WORLD { Motion::default() } else { self.twist[joint.parent] };
            let twist = parent.add_scaled(velocity[joint.coordinate], axis);
            self.axis[i] = axis;
            self.axis_rate[i] = parent.cross(axis);
            self.twist[i] = twist;
            (self.momentum[i], self.moment[i]) = body_momentum(&joint.body, poses, i, twist);
        }
    }

    /// Twice the kinetic energy, `Σ v_i J_i·H_i`, of the last [`Momenta::gradient`].
    pub(crate) fn twice_kinetic_energy(&self, tree: &Tree, velocity: &[f64]) -> f64 {
        let joints = tree.joints.iter().enumerate();
        joints
            .map(|(i, joint)| velocity[joint.coordinate] * self.axis[i].dot(self.momentum[i]))
            .sum()
    }
}

/// Momentum and first moment of mass of one body.
#[inline(always)]
fn body_momentum(body: &Body, poses: &Poses, joint: usize, twist: Motion) -> (Force, Vec3) {
    let rotation = &poses.rotation[joint];
    let spin = match &body.inertia {
        Rotational::None => return (Force::default(), Vec3::ZERO),
        Rotational::Point => Vec3::ZERO,
        Rotational::Isotropic(i) => twist.w * *i,
        Rotational::Full(tensor) => {
            rotation.apply(tensor.apply(rotation.apply_transposed(twist.w)))
        }
    };
    let center = poses.position[joint] + rotation.apply(body.center);
    let linear = (twist.v + twist.w.cross(center)) * body.mass;
    (Force { n: center.cross(linear) + spin, f: linear }, center * body.mass)
}
