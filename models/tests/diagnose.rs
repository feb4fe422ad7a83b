//! What is said of a plant agrees with what is conserved and with closed forms.

use crate::common::{builtin, floating, plant, wave};
use plantd_models::{Initial, Plant};

fn close(x: [f64; 3], y: [f64; 3], tolerance: f64) -> bool {
    x.iter().zip(y).all(|(x, y)| (x - y).abs() <= tolerance)
}

/// A floating body in general motion; no gravity, no damping.
fn in_motion(time_step_s: f64) -> Plant {
    let mut plant = plant(&floating(), |s| s.time_step_s = time_step_s);
    let q = plant.q().to_vec();
    let v = (0..q.len()).map(|i| 0.8 * (1.0 + i as f64).sin()).collect();
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    plant
}

/// Linear momentum is conserved exactly, angular momentum too: chained hinges are a chart of the
/// rotations, so the discrete symmetry is the turn about the vertical alone; the other components
/// follow to the order of the method.
#[test]
fn momenta_of_a_floating_body() {
    let mut plant = in_motion(0.02);
    let start = plant.diagnose();
    assert!(start.angular_momentum.iter().all(|l| l.abs() > 0.05), "{start:?}");
    assert!((start.mass_kg - 4.6).abs() < 1e-14);
    for _ in 0..500 {
        plant.step(&[]).unwrap();
    }
    let end = plant.diagnose();
    assert!(close(start.linear_momentum, end.linear_momentum, 1e-12), "{start:?} {end:?}");
    let turn = [0.0, 0.0, start.angular_momentum[2]];
    assert!(close(turn, [0.0, 0.0, end.angular_momentum[2]], 1e-12), "{start:?} {end:?}");
    assert!(close(start.angular_momentum, end.angular_momentum, 2e-2), "{start:?} {end:?}");
    assert_eq!(end.degrees_of_freedom, 8);
    assert_eq!(end.constraint_reciprocal_condition, 1.0);
    let energy = |d: &plantd_models::Diagnostics| d.energy.kinetic_j + d.energy.potential_j;
    assert!((energy(&start) - energy(&end)).abs() < 1e-2);
}

/// Total momentum is mass times the velocity of the centre of mass, which goes straight on.
#[test]
fn the_center_of_mass_moves_with_the_momentum() {
    let mut plant = in_motion(0.002);
    let h = plant.settings().time_step_s;
    let mut before = plant.diagnose();
    for _ in 0..200 {
        plant.step(&[]).unwrap();
        let now = plant.diagnose();
        for i in 0..3 {
            let speed = (now.center_of_mass[i] - before.center_of_mass[i]) / h;
            let expected = now.linear_momentum[i] / now.mass_kg;
            assert!((speed - expected).abs() < 1e-4, "{speed} instead of {expected}");
        }
        before = now;
    }
}

/// A pendulum in closed form.
#[test]
fn a_pendulum_in_closed_form() {
    let mut plant = plant(&builtin("pendulum"), |_| ());
    let body = plant.model().scene().frames[0].body.clone().unwrap();
    let (mass, length) = (body.mass, body.center_of_mass[1].abs());
    let (angle, rate) = (0.7_f64, 1.3);
    plant.initialize(&Initial::Velocity { q: vec![angle], v: vec![rate] }).unwrap();
    let found = plant.diagnose();
    let (sin, cos) = angle.sin_cos();
    let center = [length * sin, -length * cos, 0.0];
    let velocity = [length * rate * cos, length * rate * sin, 0.0];
    assert!(close(found.center_of_mass, center, 1e-15), "{found:?}");
    assert!(close(found.linear_momentum, velocity.map(|v| mass * v), 1e-14), "{found:?}");
    assert!(close(found.angular_momentum, [0.0, 0.0, mass * length * length * rate], 1e-14));
    assert_eq!((found.degrees_of_freedom, found.constraint_rank), (1, 0));
    assert!((found.mass_matrix_reciprocal_condition - 1.0).abs() < 1e-15);
}

/// Diagnosing leaves no trace.
#[test]
fn a_diagnosis_does_not_disturb() {
    for name in ["marionette", "four-bar", "chain-4"] {
        let (mut plain, mut watched) =
            (plant(&builtin(name), |_| ()), plant(&builtin(name), |_| ()));
        for _ in 0..20 {
            wave(&mut plain, 1);
            let found = watched.diagnose();
            assert!(found.constraint_reciprocal_condition > 1e-6, "{name}: {found:?}");
            assert!(found.mass_matrix_reciprocal_condition > 1e-6, "{name}: {found:?}");
            let q = watched.q().to_vec();
            watched.newton_matrix(&q, &q);
            wave(&mut watched, 1);
            assert_eq!(plain.state(), watched.state(), "{name}");
        }
    }
}

/// Forces of the marionette's strings carry its weight while it hangs still.
#[test]
fn multipliers_are_forces() {
    let mut plant = plant(&builtin("marionette"), |_| ());
    let q = plant.q().to_vec();
    plant.initialize(&Initial::Equilibrium { q, hold: vec![], inputs: vec![] }).unwrap();
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    plant.step(&u).unwrap();
    let found = plant.diagnose();
    // `Dhᵀ λ/h` on the vertical slide of the torso.
    let z = plant.model().coordinate_index("torso_z").unwrap();
    let dh = plant.constraint_jacobian();
    let lift: f64 = (0..dh.nrows()).map(|c| -dh[(c, z)] * found.constraint_forces[c]).sum();
    let weight = 9.8 * found.mass_kg;
    assert!((lift / weight - 1.0).abs() < 1e-9, "{lift} N instead of {weight}");
}

/// A free body on a free joint: momentum of flight, and of spin to round-off.
#[test]
fn momenta_of_a_free_joint() {
    let text = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "box"
[[frames]]
name = "box"
joint = { type = "free" }
body = { mass = 2.0, center_of_mass = [0.02, -0.01, 0.03], inertia = [0.02, 0.03, 0.045, 1e-3, 2e-3, -1e-3] }
"#;
    let mut plant = plant(&plantd_models::Scene::from_toml(text).unwrap(), |_| ());
    let q = vec![1.0, 2.0, 3.0, 0.4, -0.7, 1.1];
    let v = vec![0.5, -0.3, 0.2, 1.0, 4.0, -2.0];
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    let start = plant.diagnose();
    for _ in 0..1000 {
        plant.step(&[]).unwrap();
    }
    let end = plant.diagnose();
    assert!(start.angular_momentum.iter().all(|l| l.abs() > 1e-2), "{start:?}");
    assert!(close(start.linear_momentum, end.linear_momentum, 1e-12), "{start:?} {end:?}");
    assert!(close(start.angular_momentum, end.angular_momentum, 1e-11), "{start:?} {end:?}");
    // The centre of mass has gone straight on.
    let time_s = plant.time_s();
    for i in 0..3 {
        let travelled = end.center_of_mass[i] - start.center_of_mass[i];
        assert!((travelled - start.linear_momentum[i] / 2.0 * time_s).abs() < 1e-3, "{end:?}");
    }
    assert_eq!(end.degrees_of_freedom, 6);
}
