//! Control periods of several steps: substeps, higher orders, and halving.

use std::f64::consts::FRAC_PI_2;
use std::sync::Arc;

use crate::common::linearization::check_with;
use crate::common::{builtin, methods, model, plant, waving_input};
use plantd_models::{
    Initial, InitialError, Linearization, Plant, Precision, Scene, Settings, Snapshot, State,
    StepError,
};

const TIME_STEP_S: f64 = 0.01;

/// A chain released from horizontal, whose whip no step of 10 ms follows.
fn whip(links: usize, settings: impl FnOnce(&mut Settings)) -> Plant {
    let mut plant = plant(&builtin(&format!("chain-{links}")), settings);
    let mut q = vec![0.0; links];
    q[0] = FRAC_PI_2;
    plant.initialize(&Initial::Velocity { q, v: vec![0.0; links] }).unwrap();
    plant
}

/// Substeps are steps: the same numbers as of a plant that takes them one by one.
#[test]
fn substeps_are_shorter_steps() {
    for name in ["damped-pendulum", "chain-4", "four-bar", "marionette"] {
        let scene = builtin(name);
        let mut whole = plant(&scene, |s| s.substeps = 4);
        let mut parts = plant(&scene, |s| s.time_step_s *= 0.25);
        let dynamic = whole.model().dimensions().dynamic;
        for k in 1..=50 {
            let u = waving_input(&whole, k);
            let begin = whole.q()[dynamic..].to_vec();
            whole.step(&u).unwrap();
            let inputs = u.len() - begin.len();
            for part in 1..=4 {
                let mut u = u.clone();
                for (next, begin) in u[inputs..].iter_mut().zip(&begin) {
                    *next = begin + 0.25 * f64::from(part) * (*next - begin);
                }
                parts.step(&u).unwrap();
            }
            for (a, b) in whole.q().iter().zip(parts.q()) {
                assert!((a - b).abs() < 1e-9, "{name}, period {k}: {a} {b}");
            }
        }
    }
}

/// Every way to step goes on bit for bit from a snapshot, encoded and decoded.
#[test]
fn snapshots_continue_bit_for_bit() {
    for name in ["cart-pole", "chain-4", "four-bar"] {
        let scene = builtin(name);
        for settings in methods(&scene) {
            let mut first = plant(&scene, |s| *s = settings);
            crate::common::wave(&mut first, 12);
            let bytes = first.snapshot().to_bytes();
            let mut second = plant(&scene, |s| *s = settings);
            second.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
            crate::common::wave(&mut first, 12);
            crate::common::wave(&mut second, 12);
            assert_eq!(first.snapshot().to_bytes(), second.snapshot().to_bytes());
        }
    }
}

/// A linearization leaves no trace in the motion.
#[test]
fn linearizations_stay() {
    for name in ["cart-pole", "four-bar"] {
        let scene = builtin(name);
        for settings in methods(&scene) {
            let mut straight = plant(&scene, |s| *s = settings);
            let mut watched = plant(&scene, |s| *s = settings);
            let mut out = Linearization::new(watched.model());
            for k in 1..=20 {
                let u = waving_input(&straight, k);
                straight.step(&u).unwrap();
                watched.linearize(&u, &mut out).unwrap();
                watched.step_and_linearize(&u, &mut out).unwrap();
                assert_eq!(straight.state(), watched.state(), "{name}, {settings:?}, period {k}");
            }
        }
    }
}

/// The whip of a chain is followed by halving periods, and no longer when it is over.
#[test]
fn periods_are_halved_where_they_must_be() {
    for links in [32, 64] {
        let mut stiff = whip(links, |s| (s.time_step_s, s.halvings) = (TIME_STEP_S, 0));
        let u = vec![0.0; stiff.model().dimensions().input()];
        let failure = (0..400).find_map(|_| stiff.step(&u).err());
        assert!(failure.is_some(), "steps of 10 ms were to fail");
        let mut plant = whip(links, |s| s.time_step_s = TIME_STEP_S);
        let inputs = plant.model().dimensions().input();
        let start = plant.energy();
        let start = start.kinetic_j + start.potential_j;
        let size = plant.energy().potential_j.abs() + 9.8 * links as f64;
        let mut most = 0;
        for k in 0..400 {
            let report = plant.step(&vec![0.0; inputs]).unwrap_or_else(|e| panic!("{k}: {e}"));

            assert_eq!(report.steps, 1 << report.halvings);
            most = most.max(report.halvings);
        }
        let end = plant.energy();
        let drift = (end.kinetic_j + end.potential_j - start).abs() / size;
        println!("chain-{links}: halved {most} times, energy {drift:e}");
        assert!((1..=8).contains(&most), "{most}");
        assert!(drift < 0.05, "{drift}");
    }
}

/// The linearization of a halved period is that of the steps that were taken.
#[test]
fn halved_periods_have_exact_derivatives() {
    // A pendulum that turns by more than half a turn in a period.
    let mut fast = builtin("damped-pendulum");
    fast.time_step_s = 0.5;
    let start = Initial::Momentum { q: vec![0.3], p: vec![90.0], v: vec![] };
    let mut plant = plant(&fast, |_| ());
    plant.initialize(&start).unwrap();
    let mut out = Linearization::new(plant.model());
    let u = vec![0.2; plant.model().dimensions().input()];
    let report = plant.linearize(&u, &mut out).unwrap();
    assert!(report.halvings > 0, "{report:?}");
    let (a, b) = (out.a(), out.b());
    let mut end = |q: f64, p: f64, u: f64| {
        plant.initialize(&Initial::Momentum { q: vec![q], p: vec![p], v: vec![] }).unwrap();
        let again = plant.step(&vec![u; b.ncols()]).unwrap();
        assert_eq!(again.halvings, report.halvings);
        [plant.q()[0], plant.p()[0]]
    };
    let delta = 1e-3;
    for row in 0..2 {
        let mut slope = |dq: f64, dp: f64, du: f64| {
            let at = |s: f64, end: &mut dyn FnMut(f64, f64, f64) -> [f64; 2]| {
                end(0.3 + s * dq, 90.0 + s * dp, 0.2 + s * du)[row]
            };
            let sum = crate::common::STENCIL.iter().map(|(k, w)| w * at(k * delta, &mut end));
            sum.sum::<f64>() / delta
        };
        for (found, expected) in
            [(a[(row, 0)], slope(1.0, 0.0, 0.0)), (a[(row, 1)], slope(0.0, 1.0, 0.0))]
        {
            assert!((found - expected).abs() < 1e-8, "{found} {expected}");
        }
        if b.ncols() == 1 {
            let expected = slope(0.0, 0.0, 1.0);
            assert!((b[(row, 0)] - expected).abs() < 1e-8, "{} {expected}", b[(row, 0)]);
        }
    }
}

/// A period that cannot be solved leaves everything as it was, and the error is that of the whole period.
#[test]
fn failed_periods_change_nothing() {
    let scene = builtin("chain-8");
    for settings in methods(&scene) {
        let mut plant = plant(&scene, |s| *s = Settings { halvings: 2, ..settings });
        crate::common::wave(&mut plant, 5);
        let before = plant.snapshot().to_bytes();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        u.fill(1e9);
        let mut out = Linearization::new(plant.model());
        for error in [plant.step(&u).unwrap_err(), plant.linearize(&u, &mut out).unwrap_err()] {
            assert!(
                matches!(
                    error,
                    StepError::NotConverged { .. }
                        | StepError::TooFast { .. }
                        | StepError::NotFinite { .. }
                ),
                "{error}"
            );
            assert_eq!(plant.snapshot().to_bytes(), before, "{settings:?}");
        }
        crate::common::wave(&mut plant, 5);
    }
}

/// Half the digits are asked for, or a quarter, and nearly as many are there.
#[test]
fn fast_and_coarse_steps_end_close_to_exact_ones() {
    for name in ["double-pendulum", "four-bar", "balls-3", "marionette"] {
        let mut saved = [0; 3];
        for settings in methods(&builtin(name)) {
            let precisions = [Precision::Exact, Precision::Fast, Precision::Coarse];
            let mut plants = precisions.map(|precision| {
                plant(&builtin(name), |s| *s = Settings { precision, ..settings })
            });
            let (mut iterations, mut errors) = ([0; 3], [0.0_f64; 3]);
            for k in 1..=50 {
                let u = waving_input(&plants[0], k);
                for (iterations, plant) in iterations.iter_mut().zip(&mut plants) {
                    *iterations += i64::from(plant.step(&u).unwrap().iterations);
                }
                let exact = plants[0].q().to_vec();
                for (error, plant) in errors.iter_mut().zip(&plants) {
                    let apart = exact.iter().zip(plant.q()).map(|(a, b)| (a - b).abs());
                    *error = apart.fold(*error, f64::max);
                }
            }
            assert!(errors[1] < 1e-8 && errors[2] < 1e-6, "{name}, {settings:?}: {errors:?}");
            assert!(iterations.is_sorted_by(|a, b| a >= b), "{name}, {settings:?}: {iterations:?}");
            saved.iter_mut().zip(iterations).for_each(|(all, own)| *all += own);
        }
        assert!(saved[2] < saved[1] && saved[1] < saved[0], "{name}: {saved:?}");
    }
}

#[test]
fn settings_out_of_range_are_refused() {
    let refused = |scene: &Scene, change: &dyn Fn(&mut Settings)| {
        let model = model(scene);
        let mut settings = Settings::new(&model);
        change(&mut settings);
        Plant::new(Arc::clone(&model), settings).unwrap_err()
    };
    let pendulum = builtin("pendulum");
    for order in [0, 1, 3, 10, 14] {
        let error = refused(&pendulum, &|s| s.order = order);
        assert!(matches!(error, InitialError::Order { .. }), "{error}");
    }
    let paper = plantd_models::ForceSplit::Paper;
    let error = refused(&pendulum, &|s| (s.order, s.force_split) = (4, paper));
    assert!(matches!(error, InitialError::Order { order: 4, .. }), "{error}");
    for substeps in [0, plantd_models::SUBSTEPS_MAX + 1] {
        let error = refused(&pendulum, &|s| s.substeps = substeps);
        assert!(matches!(error, InitialError::OutOfRange { name: "substeps", .. }), "{error}");
    }
    let error = refused(&pendulum, &|s| s.halvings = 9);
    assert!(matches!(error, InitialError::OutOfRange { name: "halvings", .. }), "{error}");
}

/// Ball joints in all orders and substeps, with constraints too: derivatives by their turns.
#[test]
fn ball_joints_turn_in_any_order() {
    let read = |name: &str| {
        let path = format!("{}/../scenes/elements/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
    };
    for name in ["ball", "free", "weld"] {
        let scene = read(name);
        for settings in methods(&scene) {
            check_with(&scene, |s| *s = settings);
        }
    }
}

/// The projected momentum is `M q̇`, and its derivative that of its differences: along curves on the
/// constraints, along momenta, and along velocities of prescribed joints.
#[test]
fn projected_momenta_have_exact_derivatives() {
    for name in ["four-bar", "scissor-3", "marionette"] {
        let mut plant = plant(&builtin(name), |_| ());
        crate::common::wave(&mut plant, 20);
        let State { q, p, v, .. } = plant.state();
        let d = plant.model().dimensions();
        let n = d.coordinates();
        let by_state = plant.projected_momentum_by_state();
        let mut at = |q: &[f64], p: &[f64], v: &[f64]| {
            let (q, p, v) = (q.to_vec(), p.to_vec(), v.to_vec());
            plant.initialize(&Initial::Momentum { q, p, v }).unwrap();
            plant.projected_momentum()
        };
        let size = at(&q, &p, &v).iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        let compare = |what: &str, dx: &[f64], found: &[f64]| {
            let predicted = &by_state * nalgebra::DVector::from_row_slice(dx);
            let allowed = 1e-7 * (size + predicted.amax());
            for (i, (a, b)) in predicted.iter().zip(found).enumerate() {
                assert!((a - b).abs() < allowed, "{name}, {what}: {i}: {a} {b}");
            }
        };
        for i in 0..n {
            let mut dx = vec![0.0; 2 * n];
            dx[n + i] = 1.0;
            let found = crate::common::slope(1e-3, |s| {
                let (mut p, mut v) = (p.clone(), v.clone());
                *p.iter_mut().chain(&mut v).nth(i).unwrap() += s;
                at(&q, &p, &v)
            });
            compare(&format!("p, v {i}"), &dx, &found);
        }
        let mut on_manifold = crate::common::plant(&builtin(name), |_| ());
        for i in 0..n {
            let mut curve = |s: f64| {
                let mut q = q.clone();
                q[i] += s;
                on_manifold.initialize(&Initial::Projection { q, hold: Vec::new() }).unwrap();
                on_manifold.q().to_vec()
            };
            let mut dx = crate::common::slope(1e-3, &mut curve);
            let found = crate::common::slope(1e-3, |s| at(&curve(s), &p, &v));
            dx.resize(2 * n, 0.0);
            compare(&format!("direction {i}"), &dx, &found);
        }
    }
}
