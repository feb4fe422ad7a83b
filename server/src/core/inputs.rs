//! Inputs of plants: sequences of them, operating points, and the input that holds a plant.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_models::scene::UnknownName;
use plantd_models::{Initial, InitialError, Model, Plant, Settings, Spare};

/// A plant at an operating point of its scene, and the input there.
pub fn at_operating_point(
    model: &Arc<Model>,
    settings: Settings,
    name: &str,
) -> Result<(Plant, Vec<f64>), InitialError> {
    let point = model.operating_points().iter().find(|point| point.name == name);
    let input = point.map(|point| point.u.clone()).ok_or_else(|| {
        let known = model.operating_points().iter().map(|point| &point.name);
        InitialError::Unknown { kind: "operating point", name: UnknownName::among(name, known) }
    })?;
    let start = Initial::OperatingPoint(name.to_owned());
    Ok((Spare::new(Arc::clone(model), settings)?.start(&start)?, input))
}

/// The input that exerts no force and leaves prescribed coordinates where they are.
pub fn hold_input(plant: &Plant) -> Vec<f64> {
    let mut input = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut input);
    input
}

/// A sequence of inputs.
#[derive(Clone, Debug)]
pub struct Inputs {
    columns: usize,
    count: usize,
    numbers: Vec<f64>,
}

impl Inputs {
    /// So many inputs of `columns` entries, one after the other.
    pub(crate) fn from_numbers(columns: usize, count: usize, numbers: Vec<f64>) -> Self {
        Self { columns, count, numbers }
    }

    /// The rows of a matrix.
    pub fn from_rows(u: &DMatrix<f64>) -> Self {
        let (count, columns) = u.shape();
        Self { columns, count, numbers: u.transpose().as_slice().to_vec() }
    }

    /// Number of inputs.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Input of step `k`.
    pub fn get(&self, k: usize) -> &[f64] {
        &self.numbers[k * self.columns..][..self.columns]
    }

    /// The last input.
    pub fn last(&self) -> Option<&[f64]> {
        self.count.checked_sub(1).map(|k| self.get(k))
    }
}
