//! Products of weights and gains with rows of trajectories.

use nalgebra::DMatrix;

/// Whether a symmetric weight is diagonal, as it is more often than not.
#[derive(Clone, Debug)]
pub(super) enum WeightShape {
    Diagonal,
    Full,
}

impl WeightShape {
    pub(super) fn new(m: &DMatrix<f64>) -> Self {
        let off = |(i, j): (usize, usize)| i != j && m[(i, j)] != 0.0;
        let n = m.nrows();
        if (0..n).any(|j| (0..n).any(|i| off((i, j)))) { Self::Full } else { Self::Diagonal }
    }

    /// `out = m v`.
    pub(super) fn multiply(&self, m: &DMatrix<f64>, v: &[f64], out: &mut [f64]) {
        match self {
            Self::Diagonal => {
                for (i, (out, v)) in out.iter_mut().zip(v).enumerate() {
                    *out = m[(i, i)] * v;
                }
            }
            Self::Full => {
                out.fill(0.0);
                for_columns(m, v, out, |out, m, v| *out += m * v);
            }
        }
    }
}

/// `out −= m v`.
pub(super) fn subtract_product(m: &DMatrix<f64>, v: &[f64], out: &mut [f64]) {
    for_columns(m, v, out, |out, m, v| *out -= m * v);
}

/// Column by column, skipping zeros of `v`.
#[inline(always)]
fn for_columns(m: &DMatrix<f64>, v: &[f64], out: &mut [f64], act: impl Fn(&mut f64, f64, f64)) {
    for (column, v) in m.as_slice().chunks_exact(out.len().max(1)).zip(v) {
        if *v != 0.0 {
            out.iter_mut().zip(column).for_each(|(out, m)| act(out, *m, *v));
        }
    }
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
