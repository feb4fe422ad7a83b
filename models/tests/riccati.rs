//! Regulators against independent solutions (`tests/oracles/riccati.py`: mpmath, scipy,
//! python-control) and against what defines them.

use nalgebra::{DMatrix, DVector};
use plantd_models::control::{
    Regulator, RiccatiError, Sample, Tangent, Values, Weights, finite_horizon,
    finite_horizon_on_manifold, infinite_horizon, infinite_horizon_on_manifold, spectral_radius,
};
use serde_json::Value;

fn oracle() -> Value {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/oracles/riccati.json");
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone()).unwrap();
    DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j])
}

fn vector(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

fn relative_error(actual: &DMatrix<f64>, expected: &DMatrix<f64>) -> f64 {
    (actual - expected).norm() / expected.norm()
}

/// Deterministic numbers in (-1, 1) that follow no pattern.
fn noise(rows: usize, cols: usize, seed: f64) -> DMatrix<f64> {
    DMatrix::from_fn(rows, cols, |i, j| {
        let x = (12.9898 * i as f64 + 78.233 * j as f64 + seed).sin() * 43758.5453;
        2.0 * (x - x.floor()) - 1.0
    })
}

fn system(n: usize, m: usize, radius: f64, seed: f64) -> Sample {
    let a = noise(n, n, seed);
    let scale = radius / spectral_radius(&a).unwrap();
    Sample { a: a * scale, b: noise(n, m, seed + 0.5) }
}

#[test]
fn infinite_horizon_agrees_with_independent_solutions() {
    for case in oracle()["infinite"].as_array().unwrap() {
        let name = case["name"].as_str().unwrap();
        let (a, b) = (matrix(&case["a"]), matrix(&case["b"]));
        let weights = Weights::diagonal(&vector(&case["q"]), &vector(&case["r"])).unwrap();
        let regulator =
            infinite_horizon(&a, &b, &weights).unwrap_or_else(|e| panic!("{name}: {e}"));
        let gain_error = relative_error(&regulator.gain, &matrix(&case["k"]));
        let norm_error = regulator.value.norm() / case["value_norm"].as_f64().unwrap() - 1.0;
        let trace_error = regulator.value.trace() / case["value_trace"].as_f64().unwrap() - 1.0;
        let radius_error = regulator.spectral_radius - case["spectral_radius"].as_f64().unwrap();
        println!(
            "{name}: gain {gain_error:.1e}, value {norm_error:.1e} {trace_error:.1e}, radius \
             {radius_error:.1e}, residual {:.1e}, {} doublings",
            regulator.residual, regulator.iterations
        );
        let tolerance = 1e-10;
        assert!(gain_error < tolerance, "{name}: gain is off by {gain_error:e}");
        assert!(norm_error.abs() < tolerance, "{name}: value is off by {norm_error:e}");
        assert!(trace_error.abs() < tolerance, "{name}: value is off by {trace_error:e}");
        assert!(radius_error.abs() < 1e-9, "{name}: radius is off by {radius_error:e}");
        assert!(regulator.residual < 1e-10, "{name}: residual {:e}", regulator.residual);
    }
}

#[test]
fn finite_horizon_agrees_with_sixty_digits() {
    for case in oracle()["finite"].as_array().unwrap() {
        let name = case["name"].as_str().unwrap();
        let pairs = case["a"].as_array().unwrap().iter().zip(case["b"].as_array().unwrap());
        let samples: Vec<_> = pairs.map(|(a, b)| Sample { a: matrix(a), b: matrix(b) }).collect();
        let weight = |key: &str| matrix(&case[key]);
        let weights = Weights::new(weight("q"), weight("r"), Some(weight("q_final"))).unwrap();
        let solution = finite_horizon(&samples, &weights.into(), Values::Drop).unwrap();
        let mut worst: f64 = 0.0;
        for (gain, expected) in solution.gains.iter().zip(case["gains"].as_array().unwrap()) {
            worst = worst.max(relative_error(gain, &matrix(expected)));
        }
        let value_error = relative_error(&solution.value, &matrix(&case["value"]));
        println!("{name}: gains {worst:.1e}, value {value_error:.1e}");
        assert_eq!(solution.gains.len(), samples.len());
        assert!(worst < 1e-11, "{name}: gains are off by {worst:e}");
        assert!(value_error < 1e-11, "{name}: value is off by {value_error:e}");
    }
}

/// `½ dxᵀ P dx` is what the closed loop costs, summed step by step.
#[test]
fn the_value_is_the_cost_of_the_closed_loop() {
    let weights = Weights::new(
        DMatrix::identity(7, 7),
        DMatrix::identity(2, 2),
        Some(DMatrix::identity(7, 7) * 5.0),
    )
    .unwrap();
    let samples: Vec<_> = (0..40).map(|k| system(7, 2, 1.1, f64::from(k))).collect();
    let solution = finite_horizon(&samples, &weights.into(), Values::Drop).unwrap();
    let start = DVector::from_fn(7, |i, _| 1.0 + i as f64);
    let cost_of = |gains: &[DMatrix<f64>]| {
        let (mut x, mut cost) = (start.clone(), 0.0);
        for (sample, gain) in samples.iter().zip(gains) {
            let u = -(gain * &x);
            cost += 0.5 * (x.norm_squared() + u.norm_squared());
            x = &sample.a * x + &sample.b * u;
        }
        cost + 2.5 * x.norm_squared()
    };
    let value = 0.5 * start.dot(&(&solution.value * &start));
    assert!((cost_of(&solution.gains) / value - 1.0).abs() < 1e-12);

    let mut worse = solution.gains.clone();
    worse[20][(1, 3)] += 1e-3;
    assert!(cost_of(&worse) > value);
}

#[test]
fn the_value_is_symmetric_positive_semidefinite() {
    // A state weight of rank one and cheap control bring the value close to losing rank.
    let q = DMatrix::from_fn(20, 20, |i, j| if i == 3 && j == 3 { 1.0 } else { 0.0 });
    let weights = Weights::new(q, DMatrix::identity(3, 3) * 1e-9, None).unwrap();
    let samples: Vec<_> = (0..200).map(|k| system(20, 3, 1.0, f64::from(k % 7))).collect();
    let value = finite_horizon(&samples, &weights.into(), Values::Drop).unwrap().value;
    assert_eq!(value, value.transpose());
    let eigenvalues = value.symmetric_eigenvalues();
    assert!(eigenvalues.min() > -1e-13 * eigenvalues.max());
}

#[test]
fn a_long_horizon_ends_in_the_infinite_one() {
    let sample = system(9, 2, 1.15, 4.0);
    let weights = Weights::diagonal(&[1.0; 9], &[1.0; 2]).unwrap();
    let long =
        finite_horizon(&vec![sample.clone(); 400], &(&weights).into(), Values::Drop).unwrap();
    let regulator = infinite_horizon(&sample.a, &sample.b, &weights).unwrap();
    assert!(relative_error(&long.gains[0], &regulator.gain) < 1e-12);
    assert!(relative_error(&long.value, &regulator.value) < 1e-12);
}

fn solve(a: &[f64], b: &[f64], q: &[f64]) -> Result<Regulator, RiccatiError> {
    let (n, m) = (q.len(), b.len() / q.len());
    let weights = Weights::diagonal(q, &vec![1.0; m]).unwrap();
    infinite_horizon(&DMatrix::from_row_slice(n, n, a), &DMatrix::from_row_slice(n, m, b), &weights)
}

#[test]
fn an_unstable_mode_out_of_reach_is_named() {
    let error = solve(&[1.2, 0.0, 0.0, 0.9], &[0.0, 1.0], &[1.0, 1.0]).unwrap_err();
    let RiccatiError::NotStabilisable { real, imaginary, modulus } = error else {
        panic!("{error:?}");
    };
    assert!((real - 1.2).abs() < 1e-12 && imaginary == 0.0 && (modulus - 1.2).abs() < 1e-12);
}

#[test]
fn a_mode_on_the_unit_circle_out_of_reach_is_named() {
    let error = solve(&[1.0, 0.0, 0.0, 0.9], &[0.0, 1.0], &[1.0, 1.0]).unwrap_err();
    assert!(matches!(error, RiccatiError::NotStabilisable { modulus, .. } if modulus == 1.0));
    // A rotation that nothing damps.
    let (c, s) = (0.8, 0.6);
    let rotation = [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 0.5];
    let error = solve(&rotation, &[0.0, 0.0, 1.0], &[1.0; 3]).unwrap_err();
    let RiccatiError::NotStabilisable { real, imaginary, .. } = error else {
        panic!("{error:?}");
    };
    assert!((real - c).abs() < 1e-12 && (imaginary - s).abs() < 1e-12);
    // Without inputs there is nothing to stabilise with.
    let error = solve(&[1.5], &[], &[1.0]).unwrap_err();
    assert!(matches!(error, RiccatiError::NotStabilisable { .. }), "{error:?}");
}

#[test]
fn an_uncontrollable_mode_that_decays_does_no_harm() {
    let regulator = solve(&[1.2, 0.0, 0.0, 0.9], &[1.0, 0.0], &[1.0, 1.0]).unwrap();
    assert!((regulator.spectral_radius - 0.9).abs() < 1e-12);
}

#[test]
fn an_unstable_mode_that_costs_nothing_is_stabilised_all_the_same() {
    // Of the two solutions, P = 0 leaves the mode alone; the other mirrors it into the circle.
    let regulator = solve(&[1.5, 0.0, 0.0, 0.9], &[1.0, 0.0, 0.0, 1.0], &[0.0, 1.0]).unwrap();
    assert!((regulator.value[(0, 0)] - 1.25).abs() < 1e-9, "{}", regulator.value);
    assert!((regulator.spectral_radius - 1.0 / 1.5).abs() < 1e-9);
}

#[test]
fn a_mode_on_the_unit_circle_that_costs_nothing_is_named() {
    // An integrator that nothing pays for: the best gain would leave it on the circle.
    let error = solve(&[1.0, 0.0, 0.0, 0.9], &[1.0, 0.0, 0.0, 1.0], &[0.0, 1.0]).unwrap_err();
    assert!(
        matches!(error, RiccatiError::NotDetectable { real: 1.0, imaginary: 0.0 }),
        "{error:?}"
    );
}

#[test]
fn no_weights_at_all() {
    let regulator = solve(&[0.5], &[1.0], &[0.0]).unwrap();
    assert_eq!((regulator.gain[(0, 0)], regulator.value[(0, 0)]), (0.0, 0.0));
}

#[test]
fn wrong_shapes_and_numbers_are_refused() {
    let weights = Weights::diagonal(&[1.0; 2], &[1.0]).unwrap();
    let (a, b) = (DMatrix::identity(2, 2), DMatrix::zeros(2, 2));
    let dimension = RiccatiError::Dimension {
        matrix: "B",
        sample: 0,
        rows: 2,
        cols: 2,
        expected_rows: 2,
        expected_cols: 1,
    };
    assert_eq!(infinite_horizon(&a, &b, &weights).unwrap_err(), dimension);
    let bad = Sample { a: a.clone() * f64::NAN, b: DMatrix::zeros(2, 1) };
    let good = Sample { a, b: DMatrix::zeros(2, 1) };
    assert_eq!(
        finite_horizon(&[good.clone(), bad, good.clone()], &(&weights).into(), Values::Drop)
            .unwrap_err(),
        RiccatiError::NotFinite { matrix: "A", sample: 1 }
    );
    assert_eq!(
        finite_horizon_on_manifold(
            std::slice::from_ref(&good),
            &[],
            &(&weights).into(),
            Values::Drop
        )
        .unwrap_err(),
        RiccatiError::TangentCount { samples: 1, actual: 0 }
    );
    let explosive = Sample { a: DMatrix::identity(2, 2) * 1e120, b: DMatrix::zeros(2, 1) };
    let error =
        finite_horizon(&[good, explosive.clone(), explosive], &weights.into(), Values::Drop)
            .unwrap_err();
    assert_eq!(error, RiccatiError::Overflow { sample: 1 });
}

/// A system with a gauge and directions off the manifold: what a constrained plant looks like.
/// One dynamic pair (q1, q2) tied by q1 + q2 = q_k, one prescribed coordinate q_k.
fn constrained() -> (Sample, Tangent) {
    let tangent = Tangent::new(&DMatrix::from_row_slice(1, 3, &[1.0, 1.0, -1.0]), 2);
    let reduced = system(tangent.dimension(), 1, 1.2, 2.0);
    let basis = tangent.basis();
    let gauge = DMatrix::from_column_slice(6, 1, &[0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    // Stays on the manifold but picks up gauge momentum, and forgets what it had.
    let pickup = &gauge * noise(1, tangent.dimension(), 9.0) * basis.transpose();
    let a = basis * &reduced.a * basis.transpose() + pickup;
    let b = basis * &reduced.b + &gauge * noise(1, 1, 3.0);
    (Sample { a, b }, tangent)
}

#[test]
fn on_the_manifold_the_gain_is_blind_to_gauge_and_equals_the_full_one() {
    let (sample, tangent) = constrained();
    let basis = tangent.basis();
    // The same cost on the tangent space, none elsewhere: the full problem must agree.
    let restricted =
        Weights::new(basis * basis.transpose(), DMatrix::identity(1, 1), None).unwrap();
    let on_manifold =
        infinite_horizon_on_manifold(&sample.a, &sample.b, &tangent, &restricted).unwrap();
    let full = infinite_horizon(&sample.a, &sample.b, &restricted).unwrap();
    assert!(relative_error(&on_manifold.gain, &full.gain) < 1e-11);
    assert!(relative_error(&on_manifold.value, &full.value) < 1e-11);
    let gauge = DVector::from_column_slice(&[0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    assert!((&on_manifold.gain * gauge).amax() < 1e-13 * on_manifold.gain.amax());

    let samples = vec![sample; 200];
    let tangents = vec![tangent; 201];
    let long =
        finite_horizon_on_manifold(&samples, &tangents, &restricted.into(), Values::Drop).unwrap();
    assert!(relative_error(&long.gains[0], &on_manifold.gain) < 1e-11);
    assert!(relative_error(&long.value, &on_manifold.value) < 1e-11);
}
