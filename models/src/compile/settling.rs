//! Stiffness and damping of stops that say how deep and how fast they settle.
//!
//! With the inertia `m` of the coordinate at the initial configuration, all other coordinates held, the stop
//! is critically damped beyond its transition:
//!
//! ```text
//! ω = 5.834 / settling_time_s,  stiffness = m ω²,  damping = 2 m ω,  transition = settling_depth
//! ```
//!
//! so that `(1 + ω t) e^(−ω t)` has fallen to a fiftieth at `settling_time_s`.

use plantd_scene::{Scene, Spring};

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;

/// `ω t` at which `(1 + ω t) e^(−ω t)` is a fiftieth.
const SETTLED: f64 = 5.834;

/// The scene with stiffness and damping in place of settling times, if it has any; `model` is that of the
/// scene without these stops.
pub(super) fn stated(scene: &Scene, model: &Model) -> Option<Scene> {
    let settles = |spring: &Spring| matches!(spring, Spring::Stop { settling_time_s: Some(_), .. });
    if !scene.springs.iter().any(settles) {
        return None;
    }
    let mut scene = scene.clone();
    for spring in &mut scene.springs {
        let Spring::Stop {
            coordinate: Some(name),
            stiffness,
            damping,
            transition,
            settling_depth: depth @ Some(_),
            settling_time_s: time @ Some(_),
            ..
        } = spring
        else {
            continue;
        };
        let Some(i) = model.coordinate_index(name) else { continue };
        let (inertia, rate) = (inertia(model, i), SETTLED / time.take().unwrap_or(1.0));
        *stiffness = Some(inertia * rate * rate);
        *damping = Some(2.0 * inertia * rate);
        *transition = depth.take();
    }
    Some(scene)
}

/// Inertia of a dynamic coordinate at the initial configuration, all others held.
fn inertia(model: &Model, i: usize) -> f64 {
    let tree = &model.dynamics;
    let q: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
    let mut velocity = vec![0.0; q.len()];
    velocity[i] = 1.0;
    let (mut poses, mut momenta) = (Poses::new(tree), Momenta::new(tree));
    let [mut l_q, mut l_v] = [0; 2].map(|_| vec![0.0; model.dimensions.dynamic]);
    poses.evaluate(tree, &q, &orientations(model, &q));
    momenta.gradient(tree, &poses, &velocity, None, &mut l_q, &mut l_v);
    model.armature.add_momentum(&velocity, &mut l_v);
    l_v[i]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rod of 2 kg·m² about its hinge, 1.5 of its body and 0.5 of its rotor.
    #[test]
    fn a_held_coordinate_settles_in_time() {
        let text = "format = 1\nname = \"rod\"\ngravity = [0, 0, 0]\n[[frames]]\nname = \"rod\"\njoint = { type = \"revolute\", axis = [0, 0, 1] }\nbody = { mass = 1, center_of_mass = [1, 0, 0], inertia = [0.5, 0.5, 0.5] }\n[[coordinates]]\nname = \"rod\"\narmature = 0.5\nlimits = [-1, 1]\n[[springs]]\ntype = \"stop\"\ncoordinate = \"rod\"\nsettling_depth = 0.01\nsettling_time_s = 0.5\n";
        let scene = Scene::from_toml(text).unwrap();
        let model = Model::compile(&scene).unwrap();
        assert_eq!(model.scene, scene);
        let stated = stated(&scene, &model).unwrap();
        let [Spring::Stop { stiffness, damping, transition, settling_time_s: None, .. }] =
            &stated.springs[..]
        else {
            panic!("{stated:?}");
        };
        let rate = 5.834 / 0.5;
        assert!((stiffness.unwrap() - 2.0 * rate * rate).abs() < 1e-9, "{stiffness:?}");
        assert!((damping.unwrap() - 4.0 * rate).abs() < 1e-12, "{damping:?}");
        assert_eq!(*transition, Some(0.01));
        assert!(((1.0 + SETTLED) * (-SETTLED).exp() - 0.02).abs() < 1e-4);
        let crate::model::mechanism::Spring::Stop(stop) = &model.potentials.springs[0] else {
            panic!("{:?}", model.potentials);
        };
        assert_eq!(Some(stop.stop.stiffness), *stiffness);
    }
}
