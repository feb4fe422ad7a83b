//! Kinetic and potential energy.

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::mechanism::Model;

/// Kinetic and potential energy, with poses and momenta evaluated at `q` and `velocity`.
pub(crate) fn energy(
    model: &Model,
    (poses, momenta): (&Poses, &Momenta),
    q: &[f64],
    velocity: &[f64],
) -> Energy {
    let twice_kinetic = momenta.twice_kinetic_energy(&model.dynamics, velocity)
        + model.armature.twice_kinetic_energy(velocity);
    Energy {
        kinetic_j: 0.5 * twice_kinetic,
        potential_j: potential_energy(model, poses, momenta, q),
    }
}

/// Potential energy of gravity and springs, with poses and momenta evaluated at `q`.
pub(crate) fn potential_energy(model: &Model, poses: &Poses, momenta: &Momenta, q: &[f64]) -> f64 {
    let tree = &model.dynamics;
    let roots = tree.joints.iter().enumerate().filter(|(i, joint)| joint.root == *i);
    let weight: f64 = roots
        .map(|(i, root)| {
            let moment = momenta.moment_of(tree, i) + poses.origin[i] * root.subtree_mass;
            model.gravity.map_or(0.0, |g| g.dot(moment))
        })
        .sum();
    model.spring_energy(poses, q) - weight
}

/// Kinetic and potential energy, J.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    /// `T(q, v)`.
    pub kinetic_j: f64,
    /// Gravity and springs.
    pub potential_j: f64,
}
