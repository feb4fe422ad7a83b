//! A basis of the null space of a matrix.

use nalgebra::DMatrix;

/// Orthonormal basis of the null space of `dh` (constraints × coordinates), one column per free
/// direction. Redundant and empty constraints are recognised, whatever the constraints' scales.
pub fn tangent_basis(dh: &DMatrix<f64>) -> DMatrix<f64> {
    let coordinates = dh.ncols();
    let mut rows: DMatrix<f64> = dh.transpose();
    for mut row in rows.column_iter_mut() {
        let norm = row.norm();
        if norm > 0.0 {
            row /= norm;
        }
    }
    if rows.is_empty() {
        return DMatrix::identity(coordinates, coordinates);
    }
    // Columns of `rows` span the forbidden directions; what their reflections leave is free.
    let qr = rows.col_piv_qr();
    let r = qr.r();
    let rank = (0..r.nrows()).filter(|&i| r[(i, i)].abs() > REDUNDANT).count();
    let mut reflections = DMatrix::identity(coordinates, coordinates);
    qr.q_tr_mul(&mut reflections);
    reflections.rows(rank, coordinates - rank).transpose()
}

/// Pivot of the row-normalised constraint Jacobian below which a constraint is redundant.
pub const REDUNDANT: f64 = 1e-10;
