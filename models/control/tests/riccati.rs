//! Regulators against independent solutions (`tests/oracles/riccati.py`: mpmath, scipy,
//! python-control) and against what defines them.

use crate::oracle::{matrix, oracle, relative_error};
use nalgebra::{DMatrix, DVector};
use plantd_control::{
    Regulator, RiccatiError, Sample, StageWeights, Tangent, TrajectoryWeights, Values, Weights,
    finite_horizon, finite_horizon_on_manifold, infinite_horizon, infinite_horizon_on_manifold,
    spectral_radius,
};
use serde_json::Value;

fn vector(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
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
    for case in oracle("riccati.json")["infinite"].as_array().unwrap() {
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
    for case in oracle("riccati.json")["finite"].as_array().unwrap() {
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

/// The recipe of `tests/oracles/riccati.py`: numbers in (-1, 1) of 32 bits from a linear congruence.
struct Recipe(u64);

impl Recipe {
    fn matrix(&mut self, rows: usize, cols: usize) -> DMatrix<f64> {
        let mut out = DMatrix::zeros(rows, cols);
        for (i, j) in (0..rows).flat_map(|i| (0..cols).map(move |j| (i, j))) {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            out[(i, j)] = ((self.0 >> 32) as f64 + 0.5) / 2f64.powi(31) - 1.0;
        }
        out
    }
}

/// A large or badly scaled problem: every entry by the same operations as in the oracle.
struct Large {
    a: DMatrix<f64>,
    b: DMatrix<f64>,
    weights: Weights,
    probes: DMatrix<f64>,
    units: Vec<f64>,
}

fn large(spec: &Value) -> Large {
    let size = |key: &str| spec[key].as_u64().unwrap() as usize;
    let number = |key: &str| spec[key].as_f64().unwrap();
    let (n, m, scale) = (size("n"), size("m"), number("scale"));
    let mut recipe = Recipe(spec["seed"].as_u64().unwrap());
    let mut a = recipe.matrix(n, n) * scale;
    let mut b = recipe.matrix(n, m);
    let units = vector(&spec["units"]);
    match spec["kind"].as_str().unwrap() {
        "plain" => {}
        "singular" => a.columns_mut(0, n / 2).fill(0.0),
        "chain" => {
            let beside = |i: usize, j: usize| if j == i + 1 { scale } else { 0.0 };
            a = DMatrix::from_fn(n, n, |i, j| if i == j { 1.0 } else { beside(i, j) });
            b = DMatrix::from_fn(n, m, |i, j| if i + j + 1 == n { scale } else { 0.0 });
        }
        "triangular" => {
            a.fill_lower_triangle(0.0, 0);
            for i in 0..n {
                a[(i, i)] = 1.0 - i as f64 / n as f64;
            }
        }
        "out-of-reach" => {
            let reached = n - n / 3;
            a.rows_mut(reached, n - reached).fill(0.0);
            b.rows_mut(reached, n - reached).fill(0.0);
            for i in 0..n - reached {
                a[(reached + i, reached + i)] = 0.9 - 0.5 * i as f64 / n as f64;
            }
        }
        other => panic!("no such kind: {other}"),
    }
    let a = DMatrix::from_fn(n, n, |i, j| units[i] * a[(i, j)] / units[j]);
    let b = DMatrix::from_fn(n, m, |i, j| units[i] * b[(i, j)]);
    let weight = |u: f64| if spec["weights"] == "units" { 1.0 / (u * u) } else { 1.0 };
    let q: Vec<f64> = units.iter().map(|&u| weight(u)).collect();
    let mut weights = Weights::diagonal(&q, &vec![number("r"); m]).unwrap();
    let s = recipe.matrix(n, m);
    if number("cross") != 0.0 {
        let s = DMatrix::from_fn(n, m, |i, j| number("cross") * (s[(i, j)] / units[i]));
        weights = weights.with_cross(s).unwrap();
    }
    let probes = recipe.matrix(n, 2);
    let probes = DMatrix::from_fn(n, 2, |i, j| units[i] * probes[(i, j)]);
    Large { a, b, weights, probes, units }
}

/// Up to 100 states, units over 20 decades, cheap and dear control, singular maps, chains of
/// integrators, states out of reach, cross terms.
#[test]
fn large_and_badly_scaled_regulators_agree_with_independent_solutions() {
    let oracle = oracle("riccati.json");
    let cases = oracle["large"].as_array().unwrap();
    assert!(cases.len() > 30);
    for case in cases {
        let name = case["name"].as_str().unwrap();
        let Large { a, b, weights, probes, units } = large(case);
        let regulator =
            infinite_horizon(&a, &b, &weights).unwrap_or_else(|e| panic!("{name}: {e}"));
        let gain_error =
            relative_error(&(&regulator.gain * &probes), &matrix(&case["gain_probes"]));
        let expected = DVector::from_vec(vector(&case["value_probe"]));
        let value = (&regulator.value * probes.column(0)).component_mul(&DVector::from_vec(units));
        let value_error = (value - &expected).norm() / expected.norm();
        let radius_error = regulator.spectral_radius - case["spectral_radius"].as_f64().unwrap();
        println!(
            "{name}: gain {gain_error:.1e}, value {value_error:.1e}, radius {radius_error:.1e}"
        );
        assert!(gain_error < 1e-8, "{name}: gain is off by {gain_error:e}");
        assert!(value_error < 1e-8, "{name}: value is off by {value_error:e}");
        assert!(radius_error.abs() < 1e-8, "{name}: radius is off by {radius_error:e}");
        assert_eq!(regulator.closed_loop.len(), a.nrows());
        assert_eq!(regulator.closed_loop[0].norm(), regulator.spectral_radius);
        assert!(regulator.reciprocal_condition > 0.0 && regulator.reciprocal_condition <= 1.0);
    }
}

/// Changes of states `x' = T x` with their inverses: none, a rotation, units over twelve decades,
/// both.
fn disguises(n: usize) -> [(&'static str, DMatrix<f64>, DMatrix<f64>); 4] {
    let rotation = Recipe(5).matrix(n, n).qr().q();
    let units = |sign: i32| {
        let exponents = (0..n as i32).map(|i| sign * ((7 * i) % 13 - 6));
        DMatrix::from_diagonal(&DVector::from_iterator(n, exponents.map(|e| 10f64.powi(e))))
    };
    let identity = DMatrix::identity(n, n);
    [
        ("as it is", identity.clone(), identity),
        ("rotated", rotation.clone(), rotation.transpose()),
        ("scaled", units(1), units(-1)),
        ("rotated and scaled", units(1) * &rotation, rotation.transpose() * units(-1)),
    ]
}

/// Puts a mode, or a rotation by atan(3/4), into the first one or two states of a map.
fn with_modes(mut a: DMatrix<f64>, mode: Option<f64>) -> DMatrix<f64> {
    match mode {
        Some(mode) => a[(0, 0)] = mode,
        None => a.view_mut((0, 0), (2, 2)).copy_from_slice(&[0.8, 0.6, -0.6, 0.8]),
    }
    a
}

#[test]
fn modes_out_of_reach_are_named_however_they_hide() {
    for n in [3_usize, 6, 20, 60] {
        for mode in [Some(1.0), Some(-1.0), Some(1.0001), Some(1.3), Some(3.0), None] {
            let (hidden, m) = (if mode.is_some() { 1 } else { 2 }, 1 + n / 10);
            let mut a = Recipe(n as u64).matrix(n, n) * (1.2 / (n as f64 / 3.0).sqrt());
            let mut b = Recipe(n as u64 + 7).matrix(n, m);
            a.rows_mut(0, hidden).fill(0.0);
            b.rows_mut(0, hidden).fill(0.0);
            let a = with_modes(a, mode);
            for (disguise, to, from) in disguises(n) {
                let (a, b) = (&to * &a * &from, &to * &b);
                let natural = from.transpose() * &from;
                let natural = (&natural + natural.transpose()) * 0.5;
                for q in [DMatrix::identity(n, n), natural] {
                    let weights = Weights::new(q, DMatrix::identity(m, m), None).unwrap();
                    let error = infinite_horizon(&a, &b, &weights).unwrap_err();
                    let RiccatiError::NotStabilisable { real, imaginary, .. } = error else {
                        panic!("{n} states, {mode:?}, {disguise}: {error}");
                    };
                    let (re, im) = mode.map_or((0.8, 0.6), |mode| (mode, 0.0));
                    let distance = (real - re).hypot(imaginary.abs() - im);
                    assert!(distance < 1e-6, "{n} states, {mode:?}, {disguise}: {error}");
                }
            }
        }
    }
}

#[test]
fn modes_on_the_unit_circle_that_cost_nothing_are_named_however_they_hide() {
    for n in [3_usize, 6, 20, 60] {
        for mode in [Some(1.0), Some(-1.0), None] {
            let (hidden, m) = (if mode.is_some() { 1 } else { 2 }, 1 + n / 10);
            let mut a = Recipe(n as u64).matrix(n, n) * (1.2 / (n as f64 / 3.0).sqrt());
            let b = Recipe(n as u64 + 7).matrix(n, m);
            a.columns_mut(0, hidden).fill(0.0);
            let a = with_modes(a, mode);
            let mut q = DMatrix::identity(n, n);
            q.view_mut((0, 0), (hidden, hidden)).fill(0.0);
            for (disguise, to, from) in disguises(n) {
                let (a, b, q) = (&to * &a * &from, &to * &b, from.transpose() * &q * &from);
                let q = (&q + q.transpose()) * 0.5;
                let weights = Weights::new(q, DMatrix::identity(m, m), None).unwrap();
                let error = infinite_horizon(&a, &b, &weights).unwrap_err();
                let RiccatiError::NotDetectable { real, imaginary } = error else {
                    panic!("{n} states, {mode:?}, {disguise}: {error}");
                };
                let (re, im) = mode.map_or((0.8, 0.6), |mode| (mode, 0.0));
                let distance = (real - re).hypot(imaginary.abs() - im);
                assert!(distance < 1e-6, "{n} states, {mode:?}, {disguise}: {error}");
            }
        }
    }
}

/// The least cost and the inputs that reach it, from all inputs at once: a dense system of equations
/// in place of a recursion.
fn at_once(
    samples: &[Sample],
    weights: &TrajectoryWeights,
    start: &DVector<f64>,
) -> (f64, Vec<DVector<f64>>) {
    let (n, m, steps) = (weights.states(), weights.inputs(), samples.len());
    // x[k] = free[k] + reach[k] u.
    let (mut free, mut reach) = (start.clone(), DMatrix::zeros(n, m * steps));
    let mut hessian = DMatrix::zeros(m * steps, m * steps);
    let mut gradient = DVector::zeros(m * steps);
    let mut constant = 0.0;
    for (k, sample) in samples.iter().enumerate() {
        let stage = weights.stage(k);
        let mut pick = DMatrix::zeros(m, m * steps);
        pick.columns_mut(m * k, m).fill_with_identity();
        let zero = DMatrix::zeros(n, m);
        let s = stage.s().unwrap_or(&zero);
        let (no_x, no_u) = (DVector::zeros(n), DVector::zeros(m));
        let (x_linear, u_linear) =
            (stage.x_linear().unwrap_or(&no_x), stage.u_linear().unwrap_or(&no_u));
        let cross = reach.transpose() * s * &pick;
        hessian += reach.transpose() * stage.q() * &reach
            + &cross
            + cross.transpose()
            + pick.transpose() * stage.r() * &pick;
        gradient += reach.transpose() * (stage.q() * &free + x_linear)
            + pick.transpose() * (s.transpose() * &free + u_linear);
        constant += 0.5 * free.dot(&(stage.q() * &free)) + x_linear.dot(&free);
        free = &sample.a * &free;
        reach = &sample.a * &reach + &sample.b * &pick;
    }
    hessian += reach.transpose() * weights.q_final() * &reach;
    gradient += reach.transpose() * (weights.q_final() * &free);
    constant += 0.5 * free.dot(&(weights.q_final() * &free));
    let u = -hessian.lu().solve(&gradient).unwrap();
    let cost = constant + 0.5 * gradient.dot(&u);
    (cost, (0..steps).map(|k| u.rows(m * k, m).into_owned()).collect())
}

/// Cross terms, linear terms and weights of each step, small and large, with the rows and columns of
/// prescribed coordinates, convex step by step or only as a whole.
#[test]
fn a_recursion_finds_what_all_inputs_at_once_find() {
    for (n, m, is_convex) in
        [(2, 1, true), (5, 2, true), (5, 2, false), (14, 4, true), (14, 4, false)]
    {
        let mut recipe = Recipe(n as u64);
        let steps = 7;
        let samples: Vec<_> = (0..steps)
            .map(|_| {
                let mut a = recipe.matrix(n, n) * 0.7;
                let mut b = recipe.matrix(n, m);
                if n > 10 {
                    // Two prescribed coordinates and their velocities.
                    a.columns_mut(n - 2, 2).fill(0.0);
                    for i in 0..2 {
                        a.row_mut(5 + i).fill(0.0);
                        b.row_mut(5 + i).fill(0.0);
                        b[(5 + i, i)] = 1.0;
                        a.row_mut(n - 2 + i).fill(0.0);
                        b.row_mut(n - 2 + i).fill(0.0);
                        b[(n - 2 + i, i)] = 10.0;
                        a[(n - 2 + i, 5 + i)] = -10.0;
                    }
                }
                Sample { a, b }
            })
            .collect();
        let stages = (0..steps)
            .map(|k| {
                let root = recipe.matrix(n, n);
                let mut q = &root * root.transpose();
                if !is_convex {
                    q -= DMatrix::identity(n, n) * 0.3;
                }
                let r = DMatrix::identity(m, m) * (3.0 + k as f64);
                let s = Some(recipe.matrix(n, m) * if is_convex { 0.02 } else { 0.3 });
                let x_linear = Some(recipe.matrix(n, 1).column(0).into_owned());
                let u_linear = Some(recipe.matrix(m, 1).column(0).into_owned());
                StageWeights::symmetric(q, r, s, x_linear, u_linear).unwrap()
            })
            .collect();
        let weights = TrajectoryWeights::per_step(stages, DMatrix::identity(n, n) * 2.0).unwrap();
        let solution = finite_horizon(&samples, &weights, Values::Keep).unwrap();
        let values = solution.values.unwrap();
        assert_eq!(values.len(), steps + 1);
        assert_eq!(values[0].0, solution.value);
        assert_eq!(&values[steps].0, weights.q_final());
        let start = recipe.matrix(n, 1).column(0).into_owned();
        let (cost, inputs) = at_once(&samples, &weights, &start);
        let mut x = start.clone();
        for (k, sample) in samples.iter().enumerate() {
            let u = &solution.feedforward[k] - &solution.gains[k] * &x;
            let error = (&u - &inputs[k]).norm() / inputs[k].norm();
            assert!(error < 1e-9, "{n} states, step {k}: input is off by {error:e}");
            x = &sample.a * x + &sample.b * u;
        }
        // Costs to go lack a constant, which is that of the origin.
        let (cost_of_origin, _) = at_once(&samples, &weights, &DVector::zeros(n));
        let (p, linear) = &values[0];
        let expected = 0.5 * start.dot(&(p * &start)) + linear.dot(&start);
        let error = (cost - cost_of_origin - expected).abs() / expected.abs();
        assert!(error < 1e-9, "{n} states: value is off by {error:e}");
        for condition in solution.reciprocal_conditions {
            assert!(condition > 1e-3 && condition <= 1.0, "{condition}");
        }
    }
}

#[test]
fn problems_without_a_minimum_are_refused() {
    let sample = Sample { a: DMatrix::identity(2, 2), b: DMatrix::identity(2, 1) };
    let stage = |q: f64, r: f64| {
        let (q, r) = (DMatrix::identity(2, 2) * q, DMatrix::identity(1, 1) * r);
        StageWeights::symmetric(q, r, None, None, None).unwrap()
    };
    let stages = vec![stage(1.0, 1.0), stage(1.0, -4.0), stage(1.0, 1.0)];
    let weights = TrajectoryWeights::per_step(stages, DMatrix::identity(2, 2)).unwrap();
    assert_eq!(
        finite_horizon(&vec![sample.clone(); 3], &weights, Values::Drop).unwrap_err(),
        RiccatiError::NotConvex { sample: 1 }
    );
    assert_eq!(
        finite_horizon(&vec![sample; 2], &weights, Values::Drop).unwrap_err(),
        RiccatiError::StageCount { samples: 2, stages: 3 }
    );
}

/// On the manifold everything happens in the coordinates of the tangent space: the reduced problem,
/// solved by hand there, gives the same.
#[test]
fn on_the_manifold_cross_and_linear_terms_are_reduced_too() {
    let (sample, tangent) = constrained();
    let mut recipe = Recipe(3);
    let root = recipe.matrix(6, 6);
    let s = recipe.matrix(6, 1) * 0.05;
    let x_linear = recipe.matrix(6, 1).column(0).into_owned();
    let u_linear = recipe.matrix(1, 1).column(0).into_owned();
    let stage = StageWeights::new(
        &root * root.transpose() + DMatrix::identity(6, 6),
        DMatrix::identity(1, 1),
        Some(s),
        Some(x_linear),
        Some(u_linear),
    )
    .unwrap();
    let (samples, tangents) = (vec![sample.clone(); 5], vec![tangent.clone(); 6]);
    let weights = TrajectoryWeights::constant(stage.clone(), None).unwrap();
    let solution = finite_horizon_on_manifold(&samples, &tangents, &weights, Values::Keep).unwrap();

    let basis = tangent.basis();
    let reduced_stage = StageWeights::new(
        tangent.restrict_map(stage.q()),
        stage.r().clone(),
        stage.s().map(|s| tangent.reduce(s)),
        stage.x_linear().map(|x| basis.transpose() * x),
        stage.u_linear().cloned(),
    )
    .unwrap();
    let reduced = Sample { a: tangent.restrict_map(&sample.a), b: tangent.reduce(&sample.b) };
    let weights = TrajectoryWeights::constant(reduced_stage, None).unwrap();
    let start = recipe.matrix(tangent.dimension(), 1).column(0).into_owned();
    let (_, inputs) = at_once(&vec![reduced.clone(); 5], &weights, &start);
    let mut xi = start;
    for (k, expected) in inputs.iter().enumerate() {
        let u = &solution.feedforward[k] - &solution.gains[k] * (basis * &xi);
        assert!((&u - expected).norm() < 1e-10 * expected.norm(), "step {k}");
        xi = &reduced.a * xi + &reduced.b * u;
    }
    let (value, linear) = &solution.values.unwrap()[0];
    assert_eq!((value.shape(), linear.len()), ((6, 6), 6));
}
