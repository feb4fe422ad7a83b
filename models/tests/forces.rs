//! Forces: closed forms, balances of momentum and power, and their derivatives.

use crate::common::{SPLITS, forced_tree, plant, wave, waving_input};
use plantd_models::scene::Scene;
use plantd_models::{ForceSplit, Initial, Plant};

fn scene(text: &str) -> Scene {
    let head = "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"forces\"\ntime_step_s = 0.01\n";
    Scene::from_toml(&format!("{head}{text}")).unwrap_or_else(|e| panic!("{e}"))
}

/// A body of 2 kg that slides along x, y and z and turns about all axes, in gravity or without.
const FLYING: &str = r#"
[[frames]]
name = "x"
joint = { type = "prismatic", axis = [1, 0, 0] }
[[frames]]
name = "y"
parent = "x"
joint = { type = "prismatic", axis = [0, 1, 0] }
[[frames]]
name = "z"
parent = "y"
joint = { type = "prismatic", axis = [0, 0, 1] }
[[frames]]
name = "yaw"
parent = "z"
joint = { type = "revolute", axis = [0, 0, 1] }
[[frames]]
name = "pitch"
parent = "yaw"
joint = { type = "revolute", axis = [0, 1, 0] }
[[frames]]
name = "hull"
parent = "pitch"
joint = { type = "revolute", axis = [1, 0, 0], coordinate = "roll" }
body = { mass = 2, inertia = [0.3, 0.4, 0.5] }
[[frames]]
name = "nose"
parent = "hull"
translation = [0.5, 0.1, 0.2]
rotation = { rpy = [0.3, -0.4, 0.5] }
"#;

fn flying(force: &str) -> Scene {
    scene(&format!("{FLYING}\n[[forces]]\n{force}"))
}

fn coast(plant: &mut Plant, steps: usize) {
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    for _ in 0..steps {
        plant.step(&u).unwrap();
    }
}

fn total_energy(plant: &mut Plant) -> f64 {
    let energy = plant.energy();
    energy.kinetic_j + energy.potential_j
}

fn start(plant: &mut Plant, v: &[f64]) {
    let q = plant.q().to_vec();
    plant.initialize(&Initial::Velocity { q, v: v.to_vec() }).unwrap();
}

fn close(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (x, y) in found.iter().zip(expected) {
        assert!((x - y).abs() <= tolerance, "{what}: {found:?} instead of {expected:?}");
    }
}

/// A constant force gives exactly impulse = force · time; in world axes it keeps its direction while
/// the body turns, in the body's axes it turns as well.
#[test]
fn impulse_is_force_times_time() {
    let force = [0.3, -0.2, 0.5];
    for split in SPLITS {
        for kind in ["hybrid_wrench", "spatial_wrench"] {
            let text = format!("type = \"{kind}\"\nframe = \"nose\"\nforce = {force:?}");
            let mut plant = plant(&flying(&text), |s| s.force_split = split);
            start(&mut plant, &[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
            let before = plant.p().to_vec();
            coast(&mut plant, 200);
            let expected: Vec<f64> = (0..3).map(|i| before[i] + 2.0 * force[i]).collect();
            close(&plant.p()[..3], &expected, 1e-13, kind);
        }
    }
    let body = "type = \"body_wrench\"\nframe = \"hull\"\nforce = [1, 0, 0]";
    let mut plant = plant(&flying(body), |_| ());
    // Half a turn about z in a second, at rest in the body's axes otherwise.
    start(&mut plant, &[0.0, 0.0, 0.0, std::f64::consts::PI, 0.0, 0.0]);
    coast(&mut plant, 100);
    // ∫ (cos πt, sin πt) dt = (0, 2/π).
    close(&plant.p()[..3], &[0.0, 2.0 / std::f64::consts::PI, 0.0], 1e-4, "body");
}

/// The moment of a force: at rest, `p[1]` of turns is the arm times the impulse.
#[test]
fn moments_are_those_of_the_point_of_action() {
    // The hull's origin at (1, 2, 3) + nose (0.5, 0.1, 0.2), unturned. Torque about the nose or the
    // world's origin.
    let at = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0];
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let (f, n) = ([0.3, -0.2, 0.5], [0.7, 0.1, -0.4]);
    let arm = |kind| if kind == "spatial_wrench" { [-1.0, -2.0, -3.0] } else { [0.5, 0.1, 0.2] };
    for kind in ["spatial_wrench", "hybrid_wrench"] {
        let text = format!("type = \"{kind}\"\nframe = \"nose\"\nforce = {f:?}\ntorque = {n:?}");
        let mut plant = plant(&flying(&text), |s| s.time_step_s = 1e-6);
        plant
            .initialize(&Initial::Momentum { q: at.to_vec(), p: vec![0.0; 6], v: vec![] })
            .unwrap();
        coast(&mut plant, 1);
        let moment = cross(arm(kind), f);
        let about = [0, 1, 2].map(|i| (moment[i] + n[i]) * 1e-6);
        // Coordinates: x, y, z, then turns about z, y and x.
        let expected = [f[0] * 1e-6, f[1] * 1e-6, f[2] * 1e-6, about[2], about[1], about[0]];
        close(plant.p(), &expected, 1e-16, kind);
    }
}

/// A thruster is a body wrench along its axis.
#[test]
fn a_thruster_is_a_body_wrench() {
    let input = "[[inputs]]\nname = \"thrust\"\n[[forces]]\n";
    let thruster =
        "type = \"thruster\"\nframe = \"nose\"\naxis = [0, 0, 2]\ninput = \"thrust\"\ngain = 3";
    let wrench = "type = \"body_wrench\"\nframe = \"nose\"\nforce = [0, 0, \"thrust\"]";
    let mut thruster = plant(&scene(&format!("{FLYING}\n{input}{thruster}")), |_| ());
    let mut wrench = plant(&scene(&format!("{FLYING}\n{input}{wrench}")), |_| ());
    for k in 0..200 {
        let thrust = (0.05 * f64::from(k)).sin();
        thruster.step(&[thrust]).unwrap();
        wrench.step(&[3.0 * thrust]).unwrap();
    }
    assert!(thruster.q().iter().all(|q| q.abs() > 1e-3));
    close(thruster.q(), wrench.q(), 1e-12, "thruster");
}

/// Two bodies that fly, with a damper between points off their centres.
fn dampened(law: &str) -> Scene {
    let other = FLYING
        .replace("name = \"", "name = \"second-")
        .replace("parent = \"", "parent = \"second-")
        .replace("coordinate = \"", "coordinate = \"second-")
        .replace("mass = 2", "mass = 3");
    scene(&format!("{FLYING}\n{other}\n{law}"))
}

const DAMPER: &str = r#"
[[coordinates]]
name = "second-x"
initial = 2.0
[[coordinates]]
name = "second-z"
initial = 0.8
[[forces]]
type = "two_point_damper"
a = { frame = "nose", at = [0.1, 0.2, 0.3] }
b = { frame = "second-nose", at = [0.0, -0.2, 0.1] }
damping = 4.0
"#;

/// Linear momentum is conserved to round-off, angular momentum too with the symmetric split, and
/// energy only goes.
#[test]
fn a_damper_between_two_bodies_conserves_momentum_and_takes_energy() {
    for split in SPLITS {
        let mut plant = plant(&dampened(DAMPER), |s| {
            (s.force_split, s.time_step_s) = (split, 0.002);
        });
        let mut v: Vec<f64> = (0..12).map(|i| (1.0 + f64::from(i)).sin()).collect();
        // They pass each other.
        (v[0], v[6]) = (1.0, -2.0);
        start(&mut plant, &v);
        let momentum = |plant: &Plant| {
            let (q, p) = (plant.q(), plant.p());
            let linear = |i: usize| p[i] + p[6 + i];
            // About z: the yaw joints' momenta are the bodies' own angular momenta about z.
            let turn = |b: usize| q[b] * p[b + 1] - q[b + 1] * p[b] + p[b + 3];
            [linear(0), linear(1), linear(2), turn(0) + turn(6)]
        };
        let before = momentum(&plant);
        let first = total_energy(&mut plant);
        let mut last = first;
        for k in 0..1000 {
            coast(&mut plant, 1);
            let energy = total_energy(&mut plant);
            // What the midpoint rule itself lets the energy of a turning body swing by.
            assert!(energy < last + 2e-4 * first, "{split:?} step {k}: {last} J, then {energy} J");
            last = energy;
        }
        assert!(last < 0.9 * first, "it took nothing: {first} J, {last} J");
        // The paper's split lets a force act where the step starts, not at its middle.
        let conserved = if split == ForceSplit::Symmetric { 4 } else { 3 };
        close(&momentum(&plant)[..conserved], &before[..conserved], 2e-12, "momentum");
    }
}

/// `dE/dt` is the power of the forces: the balance closes with the square of the step.
#[test]
fn energy_follows_the_power_of_forces() {
    // Sliding alone: the points' velocities are those of the bodies.
    let damper = r#"
[[frames]]
name = "a"
joint = { type = "prismatic", axis = [1, 0, 0] }
body = { mass = 1 }
[[frames]]
name = "b"
translation = [0, 1, 0]
joint = { type = "prismatic", axis = [1, 0.5, 0] }
body = { mass = 2 }
[[forces]]
type = "two_point_damper"
a = { frame = "a" }
b = { frame = "b" }
damping = 2.0
[[forces]]
type = "drag"
frame = "b"
coefficient = 0.4
[[forces]]
type = "friction"
coordinate = "a"
force = 0.3
velocity = 0.2
[[forces]]
type = "coordinate_drag"
coordinate = "a"
coefficient = 0.1
[[forces]]
type = "hybrid_wrench"
frame = "b"
force = [0.2, 0.7, 0]
"#;
    let e = 1.0 / 1.25_f64.sqrt();
    let power = |q: &[f64], v: &[f64]| {
        let d = [q[0] - e * q[1], -1.0 - 0.5 * e * q[1]];
        let rate = [v[0] - e * v[1], -0.5 * e * v[1]];
        let length_rate = (d[0] * rate[0] + d[1] * rate[1]) / d[0].hypot(d[1]);
        let friction = 0.3 * (v[0] / 0.2).tanh() * v[0];
        let push = (0.2 * e + 0.7 * 0.5 * e) * v[1];
        push - 2.0 * length_rate * length_rate
            - 0.4 * v[1].abs().powi(3)
            - friction
            - 0.1 * v[0].abs().powi(3)
    };
    let gap = |h: f64| {
        let mut plant = plant(&scene(damper), |s| s.time_step_s = h);
        start(&mut plant, &[1.5, -0.8]);
        let first = total_energy(&mut plant);
        let mut work = 0.0;
        for _ in 0..(1.0 / h).round() as usize {
            let q0 = plant.q().to_vec();
            coast(&mut plant, 1);
            let q: Vec<_> = plant.q().iter().zip(&q0).map(|(a, b)| 0.5 * (a + b)).collect();
            let v: Vec<_> = plant.q().iter().zip(&q0).map(|(a, b)| (a - b) / h).collect();
            work += h * power(&q, &v);
        }
        let change = total_energy(&mut plant) - first;
        assert!(change < -0.3, "{change}");
        (change - work).abs()
    };
    let (coarse, fine) = (gap(0.02), gap(0.01));
    assert!(fine < 3e-5 && fine < 0.3 * coarse + 1e-13, "{coarse:e}, {fine:e}");
}

/// `m dv/dt = −c v²`: `v = v0 / (1 + c v0 t / m)`.
#[test]
fn drag_follows_its_closed_form() {
    let slider = "[[frames]]\nname = \"s\"\njoint = { type = \"prismatic\", axis = [1, 2, 2] }\nbody = { mass = 2 }\n[[forces]]\n";
    for law in ["type = \"drag\"\nframe = \"s\"", "type = \"coordinate_drag\"\ncoordinate = \"s\""]
    {
        let text = format!("{slider}{law}\ncoefficient = 0.6");
        let mut plant = plant(&scene(&text), |s| s.time_step_s = 1e-3);
        start(&mut plant, &[3.0]);
        coast(&mut plant, 1000);
        assert!((plant.p()[0] - 6.0 / 1.9).abs() < 1e-6, "{law}: {:?}", plant.p());
    }
}

/// Sliding slows down at `force / mass`, and then creeps.
#[test]
fn friction_brings_to_rest() {
    let text = "[[frames]]\nname = \"s\"\njoint = { type = \"prismatic\", axis = [1, 0, 0] }\nbody = { mass = 2 }\n[[forces]]\ntype = \"friction\"\ncoordinate = \"s\"\nforce = 3.0\nvelocity = 1e-3";
    let mut plant = plant(&scene(text), |_| ());
    start(&mut plant, &[1.5]);
    coast(&mut plant, 50);
    assert!((plant.p()[0] - 1.5).abs() < 1e-9, "{:?}", plant.p());
    coast(&mut plant, 450);
    let rest = plant.q()[0];
    coast(&mut plant, 100);
    assert!((plant.q()[0] - rest).abs() < 1e-3 && (rest - 0.75).abs() < 0.01, "{rest}");
}

/// Where a damper's ends coincide and where nothing moves there is no force, and no NaN.
#[test]
fn forces_are_finite_where_they_have_no_direction() {
    let text = r#"
[[frames]]
name = "a"
joint = { type = "revolute", axis = [0, 1, 0] }
body = { mass = 1, center_of_mass = [0, 0, -1] }
[[frames]]
name = "b"
parent = "a"
translation = [0, 0, -1]
joint = { type = "revolute", axis = [0, 1, 0] }
body = { mass = 1, center_of_mass = [0, 0, 1] }
[[forces]]
type = "two_point_damper"
a = { frame = "b", at = [0, 0, 1] }
b = { frame = "world" }
damping = 1.0
[[forces]]
type = "drag"
frame = "b"
at = [0, 0, 1]
coefficient = 1.0
[[forces]]
type = "friction"
coordinate = "b"
force = 1.0
velocity = 0.1
"#;
    let mut plant = plant(&scene(text), |_| ());
    let mut out = plantd_models::Linearization::new(&plant.model().clone());
    plant.step_and_linearize(&[], &mut out).unwrap();
    assert!(out.a().iter().all(|x| x.is_finite()));
    close(plant.q(), &[0.0, 0.0], 0.0, "rest");
}

/// Oblique joints, prescribed joints inside, forces of every kind.
#[test]
fn derivatives_of_forces() {
    let mut kinds = 0;
    for seed in 100..124 {
        let scene = forced_tree(seed);
        kinds += scene.forces.len();
        crate::common::linearization::check_within(&scene, 0.02);
    }
    assert!(kinds > 150, "{kinds}");
    crate::common::linearization::check_within(&dampened(DAMPER), 0.02);
}

/// Every force alone, on the body that flies: what goes wrong has a name.
#[test]
fn derivatives_of_each_force() {
    let vectors = "force = [0.3, \"u\", 0.5]\ntorque = [\"u\", 0.2, 0.1]";
    for force in [
        format!("type = \"body_wrench\"\nframe = \"nose\"\n{vectors}"),
        format!("type = \"spatial_wrench\"\nframe = \"nose\"\n{vectors}"),
        format!("type = \"hybrid_wrench\"\nframe = \"nose\"\n{vectors}"),
        "type = \"drag\"\nframe = \"nose\"\nat = [0.1, 0.2, 0.3]\ncoefficient = 2".to_owned(),
        "type = \"two_point_damper\"\na = { frame = \"nose\" }\nb = { frame = \"world\", at = [3, 2, 1] }\ndamping = 2".to_owned(),
    ] {
        let input = if force.contains("\"u\"") { "[[inputs]]\nname = \"u\"\n" } else { "" };
        let mut scene = scene(&format!("{FLYING}\n{input}[[forces]]\n{force}"));
        scene.gravity = Some([1.0, -3.0, -9.0]);
        crate::common::linearization::check_within(&scene, 0.02);
    }
}

/// The same motion in a world that is moved, and steps that start from other guesses.
#[test]
fn forces_follow_the_state_alone() {
    for seed in 100..108 {
        let scene = forced_tree(seed);
        let mut first = plant(&scene, |s| s.force_split = ForceSplit::Symmetric);
        wave(&mut first, 10);
        let mut second = plant(&scene, |_| ());
        second.restore(&first.snapshot()).unwrap();
        for _ in 0..10 {
            let u = waving_input(&first, first.step_index());
            first.step(&u).unwrap();
            second.step(&u).unwrap();
            assert_eq!(first.state(), second.state(), "{seed}");
        }
    }
}
