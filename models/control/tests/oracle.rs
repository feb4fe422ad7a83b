//! Independent solutions in `tests/oracles`.

use nalgebra::DMatrix;
use serde_json::Value;

/// The file of that name.
pub(crate) fn oracle(name: &str) -> Value {
    let path = crate::common::folder().join("../tests/oracles").join(name);
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

pub(crate) fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone()).unwrap();
    DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j])
}

pub(crate) fn relative_error(actual: &DMatrix<f64>, expected: &DMatrix<f64>) -> f64 {
    (actual - expected).norm() / expected.norm()
}
