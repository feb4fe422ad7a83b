//! Constraints in collocation: order, what it keeps, derivatives, redundant equations.

use crate::common::linearization::check_with;
use crate::common::{builtin, model, plant, wave, waving_input};
use crate::second_order::check_with as check_second_order_with;
use nalgebra::DMatrix;
use plantd_models::{Initial, Linearization, Plant, Scene, Settings, Snapshot};

const ORDERS: [u32; 5] = [4, 6, 8, 12, 16];

/// Two arms in space on three oblique hinges each, whose hands are one point.
fn spatial(more: &str) -> Scene {
    let arm = |name: &str, at: f64, tilt: f64| {
        format!(
            r#"
[[frames]]
name = "{name}_shoulder"
translation = [{at:?}, 0.0, 0.0]
joint = {{ type = "revolute", axis = [0.0, 0.0, 1.0] }}
body = {{ mass = 0.4, center_of_mass = [0.02, 0.0, -0.05], inertia = [0.01, 0.012, 0.008] }}
[[frames]]
name = "{name}_upper"
parent = "{name}_shoulder"
joint = {{ type = "revolute", axis = [{tilt:?}, 1.0, 0.2] }}
body = {{ mass = 1.1, center_of_mass = [0.0, 0.05, -0.3], inertia = [0.04, 0.05, 0.01] }}
[[frames]]
name = "{name}_lower"
parent = "{name}_upper"
translation = [0.0, 0.1, -0.7]
joint = {{ type = "revolute", axis = [1.0, {tilt:?}, 0.1] }}
body = {{ mass = 0.7, center_of_mass = [0.0, 0.0, -0.3], inertia = [0.02, 0.03, 0.01] }}
"#
        )
    };
    let text = format!(
        r#"
format = 1
name = "two-arms"
time_step_s = 0.02
gravity = [0.0, 0.0, -9.81]
{more}{}{}
[[constraints]]
type = "point_to_point"
name = "hands"
a = {{ frame = "left_lower", at = [0.0, 0.0, -0.7] }}
b = {{ frame = "right_lower", at = [0.05, 0.0, -0.65] }}
axes = ["x", "y", "z"]
"#,
        arm("left", -0.3, 0.3),
        arm("right", 0.3, -0.2),
    );
    Scene::from_toml(&text).unwrap()
}

/// With inputs, damping, a spring, a wrench, and a shoulder prescribed.
const DRIVEN: &str = r#"
[[coordinates]]
name = "left_shoulder"
kind = "prescribed"
[[coordinates]]
name = "right_upper"
damping = 0.1
[[inputs]]
name = "lift"
coordinate = "left_upper"
[[inputs]]
name = "gust"
[[forces]]
type = "body_wrench"
frame = "right_lower"
force = ["gust", 0.2, 0.0]
torque = [0.0, "gust", 0.0]
[[springs]]
type = "two_point"
a = { frame = "left_lower", at = [0.0, 0.1, -0.2] }
b = { frame = "right_upper", at = [0.0, 0.0, -0.2] }
stiffness = 20.0
rest_length = 0.3
"#;

/// A four-bar whose ground floats in the plane.
fn floating_linkage() -> Scene {
    let mut scene = builtin("four-bar");
    let base = r#"
format = 1
name = "base"
gravity = [0.0, 0.0, 0.0]
[[frames]]
name = "base_x"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
[[frames]]
name = "base_z"
parent = "base_x"
joint = { type = "prismatic", axis = [0.0, 0.0, 1.0] }
[[frames]]
name = "base"
parent = "base_z"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0], coordinate = "base_turn" }
body = { mass = 2.0, center_of_mass = [0.5, 0.0, 0.0], inertia = [0.2, 0.2, 0.0] }
"#;
    let base = Scene::from_toml(base).unwrap();
    for frame in scene.frames.iter_mut().filter(|frame| frame.parent == "world") {
        frame.parent = "base".to_owned();
    }
    scene.gravity = base.gravity;
    scene.frames.splice(0..0, base.frames);
    scene
}

/// In motion on the constraints, by so many steps in a second.
fn moving(scene: &Scene, order: u32, steps: f64) -> Plant {
    let model = model(scene);
    let time_step_s = 1.0 / steps;
    let settings = Settings { order, time_step_s, halvings: 0, ..Settings::new(&model) };
    let held = model.dimensions().dynamic;
    let shift = |i: usize| if i < held { 0.1 * (i as f64).sin() } else { 0.0 };
    let start = model.coordinates().iter().enumerate();
    let q = start.map(|(i, c)| c.initial + shift(i)).collect();
    let mut plant =
        Plant::at(model, settings, &Initial::Projection { q, hold: Vec::new() }).unwrap();
    let q = plant.q().to_vec();
    let velocity = |i: usize| if i < held { 1.2 * (1.7 * i as f64 + 0.5).cos() } else { 0.0 };
    plant.initialize(&Initial::Velocity { v: (0..q.len()).map(velocity).collect(), q }).unwrap();
    plant
}

fn coast(plant: &mut Plant, steps: u32) {
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    u[..plant.model().dimensions().inputs].fill(0.0);
    for _ in 0..steps {
        let report = plant.step(&u).unwrap();
        assert!(report.constraint_residual < 1e2, "{report:?}");
    }
}

fn end(scene: &Scene, order: u32, steps: u32, time_s: f64) -> Vec<f64> {
    let mut plant = moving(scene, order, f64::from(steps) / time_s);
    coast(&mut plant, steps);
    plant.q().to_vec()
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn scenes() -> [Scene; 4] {
    [builtin("four-bar"), builtin("marionette"), spatial(""), spatial(DRIVEN)]
}

/// All orders find the motion that the midpoint rule tends to, each at its own rate.
#[test]
fn every_order_is_what_it_says() {
    for scene in scenes() {
        let reference = end(&scene, 12, 32, 0.4);
        // The midpoint rule, whose error is even in the step: extrapolated twice.
        let [a, b, c] = [100, 200, 400].map(|steps| end(&scene, 2, steps, 0.4));
        let toward = |coarse: &[f64], fine: &[f64], by: f64| -> Vec<f64> {
            coarse.iter().zip(fine).map(|(c, f)| f + (f - c) / (by - 1.0)).collect()
        };
        let extrapolated = toward(&toward(&a, &b, 4.0), &toward(&b, &c, 4.0), 16.0);
        let (error, plain) = (apart(&reference, &extrapolated), apart(&reference, &c));
        assert!(error < 1e-9 && plain > 1e-7, "{}: {error:e} {plain:e}", scene.name);
        for (order, steps) in [(4, 16), (6, 16), (8, 10)] {
            let [coarse, fine] =
                [steps, 2 * steps].map(|n| apart(&reference, &end(&scene, order, n, 0.4)));
            let rate = (coarse / fine).log2();
            let what = format!("{}, order {order}: {coarse:e} {fine:e}: {rate}", scene.name);
            println!("{what}");
            assert!(rate > f64::from(order) - 0.5, "{what}");
        }
    }
}

/// The pin of the four-bar stays closed, by the geometry of its rods.
#[test]
fn loops_stay_closed() {
    for order in ORDERS {
        let mut plant = moving(&builtin("four-bar"), order, 40.0);
        for _ in 0..500 {
            coast(&mut plant, 1);
            let q = plant.q();
            let rod = |angle: f64, length: f64| [-length * angle.sin(), -length * angle.cos()];
            let (crank, coupler, rocker) = (rod(q[0], 0.5), rod(q[0] + q[1], 1.2), rod(q[2], 1.0));
            let gap = [0, 1].map(|i| crank[i] + coupler[i] - rocker[i] - [1.0, 0.0][i]);
            assert!(gap[0].hypot(gap[1]) < 1e-14, "{order}: {gap:?}");
        }
    }
}

/// Where a step goes there is a way back.
#[test]
fn a_step_back_undoes_a_step() {
    for scene in [builtin("four-bar"), spatial("")] {
        for order in ORDERS {
            let mut plant = moving(&scene, order, 25.0);
            let start = plant.state();
            for _ in 0..2 {
                coast(&mut plant, 4);
                // The momentum without what the constraints are yet to give it.
                let (q, v) = (plant.q().to_vec(), plant.velocity());
                let v = v.iter().map(|v| -v).collect();
                plant.initialize(&Initial::Velocity { q, v }).unwrap();
            }
            let error = apart(&start.q, plant.q());
            assert!(error < 1e-12, "{}, {order}: {error:e}", scene.name);
        }
    }
}

/// `δq ∧ δp` is kept by a step of any length, of changes that keep the constraints.
#[test]
fn steps_are_symplectic() {
    for scene in [builtin("four-bar"), spatial(""), floating_linkage()] {
        for order in ORDERS {
            let mut plant = moving(&scene, order, 20.0);
            coast(&mut plant, 3);
            let model = plant.model().clone();
            let n = model.dimensions().dynamic;
            let jacobian = plant.constraint_jacobian();
            // All changes without the rows of the Jacobian.
            let rows = jacobian.transpose();
            let normal = jacobian.clone().svd(true, true).v_t.unwrap();
            assert!(rows.ncols() < n, "nothing moves");
            let keeps = DMatrix::identity(n, n) - normal.transpose() * &normal;
            let mut tangent = DMatrix::identity(2 * n, 2 * n);
            tangent.view_mut((0, 0), (n, n)).copy_from(&keeps);
            let form = DMatrix::from_fn(2 * n, 2 * n, |row, column| {
                f64::from(u8::from(column == row + n)) - f64::from(u8::from(row == column + n))
            });
            let mut out = Linearization::new(&model);
            let u = vec![0.0; model.dimensions().input()];
            plant.step_and_linearize(&u, &mut out).unwrap();
            let a = out.a() * &tangent;
            let defect = a.transpose() * &form * &a - tangent.transpose() * &form * &tangent;
            let size = a.amax().powi(2);
            assert!(size > 1.0 && defect.amax() < 1e-12 * size, "{order}: {:e}", defect.amax());
        }
    }
}

/// Momenta of a linkage that floats stay in long steps, and energy stays near where it was.
#[test]
fn momenta_and_energy_are_kept() {
    let scene = floating_linkage();
    for order in ORDERS {
        let mut plant = moving(&scene, order, 20.0);
        let momenta = |plant: &Plant| {
            let (q, p) = (plant.q(), plant.p());
            // About the y axis, from z to x.
            [p[0], p[1], q[1] * p[0] - q[0] * p[1] + p[2]]
        };
        let energy = |plant: &mut Plant| plant.energy().kinetic_j;
        let (before, start) = (momenta(&plant), energy(&mut plant));
        assert!(before.iter().all(|x| x.abs() > 0.1), "a test of nothing: {before:?}");
        let mut worst = 0.0_f64;
        for _ in 0..2000 {
            coast(&mut plant, 1);
            worst = worst.max((energy(&mut plant) / start - 1.0).abs());
        }
        for (x, y) in before.iter().zip(momenta(&plant)) {
            assert!((x - y).abs() < 1e-11, "{order}: {x} became {y}");
        }
        assert!(worst < 1e-3, "{order}: {worst:e}");
    }
}

/// In space, where forces, springs, dampers and a prescribed joint act.
#[test]
fn derivatives_in_space() {
    for more in ["", DRIVEN] {
        let scene = on_constraints(spatial(more));
        for order in [4, 6] {
            check_with(&scene, |s| s.order = order);
        }
        check_with(&scene, |s| (s.order, s.substeps) = (4, 2));
        check_second_order_with(&scene, |s| s.order = 4);
    }
}

/// A scene that begins where its constraints hold.
fn on_constraints(mut scene: Scene) -> Scene {
    let start = moving(&scene, 2, 100.0);
    for (coordinate, q) in start.model().coordinates().iter().zip(start.q()) {
        match scene.coordinates.iter_mut().find(|c| c.name == coordinate.name) {
            Some(own) => own.initial = *q,
            None => scene.coordinates.push(plantd_models::scene::Coordinate {
                name: coordinate.name.clone(),
                initial: *q,
                ..Default::default()
            }),
        }
    }
    scene
}

/// A plant that goes on from bytes has the bits of one that went on, and a step that fails leaves no trace.
#[test]
fn restored_plants_go_on_bit_for_bit() {
    for order in ORDERS {
        for scene in [builtin("four-bar"), builtin("marionette")] {
            let mut plant = plant(&scene, |s| (s.order, s.halvings) = (order, 0));
            let mut other = plant.clone();
            wave(&mut plant, 7);
            let bytes = plant.snapshot().to_bytes();
            let mut u = waving_input(&plant, 8);
            u.iter_mut().for_each(|u| *u += 1e4);
            plant.step(&u).unwrap_err();
            assert_eq!(plant.snapshot().to_bytes(), bytes, "{order}");
            other.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
            wave(&mut plant, 9);
            wave(&mut other, 9);
            assert_eq!(plant.snapshot().to_bytes(), other.snapshot().to_bytes(), "{order}");
        }
    }
}
