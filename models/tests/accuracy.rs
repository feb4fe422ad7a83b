//! Built-in scenes against solutions of the continuous equations of motion, and second order.

use std::f64::consts::{FRAC_PI_2, TAU};

use crate::common::{builtin, plant};
use plantd_models::scene::{Signal, Spring};
use plantd_models::{Initial, Linearization, Scene, Settings};

/// A released mechanism, and where it is after each second: joint angles found by extrapolation of order 24
/// to 28 in 128-bit numbers, from independently written equations of motion.
struct Released {
    scene: &'static str,
    q: &'static [f64],
    v: &'static [f64],
    every_second: &'static [&'static [f64]],
}

const RELEASED: [Released; 5] = [
    Released {
        scene: "pendulum",
        q: &[FRAC_PI_2],
        v: &[0.0],
        every_second: &[
            &[-1.4041087413664248],
            &[0.9131205212088619],
            &[-0.17086059689541802],
            &[-0.6238904966102574],
            &[1.2359544800074451],
        ],
    },
    Released {
        scene: "double-pendulum",
        q: &[FRAC_PI_2, 0.0],
        v: &[0.0, 0.0],
        every_second: &[
            &[-0.6230883546162683, -0.4108302366088923],
            &[-0.48609977514169234, -0.840945647357478],
            &[1.7852833663614323, -0.6664063393942715],
        ],
    },
    Released {
        scene: "spherical-pendulum",
        q: &[0.8, 0.3],
        v: &[0.5, 1.5],
        every_second: &[
            &[-0.6382714990583256, -0.480855532720644],
            &[0.4165552468874873, 0.5748241169487062],
            &[-0.19799897613728545, -0.5705935261125412],
            &[0.05049358312837238, 0.49865999298039954],
            &[0.008891226226445668, -0.41324743727085617],
        ],
    },
    Released {
        scene: "chain-4",
        q: &[FRAC_PI_2, 0.0, 0.0, 0.0],
        v: &[0.0, 0.0, 0.0, 0.0],
        every_second: &[
            &[-0.9790638774002427, -0.9139476968151575, -0.1754313418469654, 1.1380209247520454],
            &[1.4997487042684947, -0.3138215677923457, -1.0513663278066596, 3.2121474392877354],
        ],
    },
    Released {
        scene: "four-bar",
        q: &[-1.2, 0.2784100130440415, -0.4355357264293476],
        v: &[0.0, 0.0, 0.0],
        every_second: &[
            &[0.9318379444159699, -1.9524258960466139, 0.38813195361883984],
            &[-0.3726307564516034, -0.7722271081316227, -0.27839740657308204],
            &[-0.22533427092501962, -0.9238695514299983, -0.20814184134836408],
            &[0.831352782399944, -1.8729683448140806, 0.3400738457002947],
            &[-1.1889440501828157, 0.26060229497210785, -0.43867575460345837],
        ],
    },
];

/// Largest error of an angle after any of the first seconds, in `steps` steps a second.
fn error(case: &Released, order: u32, steps: u32, seconds: usize) -> f64 {
    let settings = |s: &mut Settings| {
        (s.time_step_s, s.order, s.halvings) = (1.0 / f64::from(steps), order, 0);
    };
    let mut plant = plant(&builtin(case.scene), settings);
    plant.initialize(&Initial::Velocity { q: case.q.into(), v: case.v.into() }).unwrap();
    let u = vec![0.0; plant.model().dimensions().input()];
    let mut largest = 0.0_f64;
    for exact in &case.every_second[..seconds] {
        for _ in 0..steps {
            plant.step(&u).unwrap();
        }
        let errors = plant.q().iter().zip(*exact).map(|(x, y)| (x - y).abs());
        largest = errors.fold(largest, f64::max);
    }
    largest
}

/// An order, and two numbers of steps that show it.
type Steps = (u32, [u32; 2]);

/// Asserts that errors fall with the step as an order says: by what they are at the numbers of steps.
fn assert_order(what: &str, order: u32, steps: [u32; 2], error: impl Fn(u32) -> f64) {
    let [coarse, fine] = steps.map(error);
    let ratio = f64::from(steps[1]) / f64::from(steps[0]);
    let found = (coarse / fine).ln() / ratio.ln();
    println!("{what}, order {order}: {coarse:e} to {fine:e}, {found}");
    assert!((found - f64::from(order)).abs() < 0.1, "{what}, order {order}: {found}, {fine:e}");
}

#[test]
fn steps_are_of_their_order() {
    let pairs: [(&str, &[Steps]); 5] = [
        ("pendulum", &[(2, [400, 800]), (4, [40, 80]), (6, [16, 32]), (8, [10, 16])]),
        ("double-pendulum", &[(2, [800, 1600]), (4, [160, 320]), (6, [64, 128]), (8, [48, 60])]),
        ("spherical-pendulum", &[(2, [400, 800]), (4, [80, 160]), (6, [32, 64]), (8, [16, 24])]),
        ("chain-4", &[(2, [3200, 6400])]),
        ("four-bar", &[(2, [1600, 3200]), (4, [128, 256]), (6, [64, 128]), (8, [48, 64])]),
    ];
    for (case, (scene, pairs)) in RELEASED.iter().zip(pairs) {
        assert_eq!(case.scene, scene);
        let seconds = case.every_second.len();
        for &(order, steps) in pairs {
            assert_order(scene, order, steps, |n| error(case, order, n, seconds));
        }
    }
}

/// A pendulum by a rod that is a constraint, against the one with a hinge.
#[test]
fn constrained_steps_are_of_their_order() {
    let text = r#"
        format = 1
        name = "rod"
        gravity = [0.0, -9.8, 0.0]
        [[frames]]
        name = "slide"
        joint = { type = "prismatic", axis = [1.0, 0.0, 0.0], coordinate = "x" }
        [[frames]]
        name = "bob"
        parent = "slide"
        joint = { type = "prismatic", axis = [0.0, 1.0, 0.0], coordinate = "y" }
        body = { mass = 1.0 }
        [[coordinates]]
        name = "x"
        initial = 1.0
        [[constraints]]
        name = "rod"
        type = "distance"
        a = { frame = "bob" }
        b = { frame = "world" }
        length = 1.0
    "#;
    let scene = Scene::from_toml(text).unwrap();
    let case = &RELEASED[0];
    let error = |order: u32, steps: u32| {
        let mut plant = plant(&scene, |s| {
            (s.time_step_s, s.order) = (1.0 / f64::from(steps), order);
        });
        let mut largest = 0.0_f64;
        for angle in case.every_second {
            for _ in 0..steps {
                plant.step(&[]).unwrap();
            }
            let (sine, cosine) = angle[0].sin_cos();
            largest = largest.max((plant.q()[0] - sine).hypot(plant.q()[1] + cosine));
        }
        largest
    };
    for (order, steps) in [(2, [400, 800]), (4, [64, 128]), (6, [48, 96]), (8, [32, 48])] {
        assert_order("rod", order, steps, |n| error(order, n));
    }
}

/// Scenes without forces and bent springs are evaluated four or eight stages at a time. A stop that is never reached
/// makes them take the other way.
#[test]
fn stages_side_by_side_are_stages_one_by_one() {
    for name in ["pendulum", "damped-pendulum", "cart-pole", "spherical-pendulum", "chain-4"] {
        let mut sprung = builtin(name);
        let coordinate = sprung.coordinates[0].name.clone();
        sprung.coordinates[0].armature = 0.3;
        sprung.springs.push(Spring::Coordinate { coordinate, stiffness: 5.0, rest: 0.2 });
        for (scene, turns) in [(builtin(name), 0.0), (sprung, 7.0)] {
            for order in [4, 6, 8, 12, 16] {
                assert_same_stages(&scene, turns, order);
            }
        }
    }
}

fn assert_same_stages(scene: &Scene, turns: f64, order: u32) {
    let settings = |s: &mut Settings| (s.time_step_s, s.order) = (0.02, order);
    let mut together = plant(scene, settings);
    let mut stopped = scene.clone();
    stopped.springs.push(Spring::Stop {
        coordinate: Some(scene.coordinates[0].name.clone()),
        points: Vec::new(),
        range: Some([-1e3, 1e3]),
        stiffness: Some(1.0),
        damping: None,
        transition: None,
        settling_depth: None,
        settling_time_s: None,
    });
    let mut alone = plant(&stopped, settings);
    let q: Vec<f64> = (0..together.q().len()).map(|i| turns + 0.8 - 0.3 * i as f64).collect();
    let v: Vec<f64> = q.iter().map(|q| 0.5 - (q - turns)).collect();
    let u: Vec<f64> = (0..together.model().dimensions().input()).map(|i| 0.3 + i as f64).collect();
    for plant in [&mut together, &mut alone] {
        plant.initialize(&Initial::Velocity { q: q.clone(), v: v.clone() }).unwrap();
        for _ in 0..20 {
            plant.step(&u).unwrap();
        }
    }
    let near = |a: &[f64], b: &[f64], what: &str| {
        let size = a.iter().fold(1.0_f64, |most, x| most.max(x.abs()));
        let error = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 1e-11 * size, "{}, order {order}: {what} by {error:e}", scene.name);
    };
    near(together.q(), alone.q(), "q");
    near(together.p(), alone.p(), "p");
    let [a, b] = [&mut together, &mut alone].map(|plant| {
        let mut out = Linearization::new(plant.model());
        plant.linearize(&u, &mut out).unwrap();
        [out.a().as_slice().to_vec(), out.b().as_slice().to_vec()]
    });
    near(&a[0], &b[0], "A");
    near(&a[1], &b[1], "B");
}

/// A damped oscillator that is pulled aside, for which each order shows down to the last digits:
/// `ẍ + 2δ ẋ + ω² x = a`.
#[test]
fn an_oscillator_is_followed_in_every_order() {
    let text = r#"
        format = 1
gravity = [0.0, 0.0, 0.0]
        name = "oscillator"
        [[frames]]
        name = "mass"
        joint = { type = "prismatic", axis = [1.0, 0.0, 0.0], coordinate = "x" }
        body = { mass = 2.0 }
        [[coordinates]]
        name = "x"
        damping = 0.2
        [[springs]]
        type = "coordinate"
        coordinate = "x"
        stiffness = 2.0
        [[inputs]]
        name = "pull"
        coordinate = "x"
    "#;
    let scene = Scene::from_toml(text).unwrap();
    let (damping, omega2, pull) = (0.05_f64, 1.0_f64, 0.3);
    let omega = (omega2 - damping * damping).sqrt();
    let (start, speed, middle) = (1.0, 0.2, 0.15);
    let exact = |t: f64| {
        let (sine, cosine) = (omega * t).sin_cos();
        let amplitude = (speed + damping * (start - middle)) / omega;
        middle + (-damping * t).exp() * ((start - middle) * cosine + amplitude * sine)
    };
    let error = |order: u32, steps: u32| {
        let mut plant = plant(&scene, |s| {
            (s.time_step_s, s.order) = (20.0 / f64::from(steps), order);
        });
        plant.initialize(&Initial::Velocity { q: vec![start], v: vec![speed] }).unwrap();
        let mut largest = 0.0_f64;
        for k in 1..=steps {
            plant.step(&[pull]).unwrap();
            let t = 20.0 * f64::from(k) / f64::from(steps);
            largest = largest.max((plant.q()[0] - exact(t)).abs());
        }
        largest
    };
    let pairs = [(2, [400, 800]), (4, [80, 160]), (6, [40, 80]), (8, [32, 64]), (12, [16, 24])];
    for (order, steps) in pairs {
        assert_order("oscillator", order, steps, |n| error(order, n));
    }
}

/// The solution of `ẋ = f(t, x)` after a time, by extrapolation of the modified midpoint rule (Gragg,
/// Bulirsch, Stoer), to the last digits.
fn extrapolated(time: f64, mut x: [f64; 2], f: impl Fn(f64, [f64; 2]) -> [f64; 2]) -> [f64; 2] {
    const INTERVALS: u32 = 64;
    let length = time / f64::from(INTERVALS);
    let along = |x: [f64; 2], h: f64, f: [f64; 2]| [x[0] + h * f[0], x[1] + h * f[1]];
    for interval in 0..INTERVALS {
        let begin = f64::from(interval) * length;
        let mut above: Vec<[f64; 2]> = Vec::new();
        for k in 1..=8_u32 {
            let h = length / f64::from(2 * k);
            let (mut before, mut now) = (x, along(x, h, f(begin, x)));
            for step in 1..2 * k {
                (before, now) = (now, along(before, 2.0 * h, f(begin + f64::from(step) * h, now)));
            }
            let last = along(before, h, f(begin + length, now));
            let mut row = vec![[0.5 * (now[0] + last[0]), 0.5 * (now[1] + last[1])]];
            for (j, above) in above.iter().enumerate() {
                let ratio = (f64::from(k) / f64::from(k - 1 - j as u32)).powi(2);
                let entry = row[j];
                row.push([0, 1].map(|i| entry[i] + (entry[i] - above[i]) / (ratio - 1.0)));
            }
            above = row;
        }
        x = above[7];
    }
    x
}

/// A damped pendulum, pushed by a sinusoid: forces that dissipate and that depend on time.
#[test]
fn forced_and_damped_steps_are_of_their_order() {
    let mut scene = builtin("pendulum");
    scene.damping = 0.4;
    let (amplitude, frequency_hz) = (2.0, 0.3);
    scene.signals.push(Signal::Sinusoid {
        drives: scene.inputs[0].name.clone(),
        amplitude,
        frequency_hz,
        phase_rad: 0.0,
        offset: 0.5,
    });
    let start = [1.0, 0.5];
    let rate = |t: f64, [angle, speed]: [f64; 2]| {
        let torque = 0.5 + amplitude * (TAU * frequency_hz * t).sin();
        [speed, -9.8 * angle.sin() - 0.4 * speed + torque]
    };
    let exact = extrapolated(2.0, start, rate)[0];
    let error = |order: u32, steps: u32| {
        let mut plant = plant(&scene, |s| {
            (s.time_step_s, s.order) = (2.0 / f64::from(steps), order);
        });
        plant.initialize(&Initial::Velocity { q: vec![start[0]], v: vec![start[1]] }).unwrap();
        for _ in 0..steps {
            plant.step(&[0.0]).unwrap();
        }
        (plant.q()[0] - exact).abs()
    };
    for (order, steps) in [(2, [400, 800]), (4, [40, 80]), (6, [24, 36]), (8, [14, 20])] {
        assert_order("forced pendulum", order, steps, |n| error(order, n));
    }
}

/// The choice keeps its promise, against the midpoint rule in many substeps, extrapolated.
#[test]
fn chosen_methods_reach_their_tolerance() {
    for name in plantd_models::builtin::NAMES {
        let scene = builtin(name);
        let path = |order: u32, substeps: u32| {
            let mut plant = plant(&scene, |s| (s.order, s.substeps) = (order, substeps));
            let start = plant.q().to_vec();
            let mut u = vec![0.0; plant.model().dimensions().input()];
            let mut path = Vec::new();
            for _ in 0..50 {
                plant.hold_input(&mut u);
                plant.step(&u).unwrap();
                path.extend(plant.model().difference(&start, plant.q()));
            }
            path
        };
        let exact: Vec<f64> =
            path(2, 256).iter().zip(path(2, 128)).map(|(a, b)| a + (a - b) / 3.0).collect();
        for tolerance in [1e-3, 1e-6] {
            let choice = plant(&scene, |_| ()).choose_method(tolerance, &mut || true).unwrap();
            let found = path(choice.order, choice.substeps);
            let errors = found.iter().zip(&exact).map(|(a, b)| (a - b).abs());
            let error = errors.fold(0.0, f64::max);
            println!("{name}, {tolerance:e}: {choice:?}, {error:e}");
            assert!(error <= 3.0 * tolerance, "{name}: {choice:?} is off by {error:e}");
            assert!(choice.error <= tolerance);
        }
    }
}

/// An estimate is what a period is off by, to a few per cent where the order shows.
#[test]
fn error_estimates_are_errors() {
    for (name, order) in
        [("pendulum", 2), ("pendulum", 4), ("double-pendulum", 6), ("four-bar", 2), ("four-bar", 4)]
    {
        let time_step_s = if order > 4 { 0.1 } else { 0.03 };
        let mut coarse = plant(&builtin(name), |s| (s.time_step_s, s.order) = (time_step_s, order));
        let case = RELEASED.iter().find(|case| case.scene == name).unwrap();
        let start = Initial::Velocity { q: case.q.into(), v: case.v.into() };
        coarse.initialize(&start).unwrap();
        let mut fine = plant(&builtin(name), |s| {
            (s.time_step_s, s.order, s.substeps) = (time_step_s, order.max(6), 32);
        });
        fine.initialize(&start).unwrap();
        let u = vec![0.0; coarse.model().dimensions().input()];
        let estimate = coarse.estimate_error(&u).unwrap();
        coarse.step(&u).unwrap();
        fine.step(&u).unwrap();
        let errors = coarse.q().iter().zip(fine.q()).map(|(a, b)| (a - b).abs());
        let ratio = estimate.configuration / errors.fold(0.0, f64::max);
        assert!((0.8..1.25).contains(&ratio), "{name}, order {order}: {ratio}");
    }
}
