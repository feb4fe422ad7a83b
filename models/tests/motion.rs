//! Properties of motions: what a variational integrator conserves, and what must not matter.

use std::sync::Arc;

use crate::common::{SPLITS, builtin, floating, plant, random_tree, wave, waving_input};
use nalgebra::DMatrix;
use plantd_models::scene::{Axis, Constraint, Point, Spring};
use plantd_models::{Initial, Linearization, Model, Plant, Scene, Settings};

/// A plant of a conservative scene without inputs, set in motion by unlike momenta.
fn set_in_motion(scene: &Scene, time_step_s: f64, size: f64) -> Plant {
    let mut plant = plant(scene, |s| s.time_step_s = time_step_s);
    let d = plant.model().dimensions();
    let q = plant.q().to_vec();
    let v = (0..d.coordinates()).map(|i| size * (1.0 + i as f64).sin()).collect();
    plant.initialize(&Initial::Velocity { q, v }).unwrap();
    plant
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

const CONSERVATIVE: [&str; 5] =
    ["pendulum", "double-pendulum", "spherical-pendulum", "chain-4", "chain-12"];

/// `Aᵀ J A = J` with `J = [[0, 1], [−1, 0]]`.
#[test]
fn maps_of_conservative_scenes_are_symplectic() {
    let mut scenes: Vec<_> = CONSERVATIVE.iter().map(|name| builtin(name)).collect();
    scenes.push(floating());
    for scene in scenes {
        let mut plant = set_in_motion(&scene, 0.01, 0.5);
        coast(&mut plant, 20);
        let model = plant.model().clone();
        let n = model.dimensions().dynamic;
        let mut out = Linearization::new(&model);
        plant.linearize(&vec![0.0; model.dimensions().input()], &mut out).unwrap();
        let a = out.a();
        let j = DMatrix::from_fn(2 * n, 2 * n, |row, column| {
            f64::from(u8::from(column == row + n)) - f64::from(u8::from(row == column + n))
        });
        let defect = (a.transpose() * &j * &a - &j).amax();
        let size = a.amax().max(1.0);
        assert!(defect <= 1e-14 * n as f64 * size * size, "{}: {defect:e}", scene.name);
    }
}

/// Translations and turns about the vertical are symmetries of the discrete Lagrangian, so their
/// momenta are conserved to round-off however coarse the step.
#[test]
fn momenta_of_a_floating_body_are_conserved() {
    let scene = floating();
    let momenta = |plant: &Plant| {
        let (q, p) = (plant.q(), plant.p());
        [p[0], p[1], p[2], q[0] * p[1] - q[1] * p[0] + p[3]]
    };
    let mut plant = set_in_motion(&scene, 0.02, 0.8);
    let before = momenta(&plant);
    assert!(before.iter().all(|x| x.abs() > 0.1), "a test of nothing: {before:?}");
    coast(&mut plant, 2000);
    let moved = plant.q()[..3].iter().fold(0.0_f64, |a, x| a.max(x.abs()));
    assert!(moved > 5.0, "it hardly moved: {moved}");
    for (name, (x, y)) in ["x", "y", "z", "turn"].iter().zip(before.iter().zip(momenta(&plant))) {
        assert!((x - y).abs() < 1e-12, "{name}: {x} became {y}");
    }
}

/// With the momenta reversed, a motion runs back to its start.
#[test]
fn conservative_motions_are_reversible() {
    let mut scenes: Vec<_> = CONSERVATIVE[..4].iter().map(|name| builtin(name)).collect();
    scenes.push(floating());
    for scene in scenes {
        let mut plant = set_in_motion(&scene, 0.01, 0.5);
        let start = plant.state();
        coast(&mut plant, 100);
        let turn = plant.state();
        let back: Vec<f64> = turn.p.iter().map(|p| -p).collect();
        plant.initialize(&Initial::Momentum { q: turn.q, p: back, v: turn.v }).unwrap();
        coast(&mut plant, 100);
        for (x, y) in plant.q().iter().zip(&start.q) {
            assert!((x - y).abs() < 1e-10, "{}: {x} instead of {y}", scene.name);
        }
        for (x, y) in plant.p().iter().zip(&start.p) {
            assert!((x + y).abs() < 1e-10, "{}: {x} instead of {}", scene.name, -y);
        }
    }
}

/// The error of the energy swings, but does not grow.
#[test]
fn energy_stays_bounded() {
    const STEPS: usize = 100_000;
    for (name, bound_j) in [("pendulum", 1e-3), ("double-pendulum", 0.3)] {
        let mut plant = plant(&builtin(name), |s| s.time_step_s = 0.01);
        let q = vec![1.5; plant.q().len()];
        let v = vec![0.0; q.len()];
        plant.initialize(&Initial::Velocity { q, v }).unwrap();
        let start = total_energy(&mut plant);
        let mut worst = [0.0_f64; 10];
        for worst in &mut worst {
            for _ in 0..STEPS / 10 {
                coast(&mut plant, 1);
                *worst = worst.max((total_energy(&mut plant) - start).abs());
            }
        }
        assert!(worst.iter().all(|w| *w < bound_j && *w > 0.0), "{name}: {worst:?}");
        assert!(worst[9] < 3.0 * worst[0], "{name}: {worst:?}");
    }
}

/// Moves everything that is fixed in the world.
fn shifted(scene: &Scene, by: [f64; 3]) -> Scene {
    let mut scene = scene.clone();
    let shift = |at: &mut [f64; 3]| at.iter_mut().zip(by).for_each(|(x, d)| *x += d);
    let in_world = |point: &mut Point| {
        if point.frame == "world" {
            shift(&mut point.at);
        }
    };
    scene.frames.iter_mut().filter(|f| f.parent == "world").for_each(|f| shift(&mut f.translation));
    for spring in &mut scene.springs {
        if let Spring::TwoPoint { a, b, .. } = spring {
            in_world(a);
            in_world(b);
        }
    }
    scene
}

/// Where the world's origin is does not matter, but for the rounding of positions themselves: an
/// attachment 10 km away is known to 2e-12 m.
#[test]
fn the_origin_of_the_world_does_not_matter() {
    let by = [1e4, -1e4, 1e4];
    let mut scenes: Vec<_> =
        ["double-pendulum", "cart-pole", "chain-8", "four-bar"].map(builtin).into();
    scenes.push(random_tree(3));
    for scene in scenes {
        let mut here = plant(&scene, |_| ());
        let mut there = plant(&shifted(&scene, by), |_| ());
        wave(&mut here, 100);
        wave(&mut there, 100);
        let scale = here.p().iter().fold(1.0_f64, |a, x| a.max(x.abs()));
        for (x, y) in here.q().iter().zip(there.q()).chain(here.p().iter().zip(there.p())) {
            assert!((x - y).abs() < 1e-9 * scale, "{}: {x} and {y}", scene.name);
        }
    }
}

/// A constraint that says again what others say leaves the motion alone.
#[test]
fn redundant_constraints_do_not_change_the_motion() {
    let scene = builtin("four-bar");
    let mut out_of_plane = scene.clone();
    let Constraint::PointToPoint { axes, .. } = &mut out_of_plane.constraints[0] else { panic!() };
    axes.push(Axis::Y);
    let mut twice = scene.clone();
    let Constraint::PointToPoint { a, b, axes, .. } = scene.constraints[0].clone() else {
        panic!()
    };
    let name = "pin_again".to_owned();
    twice.constraints.push(Constraint::PointToPoint { name, a, b, axes });

    let mut plain = plant(&scene, |_| ());
    wave(&mut plain, 100);
    for redundant in [out_of_plane, twice] {
        let mut plant = plant(&redundant, |_| ());
        wave(&mut plant, 100);
        for (x, y) in plant.q().iter().zip(plain.q()).chain(plant.p().iter().zip(plain.p())) {
            assert!((x - y).abs() < 1e-10, "{x} instead of {y}");
        }
    }
}

/// Snapshots continue bit for bit, by way of bytes and in another plant.
#[test]
fn snapshots_continue_bit_for_bit() {
    let mut scenes: Vec<_> =
        plantd_models::builtin::NAMES.iter().map(|name| builtin(name)).collect();
    scenes.push(random_tree(5));
    for scene in scenes {
        for split in SPLITS {
            let mut first = plant(&scene, |s| s.force_split = split);
            wave(&mut first, 17);
            let bytes = first.snapshot().to_bytes();
            let mut second = plant(&scene, |s| s.force_split = split);
            second.restore(&plantd_models::Snapshot::from_bytes(&bytes).unwrap()).unwrap();
            for _ in 0..30 {
                wave(&mut first, 1);
                wave(&mut second, 1);
                assert_eq!(first.state(), second.state(), "{}", scene.name);
            }
            assert_eq!(first.snapshot().to_bytes(), second.snapshot().to_bytes(), "{}", scene.name);
        }
    }
}

/// The velocity of a state is that of the motion, by whichever factorization it is found.
#[test]
fn the_velocity_is_the_slope_of_the_configuration() {
    const RATE: f64 = 0.05;
    let names = ["pendulum", "cart-pole", "chain-12", "scissor-4", "four-bar", "marionette"];
    let mut scenes: Vec<_> = names.into_iter().map(builtin).collect();
    scenes.extend([7, 8].map(random_tree));
    for scene in scenes {
        let h = 1e-5;
        let mut plant = plant(&scene, |s| s.time_step_s = h);
        let d = plant.model().dimensions();
        let q = plant.q().to_vec();
        let v =
            (0..d.coordinates()).map(|i| if i < d.dynamic { (1.0 + i as f64).sin() } else { RATE });
        plant.initialize(&Initial::Velocity { q: q.clone(), v: v.collect() }).unwrap();
        let take = |plant: &mut Plant| {
            let way = RATE * h * (plant.step_index() + 1) as f64;
            let prescribed = q[d.dynamic..].iter().map(|start| start + way);
            let u: Vec<_> = std::iter::repeat_n(0.2, d.inputs).chain(prescribed).collect();
            plant.step(&u).unwrap();
            plant.q().to_vec()
        };
        (0..20).for_each(|_| drop(take(&mut plant)));
        let before = take(&mut plant);
        take(&mut plant);
        let velocity = plant.velocity();
        let after = take(&mut plant);
        let size = velocity.iter().fold(1.0, |size: f64, v| size.max(v.abs()));
        for (i, v) in velocity.iter().enumerate() {
            let slope = (after[i] - before[i]) / (2.0 * h);
            assert!((v - slope).abs() < 1e-6 * size, "{} {i}: {v} {slope}", scene.name);
        }
    }
}

/// Linearizing on the way leaves no trace in the motion.
#[test]
fn linearizing_does_not_disturb_the_motion() {
    let builtins = ["marionette", "chain-4", "four-bar", "scissor-4"].map(builtin);
    for scene in builtins.into_iter().chain([random_tree(7)]) {
        let (mut plain, mut watched) = (plant(&scene, |_| ()), plant(&scene, |_| ()));
        let mut out = Linearization::new(&watched.model().clone());
        for k in 0..30 {
            let u = waving_input(&plain, k);
            plain.step(&u).unwrap();
            watched.linearize(&u, &mut out).unwrap();
            watched.energy();
            watched.velocity();
            watched.constraint_jacobian();
            watched.step_and_linearize(&u, &mut out).unwrap();
            assert_eq!(plain.state(), watched.state(), "{}", scene.name);
        }
    }
}

/// Near rest the residual is at round-off from the first guess on, and what counts as round-off
/// decides the bits: it must follow from the state alone.
#[test]
fn at_rest_too_the_motion_follows_from_the_state_alone() {
    for (name, damping) in [("marionette", 2.0), ("four-bar", 1.0)] {
        let scene = Scene { damping, ..builtin(name) };
        let mut first = plant(&scene, |_| ());
        let mut u = vec![0.0; first.model().dimensions().input()];
        first.hold_input(&mut u);
        for k in 0..6000 {
            first.step(&u).unwrap();
            if k % 200 == 0 {
                let (mut restored, mut watched) = (plant(&scene, |_| ()), first.clone());
                restored.restore(&first.snapshot()).unwrap();
                let mut out = Linearization::new(&watched.model().clone());
                let mut reference = first.clone();
                for step in 0..20 {
                    reference.step(&u).unwrap();
                    restored.step(&u).unwrap();
                    watched.velocity();
                    watched.step_and_linearize(&u, &mut out).unwrap();
                    let expected = reference.snapshot().to_bytes();
                    assert!(restored.snapshot().to_bytes() == expected, "{name} {k} {step}");
                    assert!(watched.snapshot().to_bytes() == expected, "{name} {k} {step}");
                }
            }
        }
    }
}

/// A hinge that has turned a hundred thousand times moves like one that has not: the digits of its angle
/// that rounding takes are kept beside it.
#[test]
fn angles_wind_without_loss() {
    const TURNS: f64 = 1e5;
    const TAU_LOW: f64 = 2.449_293_598_294_706_4e-16;
    for scene in ["pendulum", "double-pendulum", "spherical-pendulum"].map(builtin) {
        let start = |q: Vec<f64>| {
            let mut plant = plant(&scene, |s| s.time_step_s = 1e-3);
            let v = vec![0.3; q.len()];
            plant.initialize(&Initial::Velocity { q, v }).unwrap();
            plant
        };
        let n = plant(&scene, |_| {}).model().dimensions().coordinates();
        let wound: Vec<f64> =
            (0..n).map(|i| 0.7 + 0.2 * i as f64 + TURNS * std::f64::consts::TAU).collect();
        // The same angles without their turns; the first difference is exact.
        let plain = wound
            .iter()
            .map(|q| (-TURNS).mul_add(std::f64::consts::TAU, *q) - TURNS * TAU_LOW)
            .collect();
        let (mut wound, mut plain) = (start(wound), start(plain));
        for _ in 0..20 {
            coast(&mut wound, 100);
            coast(&mut plain, 100);
            for (a, b) in wound.p().iter().zip(plain.p()) {
                assert!((a - b).abs() <= 2e-13, "{}: {:e}", scene.name, a - b);
            }
        }
    }
}

#[test]
fn plants_start_and_step_at_every_operating_point() {
    for name in plantd_models::builtin::NAMES.iter().copied().chain([
        "tree-63",
        "scissor-1",
        "scissor-12",
        "balls-15",
        "walker-6",
    ]) {
        let model = Arc::new(Model::compile(&builtin(name)).unwrap());
        let mut plant = Plant::new(model.clone(), Settings::new(&model)).unwrap();
        for point in model.operating_points() {
            plant.initialize(&Initial::OperatingPoint(point.name.clone())).unwrap();
            plant.step(&point.u).unwrap_or_else(|e| panic!("{name} at {}: {e}", point.name));
        }
    }
}

#[test]
fn named_operating_points_are_equilibria() {
    for name in plantd_models::builtin::NAMES {
        let model = Arc::new(Model::compile(&builtin(name)).unwrap());
        let mut plant = Plant::new(model.clone(), Settings::new(&model)).unwrap();
        for point in model.operating_points().iter().filter(|p| p.name != "initial") {
            plant.initialize(&Initial::OperatingPoint(point.name.clone())).unwrap();
            plant.step(&point.u).unwrap();
            for (now, then) in plant.q().iter().zip(&point.q) {
                assert!((now - then).abs() < 1e-14, "{name} at {}: {now} {then}", point.name);
            }
        }
    }
}
