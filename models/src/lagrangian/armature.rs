//! Armature: inertia of what a coordinate alone moves, such as a geared rotor.
//!
//! ```text
//! T += ½ a v²    L_v += a v    L_vv += a
//! ```
//!
//! `v` is the coordinate's velocity; of a ball joint that is a component of the angular velocity in its own
//! axes.

use plantd_math::scalar::Scalar;

/// A dynamic coordinate and its armature, kg or kg·m².
pub(crate) type Armature = (usize, f64);

/// Adds `a v` to `L_v`.
pub(crate) fn add_momentum<S: Scalar>(armature: &[Armature], velocity: &[S], l_v: &mut [S]) {
    for &(i, a) in armature {
        l_v[i] += velocity[i] * a;
    }
}

/// `a v²`, J.
pub(crate) fn twice_kinetic_energy(armature: &[Armature], velocity: &[f64]) -> f64 {
    armature.iter().map(|&(i, a)| a * velocity[i] * velocity[i]).sum()
}
