use nalgebra::{DMatrix, DVector};
use plantd_math::sparse_map::Map;

use crate::lq::recursion::LqRecursion;
use crate::lq::stage::{NotConvex, Stage};

/// Numbers in (-1, 1) that follow no pattern.
fn noise(rows: usize, cols: usize, seed: f64) -> DMatrix<f64> {
    DMatrix::from_fn(rows, cols, |i, j| {
        let x = (12.9898 * i as f64 + 78.233 * j as f64 + seed).sin() * 43758.5453;
        2.0 * (x - x.floor()) - 1.0
    })
}

/// The map of a system with prescribed coordinates: rows of a single entry, rows of two, columns
/// of zeros.
fn prescribed(dynamic: usize, prescribed: usize, seed: f64) -> (DMatrix<f64>, DMatrix<f64>) {
    let (nd, nk) = (dynamic, prescribed);
    let n = 2 * (nd + nk);
    let mut a = noise(n, n, seed) * 0.2;
    let mut b = noise(n, nk, seed + 0.5);
    a.columns_mut(2 * nd + nk, nk).fill(0.0);
    for i in 0..nk {
        let (position, velocity) = (nd + i, 2 * nd + nk + i);
        for row in [position, velocity] {
            a.row_mut(row).fill(0.0);
            b.row_mut(row).fill(0.0);
        }
        b[(position, i)] = 1.0;
        b[(velocity, i)] = 10.0;
        a[(velocity, position)] = -10.0;
    }
    (a, b)
}

fn map(a: &DMatrix<f64>, b: &DMatrix<f64>) -> Map {
    let mut map = Map::default();
    map.set(a, b);
    map
}

fn error(found: &DMatrix<f64>, expected: &DMatrix<f64>) -> f64 {
    if expected.is_empty() {
        return 0.0;
    }
    (found - expected).amax() / expected.amax().max(1e-300)
}

/// The recursion against its formulas, step by step, with a weight that is not definite and a map
/// whose structure changes from step to step.
#[test]
fn fast_steps_follow_the_formulas() {
    let plain =
        |n: usize, m: usize| (noise(n, n, 1.0) * (1.0 / (n as f64).sqrt()), noise(n, m, 2.0));
    let maps = [
        vec![plain(1, 1)],
        vec![plain(2, 1)],
        vec![plain(4, 1)],
        vec![plain(5, 3), plain(5, 3)],
        vec![plain(8, 8)],
        vec![plain(9, 2), (DMatrix::zeros(9, 9), noise(9, 2, 1.0))],
        vec![plain(40, 20), (DMatrix::identity(40, 40), noise(40, 20, 1.0))],
        vec![plain(12, 0)],
        vec![plain(3, 0)],
        vec![plain(10, 12)],
        vec![prescribed(5, 4, 1.0), plain(18, 4), prescribed(5, 4, 2.0)],
        vec![prescribed(22, 18, 1.0), prescribed(22, 18, 2.0)],
    ];
    for maps in maps {
        let (n, m) = maps[0].1.shape();
        let mut recursion = LqRecursion::new(n, m);
        let start = noise(n, n, 3.0);
        let (mut p, mut linear) = (&start * start.transpose(), DVector::zeros(n));
        recursion.begin(&p, None);
        let (mut gain, mut offset) = (DMatrix::zeros(m, n), DVector::zeros(m));
        for (k, (a, b)) in maps.iter().cycle().take(6).enumerate() {
            let q = noise(n, n, 4.0);
            let q = &q * q.transpose() / n as f64 - DMatrix::identity(n, n) * 0.01;
            let r = DMatrix::identity(m, m) * 500.0;
            let s = noise(n, m, 5.0);
            let x_linear = noise(n, 1, 6.0).column(0).into_owned();
            let u_linear = noise(m, 1, 7.0).column(0).into_owned();
            let has_more = k % 2 == 1;
            let stage = Stage {
                q: &q,
                r: &r,
                s: has_more.then_some(&s),
                x_linear: has_more.then_some(&x_linear),
                u_linear: has_more.then_some(&u_linear),
            };
            recursion.step(&map(a, b), stage, &mut gain, &mut offset).unwrap();
            let more = if has_more { 1.0 } else { 0.0 };
            let bracket = b.transpose() * &p * b + &r;
            let cross = b.transpose() * &p * a + s.transpose() * more;
            let input = b.transpose() * &linear + &u_linear * more;
            let inverse = bracket.clone().try_inverse().unwrap();
            let (expected_gain, expected_offset) = (&inverse * &cross, &inverse * input);
            linear =
                a.transpose() * &linear + &x_linear * more - cross.transpose() * &expected_offset;
            p = &q + a.transpose() * &p * a - cross.transpose() * &expected_gain;
            let name = format!("{n} states, {m} inputs, step {k}");
            let off = error(&gain, &expected_gain);
            assert!(off < 1e-11, "{name}: {off:e}");
            assert!(error(&recursion.value(), &p) < 1e-11, "{name}");
            assert_eq!(recursion.value(), recursion.value().transpose(), "{name}");
            let vector = |v: &DVector<f64>| DMatrix::from_column_slice(v.len(), 1, v.as_slice());
            assert!(error(&vector(&offset), &vector(&expected_offset)) < 1e-10, "{name}");
            assert!(error(&vector(recursion.linear()), &vector(&linear)) < 1e-10, "{name}");
            let norm = |m: &DMatrix<f64>| m.column_iter().map(|c| c.lp_norm(1)).fold(0.0, f64::max);
            let condition = 1.0 / (norm(&bracket) * norm(&inverse)).max(1.0);
            assert!((recursion.reciprocal_condition() / condition - 1.0).abs() < 1e-10, "{name}");
        }
    }
}

#[test]
fn a_stage_without_a_minimum_leaves_the_cost_to_go() {
    for n in [2, 12] {
        let (a, b) = (noise(n, n, 1.0), noise(n, 1, 2.0));
        let (q, r) = (DMatrix::identity(n, n), -DMatrix::identity(1, 1) * 1e3);
        let stage = Stage { q: &q, r: &r, s: None, x_linear: None, u_linear: None };
        let mut recursion = LqRecursion::new(n, 1);
        let linear = DVector::from_element(n, 1.0);
        recursion.begin(&q, Some(&linear));
        let (mut gain, mut offset) = (DMatrix::zeros(1, n), DVector::zeros(1));
        assert_eq!(recursion.step(&map(&a, &b), stage, &mut gain, &mut offset), Err(NotConvex));
        assert_eq!((&recursion.value(), recursion.linear()), (&q, &linear));
        let nan = Stage { r: &(&r * f64::NAN), ..stage };
        assert_eq!(recursion.step(&map(&a, &b), nan, &mut gain, &mut offset), Err(NotConvex));
    }
}

#[test]
fn a_map_may_lead_from_one_number_of_states_to_another() {
    for (next, n) in [(2, 3), (12, 14), (14, 12), (3, 12)] {
        let (a, b, p) = (noise(next, n, 1.0), noise(next, 2, 2.0), DMatrix::identity(next, next));
        let (q, r) = (DMatrix::identity(n, n), DMatrix::identity(2, 2));
        let stage = Stage { q: &q, r: &r, s: None, x_linear: None, u_linear: None };
        let mut recursion = LqRecursion::new(next, 2);
        recursion.begin(&p, None);
        let (mut gain, mut offset) = (DMatrix::zeros(2, n), DVector::zeros(2));
        recursion.step(&map(&a, &b), stage, &mut gain, &mut offset).unwrap();
        let bracket = b.transpose() * &b + r;
        let expected = bracket.try_inverse().unwrap() * b.transpose() * &a;
        assert!(error(&gain, &expected) < 1e-12);
        let value = &q + a.transpose() * &a - a.transpose() * &b * expected;
        assert!(error(&recursion.value(), &value) < 1e-12);
        assert_eq!(recursion.linear().len(), n);
    }
}

/// With cheap control almost all of `Q + AᵀPA` cancels: the state is put where it costs nothing.
#[test]
fn what_cancels_keeps_its_digits() {
    for n in [2, 12] {
        let a = noise(n, n, 1.0) * 1e6;
        let b = DMatrix::identity(n, n);
        let (q, r) = (DMatrix::identity(n, n), DMatrix::identity(n, n) * 1e-12);
        let stage = Stage { q: &q, r: &r, s: None, x_linear: None, u_linear: None };
        let mut recursion = LqRecursion::new(n, n);
        recursion.begin(&q, None);
        let (mut gain, mut offset) = (DMatrix::zeros(n, n), DVector::zeros(n));
        recursion.step(&map(&a, &b), stage, &mut gain, &mut offset).unwrap();
        // P = Q + Aᵀ (I − (1 + r)⁻¹) A = Q + Aᵀ A r / (1 + r).
        let expected = &q + a.transpose() * &a * (1e-12 / (1.0 + 1e-12));
        let off = error(&recursion.value(), &expected);
        assert!(off < 1e-9, "{n} states: off by {off:e}");
    }
}
