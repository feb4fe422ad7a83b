//! Natural modes of the discrete map.

use std::f64::consts::TAU;

use nalgebra::{Complex, DMatrix};

use crate::error::AnalysisError;
use crate::spectrum::{eigenvalues, sorted};

/// An eigenvalue `z` of `A`, read as a mode of continuous time: `z = exp(s h)` with the principal
/// value `s = ln(z) / h`, so that frequencies go up to the Nyquist frequency `1 / 2h`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// `Re z`.
    pub real: f64,
    /// `Im z`.
    pub imaginary: f64,
    /// `|z|`: growth per step.
    pub modulus: f64,
    /// `|s| / 2π`, Hz; infinite for `z = 0`, which is over in one step.
    pub natural_frequency_hz: f64,
    /// `-Re s / |s|`: 1 decays without oscillation, 0 oscillates without decay, negative grows; 0
    /// for `z = 1`, which rests.
    pub damping_ratio: f64,
    /// `-1 / Re s`, s: time in which the mode decays to `1/e`; negative when it grows, infinite when
    /// it does neither, 0 for `z = 0`.
    pub time_constant_s: f64,
}

impl Mode {
    fn new(z: Complex<f64>, time_step_s: f64) -> Self {
        let modulus = z.norm();
        // ln |z| to full precision about the unit circle, where lightly damped modes lie.
        let excess = (z.re - 1.0) * (z.re + 1.0) + z.im * z.im;
        let growth = 0.5 * if excess.abs() < 0.5 { excess.ln_1p() } else { (1.0 + excess).ln() };
        let s = Complex::new(if modulus == 0.0 { f64::NEG_INFINITY } else { growth }, z.arg())
            / time_step_s;
        let rate = if modulus == 0.0 { f64::INFINITY } else { s.norm() };
        let damping_ratio = match rate {
            0.0 => 0.0,
            f64::INFINITY => 1.0,
            _ => -s.re / rate,
        };
        Self {
            real: z.re,
            imaginary: z.im,
            modulus,
            natural_frequency_hz: rate / TAU,
            damping_ratio,
            time_constant_s: if s.re == 0.0 { f64::INFINITY } else { -1.0 / s.re },
        }
    }
}

/// The modes of a square matrix `A` of `x[k+1] = A x[k]` with time step `time_step_s`: all
/// eigenvalues, the slowest to decay first, conjugate ones side by side. About `25n³` flops.
///
/// For a map with constraints or prescribed coordinates give its restriction to
/// [`Tangent::held`](crate::manifold::Tangent::held): momentum gauge, errors
/// off the manifold and prescribed coordinates are no modes.
pub fn modes(a: &DMatrix<f64>, time_step_s: f64) -> Result<Vec<Mode>, AnalysisError> {
    AnalysisError::check("A", a, (a.nrows(), a.nrows()))?;
    let eigenvalues = eigenvalues(a).map_err(|_| AnalysisError::Eigenvalues { size: a.nrows() })?;
    Ok(sorted(eigenvalues).into_iter().map(|z| Mode::new(z, time_step_s)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn only(z: Complex<f64>, time_step_s: f64) -> Mode {
        Mode::new(z, time_step_s)
    }

    #[test]
    fn a_damped_oscillation_gives_its_parameters_back() {
        let (h, frequency_hz, ratio) = (0.01, 3.0, 0.05);
        let rate = TAU * frequency_hz;
        let s = Complex::new(-ratio * rate, rate * f64::sqrt(1.0 - ratio * ratio));
        let mode = only((s * h).exp(), h);
        assert!((mode.natural_frequency_hz - frequency_hz).abs() < 1e-13);
        assert!((mode.damping_ratio - ratio).abs() < 1e-13);
        assert!((mode.time_constant_s - 1.0 / (ratio * rate)).abs() < 1e-11);
    }

    #[test]
    fn limits_are_finite_where_they_can_be() {
        let rest = only(Complex::new(1.0, 0.0), 0.01);
        assert_eq!((rest.natural_frequency_hz, rest.damping_ratio), (0.0, 0.0));
        assert_eq!(rest.time_constant_s, f64::INFINITY);
        let gone = only(Complex::new(0.0, 0.0), 0.01);
        assert_eq!((gone.damping_ratio, gone.time_constant_s), (1.0, 0.0));
        assert_eq!(gone.natural_frequency_hz, f64::INFINITY);
        let growing = only(Complex::new(1.1, 0.0), 0.1);
        assert!(growing.time_constant_s < 0.0 && growing.damping_ratio == -1.0);
    }

    #[test]
    fn light_damping_survives_round_off() {
        // 1 - 1e-13 per step: a logarithm of the rounded modulus would keep three digits.
        let decay: f64 = -1e-13;
        let mode = only(Complex::from_polar(decay.exp(), 0.3), 1.0);
        assert!((mode.time_constant_s * 1e-13 - 1.0).abs() < 2e-3, "{}", mode.time_constant_s);
    }

    #[test]
    fn conjugates_stand_side_by_side() {
        let a = DMatrix::from_row_slice(3, 3, &[0.6, -0.7, 0.0, 0.7, 0.6, 0.0, 0.0, 0.0, 0.5]);
        let modes = modes(&a, 0.1).unwrap();
        let values: Vec<_> = modes.iter().map(|m| (m.real, m.imaginary.signum())).collect();
        assert_eq!(values.len(), 3);
        assert!(values[0].1 > 0.0 && values[1].1 < 0.0 && modes[2].modulus == 0.5);
    }
}
