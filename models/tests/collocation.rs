//! Collocation with ball joints: order, what it keeps, derivatives.

use crate::common::linearization::check_with;
use crate::common::{plant, wave};
use nalgebra::{DMatrix, Vector3};
use plantd_models::{Initial, Linearization, Model, Plant, Scene, Settings, Snapshot};

const ORDERS: [u32; 5] = [4, 6, 8, 12, 16];

/// A floating body with an arm on a ball joint that carries a hinge, and a leg on a hinge that carries a ball
/// joint.
fn acrobat(gravity: f64, more: &str) -> Scene {
    let text = format!(
        r#"
format = 1
name = "acrobat"
time_step_s = 0.02
gravity = [0.0, 0.0, {gravity:?}]
{more}
[[frames]]
name = "torso"
joint = {{ type = "free" }}
body = {{ mass = 3.0, center_of_mass = [0.02, 0.01, 0.05], inertia = [0.3, 0.4, 0.5, 0.05, 0.0, 0.02] }}
[[frames]]
name = "arm"
parent = "torso"
translation = [0.0, 0.3, 0.2]
joint = {{ type = "ball" }}
body = {{ mass = 0.9, center_of_mass = [0.05, 0.2, -0.1], inertia = [0.02, 0.01, 0.025] }}
[[frames]]
name = "hand"
parent = "arm"
translation = [0.0, 0.4, 0.0]
joint = {{ type = "revolute", axis = [1.0, 0.0, 0.5] }}
body = {{ mass = 0.5, center_of_mass = [0.0, 0.2, 0.0], inertia = [0.01, 0.002, 0.01] }}
[[frames]]
name = "leg"
parent = "torso"
translation = [0.0, 0.0, -0.4]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.2] }}
body = {{ mass = 1.0, center_of_mass = [0.0, 0.0, -0.2], inertia = [0.02, 0.02, 0.005] }}
[[frames]]
name = "foot"
parent = "leg"
translation = [0.0, 0.0, -0.4]
joint = {{ type = "ball" }}
body = {{ mass = 0.6, center_of_mass = [0.1, 0.0, -0.05], inertia = [0.004, 0.006, 0.005] }}
"#
    );
    Scene::from_toml(&text).unwrap()
}

/// With inputs on a hinge and on an axis of a ball joint, damping, a spring, a wrench, and the leg prescribed.
const DRIVEN: &str = r#"
[[coordinates]]
name = "leg"
kind = "prescribed"
[[coordinates]]
name = "arm_rx"
damping = 0.05
[[coordinates]]
name = "hand"
damping = 0.02
[[inputs]]
name = "grip"
coordinate = "hand"
[[inputs]]
name = "twist"
coordinate = "arm_ry"
[[inputs]]
name = "gust"
[[forces]]
type = "body_wrench"
frame = "foot"
force = ["gust", 0.2, 0.0]
torque = [0.0, "gust", 0.0]
[[springs]]
type = "two_point"
a = { frame = "hand", at = [0.0, 0.3, 0.0] }
b = { frame = "foot", at = [0.0, 0.0, -0.1] }
stiffness = 8.0
rest_length = 0.5
"#;

/// A point of the foot is held, and the hand at a distance from the torso.
const HELD: &str = r#"
[[constraints]]
type = "point_to_point"
name = "stand"
axes = ["x", "y", "z"]
a = { frame = "foot", at = [0.1, 0.0, -0.05] }
b = { frame = "world", at = [0.1, 0.0, -0.85] }
"#;
const CUFFED: &str = r#"
[[constraints]]
type = "distance"
name = "cuff"
a = { frame = "hand", at = [0.0, 0.3, 0.0] }
b = { frame = "torso", at = [0.3, 0.0, 0.2] }
length = 0.9970620775763297
[[coordinates]]
name = "hand"
initial = 0.9
"#;

/// In motion, by so many steps in a second.
fn moving(scene: &Scene, order: u32, steps: f64) -> Plant {
    let mut plant =
        plant(scene, |s| (s.order, s.time_step_s, s.halvings) = (order, 1.0 / steps, 0));
    let model = plant.model().clone();
    let q: Vec<f64> = (0..plant.q().len()).map(|i| 0.4 * (2.3 * i as f64 + 1.0).sin()).collect();
    let v = (0..q.len()).map(|i| 2.5 * (1.7 * i as f64 + 0.5).cos()).collect();
    assert_eq!(model.dimensions().prescribed, 0);
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    plant
}

/// From where the scene begins, as constraints let it.
fn bound(scene: &Scene, order: u32, steps: f64) -> Plant {
    let mut plant =
        plant(scene, |s| (s.order, s.time_step_s, s.halvings) = (order, 1.0 / steps, 0));
    let q = plant.q().to_vec();
    let v = (0..q.len()).map(|i| 1.5 * (1.7 * i as f64 + 0.5).cos()).collect();
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    plant
}

fn end(scene: &Scene, order: u32, steps: u32, time_s: f64) -> Vec<f64> {
    let begin = if scene.constraints.is_empty() { moving } else { bound };
    let mut plant = begin(scene, order, f64::from(steps) / time_s);
    for _ in 0..steps {
        plant.step(&[]).unwrap();
    }
    plant.q().to_vec()
}

fn apart(model: &Model, a: &[f64], b: &[f64]) -> f64 {
    model.difference(a, b).iter().fold(0.0, |m: f64, x| m.max(x.abs()))
}

/// All orders find the motion that the midpoint rule tends to, each at its own rate.
#[test]
fn every_order_is_what_it_says() {
    follow(&acrobat(-9.81, ""), [64, 100], [(4, 16), (6, 12), (8, 8), (12, 4)]);
}

/// The same with constraints.
#[test]
fn every_order_is_what_it_says_with_constraints() {
    let scene = acrobat(-9.81, &(HELD.to_owned() + CUFFED));
    follow(&scene, [128, 200], [(4, 96), (6, 96), (8, 32), (12, 24)]);
}

/// By order 12 in many steps, by the midpoint rule in so many and more, and by other orders from few on.
fn follow(scene: &Scene, [most, steps]: [u32; 2], coarse: [(u32, u32); 4]) {
    let model = Model::compile(scene).unwrap();
    let reference = end(scene, 12, most, 0.4);
    // The midpoint rule, whose error is even in the step: extrapolated twice.
    let [a, b, c] = [1, 2, 4].map(|times| end(scene, 2, times * steps, 0.4));
    let toward = |coarse: &[f64], fine: &[f64], by: f64| {
        let change = model.difference(coarse, fine);
        model.retract(fine, &change.iter().map(|x| x / (by - 1.0)).collect::<Vec<_>>())
    };
    let (ab, bc) = (toward(&a, &b, 4.0), toward(&b, &c, 4.0));
    let extrapolated = toward(&ab, &bc, 16.0);
    let error = apart(&model, &reference, &extrapolated);
    assert!(error < 1e-8 && apart(&model, &reference, &c) > 1e-6, "{error:e}");
    for (order, steps) in coarse {
        let [coarse, fine] =
            [steps, 2 * steps].map(|n| apart(&model, &reference, &end(scene, order, n, 0.4)));
        let rate = (coarse / fine).log2();
        assert!((rate - f64::from(order)).abs() < 0.7, "{order}: {coarse:e} {fine:e}: {rate}");
    }
}

/// Where a step goes there is a way back: with the opposite momentum, to where it came from.
#[test]
fn a_step_back_undoes_a_step() {
    let scene = acrobat(-9.81, "");
    for order in ORDERS {
        let mut plant = moving(&scene, order, 25.0);
        let start = plant.state();
        for _ in 0..2 {
            plant.step(&[]).unwrap();
            plant.step(&[]).unwrap();
            let state = plant.state();
            let p = state.p.iter().map(|p| -p).collect();
            plant.initialize(&Initial::Momentum { q: state.q, p, v: vec![] }).unwrap();
        }
        let back = plant.state();
        let error = apart(plant.model(), &start.q, &back.q);
        assert!(error < 1e-12, "{order}: {error:e}");
        let error = start.p.iter().zip(&back.p).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 1e-11, "{order}: {error:e}");
    }
}

/// `δq ∧ δp` is kept by a step of any length; in the body axes of ball joints the form is `[−[p], 1; −1, 0]`.
#[test]
fn steps_are_symplectic() {
    let scenes = ["".to_owned(), HELD.to_owned() + CUFFED].map(|more| acrobat(-9.81, &more));
    for (scene, order) in scenes.iter().flat_map(|scene| ORDERS.map(|order| (scene, order))) {
        let is_bound = !scene.constraints.is_empty();
        let mut plant =
            if is_bound { bound(scene, order, 100.0) } else { moving(scene, order, 15.0) };
        let model = plant.model().clone();
        let nd = model.dimensions().dynamic;
        // Displacements that keep the constraints.
        let mut kept = DMatrix::identity(2 * nd, 2 * nd);
        if is_bound {
            let jacobian = plant.constraint_jacobian();
            let projected = jacobian.clone().pseudo_inverse(1e-10).unwrap() * jacobian;
            let mut part = kept.view_mut((0, 0), (nd, nd));
            part -= projected;
        }
        let form = |p: &[f64]| {
            let mut form = DMatrix::zeros(2 * nd, 2 * nd);
            for i in 0..nd {
                form[(i, nd + i)] = 1.0;
                form[(nd + i, i)] = -1.0;
            }
            for &i in model.orientations() {
                let p = Vector3::new(p[i], p[i + 1], p[i + 2]);
                form.view_mut((i, i), (3, 3)).copy_from(&-p.cross_matrix());
            }
            form
        };
        let mut out = Linearization::new(&model);
        let before = form(plant.p());
        plant.step_and_linearize(&[], &mut out).unwrap();
        let a = out.a() * &kept;
        let defect = a.transpose() * form(plant.p()) * &a - kept.transpose() * before * &kept;
        let size = a.amax().powi(2);
        assert!(defect.amax() < 1e-11 * size, "{order}: {:e} of {size:e}", defect.amax());
    }
}

/// Momenta stay in long steps, and energy stays near where it was.
#[test]
fn momenta_and_energy_are_kept() {
    let scenes = ["", CUFFED].map(|more| acrobat(0.0, more));
    for (scene, order) in scenes.iter().flat_map(|scene| ORDERS.map(|order| (scene, order))) {
        let is_bound = !scene.constraints.is_empty();
        let mut plant =
            if is_bound { bound(scene, order, 100.0) } else { moving(scene, order, 25.0) };
        let momenta = |plant: &mut Plant| {
            let d = plant.diagnose();
            (Vector3::from(d.linear_momentum), Vector3::from(d.angular_momentum))
        };
        let energy = |plant: &mut Plant| plant.energy().kinetic_j + plant.energy().potential_j;
        let (linear, angular) = momenta(&mut plant);
        let start = energy(&mut plant);
        let mut worst = 0.0_f64;
        for _ in 0..4000 {
            plant.step(&[]).unwrap();
            worst = worst.max((energy(&mut plant) / start - 1.0).abs());
        }
        let (p, l) = momenta(&mut plant);
        assert!((p - linear).norm() < 1e-11, "{order}: {p} {linear}");
        assert!((l - angular).norm() < 1e-11, "{order}: {l} {angular}");
        // It swings by 2e-5 of itself in the first thousand steps of order 4.
        assert!(worst < 3e-4, "{order}: {worst:e}");
    }
}

/// About the vertical nothing turns a tree of balls that hangs in the world.
#[test]
fn the_momentum_about_the_vertical_is_kept() {
    let text = r#"
format = 1
name = "mobile"
gravity = [0.0, 0.0, -9.81]
[[frames]]
name = "upper"
joint = { type = "ball" }
body = { mass = 1.0, center_of_mass = [0.1, 0.05, -0.3], inertia = [0.03, 0.02, 0.01] }
[[frames]]
name = "lower"
parent = "upper"
translation = [0.1, 0.0, -0.5]
joint = { type = "ball" }
body = { mass = 0.7, center_of_mass = [0.0, 0.1, -0.2], inertia = [0.01, 0.02, 0.015] }
"#;
    let scene = Scene::from_toml(text).unwrap();
    for order in ORDERS {
        let mut plant = moving(&scene, order, 20.0);
        let about = |plant: &mut Plant| plant.diagnose().angular_momentum[2];
        let start = about(&mut plant);
        for _ in 0..500 {
            plant.step(&[]).unwrap();
        }
        let drift = about(&mut plant) - start;
        assert!(drift.abs() < 1e-12, "{order}: {drift:e}");
    }
}

/// Where forces, springs, dampers and a prescribed joint act.
#[test]
fn derivatives_with_ball_joints() {
    let held = [HELD.to_owned() + CUFFED, DRIVEN.to_owned() + HELD];
    for more in ["".to_owned(), DRIVEN.to_owned()].into_iter().chain(held) {
        let scene = acrobat(-9.81, &more);
        for order in ORDERS {
            check_with(&scene, |s| s.order = order);
        }
        check_with(&scene, |s| (s.order, s.substeps) = (4, 2));
    }
}

/// A plant that goes on from bytes has the bits of one that went on.
#[test]
fn restored_plants_go_on_bit_for_bit() {
    let scenes = [DRIVEN.to_owned(), DRIVEN.to_owned() + HELD].map(|more| acrobat(-9.81, &more));
    for (scene, order) in scenes.iter().flat_map(|scene| ORDERS.map(|order| (scene, order))) {
        let mut plant = plant(scene, |s: &mut Settings| s.order = order);
        let mut other = plant.clone();
        wave(&mut plant, 7);
        let bytes = plant.snapshot().to_bytes();
        other.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
        wave(&mut plant, 9);
        wave(&mut other, 9);
        assert_eq!(plant.snapshot().to_bytes(), other.snapshot().to_bytes(), "{order}");
    }
}

/// An estimate of the error is one, and a method is chosen that keeps to a tolerance.
#[test]
fn errors_are_estimated_and_methods_chosen() {
    let scene = acrobat(-9.81, "");
    let mut whole = moving(&scene, 6, 20.0);
    let estimate = whole.estimate_error(&[]).unwrap().configuration;
    whole.step(&[]).unwrap();
    let mut fine = moving(&scene, 12, 200.0);
    for _ in 0..10 {
        fine.step(&[]).unwrap();
    }
    let error = apart(whole.model(), fine.q(), whole.q());
    assert!(estimate > 0.5 * error && estimate < 2.0 * error, "{estimate:e} {error:e}");
    let choice = moving(&scene, 2, 50.0).choose_method(1e-9, &mut || true).unwrap();
    assert!(choice.error <= 1e-9 && choice.order >= 6, "{choice:?}");
}
