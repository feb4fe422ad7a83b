//! States with ball joints: derivatives by rotation vectors, and by the tangent space.

use nalgebra::DMatrix;
use plantd_math::rotation;
use plantd_math::spatial::{Mat3, Vec3, three};

/// How the rotation vector at `e[i..]` changes with a turn of what it leads to, in its own axes.
pub(super) fn chart(e: &[f64], i: usize) -> Mat3 {
    rotation::momentum_at_start(three(e, i))
}

/// Turns a gradient by `dx` into one by the tangent space at `x`.
pub(super) fn turn_gradient(orientations: &[usize], dx: &[f64], gradient: &mut [f64]) {
    for &i in orientations {
        let turned = chart(dx, i).apply_transposed(three(gradient, i));
        gradient[i..i + 3].copy_from_slice(&turned.0);
    }
}

/// Turns the rows of second derivatives by `dx` into ones by the tangent space at `x`.
pub(super) fn turn_rows(orientations: &[usize], dx: &[f64], m: &mut DMatrix<f64>) {
    orientations.iter().for_each(|&i| turn_three_rows(&chart(dx, i), i, m));
}

/// Turns second derivatives by `dx` twice into ones by the tangent space at `x`.
pub(super) fn turn_weight(orientations: &[usize], dx: &[f64], q: &mut DMatrix<f64>) {
    for &i in orientations {
        let map = chart(dx, i);
        turn_three_rows(&map, i, q);
        let mut transposed = q.transpose();
        turn_three_rows(&map, i, &mut transposed);
        q.copy_from(&transposed);
    }
}

/// `rows ← mapᵀ rows`, three of them from `i` on.
fn turn_three_rows(map: &Mat3, i: usize, m: &mut DMatrix<f64>) {
    for mut column in m.column_iter_mut() {
        let turned = map.apply_transposed(Vec3([column[i], column[i + 1], column[i + 2]]));
        column.rows_mut(i, 3).copy_from_slice(&turned.0);
    }
}
