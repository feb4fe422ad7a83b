//! Inputs, steps and snapshots that are refused leave a plant as it was.

use crate::common::{builtin, plant, random_tree, wave, waving_input};
use plantd_models::{
    Initial, InitialError, Linearization, Plant, Settings, Snapshot, SnapshotError, StepError,
};

const SCENES: [&str; 4] = ["double-pendulum", "cart-pole", "four-bar", "marionette"];

/// Does something that must fail, and that must not change the plant by a bit.
fn refused<T, E>(plant: &mut Plant, action: impl FnOnce(&mut Plant) -> Result<T, E>) -> E {
    let (state, bytes) = (plant.state(), plant.snapshot().to_bytes());
    let Err(error) = action(plant) else { panic!("{} did not refuse", plant.model().scene().name) };
    assert_eq!(plant.state(), state);
    assert_eq!(plant.snapshot().to_bytes(), bytes);
    error
}

#[test]
fn inputs_that_are_not_finite_or_do_not_fit() {
    for scene in SCENES {
        let mut plant = plant(&builtin(scene), |_| ());
        wave(&mut plant, 5);
        let u = waving_input(&plant, 6);
        let mut out = Linearization::new(&plant.model().clone());
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for index in 0..u.len() {
                let mut u = u.clone();
                u[index] = bad;
                for error in [
                    refused(&mut plant, |p| p.step(&u)),
                    refused(&mut plant, |p| p.linearize(&u, &mut out)),
                    refused(&mut plant, |p| p.step_and_linearize(&u, &mut out)),
                ] {
                    let found =
                        matches!(error, StepError::InputNotFinite { index: i, .. } if i == index);
                    assert!(found, "{scene}: {error}");
                }
            }
        }
        for length in [0, u.len() - 1, u.len() + 1] {
            let u = vec![0.0; length];
            let error = refused(&mut plant, |p| p.step(&u));
            let expected = plant.model().dimensions().input();
            assert_eq!(error, StepError::Dimension { expected, actual: length }, "{scene}");
        }
        // It goes on as if nothing had been tried.
        let mut untouched = crate::common::plant(&builtin(scene), |_| ());
        wave(&mut untouched, 6);
        wave(&mut plant, 1);
        assert_eq!(plant.state(), untouched.state(), "{scene}");
    }
}

/// A time step of seconds is far too coarse for a fall at full speed.
#[test]
fn steps_that_do_not_converge() {
    for scene in SCENES {
        let mut plant = plant(&builtin(scene), |s| s.time_step_s = 30.0);
        let d = plant.model().dimensions();
        let mut out = Linearization::new(&plant.model().clone());
        let mut u = vec![0.0; d.input()];
        plant.hold_input(&mut u);
        u[..d.inputs].fill(1e6);
        u[d.inputs..].iter_mut().for_each(|x| *x += 50.0);
        for error in [
            refused(&mut plant, |p| p.step(&u)),
            refused(&mut plant, |p| p.linearize(&u, &mut out)),
        ] {
            let refused_input =
                matches!(error, StepError::Dimension { .. } | StepError::InputNotFinite { .. });
            assert!(!refused_input, "{scene}: {error}");
        }
    }
}

/// Numbers near the end of the range must end in an error, not in NaN.
#[test]
fn overflow_is_never_convergence() {
    for scene in SCENES {
        let mut plant = plant(&builtin(scene), |_| ());
        let u = vec![1e300; plant.model().dimensions().input()];
        refused(&mut plant, |p| p.step(&u));
    }
}

#[test]
fn states_that_are_not_finite_or_do_not_fit() {
    for scene in SCENES {
        let mut plant = plant(&builtin(scene), |_| ());
        wave(&mut plant, 3);
        let x = plant.state();
        let momentum = |q: &[f64], p: &[f64], v: &[f64]| Initial::Momentum {
            q: q.into(),
            p: p.into(),
            v: v.into(),
        };
        let mut bad = x.q.clone();
        bad[0] = f64::NAN;
        for initial in [
            momentum(&bad, &x.p, &x.v),
            Initial::Velocity { q: x.q.clone(), v: bad.clone() },
            Initial::TwoConfigurations { q0: bad.clone(), q1: x.q.clone() },
            Initial::Projection { q: bad.clone(), hold: vec![] },
        ] {
            let error = refused(&mut plant, |p| p.initialize(&initial));
            assert!(matches!(error, InitialError::NotFinite { index: 0, .. }), "{scene}: {error}");
        }
        for initial in [
            momentum(&x.q[1..], &x.p, &x.v),
            momentum(&x.q, &[], &x.v),
            momentum(&x.q, &x.p, &[0.0; 99]),
            Initial::Velocity { q: x.q.clone(), v: vec![] },
        ] {
            let error = refused(&mut plant, |p| p.initialize(&initial));
            assert!(matches!(error, InitialError::Dimension { .. }), "{scene}: {error}");
        }
        let nowhere = Initial::OperatingPoint("nowhere".to_owned());
        let error = refused(&mut plant, |p| p.initialize(&nowhere));
        assert!(matches!(error, InitialError::Unknown { .. }), "{scene}: {error}");
    }
}

#[test]
fn configurations_off_the_constraints() {
    for scene in ["four-bar", "scissor-4", "marionette"] {
        let mut plant = plant(&builtin(scene), |_| ());
        let x = plant.state();
        let mut q = x.q.clone();
        q[2] += 0.01;
        let off = Initial::Momentum { q: q.clone(), p: x.p, v: x.v };
        let error = refused(&mut plant, |p| p.initialize(&off));
        assert!(matches!(error, InitialError::OffConstraint { .. }), "{scene}: {error}");
        plant.initialize(&Initial::Projection { q, hold: vec![] }).unwrap();
        wave(&mut plant, 1);
    }
}

#[test]
fn snapshots_of_others_and_damaged_ones() {
    let mut plant = plant(&random_tree(1), |_| ());
    wave(&mut plant, 5);
    let bytes = plant.snapshot().to_bytes();
    for other in [
        crate::common::plant(&random_tree(2), |_| ()),
        crate::common::plant(&random_tree(1), |s| s.time_step_s = 0.02),
        crate::common::plant(&random_tree(1), |s| s.force_split = plantd_models::ForceSplit::Paper),
    ] {
        let snapshot = other.snapshot();
        let error = refused(&mut plant, |p| p.restore(&snapshot));
        assert!(matches!(error, SnapshotError::Mismatch(_)), "{error}");
    }
    for length in 0..bytes.len() {
        assert!(Snapshot::from_bytes(&bytes[..length]).is_err(), "cut to {length} bytes");
    }
    for byte in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[byte] ^= 1 << (byte % 8);
        assert!(Snapshot::from_bytes(&damaged).is_err(), "byte {byte} damaged");
    }
}

#[test]
fn settings_out_of_range() {
    let model = crate::common::model(&builtin("pendulum"));
    for time_step_s in [0.0, -0.1, f64::NAN, f64::INFINITY] {
        let settings = Settings { time_step_s, ..Settings::new(&model) };
        let error = Plant::new(model.clone(), settings).unwrap_err();
        assert!(matches!(error, InitialError::Settings { .. }), "{error}");
    }
}
