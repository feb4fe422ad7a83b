//! Equilibria: what settles is at rest, and a minimum.

use std::f64::consts::PI;
use std::sync::Arc;

use crate::common::{Numbers, builtin, floating, plant, random_tree};
use nalgebra::DVector;
use plantd_models::scene::{Constraint, Coordinate, CoordinateKind, Spring};
use plantd_models::{
    Continuous, ContinuousPoint, Equilibrium, Initial, InitialError, Kinematics, Model, Plant,
    Scene, Settings, SettleError, SettleRequest, Target,
};

fn settle(plant: &Plant, q: &[f64], hold: &[&str]) -> Result<Equilibrium, SettleError> {
    let hold = hold.iter().map(|name| (*name).to_owned()).collect();
    plant.model().settle(&SettleRequest { q: q.to_vec(), hold, inputs: vec![] })
}

/// Potential energy less the work of inputs, near `q` on the constraints.
fn energy_near(plant: &mut Plant, q: Vec<f64>, u: &[f64]) -> (Vec<f64>, f64) {
    if plant.model().dimensions().constraints > 0 {
        plant.initialize(&Initial::Projection { q, hold: vec![] }).unwrap();
    } else {
        let v = vec![0.0; q.len()];
        plant.initialize(&Initial::Velocity { q, v }).unwrap();
    }
    let energy = plant.energy();
    let model = plant.model().clone();
    let inputs = model.scene().inputs.iter().zip(u);
    let work: f64 = inputs
        .map(|(input, u)| {
            let index = model.coordinate_index(input.coordinate.as_ref().unwrap()).unwrap();
            input.gain * u * plant.q()[index]
        })
        .sum();
    (plant.q().to_vec(), energy.potential_j - work)
}

/// Small displacements along the constraints cost energy, of second order.
fn assert_minimum(scene: &Scene, rest: &Equilibrium) {
    let mut plant = plant(scene, |_| ());
    let n = plant.model().dimensions().dynamic;
    let (_, least) = energy_near(&mut plant, rest.q.clone(), &rest.inputs);
    let mut random = Numbers::new(7);
    for _ in 0..40 {
        let mut q = rest.q.clone();
        q[..n].iter_mut().for_each(|q| *q += random.between(-1e-2, 1e-2));
        let (at, energy) = energy_near(&mut plant, q, &rest.inputs);
        let distance: f64 = at.iter().zip(&rest.q).map(|(a, b)| (a - b) * (a - b)).sum();
        let least_gain = 0.4 * rest.smallest_stiffness.min(1e6) * distance;
        assert!(
            energy - least > least_gain.min(0.0) + 0.5 * least_gain - 1e-12 * least.abs().max(1.0),
            "{}: {} after {distance:e}, stiffness {}",
            scene.name,
            energy - least,
            rest.smallest_stiffness
        );
    }
}

/// A plant put there stays.
fn assert_rest(scene: &Scene, q: &[f64], hold: &[&str], inputs: &[f64]) -> Vec<f64> {
    let mut plant = plant(scene, |_| ());
    let hold = hold.iter().map(|name| (*name).to_owned()).collect();
    let initial = Initial::Equilibrium { q: q.to_vec(), hold, inputs: inputs.to_vec() };
    plant.initialize(&initial).unwrap();
    let start = plant.state();
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    u[..inputs.len()].copy_from_slice(inputs);
    for _ in 0..100 {
        plant.step(&u).unwrap();
    }
    let scale = 1.0 + start.p.iter().fold(0.0_f64, |a, p| a.max(p.abs()));
    for (x, y) in plant.q().iter().zip(&start.q) {
        assert!((x - y).abs() < 1e-11, "{}: {x} was {y}", scene.name);
    }
    for (x, y) in plant.p().iter().zip(&start.p) {
        assert!((x - y).abs() < 1e-11 * scale, "{}: {x} was {y}", scene.name);
    }
    assert!(plant.velocity().iter().all(|v| v.abs() < 1e-9), "{:?}", plant.velocity());
    start.q
}

#[test]
fn pendulums_hang() {
    for (name, guess) in [
        ("pendulum", vec![1.0]),
        ("pendulum", vec![PI]),
        ("double-pendulum", vec![0.8, -0.5]),
        ("double-pendulum", vec![PI, 0.0]),
        ("double-pendulum", vec![PI - 1e-3, 1e-3]),
        ("double-pendulum", vec![0.0, PI]),
        ("chain-4", vec![PI, 0.1, 0.0, -0.1]),
        ("spherical-pendulum", vec![2.0, 1.0]),
    ] {
        let scene = builtin(name);
        let rest = settle(&plant(&scene, |_| ()), &guess, &[]).unwrap();
        assert!(rest.stable && rest.smallest_stiffness > 0.0, "{name}: {rest:?}");
        assert!(rest.residual < 1e-13, "{name}: {rest:?}");
        if name != "spherical-pendulum" {
            // Hanging, up to full turns.
            let mut angle: f64 = 0.0;
            for q in &rest.q {
                angle += q;
                assert!(angle.sin().abs() < 1e-12 && angle.cos() > 0.0, "{name}: {:?}", rest.q);
            }
        }
        assert_minimum(&scene, &rest);
        assert_rest(&scene, &guess, &[], &[]);
    }
}

#[test]
fn builtin_mechanisms_settle() {
    for (name, hold) in
        [("four-bar", vec![]), ("marionette", vec![]), ("scissor-4", vec!["slider"])]
    {
        let scene = builtin(name);
        let plant = plant(&scene, |_| ());
        let guess = plant.q().to_vec();
        let rest = settle(&plant, &guess, &hold).unwrap();
        assert!(rest.stable, "{name}: {rest:?}");
        assert!(rest.residual < 1e-9, "{name}: {rest:?}");
        if hold.is_empty() {
            assert_minimum(&scene, &rest);
            assert_rest(&scene, &guess, &hold, &[]);
        }
    }
    let scene = builtin("scissor-4");
    let plant = plant(&scene, |_| ());
    // Let go, it hangs as one line: the singular point, and the lowest all the same.
    let rest = settle(&plant, plant.q(), &[]).unwrap();
    assert!(rest.q[0].abs() < 1e-6 && rest.stable, "{rest:?}");
    // Eight links of 1 kg, whose centres hang 2.5 m below one another's pair: 2 · 9.8 · (1+3+5+7) · 2.5.
    assert!((rest.potential_j + 784.0).abs() < 1e-9, "{rest:?}");
}

/// A torque holds a pendulum where `m g l sin θ = u`.
#[test]
fn constant_inputs_do_work() {
    let scene = builtin("pendulum");
    let plant = plant(&scene, |_| ());
    let body = scene.frames[0].body.clone().unwrap();
    let moment = body.mass * body.center_of_mass[1].abs() * scene.gravity.unwrap()[1].abs();
    let input = 0.4 * moment / scene.inputs[0].gain;
    let request = SettleRequest { q: vec![0.0], hold: vec![], inputs: vec![input] };
    let rest = plant.model().settle(&request).unwrap();
    assert!((rest.q[0].sin() - 0.4).abs() < 1e-13 && rest.q[0].abs() < 1.0, "{rest:?}");
    assert!((rest.smallest_stiffness / (moment * rest.q[0].cos()) - 1.0).abs() < 1e-12);
    assert_minimum(&scene, &rest);
    assert_rest(&scene, &[0.0], &[], &[input]);
    // A torque that gravity cannot balance turns it on and on.
    let request = SettleRequest { inputs: vec![1.5 * moment / scene.inputs[0].gain], ..request };
    let error = plant.model().settle(&request).unwrap_err();
    assert!(matches!(error, SettleError::Unbounded { .. }), "{error}");
}

#[test]
fn what_falls_has_no_equilibrium() {
    let mut scene = floating();
    scene.gravity = Some([0.0, 0.0, -9.8]);
    let plant = plant(&scene, |_| ());
    let error = settle(&plant, plant.q(), &[]).unwrap_err();
    assert_eq!(error, SettleError::Unbounded { coordinate: "z".to_owned() });
    // Held, its arms come to rest.
    settle(&plant, plant.q(), &["x", "y", "z", "yaw"]).unwrap();
}

#[test]
fn requests_that_make_no_sense() {
    let plant = plant(&builtin("four-bar"), |_| ());
    let q = plant.q().to_vec();
    let error = settle(&plant, &q[1..], &[]).unwrap_err();
    assert_eq!(error, SettleError::Dimension { name: "q", expected: 3, actual: 2 });
    let error = settle(&plant, &[f64::NAN, 0.0, 0.0], &[]).unwrap_err();
    assert!(matches!(error, SettleError::NotFinite { name: "q", index: 0, .. }));
    let error = settle(&plant, &q, &["nobody"]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "there is no coordinate `nobody`; there are `crank`, `coupler`, `rocker`"
    );
    let request = SettleRequest { q, hold: vec![], inputs: vec![1.0, 2.0] };
    let error = plant.model().settle(&request).unwrap_err();
    assert_eq!(error, SettleError::Dimension { name: "inputs", expected: 1, actual: 2 });
    // A crank that points away from a rocker held far off cannot be reached.
    let error = settle(&plant, &[PI / 2.0, 0.0, -PI / 2.0], &["crank", "rocker"]).unwrap_err();
    assert!(matches!(error, SettleError::Constraints { .. }), "{error}");
    let mut plant = plant;
    let initial = Initial::Equilibrium { q: vec![], hold: vec![], inputs: vec![] };
    let error = plant.initialize(&initial).unwrap_err();
    assert!(matches!(error, InitialError::Settle(SettleError::Dimension { .. })), "{error}");
}

/// Trees of random shape, with springs across.
#[test]
fn random_trees_settle() {
    for seed in 0..24 {
        let mut scene = random_tree(seed);
        // Springs hold what would fall.
        let dynamic = scene.coordinates.iter().filter(|c| c.kind == CoordinateKind::Dynamic);
        let spring = |coordinate: &Coordinate| Spring::Coordinate {
            coordinate: coordinate.name.clone(),
            stiffness: 3.0,
            rest: 0.1,
        };
        scene.springs.extend(dynamic.map(spring).collect::<Vec<_>>());
        let plant = plant(&scene, |_| ());
        let rest =
            settle(&plant, plant.q(), &[]).unwrap_or_else(|error| panic!("seed {seed}: {error}"));
        assert!(rest.residual < 1e-11, "seed {seed}: {rest:?}");
        assert!(rest.stable, "seed {seed}: {rest:?}");
        assert_minimum(&scene, &rest);
        assert_rest(&scene, plant.q(), &[], &[]);
    }
}

/// Guesses at the end of the range of numbers end in an error or an equilibrium, not in NaN.
#[test]
fn guesses_out_of_range() {
    for name in ["four-bar", "marionette", "cart-pole", "double-pendulum"] {
        let plant = plant(&builtin(name), |_| ());
        for size in [1e10, 1e100, 1e300, -1e308] {
            let mut q = plant.q().to_vec();
            q.iter_mut().for_each(|q| *q = size);
            if let Ok(rest) = settle(&plant, &q, &[]) {
                assert!(rest.residual.is_finite() && rest.q.iter().all(|q| q.is_finite()));
            }
        }
        let inputs = vec![1e300; plant.model().dimensions().inputs];
        let request = SettleRequest { q: plant.q().to_vec(), hold: vec![], inputs };
        if let Ok(rest) = plant.model().settle(&request) {
            assert!(rest.residual.is_finite() && rest.q.iter().all(|q| q.is_finite()));
        }
    }
}

/// Held coordinates keep their value to the bit.
#[test]
fn held_coordinates_stay() {
    let plant = plant(&builtin("double-pendulum"), |_| ());
    let name = plant.model().coordinates()[0].name.clone();
    let rest = settle(&plant, &[0.3, 0.9], &[&name]).unwrap();
    assert_eq!(rest.q[0], 0.3);
    assert!((rest.q[0] + rest.q[1]).sin().abs() < 1e-12);
}

/// Constraint forces of a hanging four-bar balance its weight: with redundant equations too.
#[test]
fn constraint_forces_balance() {
    let scene = builtin("four-bar");
    let mut doubled = scene.clone();
    let Constraint::PointToPoint { a, b, axes, .. } = scene.constraints[0].clone() else {
        panic!()
    };
    let name = "again".to_owned();
    doubled.constraints.push(Constraint::PointToPoint { name, a, b, axes });
    let forces = [scene, doubled].map(|scene| {
        let mut plant = plant(&scene, |_| ());
        let rest = settle(&plant, plant.q(), &[]).unwrap();
        // What a step says at rest.
        let q = rest.q.clone();
        plant.initialize(&Initial::Equilibrium { q, hold: vec![], inputs: vec![] }).unwrap();
        plant.step(&[0.0]).unwrap();
        let h = plant.settings().time_step_s;
        for (force, lambda) in rest.constraint_forces.iter().zip(plant.multipliers()) {
            assert!((force - lambda / h).abs() < 1e-9, "{force} and {}", lambda / h);
        }
        rest.constraint_forces
    });
    for c in 0..2 {
        assert!((forces[0][c] - forces[1][c] - forces[1][c + 2]).abs() < 1e-10);
        assert!((forces[1][c] - forces[1][c + 2]).abs() < 1e-12);
    }
}

/// Orientations settle as rotations: a lantern on a ball joint hangs from any start, and may still
/// turn about the vertical; a torsion spring would hold it.
#[test]
fn ball_joints_settle() {
    let text = r#"
format = 1
name = "lantern"
gravity = [0.0, 0.0, -9.8]
[[frames]]
name = "lantern"
joint = { type = "ball" }
body = { mass = 2.0, center_of_mass = [0.03, 0.0, -0.4], inertia = [0.02, 0.03, 0.01] }
[[frames]]
name = "bell"
parent = "lantern"
translation = [0.0, 0.1, -0.5]
joint = { type = "revolute", axis = [1.0, 0.0, 0.0] }
body = { mass = 0.3, center_of_mass = [0.0, 0.0, -0.1] }
"#;
    let scene = Scene::from_toml(text).unwrap();
    let mut plant = plant(&scene, |_| ());
    for guess in [[0.0, 0.0, 0.0, 0.3], [1.0, -1.5, 0.7, 2.0], [3.1, 0.0, 0.0, 0.0]] {
        let rest = settle(&plant, &guess, &[]).unwrap();
        assert!(rest.residual < 1e-12, "{rest:?}");
        // Neutral about the vertical, stiff otherwise.
        assert!(!rest.stable && rest.smallest_stiffness.abs() < 1e-9, "{rest:?}");
        let q = rest.q.clone();
        plant.initialize(&Initial::Equilibrium { q, hold: vec![], inputs: vec![] }).unwrap();
        let found = plant.diagnose();
        assert!(found.center_of_mass[0].abs() < 1e-12 && found.center_of_mass[1].abs() < 1e-12);
        assert!(found.center_of_mass[2] < -0.3, "{found:?}");
        let start = plant.q().to_vec();
        for _ in 0..100 {
            plant.step(&[]).unwrap();
        }
        for (x, y) in plant.q().iter().zip(&start) {
            assert!((x - y).abs() < 1e-11, "{x} was {y}");
        }
    }
}

/// A four-bar under a constant torque, and one whose crank is held.
#[test]
fn loops_settle_under_inputs_and_with_held_coordinates() {
    let scene = builtin("four-bar");
    let plant = plant(&scene, |_| ());
    let request = SettleRequest { q: plant.q().to_vec(), hold: vec![], inputs: vec![-2.0] };
    let rest = plant.model().settle(&request).unwrap();
    assert!(rest.residual < 1e-12 && rest.stable, "{rest:?}");
    assert_minimum(&scene, &rest);
    assert_rest(&scene, plant.q(), &[], &[-2.0]);
    let rest = settle(&plant, plant.q(), &["crank"]).unwrap();
    assert_eq!(rest.q[0], plant.q()[0]);
    assert_eq!(rest.smallest_stiffness, f64::INFINITY);
}

/// Every element's scene settles and rests there, or says why not.
#[test]
fn scenes_of_all_elements() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    let mut settled = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let scene = Scene::from_text(&std::fs::read_to_string(&path).unwrap()).unwrap();
        let mut plant = plant(&scene, |_| ());
        let rest = match settle(&plant, plant.q(), &[]) {
            Ok(rest) => rest,
            Err(error) => {
                println!("{}: {error}", scene.name);
                // What flies falls, and unequal weights run into their pulley.
                let has_none = match error {
                    SettleError::Unbounded { .. } => true,
                    SettleError::NotConverged { residual, .. } => residual > 1.0,
                    _ => false,
                };
                assert!(has_none, "{}: {error}", scene.name);
                continue;
            }
        };
        println!("{}: {} {:e} {}", scene.name, rest.stable, rest.residual, rest.iterations);
        assert!(rest.residual < 1e-9, "{}: {rest:?}", scene.name);
        settled += 1;
        if !scene.signals.is_empty() {
            continue;
        }
        let q = rest.q.clone();
        plant.initialize(&Initial::Equilibrium { q, hold: vec![], inputs: vec![] }).unwrap();
        let start = plant.q().to_vec();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        plant.hold_input(&mut u);
        for _ in 0..20 {
            plant.step(&u).unwrap();
        }
        for (x, y) in plant.q().iter().zip(&start) {
            assert!((x - y).abs() < 1e-9, "{}: {x} was {y}", scene.name);
        }
    }
    assert!(settled > 5, "{settled}");
}

/// An arm of six hinges, a hand at its end.
const ARM: &str = r#"
format = 1
name = "arm"
gravity = [0.0, 0.0, -9.81]
[[frames]]
name = "base"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 2.0, inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "shoulder"
parent = "base"
translation = [0.0, 0.0, 0.3]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 2.0, center_of_mass = [0.25, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "elbow"
parent = "shoulder"
translation = [0.5, 0.0, 0.0]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.2, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "roll"
parent = "elbow"
translation = [0.4, 0.0, 0.0]
joint = { type = "revolute", axis = [1.0, 0.0, 0.0] }
body = { mass = 0.5, inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "pitch"
parent = "roll"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 0.5, inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "yaw"
parent = "pitch"
joint = { type = "revolute", axis = [1.0, 0.0, 0.0] }
body = { mass = 0.5, inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "hand"
parent = "yaw"
translation = [0.1, 0.0, 0.0]
"#;

/// The pose of the hand is that of a configuration nearby, which is found again.
#[test]
fn an_arm_reaches_a_pose() {
    let arm = Arc::new(Model::compile(&Scene::from_toml(ARM).unwrap()).unwrap());
    let pose = |q: &[f64], at: [f64; 3]| {
        let mut kinematics = Kinematics::new(Arc::clone(&arm));
        kinematics.place(q, &[0.0; 6]).unwrap();
        kinematics.motion(&kinematics.point("hand", at).unwrap())
    };
    let (there, at) = ([0.4, -0.5, 0.9, 0.3, 0.6, -0.2], [0.0, 0.05, 0.02]);
    let wanted = pose(&there, at);
    let target = Target {
        frame: "hand".to_owned(),
        at,
        position: Some(wanted.position),
        orientation: Some(wanted.orientation),
    };
    let held = Arc::new(arm.held_at(&[target]).unwrap());
    let q = there.map(|x| x + 0.15);
    let projection = Initial::Projection { q: q.to_vec(), hold: vec![] };
    let reached = Plant::at(Arc::clone(&held), Settings::new(&held), &projection).unwrap();
    for (found, there) in reached.q().iter().zip(there) {
        assert!((found - there).abs() < 1e-9, "{:?} instead of {there:?}", reached.q());
    }
}

/// With a position alone three freedoms are left: the arm rests where its energy is least, and virtual work of
/// the force at the hand balances gravity, `g(q) = Jᵀ F`.
#[test]
fn an_arm_hangs_from_a_point() {
    let arm = Arc::new(Model::compile(&Scene::from_toml(ARM).unwrap()).unwrap());
    let position = [0.5, 0.2, 0.4];
    let target = Target { frame: "hand".to_owned(), position: Some(position), ..Target::default() };
    let held = arm.held_at(&[target]).unwrap();
    let q = vec![0.3, -0.6, 1.2, 0.1, 0.3, 0.0];
    let rest = held.settle(&SettleRequest { q, ..SettleRequest::default() }).unwrap();
    let mut kinematics = Kinematics::new(Arc::clone(&arm));
    kinematics.place(&rest.q, &[0.0; 6]).unwrap();
    let hand = kinematics.point("hand", [0.0; 3]).unwrap();
    for (found, wanted) in kinematics.motion(&hand).position.iter().zip(position) {
        assert!((found - wanted).abs() < 1e-9);
    }
    let point = ContinuousPoint { q: rest.q, v: vec![0.0; 6], ..ContinuousPoint::default() };
    let weight = DVector::from_vec(Continuous::new(arm).terms(&point).unwrap().gravity);
    let jacobian = kinematics.jacobian(&hand).rows(0, 3).transpose();
    let force = jacobian.clone().svd(true, true).solve(&weight, 1e-9).unwrap();
    let left = (jacobian * force - &weight).amax();
    assert!(left < 1e-6 && weight.amax() > 1.0, "{left} of {weight}");
}

#[test]
fn targets_that_cannot_be_are_named() {
    let arm = Model::compile(&Scene::from_toml(ARM).unwrap()).unwrap();
    let hand = Target {
        frame: "hand".to_owned(),
        position: Some([0.4, 0.0, 0.3]),
        orientation: Some([1.0, 0.0, 0.0, 0.0]),
        ..Target::default()
    };
    let cases = [
        (Target { frame: "foot".to_owned(), ..hand.clone() }, "foot"),
        (Target { position: Some([f64::NAN, 0.0, 0.0]), ..hand.clone() }, "finite"),
        (Target { frame: "world".to_owned(), ..hand.clone() }, ""),
    ];
    for (target, message) in cases {
        let error = arm.held_at(&[hand.clone(), target]).unwrap_err();
        let named = error.problems.iter().all(|problem| problem.path.starts_with("targets[1]"));
        assert!(named && error.to_string().contains(message), "{error}");
    }
    assert_eq!(arm.held_at(&[hand.clone(), hand]).unwrap().dimensions().constraints, 12);
}
