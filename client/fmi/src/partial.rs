//! Partial derivatives of variables by variables.

use nalgebra::DMatrix;
use plantd_models::{Dimensions, Linearization, Plant};

use crate::error::FmuError;
use crate::variables::Kind;

/// `A = ∂f/∂x` and `B = ∂f/∂u` of the next time step.
pub(crate) struct Derivatives {
    a: DMatrix<f64>,
    b: DMatrix<f64>,
}

impl Derivatives {
    pub(crate) fn new(plant: &mut Plant, input: &[f64]) -> Result<Self, FmuError> {
        let mut linearization = Linearization::new(plant.model());
        plant.linearize(input, &mut linearization).map_err(FmuError::Linearize)?;
        Ok(Self { a: linearization.a(), b: linearization.b() })
    }

    /// Derivatives that are known without the map: an output is a function of the state, and an entry of
    /// the state of itself.
    pub(crate) fn without_map(of: Kind, by: Kind, dimensions: Dimensions) -> Option<f64> {
        if let (Some(i), Some(j)) = (state_index(of, dimensions), state_index(by, dimensions)) {
            return Some(if i == j { 1.0 } else { 0.0 });
        }
        let follows_from_state = matches!(of, Kind::Velocity(_) | Kind::Energy(_) | Kind::Force(_))
            || state_index(of, dimensions).is_some();
        (follows_from_state && matches!(by, Kind::Input(_))).then_some(0.0)
    }

    /// Whether the map gives a derivative.
    pub(crate) fn are_of_map(of: Kind, by: Kind) -> bool {
        let is_argument =
            matches!(by, Kind::Position(_) | Kind::Momentum(_) | Kind::Rate(_) | Kind::Input(_));
        matches!(of, Kind::Next(_)) && is_argument
    }

    /// An entry of A or B.
    pub(crate) fn of_map(&self, of: Kind, by: Kind, dimensions: Dimensions) -> Option<f64> {
        match (of, by) {
            (Kind::Next(i), Kind::Input(j)) => Some(self.b[(i, j)]),
            (Kind::Next(i), by) => state_index(by, dimensions).map(|j| self.a[(i, j)]),
            _ => None,
        }
    }
}

/// Place of a variable in `x = (q, p, v)`.
fn state_index(kind: Kind, dimensions: Dimensions) -> Option<usize> {
    let n = dimensions.coordinates();
    match kind {
        Kind::Position(i) => Some(i),
        Kind::Momentum(i) => Some(n + i),
        Kind::Rate(k) => Some(n + dimensions.dynamic + k),
        _ => None,
    }
}
