//! A Kalman filter that runs here, with the gain that the server computed.

use plantd_proto::v1;

use crate::error::{Error, Result};
use crate::messages::MatrixExt as _;
use crate::rotation::{compose, difference};

/// A steady-state Kalman filter about an equilibrium, from the answer of
/// [`Client::solve_kalman`](crate::Client::solve_kalman).
///
/// Each step, [`correct`](Self::correct) takes a measurement in and [`predict`](Self::predict) goes
/// one step on; [`x`](Self::x) is the estimate in between, for
/// [`GainExt::control_at`](crate::GainExt::control_at). It starts at the equilibrium.
///
/// ```no_run
/// use plantd_client::{Estimator, GainExt, v1};
///
/// # fn lqg(kalman: v1::SolveKalmanResponse, gain: v1::Gain, y: &[f64]) -> plantd_client::Result<()> {
/// let mut estimator = Estimator::new(kalman)?;
/// estimator.correct(y, None);
/// let u = gain.control_at(&estimator.x())?;
/// estimator.predict(&u);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Estimator {
    filter: v1::SolveKalmanResponse,
    gain: v1::Matrix,
    a: v1::Matrix,
    b: v1::Matrix,
    output_x: v1::Matrix,
    output_u: Option<v1::Matrix>,
    /// Estimate of `x − x_reference`.
    dx: Vec<f64>,
}

impl Estimator {
    /// A filter that begins at the equilibrium.
    ///
    /// # Errors
    /// [`Error::Protocol`] if matrices are missing or do not fit each other.
    pub fn new(mut filter: v1::SolveKalmanResponse) -> Result<Self> {
        let missing = || Error::Protocol("a filter without one of its matrices");
        let gain = filter.gain.take().ok_or_else(missing)?;
        let linearization = filter.linearization.take().ok_or_else(missing)?;
        let (a, b) = linearization.a.zip(linearization.b).ok_or_else(missing)?;
        let output_x = filter.output_x.take().ok_or_else(missing)?;
        let output_u = filter.output_u.take().filter(|d| !d.data.is_empty());
        let (n, m) = (filter.x_reference.len(), filter.u_reference.len());
        let r = filter.y_reference.len();
        let is = |matrix: &v1::Matrix, rows: usize, cols: usize| {
            (matrix.rows as usize, matrix.cols as usize, matrix.data.len())
                == (rows, cols, rows * cols)
        };
        let fits = is(&gain, n, r)
            && is(&a, n, n)
            && is(&b, n, m)
            && is(&output_x, r, n)
            && output_u.as_ref().is_none_or(|d| is(d, r, m));
        if !fits {
            return Err(Error::Protocol("a filter whose sizes do not fit"));
        }
        Ok(Self { filter, gain, a, b, output_x, output_u, dx: vec![0.0; n] })
    }

    /// Starts anew from an estimate of `x = (q, p, v)`.
    ///
    /// # Errors
    /// [`Error::StateLength`] if it is not a state of the filter's plant.
    pub fn reset(&mut self, x: &[f64]) -> Result<()> {
        let expected = self.dx.len();
        if x.len() != expected {
            return Err(Error::StateLength { expected, actual: x.len() });
        }
        self.dx = difference(&self.filter.x_reference, x, &self.filter.rotations);
        Ok(())
    }

    /// The estimate of `x = (q, p, v)`.
    pub fn x(&self) -> Vec<f64> {
        compose(&self.filter.x_reference, &self.dx, &self.filter.rotations)
    }

    /// Takes in the measurement of the present state: `dx += L (dy − C dx − D du)`. `u` is the input in
    /// it, of use only where the outputs depend on it.
    ///
    /// # Panics
    /// If `y` has not as many entries as there are outputs, or `u` as there are inputs.
    pub fn correct(&mut self, y: &[f64], u: Option<&[f64]>) {
        assert_eq!(y.len(), self.filter.y_reference.len(), "length of the measurement");
        let mut innovation = minus(y, &self.filter.y_reference);
        subtract(&mut innovation, &self.output_x.times(&self.dx));
        if let (Some(u), Some(output_u)) = (u, &self.output_u) {
            subtract(&mut innovation, &output_u.times(&minus(u, &self.filter.u_reference)));
        }
        let correction = self.gain.times(&innovation);
        for (dx, correction) in self.dx.iter_mut().zip(correction) {
            *dx += correction;
        }
    }

    /// Goes one step on with the input `u`: `dx = A dx + B du`.
    ///
    /// # Panics
    /// If `u` has not as many entries as there are inputs.
    pub fn predict(&mut self, u: &[f64]) {
        assert_eq!(u.len(), self.filter.u_reference.len(), "length of the input");
        let forced = self.b.times(&minus(u, &self.filter.u_reference));
        let free = self.a.times(&self.dx);
        self.dx = free.iter().zip(forced).map(|(a, b)| a + b).collect();
    }
}

fn minus(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

fn subtract(a: &mut [f64], b: &[f64]) {
    for (a, b) in a.iter_mut().zip(b) {
        *a -= b;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter() -> v1::SolveKalmanResponse {
        let rows = |rows: &[[f64; 2]]| Some(v1::Matrix::from_rows(rows));
        let column = |rows: &[[f64; 1]]| Some(v1::Matrix::from_rows(rows));
        v1::SolveKalmanResponse {
            gain: column(&[[0.5], [0.25]]),
            linearization: Some(v1::Linearization {
                a: rows(&[[1.0, 0.5], [-0.5, 1.0]]),
                b: column(&[[0.0], [2.0]]),
                ..Default::default()
            }),
            output_x: rows(&[[2.0, 0.0]]),
            output_u: column(&[[4.0]]),
            x_reference: vec![1.0, 2.0],
            u_reference: vec![0.5],
            y_reference: vec![2.0],
            ..Default::default()
        }
    }

    #[test]
    fn it_corrects_and_predicts() {
        let mut estimator = Estimator::new(filter()).unwrap();
        assert_eq!(estimator.x(), [1.0, 2.0]);
        estimator.reset(&[1.5, 3.0]).unwrap();
        // dy - C dx - D du = 1 - 1 - 4 * 0.25 = -1.
        estimator.correct(&[3.0], Some(&[0.75]));
        assert_eq!(estimator.x(), [1.0, 2.75]);
        // dx = (0, 0.75), du = 0.25.
        estimator.predict(&[0.75]);
        assert_eq!(estimator.x(), [1.375, 3.25]);
        estimator.correct(&[2.75], None);
        assert_eq!(estimator.x(), [1.375, 3.25]);
        assert!(estimator.reset(&[1.0]).is_err());
    }

    #[test]
    fn it_refuses_what_does_not_fit() {
        assert!(Estimator::new(v1::SolveKalmanResponse { gain: None, ..filter() }).is_err());
        let short = v1::SolveKalmanResponse { y_reference: vec![], ..filter() };
        assert!(Estimator::new(short).is_err());
    }
}
