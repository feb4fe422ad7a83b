//! Built-in scenes against solutions of the continuous equations of motion, and second order.

mod common;

use std::f64::consts::FRAC_PI_2;

use common::{builtin, plant};
use plantd_models::Initial;

/// A released mechanism, and where it is one second later: joint angles found by extrapolation of
/// order 24 in 128-bit numbers, from independently written equations of motion.
struct Released {
    scene: &'static str,
    q: &'static [f64],
    v: &'static [f64],
    after_one_second: &'static [f64],
}

const RELEASED: [Released; 5] = [
    Released {
        scene: "pendulum",
        q: &[FRAC_PI_2],
        v: &[0.0],
        after_one_second: &[-1.4041087413664248],
    },
    Released {
        scene: "double-pendulum",
        q: &[FRAC_PI_2, 0.0],
        v: &[0.0, 0.0],
        after_one_second: &[-0.6230883546162683, -0.4108302366088923],
    },
    Released {
        scene: "spherical-pendulum",
        q: &[0.8, 0.3],
        v: &[0.5, 1.5],
        after_one_second: &[-0.6382714990583256, -0.480855532720644],
    },
    Released {
        scene: "chain-4",
        q: &[FRAC_PI_2, 0.0, 0.0, 0.0],
        v: &[0.0, 0.0, 0.0, 0.0],
        after_one_second: &[
            -0.9790638774002427,
            -0.9139476968151575,
            -0.1754313418469654,
            1.1380209247520454,
        ],
    },
    Released {
        scene: "four-bar",
        q: &[-1.2, 0.2784100130440415, -0.4355357264293476],
        v: &[0.0, 0.0, 0.0],
        after_one_second: &[0.9318379444159699, -1.9524258960466139, 0.38813195361883984],
    },
];

/// Largest error of an angle after one second in `steps` steps.
fn error(case: &Released, steps: u32) -> f64 {
    let mut plant = plant(&builtin(case.scene), |s| s.time_step_s = 1.0 / f64::from(steps));
    plant.initialize(&Initial::Velocity { q: case.q.into(), v: case.v.into() }).unwrap();
    let u = vec![0.0; plant.model().dimensions().input()];
    for _ in 0..steps {
        plant.step(&u).unwrap();
    }
    let errors = plant.q().iter().zip(case.after_one_second).map(|(x, y)| (x - y).abs());
    errors.fold(0.0, f64::max)
}

/// Half the time step leaves a quarter of the error.
#[test]
fn steps_are_of_second_order() {
    for case in &RELEASED {
        let (coarse, fine) = (error(case, 800), error(case, 1600));
        let ratio = coarse / fine;
        assert!(fine < 1e-3, "{}: {fine:e}", case.scene);
        assert!((3.8..4.2).contains(&ratio), "{}: {coarse:e} to {fine:e}", case.scene);
    }
}
