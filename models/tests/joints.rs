//! Joints beyond hinges and slides: closed forms, conservation, derivatives on the manifold.

use crate::common::{SPLITS, builtin, plant, slope, wave, waving_input};
use nalgebra::{DMatrix, Matrix3, Rotation3, Vector3};
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, ForceSplit, Initial, Linearization, Plant, Scene,
    SecondOrder, Settings, State,
};

fn element(name: &str) -> Scene {
    let path = format!("{}/../scenes/elements/{name}.toml", env!("CARGO_MANIFEST_DIR"));
    Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// The linearization of a step against differences on the manifold.
fn check_derivatives(scene: &Scene, split: ForceSplit) {
    let mut plant = plant(scene, |s| s.force_split = split);
    wave(&mut plant, 20);
    let model = plant.model().clone();
    let (d, x, u) = (model.dimensions(), plant.state(), waving_input(&plant, 23));
    let mut out = Linearization::new(&model);
    plant.linearize(&u, &mut out).unwrap();
    let next = |plant: &mut Plant, x: &State, u: &[f64]| {
        let initial = Initial::Momentum { q: x.q.clone(), p: x.p.clone(), v: x.v.clone() };
        plant.initialize(&initial).unwrap();
        plant.step(u).unwrap();
        plant.state()
    };
    let nominal = next(&mut plant, &x, &u);
    let result = |plant: &mut Plant, x: &State, u: &[f64]| {
        let end = next(plant, x, u);
        [model.difference(&nominal.q, &end.q), end.p, end.v, end.multipliers].concat()
    };
    let stack = |x: DMatrix<f64>, multipliers: DMatrix<f64>| {
        let mut rows = x.resize_vertically(d.state() + d.constraints, 0.0);
        rows.rows_mut(d.state(), d.constraints).copy_from(&multipliers);
        rows
    };
    let (by_x, by_u) = (stack(out.a(), out.multipliers_x()), stack(out.b(), out.multipliers_u()));
    let n = d.coordinates();
    for column in 0..d.state() + d.input() {
        let (predicted, delta) = if column < d.state() {
            let mobility = by_x.view((0, column), (n, 1)).amax();
            (by_x.column(column), if column < n { 1e-3 } else { (2e-3 / mobility).min(0.1) })
        } else {
            let column = column - d.state();
            let mobility = by_u.view((0, column), (n, 1)).amax();
            (by_u.column(column), if column < d.inputs { (2e-3 / mobility).min(0.1) } else { 1e-3 })
        };
        let found = slope(delta, |s| {
            let (mut x, mut u) = (x.clone(), u.clone());
            if column < n {
                let mut change = vec![0.0; n];
                change[column] = s;
                x.q = model.retract(&x.q, &change);
            } else if column < d.state() {
                let (p, v) = (&mut x.p, &mut x.v);
                *p.iter_mut().chain(v).nth(column - n).unwrap() += s;
            } else if column < d.state() + d.inputs {
                u[column - d.state()] += s;
            } else {
                let mut end = x.q.clone();
                end[d.dynamic..].copy_from_slice(&u[d.inputs..]);
                let mut change = vec![0.0; n];
                change[d.dynamic + column - d.state() - d.inputs] = s;
                u[d.inputs..].copy_from_slice(&model.retract(&end, &change)[d.dynamic..]);
            }
            result(&mut plant, &x, &u)
        });
        let scale = found.iter().fold(1e-3_f64, |a, x| a.max(x.abs()));
        for (row, (p, f)) in predicted.iter().zip(&found).enumerate() {
            assert!(
                (p - f).abs() < 1e-8 * scale,
                "{} {split:?}: [{row}, {column}] is {p}, differences {f}",
                scene.name
            );
        }
    }
}

#[test]
fn derivatives_on_the_manifold() {
    for name in ["screw", "universal", "free"] {
        for split in SPLITS {
            check_derivatives(&element(name), split);
        }
    }
    check_derivatives(&builtin("spherical-pendulum"), ForceSplit::Symmetric);
}

/// `(I + m p²) q̈ = −m g p`: gravity drives a nut down its thread.
#[test]
fn a_nut_runs_down_its_thread() {
    let mut scene = element("screw");
    scene.coordinates[0].damping = None;
    let mut plant = plant(&scene, |_| {});
    let (mass, pitch, inertia) = (0.4, 0.02, 3e-4 + 0.4 * 0.01 * 0.01);
    let acceleration = -mass * 9.81 * pitch / (inertia + mass * pitch * pitch);
    for k in 1..=200 {
        plant.step(&[]).unwrap();
        let t = 0.01 * f64::from(k);
        let exact = 0.5 * acceleration * t * t;
        assert!((plant.q()[0] - exact).abs() < 1e-12 * exact.abs().max(1.0), "{k}");
    }
}

#[test]
fn a_universal_joint_is_two_hinges() {
    let text = element("universal").to_toml();
    let scene = Scene::from_toml(&text).unwrap();
    let hinges = Scene::from_toml(
        &text
            .replace("[frames.joint]\ntype = \"universal\"", "[frames.joint]\ntype = \"revolute\"")
            .replace("axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]", "axis = [0.0, 1.0, 0.0]\ncoordinate = \"bob_2\"")
            .replace("name = \"bob\"\n", "name = \"bob\"\nparent = \"yoke\"\n")
            .replacen(
                "[[frames]]",
                "[[frames]]\nname = \"yoke\"\njoint = { type = \"revolute\", axis = [1.0, 0.0, 0.0], coordinate = \"bob_1\" }\n\n[[frames]]",
                1,
            ),
    )
    .unwrap();
    let (mut a, mut b) = (plant(&scene, |_| {}), plant(&hinges, |_| {}));
    for _ in 0..200 {
        a.step(&[]).unwrap();
        b.step(&[]).unwrap();
        assert_eq!(a.q(), b.q());
    }
}

/// A ball joint and three hinges with massless yokes are two charts of one body: the same motion to
/// second order in the time step.
#[test]
fn a_ball_joint_moves_like_three_hinges() {
    let ball = element("ball");
    let mut hinges = ball.clone();
    let body = hinges.frames[0].body.take();
    hinges.frames.clear();
    for (i, (name, parent)) in [("z", "world"), ("y", "z"), ("x", "y")].iter().enumerate() {
        let mut axis = [0.0; 3];
        axis[2 - i] = 1.0;
        hinges.frames.push(plantd_models::scene::Frame {
            name: (*name).to_owned(),
            parent: (*parent).to_owned(),
            translation: [0.0; 3],
            rotation: None,
            joint: Some(plantd_models::scene::Joint::Revolute { axis, coordinate: None }),
            body: if i == 2 { body.clone() } else { None },
            ..Default::default()
        });
    }
    hinges.coordinates.clear();
    hinges.inputs.clear();
    let angles = [0.3, -0.4, 0.7];
    let orientation = |q: &[f64]| {
        let turn = |axis: Vector3<f64>, angle: f64| *Rotation3::new(axis * angle).matrix();
        turn(Vector3::z(), q[0]) * turn(Vector3::y(), q[1]) * turn(Vector3::x(), q[2])
    };
    // Angular velocity in the body for rates of the angles.
    let rates = [2.0, -1.0, 30.0];
    let spin = {
        let [_, y, x] = angles;
        let (x_turn, y_turn) = (Rotation3::new(Vector3::x() * x), Rotation3::new(Vector3::y() * y));
        Vector3::x() * rates[2]
            + x_turn.inverse() * (Vector3::y() * rates[1])
            + (y_turn * x_turn).inverse() * (Vector3::z() * rates[0])
    };
    let start = Rotation3::from_matrix_unchecked(orientation(&angles)).scaled_axis();
    let error = |h: f64| {
        let (mut a, mut b) =
            (plant(&ball, |s| s.time_step_s = h), plant(&hinges, |s| s.time_step_s = h));
        a.initialize(&Initial::Velocity {
            q: start.as_slice().to_vec(),
            v: spin.as_slice().to_vec(),
        })
        .unwrap();
        b.initialize(&Initial::Velocity { q: angles.to_vec(), v: rates.to_vec() }).unwrap();
        let steps = (0.2 / h).round() as usize;
        for _ in 0..steps {
            a.step(&[0.0]).unwrap();
            b.step(&[]).unwrap();
        }
        let turned: Matrix3<f64> = *Rotation3::new(Vector3::from_row_slice(a.q())).matrix();
        (turned - orientation(b.q())).amax()
    };
    let (coarse, fine) = (error(4e-4), error(2e-4));
    assert!(coarse < 1e-3 && (3.8..4.2).contains(&(coarse / fine)), "{coarse:e} {fine:e}");
}

/// The second order against differences of the first: with ball joints the mean of the derivative along
/// one direction of the derivative along the other, both ways.
fn check_second_order(scene: &Scene, split: ForceSplit) {
    check_second_order_with(scene, |s| s.force_split = split);
}

fn check_second_order_with(scene: &Scene, change: impl FnOnce(&mut Settings)) {
    let mut plant = plant(scene, change);
    let Settings { order, force_split: split, .. } = *plant.settings();
    wave(&mut plant, 20);
    let model = plant.model().clone();
    let (d, x, u) = (model.dimensions(), plant.state(), waving_input(&plant, 23));
    let (n, states) = (d.coordinates(), d.state());
    let mut first = Linearization::new(&model);
    let mut second = SecondOrder::new(&model).unwrap();
    plant.linearize_second_order(&u, &mut first, &mut second).unwrap();
    let weights: Vec<f64> = (0..states).map(|i| (i as f64 + 1.0).sin()).collect();
    let impulses: Vec<f64> = (0..d.constraints).map(|c| (c as f64 + 0.5).cos()).collect();
    let mut contraction = Contraction::new(&model);
    plant.contract_second_order(&u, &weights, &impulses, &mut first, &mut contraction).unwrap();
    let whole = |xx: &DMatrix<f64>, xu: &DMatrix<f64>, uu: &DMatrix<f64>| {
        let size = states + d.input();
        DMatrix::from_fn(size, size, |a, b| match (a < states, b < states) {
            (true, true) => xx[(a, b)],
            (true, false) => xu[(a, b - states)],
            (false, true) => xu[(b, a - states)],
            (false, false) => uu[(a - states, b - states)],
        })
    };
    let tensors: Vec<DMatrix<f64>> = (0..states)
        .map(|i| whole(&second.xx(i), &second.xu(i), &second.uu(i)))
        .chain((0..d.constraints).map(|c| {
            whole(&second.multiplier_xx(c), &second.multiplier_xu(c), &second.multiplier_uu(c))
        }))
        .collect();
    let sum = tensors
        .iter()
        .zip(weights.iter().chain(&impulses))
        .map(|(tensor, w)| tensor * *w)
        .reduce(|a, b| a + b)
        .unwrap();
    let contracted = whole(&contraction.xx, &contraction.xu, &contraction.uu);
    let error = (&sum - &contracted).amax() / sum.amax().max(1e-2);
    assert!(error < 1e-11, "{} {split:?} {order}: contraction differs by {error:e}", scene.name);

    // Rows of all outputs, columns of all parameters, row by row. Where there are constraints, configurations change
    // along curves that keep them.
    let size = states + d.input();
    let mut along = vec![DMatrix::zeros(tensors.len(), size); size];
    let mut directions = DMatrix::identity(size, size);
    let turned = |plant: &mut Plant, a: usize, s: f64| {
        let mut change = vec![0.0; n];
        change[a] = s;
        let q = model.retract(&x.q, &change);
        if d.constraints == 0 {
            return q;
        }
        plant.initialize(&Initial::Projection { q, hold: Vec::new() }).unwrap();
        plant.q().to_vec()
    };
    for a in 0..n {
        let direction = slope(1e-3, |s| model.difference(&x.q, &turned(&mut plant, a, s)));
        directions.view_mut((0, a), (n, 1)).copy_from_slice(&direction);
    }
    for (a, along) in along.iter_mut().enumerate() {
        if (n + d.dynamic..states).contains(&a) {
            continue;
        }
        let mobility = if a < states { first.a() } else { first.b() };
        let mobility = mobility.column(if a < states { a } else { a - states }).rows(0, n).amax();
        let delta = if a < n || a >= states + d.inputs { 1e-3 } else { (2e-3 / mobility).min(0.1) };
        let found = slope(delta, |s| {
            let (mut x, mut u) = (x.clone(), u.clone());
            let mut change = vec![0.0; n];
            if a < n {
                x.q = turned(&mut plant, a, s);
            } else if a < states {
                x.p[a - n] += s;
            } else if a < states + d.inputs {
                u[a - states] += s;
            } else {
                let mut end = x.q.clone();
                end[d.dynamic..].copy_from_slice(&u[d.inputs..]);
                change[d.dynamic + a - states - d.inputs] = s;
                u[d.inputs..].copy_from_slice(&model.retract(&end, &change)[d.dynamic..]);
            }
            let initial = Initial::Momentum { q: x.q, p: x.p, v: x.v };
            plant.initialize(&initial).unwrap();
            plant.linearize(&u, &mut first).unwrap();
            let mut rows = DMatrix::zeros(tensors.len(), size);
            rows.view_mut((0, 0), (states, states)).copy_from(&first.a());
            rows.view_mut((0, states), (states, d.input())).copy_from(&first.b());
            let lambda = (states, d.constraints);
            rows.view_mut((lambda.0, 0), (lambda.1, states)).copy_from(&first.multipliers_x());
            rows.view_mut((lambda.0, states), (lambda.1, d.input()))
                .copy_from(&first.multipliers_u());
            rows.as_slice().to_vec()
        });
        *along = DMatrix::from_column_slice(tensors.len(), size, &found);
    }
    for (output, tensor) in tensors.iter().enumerate() {
        let tensor = directions.tr_mul(&(tensor * &directions));
        let slopes = DMatrix::from_fn(size, size, |a, b| along[a][(output, b)]) * &directions;
        let differences = (&slopes + slopes.transpose()) * 0.5;
        let scale = differences.amax().max(1e-3);
        for (entry, (x, y)) in tensor.iter().zip(differences.iter()).enumerate() {
            let (a, b) = (entry % size, entry / size);
            assert!(
                (x - y).abs() < 1e-7 * scale,
                "{} {split:?} {order}: ∂²[{output}] by {a}, {b} is {x}, differences {y}",
                scene.name
            );
        }
    }
}

#[test]
fn second_derivatives_on_the_manifold() {
    for name in ["screw", "universal", "free"] {
        for split in SPLITS {
            check_second_order(&element(name), split);
        }
    }
    for name in ["ball", "free"] {
        for order in [4, 8] {
            check_second_order_with(&element(name), |s| s.order = order);
        }
    }
    for order in [2, 4, 6] {
        check_second_order_with(&element("weld"), |s| s.order = order);
    }
}

/// Euler's equation of a top about its fixed point, `I ω̇ + ω × I ω = c × m Rᵀ g`.
#[test]
fn a_top_obeys_eulers_equation() {
    let scene = element("ball");
    let model = std::sync::Arc::new(plantd_models::Model::compile(&scene).unwrap());
    let (mass, center) = (0.3, Vector3::new(0.0, 0.0, 0.05));
    let inertia = Matrix3::from_diagonal(&Vector3::new(4e-4, 4e-4, 2e-4))
        + (Matrix3::identity() * center.dot(&center) - center * center.transpose()) * mass;
    let (turn, spin) = (Vector3::new(0.4, -0.9, 0.3), Vector3::new(3.0, -5.0, 60.0));
    let torque = Vector3::new(0.0, 0.0, 0.02);
    let gravity = Rotation3::new(turn).inverse() * Vector3::new(0.0, 0.0, -9.81);
    let moment = center.cross(&(gravity * mass)) + torque - spin.cross(&(inertia * spin));
    let expected = inertia.try_inverse().unwrap() * moment;
    let found = Continuous::new(model)
        .evaluate(&ContinuousPoint {
            q: turn.as_slice().to_vec(),
            v: spin.as_slice().to_vec(),
            inputs: vec![torque[2]],
            prescribed_acceleration: Vec::new(),
        })
        .unwrap();
    let found = Vector3::from_row_slice(&found.acceleration);
    assert!((found - expected).norm() < 1e-12 * expected.norm(), "{found} {expected}");
}

/// First and second derivatives of the continuous dynamics against differences on the manifold.
#[test]
fn continuous_derivatives_on_the_manifold() {
    for name in ["screw", "universal", "ball", "free"] {
        let scene = element(name);
        let model = std::sync::Arc::new(plantd_models::Model::compile(&scene).unwrap());
        let (d, mut dynamics) = (model.dimensions(), Continuous::new(model.clone()));
        let n = d.coordinates();
        let at = ContinuousPoint {
            q: (0..n).map(|i| 0.4 + 0.3 * (i as f64).sin()).collect(),
            v: (0..n).map(|i| 0.8 * (i as f64 + 0.7).cos()).collect(),
            inputs: (0..d.inputs).map(|i| 1e-3 * (i as f64 + 1.0)).collect(),
            prescribed_acceleration: vec![0.3; d.prescribed],
        };
        let moved = |a: usize, s: f64| {
            let mut at = at.clone();
            if a < n {
                let mut change = vec![0.0; n];
                change[a] = s;
                at.q = model.retract(&at.q, &change);
            } else {
                let parts = [&mut at.v, &mut at.inputs, &mut at.prescribed_acceleration];
                *parts.into_iter().flatten().nth(a - n).unwrap() += s;
            }
            at
        };
        let first = dynamics.linearize(&at).unwrap().jacobian;
        let second = dynamics.second_order(&at).unwrap();
        let (outputs, size) = first.shape();
        let mut along = Vec::new();
        for a in 0..size {
            let found = slope(1e-2, |s| {
                let value = dynamics.evaluate(&moved(a, s)).unwrap();
                [value.acceleration, value.multipliers].concat()
            });
            for (i, f) in found.iter().enumerate() {
                let scale = first.row(i).amax().max(1e-3);
                assert!((f - first[(i, a)]).abs() < 1e-8 * scale, "{name} [{i}, {a}]: {f}");
            }
            along.push(slope(1e-2, |s| {
                dynamics.linearize(&moved(a, s)).unwrap().jacobian.as_slice().to_vec()
            }));
        }
        for (i, tensor) in second.iter().enumerate() {
            let scale = tensor.amax().max(1e-2);
            for (a, b) in (0..size * size).map(|e| (e / size, e % size)) {
                let mean = 0.5 * (along[a][b * outputs + i] + along[b][a * outputs + i]);
                let error = (mean - tensor[(a, b)]).abs();
                assert!(error < 1e-7 * scale, "{name} [{i}] by {a}, {b}: {mean} {error:e}");
            }
        }
    }
}

/// A ball joint that the input turns, a pendulum with a ball joint below it, tied by springs.
const PLATFORM: &str = r#"
format = 1
name = "platform"
gravity = [0.5, 0.0, -9.81]
damping = 0.02

[[frames]]
name = "platform"
translation = [0.1, 0.0, 0.0]
joint = { type = "ball" }
[[frames]]
name = "mast"
parent = "platform"
translation = [0.0, 0.2, 0.1]
joint = { type = "revolute", axis = [1.0, 0.2, 0.0] }
body = { mass = 0.8, center_of_mass = [0.0, 0.1, 0.3], inertia = [0.02, 0.02, 0.01] }
[[frames]]
name = "bob"
parent = "mast"
translation = [0.0, 0.0, 0.5]
joint = { type = "ball" }
body = { mass = 0.5, center_of_mass = [0.1, 0.0, -0.3], inertia = [0.02, 0.03, 0.025, 1e-3, 0.0, 2e-3] }
[[frames]]
name = "free"
joint = { type = "free" }
translation = [0.6, 0.0, 0.0]
body = { mass = 1.0, center_of_mass = [0.05, 0.0, 0.0], inertia = [0.02, 0.03, 0.025] }

[[coordinates]]
name = "platform_rx"
kind = "prescribed"
initial = 0.3
[[coordinates]]
name = "platform_ry"
kind = "prescribed"
initial = -0.2
[[coordinates]]
name = "platform_rz"
kind = "prescribed"
initial = 0.5
[[coordinates]]
name = "bob_rx"
initial = 0.4
[[coordinates]]
name = "free_rz"
initial = -0.6

[[springs]]
type = "two_point"
a = { frame = "bob", at = [0.0, 0.0, -0.5] }
b = { frame = "world", at = [1.0, 0.0, 0.0] }
stiffness = 20.0
rest_length = 0.4
[[springs]]
type = "two_point"
a = { frame = "bob", at = [0.1, 0.0, -0.5] }
b = { frame = "free", at = [0.0, 0.2, 0.0] }
stiffness = 10.0
rest_length = 0.2

[[inputs]]
name = "twist"
coordinate = "bob_ry"
gain = 0.7
[[inputs]]
name = "push"
coordinate = "free_x"
"#;

#[test]
fn ball_joints_with_springs_and_prescribed_ones() {
    let scene = Scene::from_toml(PLATFORM).unwrap();
    for split in SPLITS {
        check_derivatives(&scene, split);
        check_second_order(&scene, split);
    }
}

/// The spherical pendulum without its angles: a ball joint swings through the lower pole and over the
/// upper one, where the angles are singular, exactly as a hinge does in the plane of the motion.
#[test]
fn a_spherical_pendulum_on_a_ball_joint_has_no_poles() {
    let body =
        "body = { mass = 1.3, center_of_mass = [0.0, 0.0, -0.7], inertia = [0.01, 0.01, 0.01] }";
    let scene = |joint: &str| {
        Scene::from_toml(&format!(
            "format = 1\nname = \"pendulum\"\ngravity = [0.0, 0.0, -9.81]\n[[frames]]\nname = \"rod\"\njoint = {joint}\n{body}\n"
        ))
        .unwrap()
    };
    let axis = Vector3::new(0.6, 0.8, 0.0);
    let mut ball = plant(&scene("{ type = \"ball\" }"), |_| {});
    let mut hinge = plant(&scene("{ type = \"revolute\", axis = [0.6, 0.8, 0.0] }"), |_| {});
    let (angle, rate) = (-0.5, 11.5);
    let [turn, spin] = [axis * angle, axis * rate].map(|v| v.as_slice().to_vec());
    ball.initialize(&Initial::Velocity { q: turn, v: spin }).unwrap();
    hinge.initialize(&Initial::Velocity { q: vec![angle], v: vec![rate] }).unwrap();
    let mut top = 0.0_f64;
    for _ in 0..400 {
        let report = ball.step(&[]).unwrap();
        hinge.step(&[]).unwrap();
        assert!(report.reciprocal_condition > 1e-3, "{report:?}");
        let expected = axis * hinge.q()[0];
        let found = Rotation3::new(Vector3::from_row_slice(ball.q()));
        let apart = (found.matrix() - Rotation3::new(expected).matrix()).amax();
        assert!(apart < 1e-11, "{apart:e} at {}", hinge.q()[0]);
        top = top.max(hinge.q()[0]);
    }
    assert!(top > 2.0 * std::f64::consts::TAU, "{top}");
}

/// Free-flying bodies, one tumbling on a ball joint of the other, keep linear and angular momentum to
/// round-off over a million steps.
#[test]
fn a_million_tumbles_keep_the_momenta() {
    let text = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "tumbling"
time_step_s = 0.01

[[frames]]
name = "hull"
joint = { type = "free" }
body = { mass = 2.0, center_of_mass = [0.1, 0.0, -0.05], inertia = [0.02, 0.03, 0.045, 1e-3, 2e-3, -1e-3] }
[[frames]]
name = "arm"
parent = "hull"
translation = [0.0, 0.2, 0.1]
joint = { type = "ball" }
body = { mass = 0.7, center_of_mass = [0.0, 0.2, 0.1], inertia = [0.01, 0.012, 0.008] }
"#;
    let mut plant = plant(&Scene::from_toml(text).unwrap(), |_| {});
    let v = [0.0, 0.0, 0.0, 0.9, -1.4, 2.1, -1.1, 0.8, 1.7];
    plant.initialize(&Initial::Velocity { q: vec![0.0; 9], v: v.to_vec() }).unwrap();
    let momenta = |plant: &mut Plant| {
        let d = plant.diagnose();
        (Vector3::from(d.linear_momentum), Vector3::from(d.angular_momentum))
    };
    let (linear, angular) = momenta(&mut plant);
    for _ in 0..20 {
        for _ in 0..50_000 {
            plant.step(&[]).unwrap();
        }
        let (p, l) = momenta(&mut plant);
        assert!((p - linear).norm() < 1e-14, "{p} {linear}");
        assert!((l - angular).norm() < 1e-11, "{l} {angular}");
    }
}
