//! Matrices and trajectories of inputs.

use std::sync::Arc;

use nalgebra::{Complex, DMatrix, DVector};
use plantd_models::{Initial, Model, Plant, Settings};
use plantd_proto::v1;

use crate::core::inputs::Inputs;
use crate::core::limits::{LimitExceeded, Limits};
use crate::wire::message::checks::check_shape;
use crate::wire::message::start::{Start, momentum, plant};
use crate::wire::status::RpcError;

/// The initial state and the inputs of a trajectory in a field of the request.
pub fn trajectory_in(
    field: &str,
    trajectory: Option<v1::Trajectory>,
    model: &Arc<Model>,
    settings: Settings,
    limits: &Limits,
) -> Result<(Plant, Inputs), RpcError> {
    let trajectory = trajectory.ok_or_else(|| RpcError::field(field, "is missing"))?;
    let start = match trajectory.initial {
        None => Initial::Scene,
        Some(state) => momentum(state.q, state.p, state.v, model),
    };
    let plant = plant(model, settings, &Start::Initial(start), &format!("{field}.initial"))?;
    let width = model.dimensions().input();
    let inputs = Inputs::along(&format!("{field}.u"), trajectory.u, width, limits)?;
    Ok((plant, inputs))
}

impl Inputs {
    /// Checks a matrix whose rows are inputs of `columns` entries.
    pub fn new(field: &str, u: Option<v1::Matrix>, columns: usize) -> Result<Self, RpcError> {
        let Some(u) = u else { return Ok(Self::from_numbers(columns, 0, Vec::new())) };
        check_shape(field, &u)?;
        if u.rows > 0 && u.cols as usize != columns {
            let problem = format!("has {} columns; {columns} are needed", u.cols);
            return Err(RpcError::field(format!("{field}.cols"), problem));
        }
        Ok(Self::from_numbers(columns, u.rows as usize, u.data))
    }

    /// The inputs of a trajectory: one row at least, and no more than a horizon may have.
    pub fn along(
        field: &str,
        u: Option<v1::Matrix>,
        columns: usize,
        limits: &Limits,
    ) -> Result<Self, RpcError> {
        let inputs = Self::new(field, u, columns)?;
        LimitExceeded::check("horizon", limits.horizon, "steps", inputs.count())?;
        if inputs.count() == 0 {
            return Err(RpcError::field(field, "is missing: it needs one row at least"));
        }
        Ok(inputs)
    }
}

/// A vector's numbers.
pub fn vector(vector: DVector<f64>) -> Vec<f64> {
    vector.as_slice().to_vec()
}

/// A vector's numbers; none when all are zero.
pub fn nonzero(vector: DVector<f64>) -> Vec<f64> {
    if vector.iter().all(|&number| number == 0.0) { Vec::new() } else { self::vector(vector) }
}

/// A matrix of the request: of so many columns, and rows where their number is given.
pub fn matrix_of(
    field: &str,
    matrix: &v1::Matrix,
    expected_rows: Option<usize>,
    expected_cols: usize,
) -> Result<DMatrix<f64>, RpcError> {
    check_shape(field, matrix)?;
    let (rows, cols) = (matrix.rows as usize, matrix.cols as usize);
    let needed = expected_rows.unwrap_or(rows);
    if (rows, cols) != (needed, expected_cols) {
        let problem = format!("is {rows} x {cols}; {needed} x {expected_cols} is needed");
        return Err(RpcError::field(field, problem));
    }
    Ok(DMatrix::from_row_slice(rows, cols, &matrix.data))
}

/// Complex numbers as messages.
pub fn complex(numbers: &[Complex<f64>]) -> Vec<v1::Complex> {
    numbers.iter().map(|z| v1::Complex { real: z.re, imaginary: z.im }).collect()
}

/// A matrix as a message.
pub fn matrix(matrix: &DMatrix<f64>) -> v1::Matrix {
    v1::Matrix {
        rows: matrix.nrows() as u32,
        cols: matrix.ncols() as u32,
        data: matrix.transpose().as_slice().to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::message::weights::weight;
    use v1::weight::Form as WeightForm;

    fn matrix_of(rows: u32, cols: u32, data: Vec<f64>) -> v1::Matrix {
        v1::Matrix { rows, cols, data }
    }

    #[test]
    fn matrices_are_row_major() {
        let m = DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(matrix(&m), matrix_of(2, 3, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let full =
            v1::Weight { form: Some(WeightForm::Full(matrix_of(2, 2, vec![1.0, 2.0, 3.0, 4.0]))) };
        assert_eq!(weight("q", Some(full), 2).unwrap()[(0, 1)], 2.0);
    }

    #[test]
    fn shapes_that_lie_are_refused() {
        for (matrix, field) in [
            (matrix_of(u32::MAX, u32::MAX, vec![]), "u.data"),
            (matrix_of(2, 2, vec![0.0; 3]), "u.data"),
            (matrix_of(1, 3, vec![0.0; 3]), "u.cols"),
            (matrix_of(1, 2, vec![0.0, f64::NAN]), "u.data[1]"),
        ] {
            let fault = Inputs::new("u", Some(matrix), 2).unwrap_err();
            let status = tonic::Status::from(fault);
            assert!(status.message().starts_with(field), "{}", status.message());
        }
    }
}
