//! Filters against independent solutions (`tests/oracles/kalman.py`: mpmath, scipy, python-control)
//! and against what defines them.

use crate::oracle::{matrix, oracle, relative_error};
use nalgebra::{DMatrix, DVector};
use plantd_control::{
    Kalman, KalmanError, NoiseCovariances, NoiseError, RiccatiError, Sample, Tangent, Values,
    steady_state_kalman, steady_state_kalman_on_manifold, time_varying_kalman,
    time_varying_kalman_on_manifold,
};
use serde_json::Value;

fn matrices(value: &Value) -> Vec<DMatrix<f64>> {
    value.as_array().unwrap().iter().map(matrix).collect()
}

fn optional(value: &Value) -> Option<DMatrix<f64>> {
    (!value.is_null()).then(|| matrix(value))
}

/// Numbers in (-1, 1) that follow no pattern.
fn noise(rows: usize, cols: usize, seed: f64) -> DMatrix<f64> {
    DMatrix::from_fn(rows, cols, |i, j| {
        let x = (12.9898 * i as f64 + 78.233 * j as f64 + seed).sin() * 43758.5453;
        2.0 * (x - x.floor()) - 1.0
    })
}

fn identities(n: usize, r: usize) -> NoiseCovariances {
    let process = Some(DMatrix::identity(n, n));
    NoiseCovariances::new(process, None, DMatrix::identity(r, r)).unwrap()
}

#[test]
fn steady_state_filters_agree_with_independent_solutions() {
    for case in oracle("kalman.json")["steady"].as_array().unwrap() {
        let name = case["name"].as_str().unwrap();
        let (process, input) = (optional(&case["process"]), optional(&case["input"]));
        let noise = NoiseCovariances::new(process, input, matrix(&case["measurement"])).unwrap();
        let (a, b, c) = (matrix(&case["a"]), matrix(&case["b"]), matrix(&case["c"]));
        let kalman =
            steady_state_kalman(&a, &b, &c, &noise).unwrap_or_else(|e| panic!("{name}: {e}"));
        for (what, found) in [
            ("gain", &kalman.gain),
            ("predicted", &kalman.predicted),
            ("filtered", &kalman.filtered),
        ] {
            let error = relative_error(found, &matrix(&case[what]));
            println!("{name}: {what} {error:.1e}");
            assert!(error < 1e-9, "{name}: {what} is off by {error:e}");
        }
        let radius = kalman.error_modes[0].norm();
        assert!((radius - case["radius"].as_f64().unwrap()).abs() < 1e-9, "{name}");
        let Kalman { residual, reciprocal_condition, .. } = kalman;
        assert!(residual < 1e-10 && reciprocal_condition > 0.0 && reciprocal_condition <= 1.0);
    }
}

#[test]
fn filters_along_a_trajectory_agree_with_least_squares_of_all_states_at_once() {
    let case = &oracle("kalman.json")["trajectory"];
    let pairs = matrices(&case["a"]).into_iter().zip(matrices(&case["b"]));
    let samples: Vec<_> = pairs.map(|(a, b)| Sample { a, b }).collect();
    let covariances = matrices(&case["process"]).into_iter().zip(matrices(&case["input"]));
    let noise: Vec<_> = covariances
        .zip(matrices(&case["measurement"]))
        .map(|((process, input), v)| NoiseCovariances::new(Some(process), Some(input), v).unwrap())
        .collect();
    let (outputs, initial) = (matrices(&case["c"]), matrix(&case["initial"]));
    let solution = time_varying_kalman(&samples, &outputs, &noise, &initial, Values::Keep).unwrap();
    let covariances = solution.covariances.unwrap();
    assert_eq!(solution.gains.len(), samples.len() + 1);
    assert_eq!((covariances.len(), solution.reciprocal_conditions.len()), (7, 7));
    let expected = |what: &str| matrices(&case[what]);
    for (k, gain) in expected("gains").iter().enumerate() {
        assert!(relative_error(&solution.gains[k], gain) < 1e-11, "gain {k}");
        let (predicted, filtered) = &covariances[k];
        assert!(relative_error(predicted, &expected("predicted")[k]) < 1e-11, "predicted {k}");
        assert!(relative_error(filtered, &expected("filtered")[k]) < 1e-11, "filtered {k}");
    }
    let dropped = time_varying_kalman(&samples, &outputs, &noise, &initial, Values::Drop).unwrap();
    assert_eq!((dropped.covariances, dropped.gains), (None, solution.gains));
}

#[test]
fn a_long_trajectory_ends_in_the_steady_state() {
    let sample = Sample { a: noise(5, 5, 1.0) * 0.8, b: noise(5, 2, 2.0) };
    let c = noise(2, 5, 3.0);
    let noise = NoiseCovariances::new(None, Some(DMatrix::identity(2, 2)), DMatrix::identity(2, 2))
        .unwrap();
    let steady = steady_state_kalman(&sample.a, &sample.b, &c, &noise).unwrap();
    let long = time_varying_kalman(
        &vec![sample; 300],
        std::slice::from_ref(&c),
        std::slice::from_ref(&noise),
        &(DMatrix::identity(5, 5) * 10.0),
        Values::Keep,
    )
    .unwrap();
    assert!(relative_error(long.gains.last().unwrap(), &steady.gain) < 1e-11);
    let (predicted, filtered) = long.covariances.unwrap().pop().unwrap();
    assert!(relative_error(&predicted, &steady.predicted) < 1e-11);
    assert!(relative_error(&filtered, &steady.filtered) < 1e-11);
}

/// Errors follow `e⁺ = (I − L C) e⁻ − L v`, `e⁻ ← A e⁺ + w`: their covariance over many noises is what
/// the filter says, and another gain's is greater.
#[test]
fn the_covariance_is_that_of_the_errors_and_no_gain_has_less() {
    let (a, b, c) = (noise(3, 3, 1.0), noise(3, 1, 2.0), noise(1, 3, 4.0));
    let noise_of_all = identities(3, 1);
    let kalman = steady_state_kalman(&a, &b, &c, &noise_of_all).unwrap();
    let settle = |gain: &DMatrix<f64>| {
        let mut p = DMatrix::<f64>::zeros(3, 3);
        for _ in 0..2000 {
            let left = DMatrix::identity(3, 3) - gain * &c;
            let filtered = &left * &p * left.transpose() + gain * gain.transpose();
            p = &a * filtered * a.transpose() + DMatrix::identity(3, 3);
        }
        p
    };
    assert!(relative_error(&settle(&kalman.gain), &kalman.predicted) < 1e-12);
    for i in 0..3 {
        let mut worse = kalman.gain.clone();
        worse[(i, 0)] += 0.01;
        let excess = settle(&worse) - &kalman.predicted;
        assert!(excess.trace() > 0.0 && excess.symmetric_eigenvalues().min() > -1e-12);
    }
}

#[test]
fn a_mode_that_no_output_shows_is_named() {
    let map = |mode: f64| DMatrix::from_diagonal(&DVector::from_vec(vec![mode, 0.5]));
    let (b, c) = (DMatrix::zeros(2, 1), DMatrix::from_row_slice(1, 2, &[0.0, 1.0]));
    for mode in [1.2, 1.0, -1.0] {
        let error = steady_state_kalman(&map(mode), &b, &c, &identities(2, 1)).unwrap_err();
        let KalmanError::NotDetectable { real, imaginary, modulus } = error else {
            panic!("{error:?}");
        };
        assert_eq!((real, imaginary, modulus), (mode, 0.0, mode.abs()));
    }
    // What decays by itself need not be seen.
    assert!(steady_state_kalman(&map(0.99), &b, &c, &identities(2, 1)).is_ok());
    // Without outputs the filter predicts, which is good as long as everything decays.
    let nothing = DMatrix::zeros(0, 2);
    assert!(steady_state_kalman(&map(0.9), &b, &nothing, &identities(2, 0)).is_ok());
    let error = steady_state_kalman(&map(1.1), &b, &nothing, &identities(2, 0)).unwrap_err();
    assert!(matches!(error, KalmanError::NotDetectable { .. }), "{error:?}");
}

/// Rotated states, and units over twelve decades, hide a mode from the eye and not from the check.
#[test]
fn a_mode_that_no_output_shows_is_named_however_it_hides() {
    for n in [4_usize, 20, 50] {
        for mode in [1.0, -1.0, 1.4] {
            let r = 1 + n / 10;
            let mut a = noise(n, n, 1.0) * (1.1 / (n as f64 / 3.0).sqrt());
            let mut c = noise(r, n, 2.0);
            a.column_mut(0).fill(0.0);
            c.column_mut(0).fill(0.0);
            a[(0, 0)] = mode;
            let rotation = noise(n, n, 3.0).qr().q();
            let units = DVector::from_fn(n, |i, _| 10f64.powi((7 * i as i32) % 13 - 6));
            let to = DMatrix::from_diagonal(&units) * &rotation;
            let from = rotation.transpose() * DMatrix::from_diagonal(&units.map(f64::recip));
            let (a, c, b) = (&to * a * &from, c * &from, DMatrix::zeros(n, 0));
            let error = steady_state_kalman(&a, &b, &c, &identities(n, r)).unwrap_err();
            let KalmanError::NotDetectable { real, imaginary, .. } = error else {
                panic!("{n} states, {mode}: {error}");
            };
            assert!((real - mode).hypot(imaginary) < 1e-6, "{n} states, {mode}: {error}");
        }
    }
}

#[test]
fn a_mode_on_the_unit_circle_without_noise_is_named() {
    let a = DMatrix::from_diagonal(&DVector::from_vec(vec![1.0, 0.5]));
    let (b, c) = (DMatrix::from_row_slice(2, 1, &[0.0, 1.0]), DMatrix::identity(2, 2));
    let noise = NoiseCovariances::new(None, Some(DMatrix::identity(1, 1)), DMatrix::identity(2, 2))
        .unwrap();
    assert_eq!(
        steady_state_kalman(&a, &b, &c, &noise).unwrap_err(),
        KalmanError::NotExcited { real: 1.0, imaginary: 0.0 }
    );
}

#[test]
fn bad_covariances_are_named() {
    let identity = DMatrix::<f64>::identity(2, 2);
    let new = |process: &DMatrix<f64>, input: &DMatrix<f64>, v: &DMatrix<f64>| {
        NoiseCovariances::new(Some(process.clone()), Some(input.clone()), v.clone())
    };
    let error = new(&-&identity, &identity, &identity).unwrap_err();
    assert_eq!(error, NoiseError::Negative { covariance: "process" });
    let error = new(&identity, &(&identity * f64::NAN), &identity).unwrap_err();
    assert_eq!(error.covariance(), "input");
    assert!(matches!(error, NoiseError::Malformed { .. }));
    let skew = DMatrix::from_row_slice(2, 2, &[1.0, 0.5, 0.0, 1.0]);
    assert_eq!(new(&identity, &identity, &skew).unwrap_err().covariance(), "measurement");
    let error = new(&identity, &identity, &DMatrix::zeros(2, 2)).unwrap_err();
    assert_eq!(error, NoiseError::NotPositiveDefinite);
    let error = new(&identity, &DMatrix::zeros(2, 3), &identity).unwrap_err();
    assert_eq!(error.covariance(), "input");

    let (a, b, c) = (identity.clone() * 0.5, DMatrix::zeros(2, 1), identity.clone());
    let misfit = new(&identity, &identity, &identity).unwrap();
    assert_eq!(
        steady_state_kalman(&a, &b, &c, &misfit).unwrap_err(),
        NoiseError::Dimension { covariance: "input", size: 2, expected: 1 }.into()
    );
    let error = steady_state_kalman(&a, &b, &DMatrix::zeros(1, 3), &identities(2, 1)).unwrap_err();
    assert!(
        matches!(error, KalmanError::Riccati(RiccatiError::Dimension { matrix: "C", .. })),
        "{error:?}"
    );
    let samples = vec![Sample { a, b }; 3];
    let (outputs, noise) = (vec![c; 2], vec![identities(2, 2)]);
    let error =
        time_varying_kalman(&samples, &outputs, &noise, &identity, Values::Drop).unwrap_err();
    assert!(matches!(error, KalmanError::Count { list: "outputs", actual: 2, .. }), "{error:?}");
    let error =
        time_varying_kalman(&samples, &outputs[..1], &noise, &-identity, Values::Drop).unwrap_err();
    assert_eq!(error, NoiseError::Negative { covariance: "initial_covariance" }.into());
}

/// One dynamic pair (q1, q2) tied by q1 + q2 = q_k, one prescribed coordinate; momentum that the
/// constraint absorbs.
fn constrained() -> (Sample, Tangent) {
    let tangent = Tangent::new(&DMatrix::from_row_slice(1, 3, &[1.0, 1.0, -1.0]), 2);
    let size = tangent.dimension();
    let basis = tangent.basis();
    let gauge = DMatrix::from_column_slice(6, 1, &[0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    let pickup = &gauge * noise(1, size, 9.0) * basis.transpose();
    let a = basis * noise(size, size, 2.0) * 0.6 * basis.transpose() + pickup;
    let b = basis * noise(size, 1, 5.0) + &gauge * noise(1, 1, 3.0);
    (Sample { a, b }, tangent)
}

/// Filters on the manifold are those of the reduced map, and their corrections stay on the manifold.
#[test]
fn on_the_manifold_a_filter_corrects_along_it() {
    let (sample, tangent) = constrained();
    let basis = tangent.basis();
    let c = noise(2, 6, 7.0);
    let process = DMatrix::identity(6, 6) * 0.3;
    let input = Some(DMatrix::identity(1, 1));
    let measurement = DMatrix::identity(2, 2);
    let full_noise =
        NoiseCovariances::new(Some(process.clone()), input.clone(), measurement.clone()).unwrap();
    let found =
        steady_state_kalman_on_manifold(&sample.a, &sample.b, &c, &tangent, &full_noise).unwrap();

    let size = tangent.dimension();
    let reduced_noise =
        NoiseCovariances::new(Some(DMatrix::identity(size, size) * 0.3), input, measurement)
            .unwrap();
    let (a, b) = (tangent.restrict_map(&sample.a), tangent.reduce(&sample.b));
    let reduced = steady_state_kalman(&a, &b, &(&c * basis), &reduced_noise).unwrap();
    assert!(relative_error(&found.gain, &(basis * &reduced.gain)) < 1e-12);
    let expected = basis * &reduced.filtered * basis.transpose();
    assert!(relative_error(&found.filtered, &expected) < 1e-12);
    assert_eq!(found.error_modes.len(), size);
    let constraint = DMatrix::from_row_slice(1, 6, &[1.0, 1.0, -1.0, 0.0, 0.0, 0.0]);
    assert!((constraint * &found.gain).amax() < 1e-14 * found.gain.amax());

    let long = time_varying_kalman_on_manifold(
        &vec![sample; 200],
        &[c],
        &vec![tangent; 201],
        &[full_noise],
        &process,
        Values::Keep,
    )
    .unwrap();
    assert!(relative_error(&long.gains[200], &found.gain) < 1e-11);
    let (predicted, _) = long.covariances.unwrap().pop().unwrap();
    assert!(relative_error(&predicted, &found.predicted) < 1e-11);
}
