//! The kernel for few states and inputs: plain loops over arrays.
//!
//! It writes the formulas of the other kernel anew, for speed alone. A stage took so many nanoseconds with plain
//! loops and in blocks:
//!
//! ```text
//! 2 states, 1 input: 84, 295    4, 1: 182, 350    6, 2: 594, 490    8, 2: 916, 764    8, 8: 2080, 1280
//! ```
//!
//! So it takes a tenth off an iteration of Newton's method with a pendulum, and nothing from five states on.

use nalgebra::{DMatrix, DVector};
use plantd_math::gemm::LANES;
use plantd_math::sparse_map::Map;

use crate::lq::cost_to_go::{CANCELLED, CostToGo};
use crate::lq::stage::{NotConvex, Stage};

/// States and inputs up to which loops are plain.
pub(super) const SMALL: usize = 8;

/// A matrix by columns.
type Columns<const N: usize> = [[f64; N]; N];

/// One stage back, of at most `N` states and inputs.
#[inline(always)]
#[allow(clippy::needless_range_loop, reason = "the indices are those of the formulas")]
pub(super) fn step<const N: usize>(
    (next, n, m): (usize, usize, usize),
    map: &Map,
    stage: Stage<'_>,
    cost: &mut CostToGo,
    factor: &mut DMatrix<f64>,
    gain: &mut DMatrix<f64>,
    offset: &mut DVector<f64>,
) -> Result<(), NotConvex> {
    let (mut a, mut b) = ([[0.0; N]; N], [[0.0; N]; N]);
    fill_columns(map, m, &mut a, &mut b);
    let value = &cost.numbers()[..LANES * next];
    let r = &stage.r.as_slice()[..m * m];
    let times_value = |x| times_value::<N>(value, next, x);
    let dot = |x: &[f64; N], y: &[f64]| dot(next, x, y);

    // Γ = R + BᵀPB, its lower triangle by rows, and X = AᵀPB + S.
    let mut bracket = [[0.0; N]; N];
    let mut cross = [[0.0; N]; N];
    for j in 0..m {
        let value_b = times_value(&b[j]);
        for i in 0..=j {
            bracket[j][i] = r[m * j + i] + dot(&b[i], &value_b);
        }
        for i in 0..n {
            cross[j][i] = dot(&a[i], &value_b);
            if let Some(s) = stage.s {
                cross[j][i] += s.as_slice()[n * j + i];
            }
        }
    }

    // Γ = L Lᵀ, in the place of Γ.
    factorize(&mut bracket, m)?;
    let factor = factor.as_mut_slice();
    for j in 0..m {
        for i in 0..=j {
            factor[m * i + j] = bracket[j][i];
        }
    }

    // Y = X L⁻ᵀ, in the place of X, and Kᵀ = Y L⁻¹.
    for j in 0..m {
        for i in 0..n {
            let known: f64 = (0..j).map(|k| bracket[j][k] * cross[k][i]).sum();
            cross[j][i] = (cross[j][i] - known) / bracket[j][j];
        }
    }
    let mut law = cross;
    for j in (0..m).rev() {
        for i in 0..n {
            let known: f64 = (j + 1..m).map(|k| bracket[k][j] * law[k][i]).sum();
            law[j][i] = (law[j][i] - known) / bracket[j][j];
        }
    }
    let gain = &mut gain.as_mut_slice()[..m * n];
    for i in 0..n {
        for j in 0..m {
            gain[m * i + j] = law[j][i];
        }
    }

    // y = L⁻¹ (Bᵀb + u_linear), b ← x_linear + Aᵀb − Y y, offset = L⁻ᵀ y in the place of y.
    let linear = &cost.linear.as_slice()[..next];
    let mut input = [0.0; N];
    for j in 0..m {
        let known: f64 = (0..j).map(|k| bracket[j][k] * input[k]).sum();
        let given = stage.u_linear.map_or(0.0, |u_linear| u_linear[j]);
        input[j] = (dot(&b[j], linear) + given - known) / bracket[j][j];
    }
    let mut new_linear = [0.0; N];
    for i in 0..n {
        let known: f64 = (0..m).map(|k| cross[k][i] * input[k]).sum();
        let given = stage.x_linear.map_or(0.0, |x_linear| x_linear[i]);
        new_linear[i] = dot(&a[i], linear) + given - known;
    }
    for j in (0..m).rev() {
        let known: f64 = (j + 1..m).map(|k| bracket[k][j] * input[k]).sum();
        input[j] = (input[j] - known) / bracket[j][j];
    }
    offset.as_mut_slice()[..m].copy_from_slice(&input[..m]);

    let mut new_value = [[0.0; N]; N];
    let maps = (&a, &b);
    fill_value_before(maps, value, (&cross, &law), stage, (next, n, m), &mut new_value);
    cost.set_states(n);
    cost.linear.as_mut_slice()[..n].copy_from_slice(&new_linear[..n]);
    let value = &mut cost.numbers_mut()[..LANES * n];
    for j in 0..n {
        for i in 0..=j {
            value[LANES * j + i] = new_value[j][i];
            value[LANES * i + j] = new_value[j][i];
        }
    }
    Ok(())
}

/// `A` and `B`, where they differ from zero.
#[inline(always)]
fn fill_columns<const N: usize>(map: &Map, m: usize, a: &mut Columns<N>, b: &mut Columns<N>) {
    for (&row, &start) in map.full.iter().zip(&map.starts) {
        let numbers = &map.numbers()[start..];
        for (column, entry) in b[..m].iter_mut().zip(numbers) {
            column[row] = *entry;
        }
        for (&state, entry) in map.active.iter().zip(&numbers[m..]) {
            a[state][row] = *entry;
        }
    }
    for (row, col, entry) in map.entries() {
        if col < m {
            b[col][row] = entry;
        } else {
            a[map.active[col - m]][row] = entry;
        }
    }
}

/// `P x`, by columns of `P`. A function of its own, where compilers find wider registers.
#[inline(never)]
fn times_value<const N: usize>(value: &[f64], next: usize, x: &[f64]) -> [f64; N] {
    let mut y = [0.0; N];
    for k in 0..next {
        for i in 0..next {
            y[i] += value[LANES * k + i] * x[k];
        }
    }
    y
}

#[inline(always)]
fn dot(next: usize, x: &[f64], y: &[f64]) -> f64 {
    (0..next).map(|k| x[k] * y[k]).sum()
}

/// Makes `L` of `Γ = L Lᵀ`; row j is `bracket[j]`.
#[inline(always)]
fn factorize<const N: usize>(bracket: &mut Columns<N>, m: usize) -> Result<(), NotConvex> {
    for j in 0..m {
        for i in 0..=j {
            let known: f64 = (0..i).map(|k| bracket[j][k] * bracket[i][k]).sum();
            let rest = bracket[j][i] - known;
            if i < j {
                bracket[j][i] = rest / bracket[i][i];
            } else if rest > 0.0 {
                bracket[j][j] = rest.sqrt();
            } else {
                return Err(NotConvex);
            }
        }
    }
    Ok(())
}

/// `P ← Q + AᵀPA − Y Yᵀ`, its lower triangle by rows.
#[inline(always)]
#[allow(clippy::needless_range_loop, reason = "the indices are those of the formulas")]
fn fill_value_before<const N: usize>(
    (a, b): (&Columns<N>, &Columns<N>),
    value: &[f64],
    (cross, law): (&Columns<N>, &Columns<N>),
    stage: Stage<'_>,
    (next, n, m): (usize, usize, usize),
    new_value: &mut Columns<N>,
) {
    let q = &stage.q.as_slice()[..n * n];
    let mut has_cancelled = false;
    for j in 0..n {
        let value_a = times_value::<N>(value, next, &a[j]);
        for i in 0..=j {
            let whole = q[n * j + i] + dot(next, &a[i], &value_a);
            let gained: f64 = (0..m).map(|k| cross[k][i] * cross[k][j]).sum();
            new_value[j][i] = whole - gained;
            if i == j {
                has_cancelled |= new_value[j][j].abs() < CANCELLED * whole.abs();
            }
        }
    }
    if has_cancelled {
        let closed_loop = closed_loop((a, b), law, (next, n, m));
        for j in 0..n {
            let pushed = times_value::<N>(value, next, &closed_loop[j]);
            for i in 0..=j {
                let kept = q[n * j + i] + dot(next, &closed_loop[i], &pushed);
                new_value[j][i] = add_price(kept, stage, law, (i, j));
            }
        }
    }
}

/// `A − BK`.
#[inline(always)]
fn closed_loop<const N: usize>(
    (a, b): (&Columns<N>, &Columns<N>),
    law: &Columns<N>,
    (next, n, m): (usize, usize, usize),
) -> Columns<N> {
    let mut closed_loop = [[0.0; N]; N];
    for j in 0..n {
        for i in 0..next {
            let fed: f64 = (0..m).map(|k| b[k][i] * law[k][j]).sum();
            closed_loop[j][i] = a[j][i] - fed;
        }
    }
    closed_loop
}

/// Adds an entry of `KᵀRK − SK − KᵀSᵀ`.
#[inline(always)]
fn add_price<const N: usize>(
    mut sum: f64,
    stage: Stage<'_>,
    law: &Columns<N>,
    (i, j): (usize, usize),
) -> f64 {
    let (n, m) = (stage.q.nrows(), stage.r.nrows());
    let r = stage.r.as_slice();
    for k in 0..m {
        let priced: f64 = (0..m).map(|l| r[m * k + l] * law[l][j]).sum();
        sum += law[k][i] * priced;
        if let Some(s) = stage.s {
            let s = &s.as_slice()[n * k..];
            sum -= s[i] * law[k][j] + s[j] * law[k][i];
        }
    }
    sum
}
