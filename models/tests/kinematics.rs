//! Kinematics of frames and the terms of the equation of motion against differences, energies, closed forms
//! and forward dynamics.

use std::sync::Arc;

use crate::common::{
    Numbers, builtin, floating, forced_tree, model, plant, random_tree, slope, wave,
};
use nalgebra::{DMatrix, DVector};
use plantd_models::{
    Continuous, ContinuousError, ContinuousPoint, Diagnostics, FrameMotion, Initial, Kinematics,
    Model, Plant, Scene, Settings, Terms,
};

fn elements() -> Vec<Scene> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    let mut paths: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let read = |path: &std::path::PathBuf| {
        Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
    };
    paths.iter().map(read).collect()
}

fn scenes() -> Vec<Scene> {
    let names = ["pendulum", "double-pendulum", "cart-pole", "four-bar", "scissor-3", "marionette"];
    let trees = (0..8).map(random_tree).chain((0..8).map(forced_tree));
    names.map(builtin).into_iter().chain([floating()]).chain(trees).chain(elements()).collect()
}

/// Any configuration near the initial one, on constraints or not, with any velocity, inputs and accelerations.
fn point(model: &Model, seed: u64) -> (ContinuousPoint, Vec<f64>) {
    let d = model.dimensions();
    let mut random = Numbers::new(seed);
    let mut numbers =
        |count: usize| -> Vec<f64> { (0..count).map(|_| random.between(-1.0, 1.0)).collect() };
    let change: Vec<f64> = numbers(d.coordinates()).iter().map(|x| 0.4 * x).collect();
    let initial: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
    let point = ContinuousPoint {
        q: model.retract(&initial, &change),
        v: numbers(d.coordinates()),
        inputs: numbers(d.inputs),
        prescribed_acceleration: numbers(d.prescribed),
    };
    (point, numbers(d.dynamic))
}

fn close(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1.0_f64, |scale, x| scale.max(x.abs()));
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        assert!((x - y).abs() <= tolerance * scale, "{what}[{i}]: {x} instead of {y}");
    }
}

fn unit(n: usize, i: usize) -> Vec<f64> {
    (0..n).map(|j| f64::from(u8::from(i == j))).collect()
}

/// The angular velocity `2 ṗ p⁻¹` of a quaternion, by differences of its sign-corrected components.
fn angular_velocity(reference: [f64; 4], rate: &[f64]) -> [f64; 3] {
    let [w, x, y, z] = reference;
    let [a, b, c, d] = [rate[0], rate[1], rate[2], rate[3]];
    [
        2.0 * (-a * x + b * w - c * z + d * y),
        2.0 * (-a * y + b * z + c * w - d * x),
        2.0 * (-a * z - b * y + c * x + d * w),
    ]
}

fn numbers(motion: &FrameMotion, reference: [f64; 4]) -> Vec<f64> {
    let along: f64 = motion.orientation.iter().zip(reference).map(|(a, b)| a * b).sum();
    let orientation = motion.orientation.map(|x| x * along.signum());
    [&motion.position[..], &orientation].concat()
}

/// Jacobians, velocities and the centre of mass against differences of positions and orientations, along each
/// coordinate and along the velocity.
#[test]
fn velocities_and_jacobians_are_differences_of_poses() {
    for scene in scenes() {
        let model = model(&scene);
        let (n, name) = (model.dimensions().coordinates(), &scene.name);
        let (at, _) = point(&model, 3);
        let mut kinematics = Kinematics::new(Arc::clone(&model));
        let frames: Vec<String> =
            kinematics.frames().iter().cloned().chain(["world".to_owned()]).collect();
        for frame in frames {
            let place = kinematics.point(&frame, [0.3, -0.2, 0.5]).unwrap();
            kinematics.place(&at.q, &at.v).unwrap();
            let (here, jacobian) = (kinematics.motion(&place), kinematics.jacobian(&place));
            let mut rates = |direction: &[f64]| {
                let rate = slope(1e-3, |t| {
                    let change: Vec<f64> = direction.iter().map(|d| t * d).collect();
                    kinematics.place(&model.retract(&at.q, &change), &at.v).unwrap();
                    numbers(&kinematics.motion(&place), here.orientation)
                });
                let turned = angular_velocity(here.orientation, &rate[3..]);
                [&rate[..3], &turned].concat()
            };
            let what = format!("{name}, {frame}");
            for i in 0..n {
                close(jacobian.column(i).as_slice(), &rates(&unit(n, i)), 1e-9, &what);
            }
            let velocity = [here.linear_velocity, here.angular_velocity].concat();
            close(&velocity, &rates(&at.v), 1e-9, &what);
        }
        kinematics.place(&at.q, &at.v).unwrap();
        let (center, jacobian) =
            (kinematics.center_of_mass(), kinematics.center_of_mass_jacobian());
        let mut rates = |direction: &[f64]| {
            slope(1e-3, |t| {
                let change: Vec<f64> = direction.iter().map(|d| t * d).collect();
                kinematics.place(&model.retract(&at.q, &change), &at.v).unwrap();
                kinematics.center_of_mass().position.to_vec()
            })
        };
        for i in 0..n {
            close(jacobian.column(i).as_slice(), &rates(&unit(n, i)), 1e-9, name);
        }
        close(&center.velocity, &rates(&at.v), 1e-9, name);
    }
}

/// Poses are those of sites, the centre of mass that of the diagnosis, in a motion.
#[test]
fn frames_and_mass_are_those_of_a_plant() {
    for scene in ["cart-pole", "marionette", "scissor-3"].map(builtin) {
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 5);
        let mut kinematics = Kinematics::new(plant.model().clone());
        let velocity = plant.velocity();
        kinematics.place(plant.q(), &velocity).unwrap();
        for frame in kinematics.frames() {
            let at = [0.1, 0.2, -0.3];
            let site = plant.model().site(frame, at).unwrap();
            let motion = kinematics.motion(&kinematics.point(frame, at).unwrap());
            close(&motion.position, &plant.pose(&site).position, 1e-13, frame);
            let rotation = plant.pose(&site).rotation;
            let angle = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
            let [w, ..] = motion.orientation;
            close(&[w.abs()], &[(0.5 * angle).cos().abs()], 1e-13, frame);
        }
        let (found, known) = (kinematics.center_of_mass(), plant.diagnose());
        close(&found.position, &known.center_of_mass, 1e-13, &scene.name);
        let momentum = found.velocity.map(|v| v * found.mass_kg);
        close(&momentum, &known.linear_momentum, 1e-12, &scene.name);
        assert!((found.mass_kg - known.mass_kg).abs() < 1e-13 * known.mass_kg);
    }
}

fn terms(model: &Arc<Model>, at: &ContinuousPoint) -> Terms {
    Continuous::new(Arc::clone(model)).terms(at).unwrap()
}

/// `½ vᵀ M v` is the kinetic energy of the plant, and forces at rest are the slope of its potential energy.
#[test]
fn energies_make_the_mass_matrix_and_the_forces_at_rest() {
    for scene in scenes() {
        let (model, name) = (model(&scene), &scene.name);
        let (at, _) = point(&model, 11);
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model));
        // Scenes that begin at a guess have no plant at it.
        let Ok(plant) = &mut plant else { continue };
        let found = terms(&model, &at);
        let energy = plant.energy_at(&at.q, &at.v).unwrap();
        let v = DVector::from_column_slice(&at.v);
        let twice = v.dot(&(&found.mass_matrix * &v));
        let energies = [found.energy.kinetic_j, found.energy.potential_j, 0.5 * twice];
        let expected = [energy.kinetic_j, energy.potential_j, energy.kinetic_j];
        close(&energies, &expected, 1e-12, name);
        assert_eq!((&found.mass_matrix - found.mass_matrix.transpose()).amax(), 0.0, "{name}");

        if !scene.forces.is_empty() {
            continue;
        }
        let rest = ContinuousPoint { v: vec![0.0; at.v.len()], ..at.clone() };
        let still = terms(&model, &rest);
        close(&still.bias, &found.gravity, 1e-12, name);
        for i in 0..at.q.len() {
            let slope = slope(1e-3, |t| {
                let change: Vec<f64> = unit(at.q.len(), i).iter().map(|x| t * x).collect();
                let q = model.retract(&at.q, &change);
                vec![plant.energy_at(&q, &rest.v).unwrap().potential_j]
            });
            close(&[still.gravity[i] - still.passive[i]], &slope, 1e-9, name);
        }
    }
}

/// `bias = Ṁ v − ½ ∂(vᵀ M v)/∂q + gravity`, where coordinates are no rotation vectors.
#[test]
fn the_bias_follows_from_the_mass_matrix() {
    let has_balls = |scene: &Scene| !model(scene).orientations().is_empty();
    for scene in scenes().iter().filter(|scene| !has_balls(scene)) {
        let model = model(scene);
        let (at, _) = point(&model, 5);
        let (n, found) = (at.q.len(), terms(&model, &at));
        let v = DVector::from_column_slice(&at.v);
        let mut by_q: Vec<DMatrix<f64>> = Vec::new();
        for i in 0..n {
            let column = slope(1e-3, |t| {
                let mut at = at.clone();
                at.q[i] += t;
                terms(&model, &at).mass_matrix.as_slice().to_vec()
            });
            by_q.push(DMatrix::from_column_slice(n, n, &column));
        }
        let moving = by_q.iter().zip(&at.v).map(|(by, v)| by * *v);
        let rate: DMatrix<f64> = moving.fold(DMatrix::zeros(n, n), |sum, term| sum + term);
        let expected: Vec<f64> = (0..n)
            .map(|i| (&rate * &v)[i] - 0.5 * v.dot(&(&by_q[i] * &v)) + found.gravity[i])
            .collect();
        close(&found.bias, &expected, 1e-8, &scene.name);
    }
}

const DOUBLE: &str = r#"
format = 1
name = "two-rods"
gravity = [0, 0, -9.8]
[[frames]]
name = "upper"
joint = { type = "revolute", axis = [0, 1, 0] }
body = { mass = 1.5, center_of_mass = [0, 0, -0.7] }
[[frames]]
name = "lower"
parent = "upper"
translation = [0, 0, -0.7]
joint = { type = "revolute", axis = [0, 1, 0] }
body = { mass = 0.8, center_of_mass = [0, 0, -0.4] }
[[coordinates]]
name = "upper"
armature = 0.25
damping = 0.1
[[coordinates]]
name = "lower"
damping = 0.0
[[inputs]]
name = "elbow"
coordinate = "lower"
gain = 2.0
"#;

/// Two point masses on massless rods, in relative angles.
#[test]
fn a_double_pendulum_in_closed_form() {
    let model = model(&Scene::from_toml(DOUBLE).unwrap());
    let (m1, m2, l1, l2, g) = (1.5, 0.8, 0.7, 0.4, 9.8);
    let (a, b, va, vb) = (0.4_f64, -1.1_f64, 0.9, -1.7);
    let at = ContinuousPoint {
        q: vec![a, b],
        v: vec![va, vb],
        inputs: vec![0.6],
        prescribed_acceleration: vec![],
    };
    let found = terms(&model, &at);
    let (cross, inner) = (m2 * l1 * l2 * b.cos(), m2 * l2 * l2);
    let corner = (m1 + m2) * l1 * l1 + inner + 2.0 * cross + 0.25;
    let mass = [corner, inner + cross, inner + cross, inner];
    close(found.mass_matrix.as_slice(), &mass, 1e-14, "M");
    let s = m2 * l1 * l2 * b.sin();
    let (down_a, down_b) = ((m1 + m2) * g * l1 * a.sin(), m2 * g * l2 * (a + b).sin());
    let gravity = [down_a + down_b, down_b];
    close(&found.gravity, &gravity, 1e-14, "gravity");
    let bias = [gravity[0] - s * (2.0 * va * vb + vb * vb), gravity[1] + s * va * va];
    close(&found.bias, &bias, 1e-14, "bias");
    close(&found.passive, &[-0.1 * va, 0.0], 1e-15, "passive");
    close(&found.input, &[0.0, 1.2], 1e-15, "input");
    assert_eq!(found.constraint_jacobian.shape(), (0, 2));
    let bob = (va + vb) * l2;
    let speed = l1 * l1 * va * va + bob * bob + 2.0 * l1 * va * bob * b.cos();
    let kinetic = 0.5 * (m1 * l1 * l1 * va * va + m2 * speed + 0.25 * va * va);
    close(&[found.energy.kinetic_j], &[kinetic], 1e-14, "T");

    let inverse = Continuous::new(model).inverse(&at, &[2.0, -3.0]).unwrap();
    let expected = [
        mass[0] * 2.0 - mass[1] * 3.0 + bias[0] + 0.1 * va,
        mass[1] * 2.0 - mass[3] * 3.0 + bias[1] - 1.2,
    ];
    close(&inverse.force, &expected, 1e-14, "inverse");
}

/// A motion on the constraints, with the accelerations of forward dynamics.
fn moving(scene: &Scene) -> (Arc<Model>, ContinuousPoint) {
    let mut plant = plant(scene, |_| ());
    wave(&mut plant, 10);
    let (mut at, _) = point(plant.model(), 23);
    (at.q, at.v) = (plant.q().to_vec(), plant.velocity());
    (plant.model().clone(), at)
}

fn moving_scenes() -> Vec<Scene> {
    let starts = |scene: &Scene| {
        let model = model(scene);
        let plant = Plant::new(Arc::clone(&model), Settings::new(&model));
        plant.is_ok_and(|mut plant| plant.initialize(&Initial::Scene).is_ok())
    };
    scenes().into_iter().filter(starts).collect()
}

/// The accelerations of forward dynamics take no force but those of the drives, and their constraint forces;
/// others take `M` times the difference, with the same constraint forces where constraints allow them.
#[test]
fn inverse_dynamics_undoes_forward_dynamics() {
    for scene in moving_scenes() {
        let (model, at) = moving(&scene);
        let (d, name) = (model.dimensions(), &scene.name);
        let nd = d.dynamic;
        let mut continuous = Continuous::new(Arc::clone(&model));
        let forward = continuous.evaluate(&at).unwrap();
        let found = continuous.terms(&at).unwrap();
        let inverse = continuous.inverse(&at, &forward.acceleration).unwrap();
        let scale = 1.0 + found.bias.iter().fold(0.0_f64, |max, x| max.max(x.abs()));
        let passive = found.passive.iter().fold(scale, |max, x| max.max(x.abs()));
        let zero = inverse.force[..nd].iter().fold(0.0_f64, |max, x| max.max(x.abs()));
        assert!(zero < 1e-9 * passive, "{name}: {zero:e} of {passive:e}");
        close(&inverse.multipliers, &forward.multipliers, 1e-8, name);
        let size = forward.acceleration.iter().fold(1.0_f64, |max, x| max.max(x.abs()));
        let left = inverse.constraint_acceleration.iter().fold(0.0_f64, |max, x| max.max(x.abs()));
        assert!(left < 1e-9 * size, "{name}: {left:e}");

        // The whole equation, rows of prescribed coordinates too.
        let all = [&forward.acceleration[..], &at.prescribed_acceleration].concat();
        let lambda = DVector::from_column_slice(&inverse.multipliers);
        let taken = found.constraint_jacobian.tr_mul(&lambda);
        let inertial = &found.mass_matrix * DVector::from_column_slice(&all);
        for i in 0..d.coordinates() {
            let left = inertial[i] + found.bias[i];
            let right = found.passive[i] + found.input[i] + inverse.force[i] - taken[i];
            assert!((left - right).abs() < 1e-9 * passive, "{name}: {left} and {right}");
        }

        // Another acceleration that constraints allow: changed along their null space.
        let (_, change) = point(&model, 31);
        let free = found.constraint_jacobian.columns(0, nd).into_owned();
        let change = DVector::from_vec(change);
        let change = if d.constraints == 0 {
            change
        } else {
            let inverse = free.clone().pseudo_inverse(1e-9).unwrap();
            &change - inverse * (&free * &change)
        };
        let other: Vec<f64> =
            forward.acceleration.iter().zip(&change).map(|(a, z)| a + z).collect();
        let inverse = continuous.inverse(&at, &other).unwrap();
        let mass = found.mass_matrix.view((0, 0), (nd, nd));
        let lacking = mass * change;
        for (force, expected) in inverse.force.iter().zip(&lacking) {
            assert!((force - expected).abs() < 1e-8 * passive, "{name}: {force}, {expected}");
        }
        let scale = forward.multipliers.iter().fold(passive, |max, x| max.max(x.abs()));
        for (found, expected) in inverse.multipliers.iter().zip(&forward.multipliers) {
            assert!((found - expected).abs() < 1e-8 * scale, "{name}: {found}, {expected}");
        }
    }
}

/// Forces of inverse dynamics, exerted by inputs, make the acceleration.
#[test]
fn what_inverse_dynamics_asks_for_moves_the_mechanism_so() {
    for scene in (0..8).map(random_tree) {
        let model = model(&scene);
        let (mut at, wanted) = point(&model, 41);
        let mut continuous = Continuous::new(Arc::clone(&model));
        let inverse = continuous.inverse(&at, &wanted).unwrap();
        for (input, value) in scene.inputs.iter().zip(&mut at.inputs) {
            let coordinate = input.coordinate.as_ref().unwrap();
            *value += inverse.force[model.coordinate_index(coordinate).unwrap()] / input.gain;
        }
        let found = continuous.evaluate(&at).unwrap().acceleration;
        close(&found, &wanted, 1e-9, &scene.name);
    }
}

/// The energy of a mechanism without friction changes by the power of inputs and of the forces that inverse
/// dynamics finds, those of drives and driven lengths among them; constraints do no work.
#[test]
fn forces_of_drives_balance_the_energy() {
    let without_friction = |mut scene: Scene| {
        scene.damping = 0.0;
        scene.coordinates.iter_mut().for_each(|c| c.damping = None);
        scene
    };
    let mut driven = 0;
    let names = ["marionette", "cart-pole", "four-bar"].map(builtin);
    let trees = (0..8).map(random_tree);
    for scene in names.into_iter().chain([floating()]).chain(trees).map(without_friction) {
        let (model, at) = moving(&scene);
        let mut continuous = Continuous::new(Arc::clone(&model));
        let forward = continuous.evaluate(&at).unwrap();
        let inverse = continuous.inverse(&at, &forward.acceleration).unwrap();
        let found = continuous.terms(&at).unwrap();
        let acceleration = [&forward.acceleration[..], &at.prescribed_acceleration].concat();
        let rate = slope(1e-3, |t| {
            let motion = at.v.iter().zip(&acceleration);
            let change: Vec<f64> = motion.map(|(v, a)| t * (v + 0.5 * t * a)).collect();
            let v = at.v.iter().zip(&acceleration).map(|(v, a)| v + t * a).collect();
            let q = model.retract(&at.q, &change);
            let energy = terms(&model, &ContinuousPoint { q, v, ..at.clone() }).energy;
            vec![energy.kinetic_j + energy.potential_j]
        });
        let forces = inverse.force.iter().zip(&found.input).map(|(force, input)| force + input);
        let power: f64 = forces.zip(&at.v).map(|(force, v)| force * v).sum();
        let scale = at.v.iter().zip(&inverse.force).fold(1.0, |sum, (v, f)| sum + (v * f).abs());
        assert!((power - rate[0]).abs() < 1e-8 * scale, "{}: {power}, {}", scene.name, rate[0]);
        driven += model.dimensions().prescribed;
    }
    assert!(driven > 20, "a test of little: {driven} driven coordinates");
}

#[test]
fn malformed_points_are_refused() {
    let model = model(&builtin("cart-pole"));
    let (at, acceleration) = point(&model, 1);
    let mut kinematics = Kinematics::new(Arc::clone(&model));
    let error = kinematics.place(&[0.0], &at.v).unwrap_err();
    assert_eq!(error, ContinuousError::Dimension { name: "q", expected: 2, actual: 1 });
    let error = kinematics.place(&at.q, &[0.0, f64::NAN]).unwrap_err();
    assert!(matches!(error, ContinuousError::NotFinite { name: "v", index: 1, .. }), "{error}");
    let error = kinematics.place(&at.q, &[1e308, 1e308]).unwrap_err();
    assert_eq!(error, ContinuousError::Overflow);
    assert!(kinematics.point("nowhere", [0.0; 3]).is_none());

    let mut continuous = Continuous::new(model);
    let error = continuous.inverse(&at, &acceleration[..1]).unwrap_err();
    assert!(matches!(error, ContinuousError::Dimension { name: "acceleration", .. }), "{error}");
    let short = ContinuousPoint { inputs: vec![], ..at.clone() };
    let error = continuous.terms(&short).unwrap_err();
    assert!(matches!(error, ContinuousError::Dimension { name: "inputs", .. }), "{error}");
    let huge = ContinuousPoint { v: vec![1e200; 2], ..at };
    assert_eq!(continuous.terms(&huge).unwrap_err(), ContinuousError::Overflow);
}

/// Terms are there where the mass matrix is singular; without constraints inverse dynamics, too.
#[test]
fn a_singular_mass_matrix_has_terms() {
    let model = model(&builtin("spherical-pendulum"));
    let at = ContinuousPoint {
        q: vec![0.3, std::f64::consts::FRAC_PI_2],
        v: vec![0.0; 2],
        inputs: vec![0.0; model.dimensions().inputs],
        prescribed_acceleration: vec![],
    };
    let mut continuous = Continuous::new(model);
    assert!(matches!(continuous.evaluate(&at), Err(ContinuousError::SingularMass { .. })));
    let found = continuous.terms(&at).unwrap();
    let inverse = continuous.inverse(&at, &[0.0, 1.0]).unwrap();
    let expected = &found.mass_matrix * DVector::from_column_slice(&[0.0, 1.0]);
    let lacking: Vec<f64> =
        (0..2).map(|i| expected[i] + found.bias[i] - found.passive[i] - found.input[i]).collect();
    close(&inverse.force, &lacking, 1e-13, "inverse");
}

const TUMBLING: &str = r#"
format = 1
name = "tumbling"
gravity = [0, 0, 0]
[[frames]]
name = "hull"
joint = { type = "free" }
body = { mass = 2, inertia = [0.3, 0.4, 0.5] }
"#;

const ARM: &str = r#"
[[frames]]
name = "arm"
parent = "hull"
translation = [0.4, 0.1, 0.0]
joint = { type = "revolute", axis = [0.3, 1.0, 0.2] }
body = { mass = 0.7, center_of_mass = [0.3, 0.1, -0.2], inertia = [0.02, 0.03, 0.04] }
[[frames]]
name = "hand"
parent = "arm"
translation = [0.5, 0.0, 0.0]
joint = { type = "ball" }
body = { mass = 0.4, center_of_mass = [0.2, 0.0, 0.1], inertia = [0.01, 0.02, 0.015] }
"#;

/// Euler's equations, in the body's axes: `I α + ω × I ω = τ`.
#[test]
fn a_tumbling_body_in_closed_form() {
    let model = model(&Scene::from_toml(TUMBLING).unwrap());
    let (at, acceleration) = point(&model, 17);
    let ball = model.orientations()[0];
    let (w, i) = (&at.v[ball..ball + 3], [0.3, 0.4, 0.5]);
    let expected: Vec<f64> = (0..3)
        .map(|a| (a, (a + 1) % 3, (a + 2) % 3))
        .map(|(_, b, c)| (i[c] - i[b]) * w[b] * w[c])
        .collect();
    let mut continuous = Continuous::new(model);
    close(&continuous.terms(&at).unwrap().bias[ball..ball + 3], &expected, 1e-14, "bias");
    let force = continuous.inverse(&at, &acceleration).unwrap().force;
    let turned = (0..3).map(|a| i[a] * acceleration[ball + a] + expected[a]);
    close(&force[ball..ball + 3], &turned.collect::<Vec<_>>(), 1e-14, "torque");
}

/// Nothing pushes from outside: along the accelerations of zero forces the momenta stay as they are.
#[test]
fn free_bodies_with_ball_joints_keep_their_momenta() {
    let model = model(&Scene::from_toml(&format!("{TUMBLING}{ARM}")).unwrap());
    let (at, _) = point(&model, 17);
    let found = terms(&model, &at);
    let bias = DVector::from_column_slice(&found.bias);
    let acceleration = -found.mass_matrix.cholesky().unwrap().solve(&bias);
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    let rate = slope(1e-3, |t| {
        let motion = at.v.iter().zip(&acceleration);
        let change: Vec<f64> = motion.map(|(v, a)| t * (v + 0.5 * t * a)).collect();
        let v = at.v.iter().zip(&acceleration).map(|(v, a)| v + t * a).collect();
        let q = model.retract(&at.q, &change);
        plant.initialize(&Initial::Velocity { q, v }).unwrap();
        let Diagnostics { linear_momentum, angular_momentum, .. } = plant.diagnose();
        [linear_momentum, angular_momentum].concat()
    });
    close(&rate, &[0.0; 6], 1e-9, "rates of momenta");
}
