//! Sites and pushes: derivatives of poses, balances of momentum, and equivalent forces.

use crate::common::{builtin, plant, wave};
use plantd_models::scene::{Constraint, Scene};
use plantd_models::{Initial, InitialError, Pose, StepError};

fn scenes() -> Vec<Scene> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    let mut paths: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let read = |path: &std::path::PathBuf| {
        Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
    };
    let builtins = ["pendulum", "cart-pole", "marionette"].map(builtin);
    paths.iter().map(read).chain(builtins).collect()
}

fn scene(text: &str) -> Scene {
    let head = "format = 1\nname = \"sites\"\ntime_step_s = 0.01\ngravity = [0, 0, 0]\n";
    Scene::from_toml(&format!("{head}{text}")).unwrap_or_else(|e| panic!("{e}"))
}

const FREE: &str = r#"
[[frames]]
name = "hull"
joint = { type = "free" }
body = { mass = 2, inertia = [0.3, 0.4, 0.5] }
[[frames]]
name = "nose"
parent = "hull"
translation = [0.5, 0.1, 0.2]
rotation = { rpy = [0.3, -0.4, 0.5] }
"#;

fn close(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (x, y) in found.iter().zip(expected) {
        assert!((x - y).abs() <= tolerance, "{what}: {found:?} instead of {expected:?}");
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The matrix of a rotation vector, by Rodrigues' formula.
fn matrix(r: [f64; 3]) -> [[f64; 3]; 3] {
    let t = dot(r, r).sqrt();
    let (a, b) = if t < 1e-8 { (1.0, 0.5) } else { (t.sin() / t, (1.0 - t.cos()) / (t * t)) };
    let hat = [[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]];
    [0, 1, 2].map(|i| {
        [0, 1, 2].map(|j| {
            let square: f64 = (0..3).map(|k| hat[i][k] * hat[k][j]).sum();
            f64::from(u8::from(i == j)) + a * hat[i][j] + b * square
        })
    })
}

/// How a frame turned from one pose to one nearby, in world axes, to first order.
fn turn(from: Pose, to: Pose) -> [f64; 3] {
    let (a, b) = (matrix(from.rotation), matrix(to.rotation));
    let product = |i: usize, j: usize| (0..3).map(|k| b[i][k] * a[j][k]).sum::<f64>();
    [
        0.5 * (product(2, 1) - product(1, 2)),
        0.5 * (product(0, 2) - product(2, 0)),
        0.5 * (product(1, 0) - product(0, 1)),
    ]
}

/// The generalized force of a wrench is its power per velocity: finite differences of poses.
#[test]
fn wrenches_are_dual_to_poses() {
    let (force, torque) = ([0.3, -0.7, 0.5], [0.2, 0.4, -0.6]);
    // Small enough for constraints.
    let step = 1e-8;
    for scene in scenes() {
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 5);
        let nd = plant.model().dimensions().dynamic;
        let (model, mut moved) = (plant.model().clone(), plant.clone());
        let (q, v) = (plant.q().to_vec(), vec![0.0; model.dimensions().prescribed]);
        for frame in scene.frames.iter().map(|frame| frame.name.as_str()).chain(["world"]) {
            let site = plant.model().site(frame, [0.1, -0.2, 0.3]).unwrap();
            let mut found = vec![0.0; nd];
            plant.add_wrench(&site, force, torque, &mut found);
            let expected: Vec<f64> = (0..nd)
                .map(|i| {
                    let mut at = |by: f64| {
                        let mut change = vec![0.0; q.len()];
                        change[i] = by;
                        let q = model.retract(&q, &change);
                        let p = vec![0.0; nd];
                        moved.initialize(&Initial::Momentum { q, p, v: v.clone() }).unwrap();
                        moved.pose(&site)
                    };
                    let (before, after) = (at(-step), at(step));
                    let shift = [0, 1, 2].map(|a| after.position[a] - before.position[a]);
                    (dot(shift, force) + dot(turn(before, after), torque)) / (2.0 * step)
                })
                .collect();
            close(&found, &expected, 3e-7, &format!("{}, {frame}", scene.name));
        }
    }
}

#[test]
fn poses_of_a_free_body_are_its_coordinates() {
    let mut plant = plant(&scene(FREE), |_| ());
    let q = [1.0, 2.0, -3.0, 0.4, -1.1, 2.0];
    plant.initialize(&Initial::Momentum { q: q.to_vec(), p: vec![0.0; 6], v: vec![] }).unwrap();
    let model = plant.model().clone();
    let hull = plant.pose(&model.site("hull", [0.0; 3]).unwrap());
    close(&[hull.position, hull.rotation].concat(), &q, 1e-14, "hull");
    let nose = plant.pose(&model.site("nose", [0.0; 3]).unwrap());
    let axes = matrix([q[3], q[4], q[5]]);
    let expected = [0, 1, 2].map(|i| q[i] + dot(axes[i], [0.5, 0.1, 0.2]));
    close(&nose.position, &expected, 1e-14, "nose");
    let world = plant.pose(&model.site("world", [1.0, 2.0, 3.0]).unwrap());
    assert_eq!(world, Pose { position: [1.0, 2.0, 3.0], rotation: [0.0; 3] });
    assert!(model.site("tail", [0.0; 3]).is_none());
}

/// A push changes the momenta of a free body by its impulse and the moment of that.
#[test]
fn pushes_balance_momenta() {
    let mut plant = plant(&scene(FREE), |_| ());
    let (q, v) = (vec![1.0, 2.0, -3.0, 0.4, -1.1, 2.0], vec![0.1, 0.2, 0.3, 1.0, -2.0, 0.5]);
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    let (force, torque, h) = ([30.0, -20.0, 50.0], [7.0, 1.0, -4.0], 0.01);
    let site = plant.model().site("nose", [0.0, 0.1, 0.0]).unwrap();
    let before = plant.diagnose();
    let at = plant.pose(&site).position;
    let mut impulse = vec![0.0; 6];
    plant.add_wrench(&site, force.map(|f| h * f), torque.map(|n| h * n), &mut impulse);
    plant.with_impulse(&impulse, |plant| plant.step(&[])).unwrap();
    let after = plant.diagnose();
    let linear = [0, 1, 2].map(|i| before.linear_momentum[i] + h * force[i]);
    let moment = cross(at, force);
    let angular = [0, 1, 2].map(|i| before.angular_momentum[i] + h * (moment[i] + torque[i]));
    close(&after.linear_momentum, &linear, 1e-14, "linear");
    close(&after.angular_momentum, &angular, 1e-13, "angular");
}

/// A torque about a hinge is its momentum; ten thousand small pushes lose no digits.
#[test]
fn pushes_on_a_hinge_add_up() {
    let hinge = "[[frames]]\nname = \"rod\"\njoint = { type = \"revolute\", axis = [0, 2, 0] }\nbody = { mass = 1, inertia = [1, 1, 1] }";
    let mut plant = plant(&scene(hinge), |_| ());
    plant.initialize(&Initial::Momentum { q: vec![0.3], p: vec![1.0], v: vec![] }).unwrap();
    let site = plant.model().site("rod", [0.0; 3]).unwrap();
    let mut impulse = vec![0.0];
    plant.add_wrench(&site, [5.0, 6.0, 7.0], [1.0, 1e-17, 2.0], &mut impulse);
    assert_eq!(impulse, [1e-17]);
    for _ in 0..10_000 {
        plant.with_impulse(&impulse, |plant| plant.step(&[])).unwrap();
    }
    close(&[plant.p()[0] - 1.0], &[1e-13], 3e-16, "momentum");
}

/// A push that lasts is the wrench in the scene, to first order in the time step.
#[test]
fn a_lasting_push_is_a_force_of_the_scene() {
    let body = FREE.replace("joint = { type = \"free\" }", "joint = { type = \"ball\" }");
    let body = body.replace("body = {", "body = { center_of_mass = [0.2, 0.1, 0.3], ");
    let (force, torque) = ([3.0, -2.0, 5.0], [0.7, 0.1, -0.4]);
    let wrench = format!(
        "{body}\n[[forces]]\ntype = \"hybrid_wrench\"\nframe = \"nose\"\nforce = {force:?}\ntorque = {torque:?}"
    );
    let difference = |h: f64| {
        let mut forced = plant(&scene(&wrench), |s| s.time_step_s = h);
        let mut pushed = plant(&scene(&body), |s| s.time_step_s = h);
        let site = pushed.model().site("nose", [0.0; 3]).unwrap();
        for _ in 0..(0.5 / h).round() as u32 {
            let mut impulse = vec![0.0; 3];
            pushed.add_wrench(&site, force.map(|f| h * f), torque.map(|n| h * n), &mut impulse);
            pushed.with_impulse(&impulse, |plant| plant.step(&[])).unwrap();
            forced.step(&[]).unwrap();
        }
        let change = forced.model().difference(forced.q(), pushed.q());
        change.iter().map(|c| c * c).sum::<f64>().sqrt()
    };
    let (coarse, fine) = (difference(0.002), difference(0.001));
    assert!(fine > 1e-6 && fine < 1e-2, "{fine}");
    assert!((coarse / fine - 2.0).abs() < 0.05, "{coarse} and {fine}");
}

#[test]
fn a_failed_step_gives_the_impulse_back() {
    for scene in scenes() {
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 3);
        let before = plant.snapshot();
        let impulse = vec![0.1; plant.model().dimensions().dynamic];
        let length = plant.model().dimensions().input() + 1;
        let refused = plant.with_impulse(&impulse, |plant| plant.step(&vec![0.0; length]));
        assert!(matches!(refused, Err(StepError::Dimension { .. })));
        assert_eq!(plant.snapshot(), before, "{}", scene.name);
    }
}

/// Energies may be looked at between steps.
#[test]
fn looking_at_the_energy_does_not_change_the_motion() {
    for scene in scenes() {
        let (mut looked, mut plain) = (plant(&scene, |_| ()), plant(&scene, |_| ()));
        for k in 0..20 {
            let u = crate::common::waving_input(&plain, k);
            looked.energy();
            looked.velocity();
            assert_eq!(looked.step(&u).is_ok(), plain.step(&u).is_ok());
            assert_eq!(looked.snapshot(), plain.snapshot(), "{}", scene.name);
        }
    }
}

#[test]
fn a_plant_takes_over_a_state() {
    for scene in scenes() {
        let mut former = plant(&scene, |_| ());
        wave(&mut former, 7);
        let mut same = plant(&scene, |_| ());
        wave(&mut same, 2);
        same.go_on_from(&former).unwrap();
        assert_eq!(same.snapshot(), former.snapshot());
        wave(&mut former, 5);
        wave(&mut same, 5);
        assert_eq!(same.snapshot(), former.snapshot(), "{}", scene.name);
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements/distance.toml");
    let scene = Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap();
    let mut former = plant(&scene, |_| ());
    wave(&mut former, 20);
    // Holds where the scene begins, and not where the former plant has got.
    let mut other = scene;
    for constraint in &mut other.constraints {
        if let Constraint::Distance { a, b, .. } = constraint {
            a.at[2] += 0.1;
            b.at[2] += 0.1;
        }
    }
    let mut other = plant(&other, |_| ());
    let before = other.snapshot();
    assert!(matches!(other.go_on_from(&former), Err(InitialError::OffConstraint { .. })));
    let pendulum = plant(&builtin("pendulum"), |_| ());
    assert!(matches!(other.go_on_from(&pendulum), Err(InitialError::Dimension { .. })));
    assert_eq!(other.snapshot(), before);
}
