//! Kalman filters, the dual of regulators.
//!
//! The map is `x[k+1] = A x + B (u + w_u) + w`, what is measured `y = C x + v`, with white noises of
//! the covariances
//!
//! ```text
//! W = process + B input Bᵀ ,   V = measurement
//! ```
//!
//! and each step the filter corrects what it predicted, `x⁺ = x⁻ + L (y − C x⁻)`, then predicts
//! `A x⁺ + B u`. A part of the output that the input sets at once, `D u`, is subtracted from `y`
//! beforehand and changes nothing here.

use std::borrow::Cow;

use nalgebra::{Complex, DMatrix};

use crate::coordinates::Coordinates;
use crate::error::RiccatiError;
use crate::finite_horizon::{Sample, Values};
use crate::infinite_horizon::solve_without_cross;
use crate::manifold::Tangent;
use crate::matrix::{all_finite, solve_definite, symmetrize};
use crate::noise::{KalmanError, NoiseCovariances, semidefinite};

/// A steady-state filter.
#[derive(Clone, Debug, PartialEq)]
pub struct Kalman {
    /// `L`, n × r: `x⁺ = x⁻ + L (y − C x⁻)`.
    pub gain: DMatrix<f64>,
    /// Covariance of the error of `x⁻`, n × n.
    pub predicted: DMatrix<f64>,
    /// Covariance of the error of `x⁺`, n × n.
    pub filtered: DMatrix<f64>,
    /// Eigenvalues of the error's map `A (I − L C)`, largest modulus first, conjugate ones side by
    /// side.
    pub error_modes: Vec<Complex<f64>>,
    /// Relative residual of the Riccati equation, as in [`Regulator`](crate::infinite_horizon::Regulator).
    pub residual: f64,
    /// Doublings.
    pub iterations: u32,
    /// Reciprocal condition in the 1-norm, at most 1, of the innovation's covariance `C P Cᵀ + V`.
    pub reciprocal_condition: f64,
}

/// Filters along a trajectory, one for each of its states.
#[derive(Clone, Debug, PartialEq)]
pub struct KalmanTrajectory {
    /// `L[k]`, n × r.
    pub gains: Vec<DMatrix<f64>>,
    /// Covariances of the errors of `x⁻[k]` and `x⁺[k]`, when asked for.
    pub covariances: Option<Vec<(DMatrix<f64>, DMatrix<f64>)>>,
    /// Reciprocal condition in the 1-norm, at most 1, of the innovation's covariance.
    pub reciprocal_conditions: Vec<f64>,
}

/// Solves the steady-state filter of `x[k+1] = A x + B u`, `y = C x`: with `P` of
///
/// ```text
/// P = A P Aᵀ + W − A P Cᵀ (C P Cᵀ + V)⁻¹ C P Aᵀ ,   L = P Cᵀ (C P Cᵀ + V)⁻¹
/// ```
///
/// The regulator problem of `(Aᵀ, Cᵀ, W, V)`; costs and checks are those of
/// [`infinite_horizon`](crate::infinite_horizon).
pub fn steady_state_kalman(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    c: &DMatrix<f64>,
    noise: &NoiseCovariances,
) -> Result<Kalman, KalmanError> {
    steady_state((a, b, c), Coordinates(None), noise)
}

/// The steady-state filter on the constraint manifold, at an equilibrium with that tangent space: noise
/// counts only as far as the tangent space holds it, corrections keep to the manifold, and the error's
/// modes leave out directions off it.
pub fn steady_state_kalman_on_manifold(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    c: &DMatrix<f64>,
    tangent: &Tangent,
    noise: &NoiseCovariances,
) -> Result<Kalman, KalmanError> {
    steady_state((a, b, c), Coordinates(Some(tangent)), noise)
}

/// The steady-state filter in coordinates of the state, as the dual regulator.
fn steady_state(
    (a, b, c): (&DMatrix<f64>, &DMatrix<f64>, &DMatrix<f64>),
    space: Coordinates<'_>,
    noise: &NoiseCovariances,
) -> Result<Kalman, KalmanError> {
    let (n, m) = (a.nrows(), b.ncols());
    RiccatiError::check_map(0, (a, b), (n, m))?;
    RiccatiError::check("C", 0, c, (c.nrows(), n))?;
    noise.check(n, m, c.nrows())?;
    space.check(0, n)?;
    let (process, measurement) = (noise.state_noise(b), noise.measurement());
    let (a, c) = (space.map(space, a), space.columns(Cow::Borrowed(c)));
    let process = space.restrict(&process);
    let dual = solve_without_cross(&a.transpose(), &c.transpose(), &process, measurement)?;
    let (gain, reciprocal_condition) = gain(0, &c, &dual.value, measurement)?;
    let filtered = correct(&c, &gain, &dual.value, measurement);
    Ok(Kalman {
        gain: space.extend(&gain),
        predicted: space.extend_value(&dual.value),
        filtered: space.extend_value(&filtered),
        error_modes: dual.closed_loop,
        residual: dual.residual,
        iterations: dual.iterations,
        reciprocal_condition,
    })
}

/// Solves the filters along the samples, in the order of time, from the covariance `initial` of the
/// error of `x⁻[0]`:
///
/// ```text
/// L = P Cᵀ (C P Cᵀ + V)⁻¹ ,   P⁺ = (I − L C) P (I − L C)ᵀ + L V Lᵀ ,   P ← A P⁺ Aᵀ + W
/// ```
///
/// There is one state more than there are samples. `outputs` are the `C` of the states, `noise` has
/// the measurement's covariance of each state and the process's of the step that follows it: one
/// entry for all of them, or one for each state. About `8n³` flops per sample.
pub fn time_varying_kalman(
    samples: &[Sample],
    outputs: &[DMatrix<f64>],
    noise: &[NoiseCovariances],
    initial: &DMatrix<f64>,
    covariances: Values,
) -> Result<KalmanTrajectory, KalmanError> {
    time_varying(samples, (outputs, noise), initial, covariances, |_| Coordinates(None))
}

/// The filters along the samples on the constraint manifold: `tangents` has the tangent space of each
/// state.
pub fn time_varying_kalman_on_manifold(
    samples: &[Sample],
    outputs: &[DMatrix<f64>],
    tangents: &[Tangent],
    noise: &[NoiseCovariances],
    initial: &DMatrix<f64>,
    covariances: Values,
) -> Result<KalmanTrajectory, KalmanError> {
    if tangents.len() != samples.len() + 1 {
        let (samples, actual) = (samples.len(), tangents.len());
        return Err(RiccatiError::TangentCount { samples, actual }.into());
    }
    for (state, tangent) in tangents.iter().enumerate() {
        tangent.check(state, initial.nrows())?;
    }
    let coordinates = |state: usize| Coordinates(tangents.get(state));
    time_varying(samples, (outputs, noise), initial, covariances, coordinates)
}

/// The filters in coordinates of each state.
fn time_varying<'a>(
    samples: &[Sample],
    (outputs, noise): (&[DMatrix<f64>], &[NoiseCovariances]),
    initial: &DMatrix<f64>,
    covariances: Values,
    coordinates: impl Fn(usize) -> Coordinates<'a>,
) -> Result<KalmanTrajectory, KalmanError> {
    let (n, states) = (initial.nrows(), samples.len() + 1);
    for (list, actual) in [("outputs", outputs.len()), ("noise", noise.len())] {
        if actual != 1 && actual != states {
            let (samples, expected) = (samples.len(), format!("1 or {states}"));
            return Err(KalmanError::Count { list, samples, actual, expected });
        }
    }
    let initial = semidefinite("initial_covariance", initial.clone())?;
    let mut found = KalmanTrajectory {
        gains: Vec::with_capacity(states),
        covariances: (covariances == Values::Keep).then(|| Vec::with_capacity(states)),
        reciprocal_conditions: Vec::with_capacity(states),
    };
    let mut predicted = coordinates(0).restrict(&initial).into_owned();
    for state in 0..states {
        let c = &outputs[if outputs.len() == 1 { 0 } else { state }];
        let noise = &noise[if noise.len() == 1 { 0 } else { state }];
        RiccatiError::check("C", state, c, (c.nrows(), n))?;
        let any = noise.input().map_or(0, DMatrix::nrows);
        let nearest = samples.get(state).or(samples.last());
        noise.check(n, nearest.map_or(any, |sample| sample.b.ncols()), c.nrows())?;
        // L = P Cᵀ (C P Cᵀ + V)⁻¹ and P⁺ = (I − L C) P (I − L C)ᵀ + L V Lᵀ.
        let space = coordinates(state);
        let c = space.columns(Cow::Borrowed(c));
        let (gain, condition) = gain(state, &c, &predicted, noise.measurement())?;
        let filtered = correct(&c, &gain, &predicted, noise.measurement());
        found.reciprocal_conditions.push(condition);
        if let Some(covariances) = &mut found.covariances {
            covariances.push((space.extend_value(&predicted), space.extend_value(&filtered)));
        }
        found.gains.push(space.extend(&gain));
        // P ← A P⁺ Aᵀ + W.
        if let Some(sample) = samples.get(state) {
            RiccatiError::check_map(state, (&sample.a, &sample.b), (n, sample.b.ncols()))?;
            let next = coordinates(state + 1);
            let process = noise.state_noise(&sample.b);
            let (a, process) = (space.map(next, &sample.a), next.restrict(&process));
            predicted = predict(state, &a, &filtered, &process)?;
        }
    }
    Ok(found)
}

/// `P Cᵀ (C P Cᵀ + V)⁻¹` and the reciprocal condition of the bracket, which has to be positive definite
/// in floating point.
fn gain(
    sample: usize,
    c: &DMatrix<f64>,
    predicted: &DMatrix<f64>,
    measurement: &DMatrix<f64>,
) -> Result<(DMatrix<f64>, f64), RiccatiError> {
    let seen = c * predicted;
    let (transposed, condition) = solve_definite(&seen * c.transpose() + measurement, &seen)
        .ok_or(RiccatiError::Overflow { sample })?;
    Ok((transposed.transpose(), condition))
}

/// `(I − L C) P (I − L C)ᵀ + L V Lᵀ`.
fn correct(
    c: &DMatrix<f64>,
    gain: &DMatrix<f64>,
    predicted: &DMatrix<f64>,
    measurement: &DMatrix<f64>,
) -> DMatrix<f64> {
    let mut left = -(gain * c);
    for i in 0..left.nrows() {
        left[(i, i)] += 1.0;
    }
    let mut filtered =
        &left * (predicted * left.transpose()) + gain * (measurement * gain.transpose());
    symmetrize(&mut filtered);
    filtered
}

/// `A P Aᵀ + W`.
fn predict(
    state: usize,
    a: &DMatrix<f64>,
    filtered: &DMatrix<f64>,
    process: &DMatrix<f64>,
) -> Result<DMatrix<f64>, KalmanError> {
    let mut predicted = a * (filtered * a.transpose()) + process;
    symmetrize(&mut predicted);
    if all_finite(&predicted) {
        Ok(predicted)
    } else {
        Err(RiccatiError::Overflow { sample: state }.into())
    }
}
