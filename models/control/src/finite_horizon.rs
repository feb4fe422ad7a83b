//! Time-varying regulator: the Riccati recursion, backwards along a trajectory.

use nalgebra::{DMatrix, DVector};
use plantd_math::sparse_map::Map;

use crate::coordinates::Coordinates;
use crate::error::RiccatiError;
use crate::lq::recursion::LqRecursion;
use crate::lq::stage::{NotConvex, Stage};
use crate::manifold::Tangent;
use crate::matrix::all_finite;
use crate::weights::TrajectoryWeights;

/// The linearized map of one step, `dx[k+1] = A dx[k] + B du[k]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// `A = ∂f/∂x`, n × n.
    pub a: DMatrix<f64>,
    /// `B = ∂f/∂u`, n × m.
    pub b: DMatrix<f64>,
}

/// Whether a solution keeps the value function of each step, `n² + n` numbers each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Values {
    /// Only that of the start.
    Drop,
    /// Those of all steps.
    Keep,
}

/// A time-varying regulator.
#[derive(Clone, Debug, PartialEq)]
pub struct FiniteHorizon {
    /// `K[k]`, m × n, one per sample: `u = u_ref[k] + feedforward[k] − K[k] (x − x_ref[k])`.
    pub gains: Vec<DMatrix<f64>>,
    /// m entries, one per sample; empty when the weights have no linear terms, which means zero.
    pub feedforward: Vec<DVector<f64>>,
    /// `P[k]` and `b[k]` for k from 0 to the number of samples, when asked for: the cost to go from
    /// step k is `½ dxᵀ P dx + bᵀ dx` and a constant.
    pub values: Option<Vec<(DMatrix<f64>, DVector<f64>)>>,
    /// `P[0]`, n × n, symmetric: the cost to go from the start is `½ dxᵀ P dx`, and what linear terms
    /// add. Positive semidefinite if the weights are.
    pub value: DMatrix<f64>,
    /// Reciprocal condition in the 1-norm, at most 1, of `R + BᵀP[k + 1]B`, whose inverse makes the
    /// gain, one per sample.
    pub reciprocal_conditions: Vec<f64>,
}

/// Solves the time-varying regulator problem along the samples, in the order of time:
///
/// ```text
/// Γ = R + BᵀPB ,   K = Γ⁻¹ (BᵀPA + Sᵀ) ,   feedforward = −Γ⁻¹ (Bᵀb + u_linear)
/// P ← Q + AᵀPA − Kᵀ Γ K ,   b ← x_linear + Aᵀb + Kᵀ Γ feedforward ,   P[N] = Q_f ,   b[N] = 0
/// ```
///
/// Weights that are not convex step by step are good as long as each `Γ` is positive definite.
/// Costs at most `3n³ + 6n²m` flops per sample.
///
/// ```
/// use std::sync::Arc;
/// use plantd_control::{Sample, Values, Weights, finite_horizon};
/// use plantd_models::{Linearization, Model, Plant, Settings, builtin};
///
/// // Gains along a motion of the pendulum.
/// let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap())?);
/// let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
/// let mut linearization = Linearization::new(&model);
/// let mut samples = Vec::new();
/// for _ in 0..50 {
///     plant.step_and_linearize(&[0.1], &mut linearization)?;
///     samples.push(Sample { a: linearization.a(), b: linearization.b() });
/// }
/// let weights = Weights::diagonal(&[10.0, 1.0], &[0.5])?;
/// let regulator = finite_horizon(&samples, &weights.into(), Values::Drop)?;
/// assert_eq!(regulator.gains.len(), 50);
/// assert!(regulator.value.cholesky().is_some());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn finite_horizon(
    samples: &[Sample],
    weights: &TrajectoryWeights,
    values: Values,
) -> Result<FiniteHorizon, RiccatiError> {
    solve(samples, weights, values, |_| Coordinates(None))
}

/// The time-varying regulator on the constraint manifold: sample `k` maps from `tangents[k]` to
/// `tangents[k + 1]`, the cost counts only what the tangent space holds, and the gains act on the full
/// state.
pub fn finite_horizon_on_manifold(
    samples: &[Sample],
    tangents: &[Tangent],
    weights: &TrajectoryWeights,
    values: Values,
) -> Result<FiniteHorizon, RiccatiError> {
    if tangents.len() != samples.len() + 1 {
        let (samples, actual) = (samples.len(), tangents.len());
        return Err(RiccatiError::TangentCount { samples, actual });
    }
    solve(samples, weights, values, |k| Coordinates(tangents.get(k)))
}

/// The recursion in coordinates of each state.
fn solve<'a>(
    samples: &[Sample],
    weights: &TrajectoryWeights,
    values: Values,
    coordinates: impl Fn(usize) -> Coordinates<'a>,
) -> Result<FiniteHorizon, RiccatiError> {
    let (n, m, count) = (weights.states(), weights.inputs(), samples.len());
    if let Some(stages) = weights.steps().filter(|stages| *stages != count) {
        return Err(RiccatiError::StageCount { samples: count, stages });
    }
    let mut end = coordinates(count);
    end.check(count, n)?;
    let mut recursion = LqRecursion::new(end.dimension(n), m);
    recursion.begin(&end.restrict(weights.q_final()), None);
    let (mut map, mut offset) = (Map::default(), DVector::zeros(m));
    let mut gain = DMatrix::zeros(m, end.dimension(n));
    // Gathered as it is found: the end of the horizon first.
    let mut found = FiniteHorizon {
        gains: Vec::with_capacity(count),
        feedforward: Vec::with_capacity(count),
        values: (values == Values::Keep).then(|| Vec::with_capacity(count + 1)),
        value: DMatrix::zeros(0, 0),
        reciprocal_conditions: Vec::with_capacity(count),
    };
    found.keep(&recursion, end);
    for (index, sample) in samples.iter().enumerate().rev() {
        RiccatiError::check_map(index, (&sample.a, &sample.b), (n, m))?;
        let start = coordinates(index);
        start.check(index, n)?;
        if start.dimension(n) != gain.ncols() {
            gain = DMatrix::zeros(m, start.dimension(n));
        }
        map.set(&start.map(end, &sample.a), &end.reduce(&sample.b));
        let weights = weights.stage(index);
        let (q, s) = (start.restrict(weights.q()), weights.s().map(|s| start.reduce(s)));
        let x_linear = weights.x_linear().map(|linear| start.reduce_vector(linear));
        let stage =
            Stage { q: &q, s: s.as_deref(), x_linear: x_linear.as_deref(), ..weights.stage() };
        recursion.step(&map, stage, &mut gain, &mut offset).map_err(|NotConvex| {
            // Convex stages lose definiteness to overflow or round-off alone.
            if weights.is_convex() || !recursion.is_finite() {
                RiccatiError::Overflow { sample: index }
            } else {
                RiccatiError::NotConvex { sample: index }
            }
        })?;
        if !recursion.is_finite() || !all_finite(&gain) {
            return Err(RiccatiError::Overflow { sample: index });
        }
        found.gains.push(start.extend_gain(&gain));
        found.feedforward.push(-&offset);
        found.reciprocal_conditions.push(recursion.reciprocal_condition());
        found.keep(&recursion, start);
        end = start;
    }
    found.value = end.extend_value(&recursion.value());
    found.reverse();
    Ok(found)
}

impl FiniteHorizon {
    fn keep(&mut self, recursion: &LqRecursion, at: Coordinates<'_>) {
        if let Some(values) = &mut self.values {
            let value = at.extend_value(&recursion.value());
            values.push((value, at.extend_vector(recursion.linear())));
        }
    }

    /// From the start of the horizon to its end.
    fn reverse(&mut self) {
        self.gains.reverse();
        self.feedforward.reverse();
        self.reciprocal_conditions.reverse();
        if let Some(values) = &mut self.values {
            values.reverse();
        }
        if self.feedforward.iter().all(|u| u.iter().all(|&u| u == 0.0)) {
            self.feedforward = Vec::new();
        }
    }
}
