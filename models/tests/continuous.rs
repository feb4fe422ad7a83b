//! Continuous-time dynamics against closed forms, Lagrange's equations, the discrete map, and
//! differences.

use std::sync::Arc;

use crate::common::{
    Numbers, builtin, elements_with_coordinates, floating, model, plant, random_tree, slope, wave,
};
use nalgebra::{DMatrix, DVector};
use plantd_models::{
    Continuous, ContinuousError, ContinuousPoint, ForceSplit, Initial, Model, Plant, Scene,
};

/// A point in the middle of a motion that satisfies the constraints.
fn point(scene: &Scene) -> (Plant, ContinuousPoint) {
    let mut plant = plant(scene, |_| ());
    wave(&mut plant, 20);
    let d = plant.model().dimensions();
    let mut random = Numbers::new(7);
    let mut numbers = |count: usize| (0..count).map(|_| random.between(-1.0, 1.0)).collect();
    let point = ContinuousPoint {
        q: plant.q().to_vec(),
        v: plant.velocity(),
        inputs: numbers(d.inputs),
        prescribed_acceleration: numbers(d.prescribed),
    };
    (plant, point)
}

fn scenes() -> impl Iterator<Item = Scene> {
    let names = ["damped-pendulum", "double-pendulum", "cart-pole", "four-bar", "scissor-3"];
    let builtins = names.into_iter().chain(["chain-4", "marionette"]).map(builtin);
    builtins.chain([floating()]).chain((0..12).map(random_tree))
}

/// Accelerations of all coordinates.
fn accelerations(continuous: &mut Continuous, point: &ContinuousPoint) -> Vec<f64> {
    let value = continuous.evaluate(point).unwrap();
    [&value.acceleration[..], &point.prescribed_acceleration].concat()
}

/// `m l² q̈ = −m g l sin q − c q̇ + u` with all derivatives.
#[test]
fn pendulum_in_closed_form() {
    let mut scene = builtin("pendulum");
    scene.damping = 0.3;
    let mut continuous = Continuous::new(model(&scene));
    let (q, v, u) = (0.7_f64, -1.1, 0.4);
    let at = ContinuousPoint {
        q: vec![q],
        v: vec![v],
        inputs: vec![u],
        prescribed_acceleration: vec![],
    };
    let linear = continuous.linearize(&at).unwrap();
    let expected = -9.8 * q.sin() - 0.3 * v + u;
    assert!((linear.value.acceleration[0] - expected).abs() < 1e-14);
    assert!(linear.value.multipliers.is_empty());
    let jacobian = DMatrix::from_row_slice(1, 3, &[-9.8 * q.cos(), -0.3, 1.0]);
    assert!((linear.jacobian - jacobian).amax() < 1e-14);
    let second = continuous.second_order(&at).unwrap();
    let mut expected = DMatrix::zeros(3, 3);
    expected[(0, 0)] = 9.8 * q.sin();
    assert_eq!(second.len(), 1);
    assert!((&second[0] - expected).amax() < 1e-14);
}

/// `d/dt ∂L/∂v − ∂L/∂q = f` with `L` from the energies: differences in time and in `q`; in `v`, of
/// which it is a quadratic function, differences are exact.
#[test]
fn lagranges_equations_hold() {
    for scene in scenes().filter(|scene| scene.constraints.is_empty()) {
        let (mut plant, at) = point(&scene);
        let acceleration = accelerations(&mut Continuous::new(plant.model().clone()), &at);
        let mut lagrangian = |q: &[f64], v: &[f64]| {
            plant.initialize(&Initial::Velocity { q: q.to_vec(), v: v.to_vec() }).unwrap();
            let energy = plant.energy();
            energy.kinetic_j - energy.potential_j
        };
        let shifted = |x: &[f64], i: usize, s: f64| {
            let mut x = x.to_vec();
            x[i] += s;
            x
        };
        let nd = at.q.len() - at.prescribed_acceleration.len();
        for i in 0..nd {
            let rate = slope(1e-3, |t| {
                let motion = at.q.iter().zip(&at.v).zip(&acceleration);
                let q: Vec<_> = motion.map(|((q, v), a)| q + t * (v + 0.5 * t * a)).collect();
                let v: Vec<_> = at.v.iter().zip(&acceleration).map(|(v, a)| v + t * a).collect();
                let (up, down) = (shifted(&v, i, 1.0), shifted(&v, i, -1.0));
                vec![0.5 * (lagrangian(&q, &up) - lagrangian(&q, &down))]
            });
            let by_q = slope(1e-3, |s| vec![lagrangian(&shifted(&at.q, i, s), &at.v)]);
            let force = -damping(&scene, i) * at.v[i] + input(&scene, i, &at.inputs);
            let (left, right) = (rate[0] - by_q[0], force);
            let scale = 1.0 + rate[0].abs() + by_q[0].abs() + acceleration[i].abs();
            let name = &scene.name;
            assert!((left - right).abs() < 1e-9 * scale, "{name}, {i}: {left} and {right}");
        }
    }
}

fn damping(scene: &Scene, coordinate: usize) -> f64 {
    let name = name(scene, coordinate);
    let own = scene.coordinates.iter().find(|c| c.name == name).and_then(|c| c.damping);
    own.unwrap_or(scene.damping)
}

fn input(scene: &Scene, coordinate: usize, values: &[f64]) -> f64 {
    let name = name(scene, coordinate);
    let inputs = scene
        .inputs
        .iter()
        .zip(values)
        .filter(|(input, _)| input.coordinate.as_ref() == Some(&name));
    inputs.map(|(input, value)| input.gain * value).sum()
}

fn name(scene: &Scene, coordinate: usize) -> String {
    model(scene).coordinates()[coordinate].name.clone()
}

/// The first steps of ever shorter length from a state follow `q + h v + ½h² a`; from a momentum that
/// the constraints do not load, they take half of the constraints' force.
#[test]
fn short_steps_follow_the_accelerations() {
    for scene in scenes() {
        let (plant, at) = point(&scene);
        let model = plant.model().clone();
        let value = Continuous::new(model.clone()).evaluate(&at).unwrap();
        let estimate = |h: f64| doubled_slope(&model, &at, h);
        let h = 2e-3;
        let [a, b, c] = [h, h / 2.0, h / 4.0].map(estimate);
        // Richardson: errors of h and h² drop out.
        let limit = (c * 8.0 - b * 6.0 + a) / 3.0;
        let expected = DVector::from_vec([&value.acceleration[..], &value.multipliers].concat());
        let nd = value.acceleration.len();
        for (part, range) in [("a", 0..nd), ("λ", nd..expected.len())] {
            let (found, expected) = (
                limit.rows(range.start, range.len()).into_owned(),
                expected.rows(range.start, range.len()).into_owned(),
            );
            let error = if range.is_empty() { 0.0 } else { (&found - &expected).amax() };
            let scale = if range.is_empty() { 0.0 } else { expected.amax() };
            assert!(
                error <= 1e-4 * scale + 1e-6,
                "{}, {part}: error {error:e}\n{found}{expected}",
                scene.name
            );
        }
    }
}

/// `2 (x/h − v)/h` and `2 λ/h` of one step.
fn doubled_slope(model: &Arc<Model>, at: &ContinuousPoint, h: f64) -> DVector<f64> {
    let mut settings = plantd_models::Settings::new(model);
    (settings.time_step_s, settings.force_split) = (h, ForceSplit::Symmetric);
    let mut plant = Plant::new(model.clone(), settings).unwrap();
    plant.initialize(&Initial::Velocity { q: at.q.clone(), v: at.v.clone() }).unwrap();
    let nd = model.dimensions().dynamic;
    let prescribed = at.prescribed_acceleration.iter().enumerate();
    let next = prescribed.map(|(k, a)| at.q[nd + k] + h * (at.v[nd + k] + 0.5 * h * a));
    let u: Vec<f64> = at.inputs.iter().copied().chain(next).collect();
    plant.step(&u).unwrap();
    let motion = (0..nd).map(|i| 2.0 * ((plant.q()[i] - at.q[i]) / h - at.v[i]) / h);
    let forces = plant.multipliers().iter().map(|lambda| 2.0 * lambda / h);
    DVector::from_vec(motion.chain(forces).collect())
}

/// Constraints keep their velocity: the rate of `Dh v` along the motion vanishes.
#[test]
fn constraints_do_not_accelerate() {
    for scene in scenes().filter(|scene| !scene.constraints.is_empty()) {
        let (mut plant, at) = point(&scene);
        let acceleration = accelerations(&mut Continuous::new(plant.model().clone()), &at);
        let rate = slope(1e-4, |t| {
            let motion = at.q.iter().zip(&at.v).zip(&acceleration);
            let q = motion.map(|((q, v), a)| q + t * (v + 0.5 * t * a)).collect();
            let v = at.v.iter().zip(&acceleration).map(|(v, a)| v + t * a).collect();
            plant.initialize(&Initial::Velocity { q, v }).unwrap();
            let v: Vec<_> = at.v.iter().zip(&acceleration).map(|(v, a)| v + t * a).collect();
            (plant.constraint_jacobian() * DVector::from_vec(v)).as_slice().to_vec()
        });
        let size = acceleration.iter().fold(1.0_f64, |size, a| size.max(a.abs()));
        for rate in rate {
            assert!(rate.abs() < 1e-8 * size, "{}: {rate:e}", scene.name);
        }
    }
}

/// First derivatives against differences of the value, second ones against differences of the first.
#[test]
fn derivatives_are_those_of_differences() {
    for scene in scenes().chain(elements_with_coordinates()) {
        let (plant, at) = point(&scene);
        let mut continuous = Continuous::new(plant.model().clone());
        let linear = continuous.linearize(&at).unwrap();
        let second = continuous.second_order(&at).unwrap();
        let rows = linear.jacobian.nrows();
        for (output, tensor) in second.iter().enumerate() {
            let asymmetry = (tensor - tensor.transpose()).amax();
            assert_eq!(asymmetry, 0.0, "{}: output {output}", scene.name);
        }
        for column in 0..linear.jacobian.ncols() {
            let delta = 1e-3;
            let found = slope(delta, |s| {
                let mut at = at.clone();
                let parts = [&mut at.q, &mut at.v, &mut at.inputs, &mut at.prescribed_acceleration];
                *parts.into_iter().flatten().nth(column).unwrap() += s;
                let linear = continuous.linearize(&at).unwrap();
                let value = linear.value;
                [&value.acceleration[..], &value.multipliers, linear.jacobian.as_slice()].concat()
            });
            let found = DMatrix::from_column_slice(rows, 1 + linear.jacobian.ncols(), &found);
            for row in 0..rows {
                let error = (found[(row, 0)] - linear.jacobian[(row, column)]).abs();
                let scale = linear.jacobian.row(row).amax();
                let name = &scene.name;
                assert!(
                    error <= 1e-8 * scale + 1e-9,
                    "{name}: output {row} by parameter {column}: {error:e} of {scale:e}"
                );
                let scale = second[row].amax();
                for other in 0..linear.jacobian.ncols() {
                    let error = (found[(row, 1 + other)] - second[row][(column, other)]).abs();
                    assert!(
                        error <= 1e-7 * scale + 1e-8,
                        "{name}: output {row} by parameters {column}, {other}: {error:e} of {scale:e}"
                    );
                }
            }
        }
    }
}

#[test]
fn malformed_points_are_refused() {
    let mut continuous = Continuous::new(model(&builtin("cart-pole")));
    let good = ContinuousPoint {
        q: vec![0.0; 2],
        v: vec![0.0; 2],
        inputs: vec![0.0],
        prescribed_acceleration: vec![],
    };
    assert!(continuous.evaluate(&good).is_ok());
    let short = ContinuousPoint { v: vec![0.0], ..good.clone() };
    let error = continuous.evaluate(&short).unwrap_err();
    assert_eq!(error, ContinuousError::Dimension { name: "v", expected: 2, actual: 1 });
    let infinite = ContinuousPoint { inputs: vec![f64::INFINITY], ..good.clone() };
    let error = continuous.linearize(&infinite).unwrap_err();
    assert!(matches!(error, ContinuousError::NotFinite { name: "inputs", index: 0, .. }));
    let huge = ContinuousPoint { v: vec![1e200, 1e200], ..good };
    assert_eq!(continuous.second_order(&huge).unwrap_err(), ContinuousError::Overflow);
}

/// The spherical pendulum in two angles has no azimuth at its pole.
#[test]
fn singular_mass_matrix_names_the_coordinate() {
    let mut continuous = Continuous::new(model(&builtin("spherical-pendulum")));
    let at = ContinuousPoint {
        q: vec![0.3, std::f64::consts::FRAC_PI_2],
        v: vec![0.0; 2],
        inputs: vec![0.0; continuous.model().dimensions().inputs],
        prescribed_acceleration: vec![],
    };
    let error = continuous.evaluate(&at).unwrap_err();
    assert!(matches!(error, ContinuousError::SingularMass { .. }), "{error}");
}
