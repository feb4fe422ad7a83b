//! Modes, ranks and frequency responses: of maps against scipy (`tests/oracles/analysis.py`), of
//! mechanisms against closed forms.
//!
//! On a linear oscillator the midpoint rule is Cayley's transform: a root `s` of the equation of
//! motion becomes `z = (1 + sh/2) / (1 - sh/2)`.

use std::f64::consts::{PI, TAU};

use crate::common::{model, plant};
use crate::oracle::{matrix, oracle};
use nalgebra::{Complex, DMatrix};
use plantd_control::{
    AnalysisError, Mode, Tangent, TransferFunction, controllability_rank, modes, observability_rank,
};
use plantd_models::{Initial, Linearization, Plant, Scene};

#[test]
fn maps_agree_with_scipy() {
    for case in oracle("analysis.json")["cases"].as_array().unwrap() {
        let name = case["name"].as_str().unwrap();
        let [a, b, c, d] = ["a", "b", "c", "d"].map(|key| matrix(&case[key]));
        let h = case["time_step_s"].as_f64().unwrap();

        let expected = matrix(&case["eigenvalues"]);
        let found = modes(&a, h).unwrap();
        assert_eq!(found.len(), expected.nrows(), "{name}");
        for (mode, expected) in found.iter().zip(expected.row_iter()) {
            let error = (mode.real - expected[0]).hypot(mode.imaginary - expected[1]);
            assert!(error < 1e-10, "{name}: {mode:?} is off by {error:e}");
        }
        let rank = |key: &str| case[key].as_u64().unwrap() as usize;
        assert_eq!(controllability_rank(&a, &b), rank("controllable"), "{name}");
        assert_eq!(observability_rank(&a, &c), rank("observable"), "{name}");

        let transfer = TransferFunction::new(&a, &b, &c, &d, h).unwrap();
        for response in case["responses"].as_array().unwrap() {
            let found = transfer.at(response["frequency_hz"].as_f64().unwrap()).unwrap();
            let expected = matrix(&response["real"]).map(Complex::from)
                + matrix(&response["imaginary"]).map(|im| Complex::new(0.0, im));
            let error = (&found - &expected).norm() / expected.norm();
            assert!(error < 1e-11, "{name}: the response is off by {error:e}");
        }
    }
}

/// A and B at rest in the scene's initial configuration.
fn linearized(plant: &mut Plant) -> (DMatrix<f64>, DMatrix<f64>) {
    plant.initialize(&Initial::OperatingPoint("initial".to_owned())).unwrap();
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    let mut linearization = Linearization::new(plant.model());
    plant.linearize(&u, &mut linearization).unwrap();
    (linearization.a(), linearization.b())
}

/// The modes that oscillate or decay by themselves, with the prescribed coordinates held.
fn free_modes(plant: &mut Plant) -> Vec<Mode> {
    let (a, _) = linearized(plant);
    let dynamic = plant.model().dimensions().dynamic;
    let held = Tangent::held(&plant.constraint_jacobian(), dynamic);
    modes(&held.restrict_map(&a), plant.settings().time_step_s).unwrap()
}

fn cayley(s: Complex<f64>, h: f64) -> Complex<f64> {
    (1.0 + s * h / 2.0) / (1.0 - s * h / 2.0)
}

fn scene(text: &str) -> Scene {
    Scene::from_toml(text).unwrap()
}

/// Three masses in a row between walls, joined by four equal springs; a force on the middle one.
fn row_of_masses(damping: f64) -> Scene {
    let mut text = format!(
        "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"row\"\ntime_step_s = 0.02\ndamping = {damping}\n\
         [[inputs]]\nname = \"push\"\ncoordinate = \"m1\"\n"
    );
    for i in 0..3 {
        text += &format!(
            "[[frames]]\nname = \"m{i}\"\ntranslation = [{}.0, 0.0, 0.0]\n\
             joint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\nbody = {{ mass = 2.0 }}\n",
            i + 1
        );
    }
    for i in 0..4 {
        let end = |j: i32, at: i32| match j {
            0..3 => format!("{{ frame = \"m{j}\" }}"),
            _ => format!("{{ frame = \"world\", at = [{at}.0, 0.0, 0.0] }}"),
        };
        text += &format!(
            "[[springs]]\ntype = \"two_point\"\na = {}\nb = {}\nstiffness = 50.0\nrest_length = 1.0\n",
            end(i - 1, 0),
            end(if i == 3 { 9 } else { i }, 4)
        );
    }
    scene(&text)
}

#[test]
fn a_row_of_masses_has_the_modes_of_the_textbook() {
    let (m, k, c) = (2.0, 50.0, 0.3);
    for damping in [0.0, c] {
        let mut plant = plant(&row_of_masses(damping), |_| {});
        let h = plant.settings().time_step_s;
        let found = free_modes(&mut plant);
        assert_eq!(found.len(), 6);
        let mut expected: Vec<_> = (1..=3)
            .map(|j| {
                let rate = 2.0 * f64::sqrt(k / m) * (f64::from(j) * PI / 8.0).sin();
                let decay = damping / (2.0 * m);
                let s = Complex::new(-decay, (rate * rate - decay * decay).sqrt());
                cayley(s, h).ln() / h
            })
            .collect();
        expected.sort_by(|a, b| a.norm().total_cmp(&b.norm()));
        let mut upper: Vec<_> = found.iter().filter(|mode| mode.imaginary > 0.0).collect();
        upper.sort_by(|a, b| a.natural_frequency_hz.total_cmp(&b.natural_frequency_hz));
        assert_eq!(upper.len(), 3);
        for (mode, s) in upper.into_iter().zip(expected) {
            assert!((mode.natural_frequency_hz - s.norm() / TAU).abs() < 1e-10, "{mode:?}");
            assert!((mode.damping_ratio + s.re / s.norm()).abs() < 1e-12, "{mode:?}");
            if damping > 0.0 {
                assert!((mode.time_constant_s * s.re + 1.0).abs() < 1e-10, "{mode:?}");
            }
        }
    }
}

#[test]
fn what_moves_against_the_middle_is_out_of_its_reach_and_sight() {
    let mut plant = plant(&row_of_masses(0.3), |_| {});
    let (a, b) = linearized(&mut plant);
    assert_eq!(controllability_rank(&a, &b), 4);
    let sees = |index| DMatrix::from_fn(1, 6, |_, j| f64::from(u8::from(j == index)));
    assert_eq!(observability_rank(&a, &sees(1)), 4);
    assert_eq!(observability_rank(&a, &sees(0)), 6);
}

#[test]
fn an_oscillator_answers_as_the_midpoint_rule_does() {
    let (m, k, c) = (2.0, 50.0, 0.3);
    let text = "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"oscillator\"\ntime_step_s = 0.02\ndamping = 0.3\n\
        [[frames]]\nname = \"x\"\njoint = { type = \"prismatic\", axis = [1.0, 0.0, 0.0] }\n\
        body = { mass = 2.0 }\n\
        [[springs]]\ntype = \"coordinate\"\ncoordinate = \"x\"\nstiffness = 50.0\n\
        [[inputs]]\nname = \"push\"\ncoordinate = \"x\"\n";
    let response = |text: &str, frequency_hz: f64| {
        let mut plant = plant(&scene(text), |_| {});
        let h = plant.settings().time_step_s;
        let (a, b) = linearized(&mut plant);
        let position = DMatrix::from_row_slice(1, 2, &[1.0, 0.0]);
        let transfer = TransferFunction::new(&a, &b, &position, &DMatrix::zeros(1, 1), h).unwrap();
        transfer.at(frequency_hz).map(|g| g[(0, 0)])
    };
    let h = 0.02;
    for frequency_hz in [0.0, 0.1, 0.8, 3.0, 24.0] {
        let z = Complex::from_polar(1.0, TAU * frequency_hz * h);
        let warped = 2.0 / h * (PI * frequency_hz * h).tan();
        let expected = 2.0 / (z + 1.0) / Complex::new(k - m * warped * warped, c * warped);
        let found = response(text, frequency_hz).unwrap();
        assert!((found - expected).norm() < 1e-11 * expected.norm(), "{frequency_hz} Hz");
    }
    // Without damping the response is infinite at the frequency of the discrete oscillation.
    let undamped = text.replace("damping = 0.3\n", "");
    let resonance_hz = 2.0 / h * (5.0 * h / 2.0_f64).atan() / TAU;
    let error = response(&undamped, resonance_hz).unwrap_err();
    assert!(matches!(error, AnalysisError::Pole { .. }), "{error}");
    assert!(response(&undamped, 1.001 * resonance_hz).is_ok());
}

/// A point of 1 kg on a rod of 2 m: as a hinge, hung from a prescribed slider, and in Cartesian
/// coordinates tied by a constraint. There gravity acts through the multiplier, at the ends of a step:
/// `x[k+1] - 2 x[k] + x[k-1] = -h² (g / l) x[k]`, so that `cos(arg z) = 1 - h² g / 2l`.
#[test]
fn constraints_gauge_and_prescribed_coordinates_make_no_modes() {
    let head = "format = 1\ntime_step_s = 0.05\ngravity = [0.0, -9.8, 0.0]\n";
    let hinge = "[[frames]]\nname = \"rod\"\njoint = { type = \"revolute\", axis = [0.0, 0.0, 1.0] }\n\
        body = { mass = 1.0, center_of_mass = [0.0, -2.0, 0.0] }\n";
    let cartesian = "[[frames]]\nname = \"x\"\njoint = { type = \"prismatic\", axis = [1.0, 0.0, 0.0] }\n\
        [[frames]]\nname = \"y\"\nparent = \"x\"\n\
        joint = { type = \"prismatic\", axis = [0.0, 1.0, 0.0] }\nbody = { mass = 1.0 }\n\
        [[coordinates]]\nname = \"y\"\ninitial = -2.0\n\
        [[constraints]]\ntype = \"distance\"\nname = \"rod\"\na = { frame = \"world\" }\n\
        b = { frame = \"y\" }\nlength = 2.0\n";
    let hung = "[[frames]]\nname = \"slider\"\njoint = { type = \"prismatic\", axis = [1.0, 0.0, 0.0] }\n\
        [[coordinates]]\nname = \"slider\"\nkind = \"prescribed\"\n";
    let swinging = cayley(Complex::new(0.0, f64::sqrt(9.8 / 2.0)), 0.05);
    let tied = Complex::from_polar(1.0, f64::acos(1.0 - 0.05 * 0.05 * 9.8 / 4.0));
    let hung = format!(
        "{head}name = \"c\"\n{hung}{}",
        hinge.replace("\njoint", "\nparent = \"slider\"\njoint")
    );
    for (text, prescribed, expected) in [
        (format!("{head}name = \"a\"\n{hinge}"), 0, swinging),
        (format!("{head}name = \"b\"\n{cartesian}"), 0, tied),
        (hung, 1, swinging),
    ] {
        let scene = scene(&text);
        assert_eq!(model(&scene).dimensions().prescribed, prescribed);
        let found = free_modes(&mut plant(&scene, |_| {}));
        assert_eq!(found.len(), 2, "{found:?}");
        assert!((found[0].real - expected.re).abs() < 1e-12, "{found:?}");
        assert!((found[0].imaginary - expected.im).abs() < 1e-12, "{found:?}");
        assert!((found[0].modulus - 1.0).abs() < 1e-13, "{found:?}");
    }
}

#[test]
fn a_four_bar_swings_in_one_mode() {
    let mut plant = plant(&crate::common::builtin("four-bar"), |_| {});
    let (a, b) = linearized(&mut plant);
    let jacobian = plant.constraint_jacobian();
    let tangent = Tangent::new(&jacobian, 3);
    let (a, b) = (tangent.restrict_map(&a), tangent.reduce(&b));
    assert_eq!((a.nrows(), controllability_rank(&a, &b)), (2, 2));
}
