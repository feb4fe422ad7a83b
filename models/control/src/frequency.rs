//! Frequency response of the linearized map.

use std::f64::consts::TAU;

use nalgebra::linalg::Hessenberg;
use nalgebra::{Complex, DMatrix};

use crate::error::AnalysisError;
use crate::spectrum::balance;

/// Pivot of `zI − A`, relative to its largest entry, below which `z` counts as an eigenvalue.
const POLE: f64 = 1e-13;

/// The transfer function `G(z) = C (zI − A)⁻¹ B + D` of
///
/// ```text
/// x[k+1] = A x[k] + B u[k]        y[k] = C x[k] + D u[k]
/// ```
///
/// prepared for evaluation at many frequencies: `A` is balanced and brought to Hessenberg form once
/// (about `10/3 n³` flops), after which one evaluation costs about `4n²(m + 1)` complex flops for
/// `m` inputs.
#[derive(Clone, Debug)]
pub struct TransferFunction {
    /// `Qᵀ A Q`, upper Hessenberg.
    a: DMatrix<f64>,
    /// `Qᵀ B`.
    b: DMatrix<f64>,
    /// `C Q`.
    c: DMatrix<f64>,
    d: DMatrix<f64>,
    time_step_s: f64,
}

impl TransferFunction {
    /// The transfer function of a map with `n` states, `m` inputs and `r` outputs: `A` n × n, `B`
    /// n × m, `C` r × n, `D` r × m.
    pub fn new(
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        c: &DMatrix<f64>,
        d: &DMatrix<f64>,
        time_step_s: f64,
    ) -> Result<Self, AnalysisError> {
        let (n, m, r) = (a.nrows(), b.ncols(), c.nrows());
        AnalysisError::check("A", a, (n, n))?;
        AnalysisError::check("B", b, (n, m))?;
        AnalysisError::check("C", c, (r, n))?;
        AnalysisError::check("D", d, (r, m))?;
        let (mut a, mut b, mut c) = (a.clone(), b.clone(), c.clone());
        if n > 1 {
            let scales = balance(&mut a, &mut b);
            for (mut column, scale) in c.column_iter_mut().zip(scales.iter()) {
                column *= *scale;
            }
            let (q, hessenberg) = Hessenberg::new(a).unpack();
            b = q.tr_mul(&b);
            c *= q;
            a = hessenberg;
        }
        Ok(Self { a, b, c, d: d.clone(), time_step_s })
    }

    /// `G(e^{iωh})` at `ω = 2π frequency_hz`, r × m. The sign is that of `e^{+iωt}`: a lag has a
    /// negative phase. Frequencies beyond the Nyquist frequency `1 / 2h` repeat those below.
    ///
    /// # Errors
    /// [`AnalysisError::Pole`] where `e^{iωh}` is an eigenvalue of `A`: the response is infinite.
    pub fn at(&self, frequency_hz: f64) -> Result<DMatrix<Complex<f64>>, AnalysisError> {
        if !frequency_hz.is_finite() {
            return Err(AnalysisError::Frequency { frequency_hz });
        }
        // Whole turns are taken off before they are multiplied by 2π.
        let turns = frequency_hz * self.time_step_s;
        let z = Complex::from_polar(1.0, TAU * (turns - turns.round()));
        let response = self.solve(z).ok_or(AnalysisError::Pole {
            frequency_hz,
            real: z.re,
            imaginary: z.im,
        })?;
        let c = self.c.map(|entry| Complex::new(entry, 0.0));
        Ok(c * response + self.d.map(|entry| Complex::new(entry, 0.0)))
    }

    /// `(zI − A)⁻¹ B` by elimination of the one subdiagonal, with interchanges of neighbours; `None`
    /// where a pivot vanishes.
    fn solve(&self, z: Complex<f64>) -> Option<DMatrix<Complex<f64>>> {
        let n = self.a.nrows();
        let mut m = self.a.map(|entry| Complex::new(-entry, 0.0));
        for i in 0..n {
            m[(i, i)] += z;
        }
        let mut x = self.b.map(|entry| Complex::new(entry, 0.0));
        let largest = m.iter().fold(0.0, |largest: f64, entry| largest.max(entry.norm()));
        for k in 0..n {
            if k + 1 < n && m[(k + 1, k)].norm() > m[(k, k)].norm() {
                m.swap_rows(k, k + 1);
                x.swap_rows(k, k + 1);
            }
            let pivot = m[(k, k)];
            // Written so that NaN is a pole too.
            if !(pivot.norm() > POLE * largest) {
                return None;
            }
            if k + 1 < n && m[(k + 1, k)] != Complex::new(0.0, 0.0) {
                let factor = m[(k + 1, k)] / pivot;
                for j in k..n {
                    let above = m[(k, j)];
                    m[(k + 1, j)] -= factor * above;
                }
                for j in 0..x.ncols() {
                    let above = x[(k, j)];
                    x[(k + 1, j)] -= factor * above;
                }
            }
        }
        let is_solved = m.solve_upper_triangular_mut(&mut x);
        (is_solved && x.iter().all(|entry| entry.re.is_finite() && entry.im.is_finite()))
            .then_some(x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(value: f64) -> DMatrix<f64> {
        DMatrix::from_element(1, 1, value)
    }

    #[test]
    fn one_state_in_closed_form() {
        let h = 0.05;
        let g = TransferFunction::new(&one(0.8), &one(2.0), &one(3.0), &one(0.5), h).unwrap();
        for frequency_hz in [0.0, 0.7, 5.0, 9.99, -3.0, 23.0] {
            let z = Complex::from_polar(1.0, TAU * frequency_hz * h);
            let expected = Complex::new(6.0, 0.0) / (z - 0.8) + 0.5;
            assert!((g.at(frequency_hz).unwrap()[(0, 0)] - expected).norm() < 1e-13);
        }
    }

    #[test]
    fn poles_on_the_unit_circle_are_named() {
        // An integrator, and a rotation by an eighth of a turn per step.
        let c = f64::sqrt(0.5);
        let a = DMatrix::from_row_slice(3, 3, &[1.0, 0.0, 0.0, 0.0, c, -c, 0.0, c, c]);
        let b = DMatrix::from_element(3, 1, 1.0);
        let g = TransferFunction::new(&a, &b, &b.transpose(), &one(0.0), 0.1).unwrap();
        for frequency_hz in [0.0, 1.25, -1.25, 10.0, 11.25] {
            let error = g.at(frequency_hz).unwrap_err();
            assert!(
                matches!(error, AnalysisError::Pole { frequency_hz: f, .. } if f == frequency_hz)
            );
        }
        assert!(g.at(1.2499).is_ok());
        assert!(matches!(g.at(f64::NAN), Err(AnalysisError::Frequency { .. })));
    }

    #[test]
    fn nothing_at_all() {
        let none = |rows, cols| DMatrix::<f64>::zeros(rows, cols);
        let g = TransferFunction::new(&none(0, 0), &none(0, 1), &none(1, 0), &one(4.0), 0.1);
        assert_eq!(g.unwrap().at(1.0).unwrap()[(0, 0)], Complex::new(4.0, 0.0));
        let misfit = TransferFunction::new(&one(0.5), &none(2, 1), &one(1.0), &one(0.0), 0.1);
        assert!(matches!(misfit, Err(AnalysisError::Dimension { matrix: "B", .. })));
    }
}
