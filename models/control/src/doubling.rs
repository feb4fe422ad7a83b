//! Doubling: iterations that cover 2, 4, 8, ... steps at once.

use nalgebra::DMatrix;

use crate::matrix::{all_finite, congruent, symmetrize};

/// More than enough for every closed loop that double precision tells from the unit circle.
const DOUBLINGS_MAX: u32 = 50;
/// Relative change at which the solution stands still.
const CHANGE_CONVERGED: f64 = 1e-14;
/// Relative change below which growing again means that round-off rules.
const CHANGE_STAGNATING: f64 = 1e-10;

/// Structure-preserving doubling for `P = Q + AᵀP (I + G P)⁻¹ A` with `G = B R⁻¹ Bᵀ`
/// (Chu, Fan, Lin, Wang 2004). `A` may be singular. About `15n³` flops per doubling.
///
/// Gives the fixed point, symmetric, which still has to pass the caller's checks, and the number of
/// doublings; fails, with the number of doublings, when it overflows or does not come to rest.
pub(super) fn riccati(
    a: &DMatrix<f64>,
    g: &DMatrix<f64>,
    q: &DMatrix<f64>,
) -> Result<(DMatrix<f64>, u32), u32> {
    let (mut a, mut g, mut h) = (a.clone(), g.clone(), q.clone());
    let mut last_change = f64::INFINITY;
    for iterations in 1..=DOUBLINGS_MAX {
        let mut w = &g * &h;
        for i in 0..w.nrows() {
            w[(i, i)] += 1.0;
        }
        let lu = w.lu();
        let (Some(w_a), Some(w_g)) = (lu.solve(&a), lu.solve(&g)) else {
            return Err(iterations);
        };
        let a_t = a.transpose();
        let mut increase = &a_t * (&h * &w_a);
        symmetrize(&mut increase);
        g += &a * (w_g * &a_t);
        symmetrize(&mut g);
        h += &increase;
        a *= w_a;
        let change = increase.norm() / h.norm().max(f64::MIN_POSITIVE);
        if !change.is_finite() || !all_finite(&a) || !all_finite(&g) {
            return Err(iterations);
        }
        let stagnating = change < CHANGE_STAGNATING && change >= last_change;
        if change < CHANGE_CONVERGED || stagnating {
            return Ok((h, iterations));
        }
        last_change = change;
    }
    Err(DOUBLINGS_MAX)
}

/// Solves `X = FᵀX F + C` for a stable `F` by doubling (Smith 1968); about `6n³` flops per doubling.
pub(super) fn lyapunov(f: &DMatrix<f64>, c: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let (mut f, mut x) = (f.clone(), c.clone());
    for _ in 0..DOUBLINGS_MAX {
        let increase = congruent(&f, &x);
        x += &increase;
        if !all_finite(&x) {
            return None;
        }
        if increase.norm() <= f64::EPSILON * x.norm() {
            return Some(x);
        }
        f = &f * &f;
    }
    None
}
