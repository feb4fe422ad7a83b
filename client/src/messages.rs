//! Arithmetic on the contract's messages, so that a controller needs no linear-algebra library.

use std::borrow::Cow;

use plantd_proto::v1;

use crate::error::{Error, Result};
use crate::rotation::difference;

/// Reading and writing of [`v1::Matrix`].
pub trait MatrixExt: Sized {
    /// A matrix of these rows, which must have equal lengths; no rows give a 0 × 0 matrix.
    ///
    /// # Panics
    /// If the rows differ in length.
    fn from_rows<R: AsRef<[f64]>>(rows: &[R]) -> Self;
    /// The rows, top to bottom.
    fn rows_iter(&self) -> impl Iterator<Item = &[f64]>;
    /// Entry of row `row` and column `col`.
    ///
    /// # Panics
    /// If there is no such entry.
    fn at(&self, row: usize, col: usize) -> f64;
    /// The product with a column vector.
    ///
    /// # Panics
    /// If the vector has not as many entries as the matrix has columns.
    fn times(&self, vector: &[f64]) -> Vec<f64>;
}

impl MatrixExt for v1::Matrix {
    fn from_rows<R: AsRef<[f64]>>(rows: &[R]) -> Self {
        let cols = rows.first().map_or(0, |row| row.as_ref().len());
        let mut data = Vec::with_capacity(rows.len() * cols);
        for row in rows {
            assert_eq!(row.as_ref().len(), cols, "rows differ in length");
            data.extend_from_slice(row.as_ref());
        }
        Self { rows: rows.len() as u32, cols: cols as u32, data }
    }

    fn rows_iter(&self) -> impl Iterator<Item = &[f64]> {
        let cols = self.cols as usize;
        (0..self.rows as usize).map(move |row| &self.data[row * cols..(row + 1) * cols])
    }

    fn at(&self, row: usize, col: usize) -> f64 {
        assert!(col < self.cols as usize, "column {col} of {}", self.cols);
        self.data[row * self.cols as usize + col]
    }

    fn times(&self, vector: &[f64]) -> Vec<f64> {
        assert_eq!(vector.len(), self.cols as usize, "length of the vector");
        let dot = |row: &[f64]| row.iter().zip(vector).map(|(a, b)| a * b).sum();
        self.rows_iter().map(dot).collect()
    }
}

/// Reading of [`v1::RolloutResponse`].
pub trait RolloutExt {
    /// The states of a case that came to its end.
    ///
    /// # Errors
    /// What kept it from that: its initial state was refused, and there are no states, or a step failed, and
    /// the message holds those before.
    fn into_states(self) -> Result<Vec<v1::State>>;
}

impl RolloutExt for v1::RolloutResponse {
    fn into_states(self) -> Result<Vec<v1::State>> {
        match self.failure {
            Some(failure) => Err(Error::Rpc(Box::new(failure.into()))),
            None => Ok(self.states),
        }
    }
}

/// Reading of [`v1::State`].
pub trait StateExt {
    /// The state vector `x = (q, p, v)` in which linearizations and gains are expressed.
    fn x(&self) -> Vec<f64>;
}

impl StateExt for v1::State {
    fn x(&self) -> Vec<f64> {
        [self.q.as_slice(), &self.p, &self.v].concat()
    }
}

/// A state that a feedback law can be asked about: of a [`Driver`](crate::Driver), a watch or a
/// [`LinkDriver`](crate::link::LinkDriver).
pub trait LawState {
    /// Steps since the plant was created or reset.
    fn step_index(&self) -> u64;
    /// `x = (q, p, v)`.
    fn state_vector(&self) -> Cow<'_, [f64]>;
    /// Time step of the plant, s, if the state knows it.
    fn time_step_s(&self) -> Option<f64> {
        None
    }
}

impl LawState for v1::State {
    fn step_index(&self) -> u64 {
        self.step
    }

    fn state_vector(&self) -> Cow<'_, [f64]> {
        Cow::Owned(self.x())
    }
}

/// Use of [`v1::Gain`].
pub trait GainExt {
    /// The feedback law `u = u_reference + feedforward − K (x − x_reference)`.
    ///
    /// Differences of angles are taken as they are: a joint that has turned by 2π is 2π away. Those of
    /// ball joints are rotation vectors, see [`difference`].
    ///
    /// # Errors
    /// [`Error::StateLength`] if the state has not as many entries as the reference, and
    /// [`Error::GainTimeStep`] if it knows that it is one of a plant of another time step, as those of the
    /// shared-memory link do.
    fn control(&self, state: &impl LawState) -> Result<Vec<f64>>;
    /// The feedback law at a state vector `x = (q, p, v)`, as [`control`](Self::control).
    ///
    /// # Errors
    /// [`Error::StateLength`] if `x` has not as many entries as the reference, [`Error::Protocol`] if the
    /// gain's own sizes do not fit each other.
    fn control_at(&self, x: &[f64]) -> Result<Vec<f64>>;
    /// Whether the gain was computed for such a plant, over whichever link it is driven;
    /// [`Driver::step_by`](crate::Driver::step_by) asks it.
    ///
    /// # Errors
    /// The plant has another model, another time step or states of another length. What a gain does not say
    /// of itself is not compared.
    fn suits(&self, plant: &v1::PlantInfo) -> Result<()>;
}

impl GainExt for v1::Gain {
    fn control(&self, state: &impl LawState) -> Result<Vec<f64>> {
        check_time_step(self, state.time_step_s())?;
        self.control_at(&state.state_vector())
    }

    fn control_at(&self, x: &[f64]) -> Result<Vec<f64>> {
        check(self)?;
        let expected = self.x_reference.len();
        if x.len() != expected {
            return Err(Error::StateLength { expected, actual: x.len() });
        }
        let error = difference(&self.x_reference, x, &self.rotations);
        let correction = self.k.as_ref().map(|k| k.times(&error)).unwrap_or_default();
        let mut u = self.u_reference.clone();
        for (u, forward) in u.iter_mut().zip(&self.feedforward) {
            *u += forward;
        }
        for (u, du) in u.iter_mut().zip(correction) {
            *u -= du;
        }
        Ok(u)
    }

    fn suits(&self, plant: &v1::PlantInfo) -> Result<()> {
        if !self.model.is_empty() && self.model != plant.model {
            let (expected, actual) = (self.model.clone(), plant.model.clone());
            return Err(Error::GainModel { expected, actual });
        }
        check_time_step(self, plant.settings.as_ref().map(|settings| settings.time_step_s))?;
        match (self.x_reference.len(), plant.state.as_ref().map(|state| state.x().len())) {
            (expected, Some(actual)) if actual != expected => {
                Err(Error::StateLength { expected, actual })
            }
            _ => Ok(()),
        }
    }
}

/// Whether the contract's promises on a gain hold, so that it can be applied.
pub(crate) fn check(gain: &v1::Gain) -> Result<()> {
    let (inputs, states) = (gain.u_reference.len(), gain.x_reference.len());
    let fits = gain.k.as_ref().is_none_or(|k| {
        (k.rows as usize, k.cols as usize) == (inputs, states) && k.data.len() == inputs * states
    });
    if fits { Ok(()) } else { Err(Error::Protocol("a gain whose sizes do not fit")) }
}

/// Refuses a time step that is known and another one than the gain says.
fn check_time_step(gain: &v1::Gain, time_step_s: Option<f64>) -> Result<()> {
    match time_step_s {
        Some(actual) if gain.time_step_s != 0.0 && gain.time_step_s != actual => {
            Err(Error::GainTimeStep { expected: gain.time_step_s, actual })
        }
        _ => Ok(()),
    }
}

/// The present state of a plant, where a linearization, an analysis or a regulator is wanted.
pub fn present_state(plant: impl Into<String>) -> v1::Point {
    v1::Point { source: Some(v1::point::Source::Plant(plant.into())) }
}

/// A weight with these diagonal entries.
pub fn diagonal(values: impl Into<Vec<f64>>) -> v1::Weight {
    let diagonal = v1::Diagonal { values: values.into() };
    v1::Weight { form: Some(v1::weight::Form::Diagonal(diagonal)) }
}

/// A weight that is a full symmetric matrix.
pub fn full(matrix: v1::Matrix) -> v1::Weight {
    v1::Weight { form: Some(v1::weight::Form::Full(matrix)) }
}

/// Weights of a regulator: `Σ ½ xᵀ q x + ½ uᵀ r u`, the final one being `q` as well.
pub fn weights(q: v1::Weight, r: v1::Weight) -> v1::LqrWeights {
    v1::LqrWeights { q: Some(q), r: Some(r), ..Default::default() }
}

/// Parts of [`v1::LqrWeights`] that not everybody needs.
pub trait WeightsExt: Sized {
    /// With the cross term `xᵀ s u`; `s` has a row per entry of x and a column per entry of u.
    fn with_cross(self, s: v1::Matrix) -> Self;
    /// With `½ xᵀ q_final x` at the end of a finite horizon.
    fn with_final(self, q_final: v1::Weight) -> Self;
    /// On the projected momentum in place of the state's own.
    fn on_projected_momentum(self) -> Self;
}

impl WeightsExt for v1::LqrWeights {
    fn with_cross(self, s: v1::Matrix) -> Self {
        Self { s: Some(s), ..self }
    }

    fn with_final(self, q_final: v1::Weight) -> Self {
        Self { q_final: Some(q_final), ..self }
    }

    fn on_projected_momentum(self) -> Self {
        Self { momentum: v1::Momentum::Projected.into(), ..self }
    }
}

/// The operating point of that name, where a linearization or a regulator is wanted.
pub fn operating_point(name: impl Into<String>) -> v1::Point {
    v1::Point { source: Some(v1::point::Source::OperatingPoint(name.into())) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gain_steers_against_the_error() {
        let gain = v1::Gain {
            step: 0,
            k: Some(v1::Matrix::from_rows(&[[2.0, 3.0]])),
            x_reference: vec![1.0, 0.5],
            u_reference: vec![10.0],
            ..Default::default()
        };
        let state = v1::State { q: vec![2.0], p: vec![0.0], ..Default::default() };
        assert_eq!(gain.control(&state).unwrap(), [10.0 - 2.0 * 1.0 + 3.0 * 0.5]);
        let forward = v1::Gain { feedforward: vec![0.25], ..gain };
        assert_eq!(forward.control_at(&[2.0, 0.0]).unwrap(), [10.25 - 2.0 * 1.0 + 3.0 * 0.5]);
    }

    #[test]
    fn a_state_of_another_model_is_refused() {
        let gain = v1::Gain {
            k: Some(v1::Matrix::from_rows(&[[2.0, 3.0]])),
            x_reference: vec![1.0, 0.5],
            u_reference: vec![10.0],
            ..Default::default()
        };
        // One that numbers would be repeated to fit, one that is too long, and none at all.
        for x in [&[2.0][..], &[2.0, 0.0, 1.0, 0.0], &[]] {
            let refusal = gain.control_at(x).unwrap_err();
            assert_eq!(
                refusal.to_string(),
                format!("the state has {} entries; the gain is for 2", x.len())
            );
        }
        let torn = v1::Gain { u_reference: Vec::new(), ..gain };
        assert!(matches!(torn.control_at(&[2.0, 0.0]), Err(Error::Protocol(_))));
    }

    #[test]
    fn a_gain_knows_its_plants() {
        let gain = v1::Gain {
            model: "pendulum".into(),
            time_step_s: 0.01,
            x_reference: vec![0.0; 2],
            ..Default::default()
        };
        let plant = |model: &str, time_step_s, entries| v1::PlantInfo {
            model: model.into(),
            settings: Some(v1::PlantSettings { time_step_s, ..Default::default() }),
            state: Some(v1::State { q: vec![0.0; entries], ..Default::default() }),
            ..Default::default()
        };
        assert!(gain.suits(&plant("pendulum", 0.01, 2)).is_ok());
        let refusal = |plant| gain.suits(&plant).unwrap_err();
        assert!(matches!(refusal(plant("cart-pole", 0.01, 2)), Error::GainModel { .. }));
        assert!(matches!(refusal(plant("pendulum", 0.02, 2)), Error::GainTimeStep { .. }));
        assert!(matches!(refusal(plant("pendulum", 0.01, 4)), Error::StateLength { .. }));
        assert!(v1::Gain::default().suits(&v1::PlantInfo::default()).is_ok());
    }

    #[test]
    fn weights_keep_what_is_added() {
        let cross = v1::Matrix::from_rows(&[[0.5], [0.0]]);
        let weights = weights(diagonal([1.0, 2.0]), full(v1::Matrix::from_rows(&[[3.0]])))
            .with_cross(cross.clone())
            .with_final(diagonal([4.0, 5.0]))
            .on_projected_momentum();
        assert_eq!(weights.momentum(), v1::Momentum::Projected);
        assert_eq!((weights.s, weights.q_final), (Some(cross), Some(diagonal([4.0, 5.0]))));
        assert_eq!(weights.q, Some(diagonal([1.0, 2.0])));
    }

    #[test]
    fn rows_come_back_as_they_went_in() {
        let matrix = v1::Matrix::from_rows(&[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        assert_eq!((matrix.rows, matrix.cols), (2, 3));
        assert_eq!(matrix.rows_iter().nth(1), Some([4.0, 5.0, 6.0].as_slice()));
        assert_eq!(matrix.at(1, 0), 4.0);
        assert_eq!(v1::Matrix::from_rows::<[f64; 1]>(&[]).rows_iter().count(), 0);
    }
}
