//! Time-varying regulator: the Riccati recursion, backwards along a trajectory.

use nalgebra::{DMatrix, DVector};

use super::lq::LqRecursion;
use super::lq::NotConvex;
use super::lq::Stage;
use super::{RiccatiError, StageWeights, Tangent, TrajectoryWeights, all_finite};
use crate::math::sparse_map::Map;

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
pub fn finite_horizon(
    samples: &[Sample],
    weights: &TrajectoryWeights,
    values: Values,
) -> Result<FiniteHorizon, RiccatiError> {
    let (n, m) = (weights.states(), weights.inputs());
    check_steps(samples, weights)?;
    let mut recursion = LqRecursion::new(n, m);
    recursion.begin(weights.q_final(), None);
    let mut backwards = Backwards::new(m, n, samples.len(), values);
    backwards.keep(&recursion, |value| value.clone(), |linear| linear.clone());
    for (index, sample) in samples.iter().enumerate().rev() {
        check(index, sample, n, m)?;
        let stage = weights.stage(index);
        backwards.step(index, &mut recursion, &sample.a, &sample.b, stage.stage(), stage)?;
        backwards.gains.push(backwards.gain.clone());
        backwards.keep(&recursion, |value| value.clone(), |linear| linear.clone());
    }
    Ok(backwards.finish(recursion.value()))
}

/// The same on the constraint manifold: sample `k` maps from `tangents[k]` to `tangents[k + 1]`,
/// the cost counts only what the tangent space holds, and the gains act on the full state.
pub fn finite_horizon_on_manifold(
    samples: &[Sample],
    tangents: &[Tangent],
    weights: &TrajectoryWeights,
    values: Values,
) -> Result<FiniteHorizon, RiccatiError> {
    let Some((last, starts)) = tangents.split_last().filter(|(_, s)| s.len() == samples.len())
    else {
        let (samples, actual) = (samples.len(), tangents.len());
        return Err(RiccatiError::TangentCount { samples, actual });
    };
    check_steps(samples, weights)?;
    let (n, m) = (weights.states(), weights.inputs());
    last.check(samples.len(), n)?;
    let mut end = last;
    let mut recursion = LqRecursion::new(end.dimension(), m);
    recursion.begin(&end.restrict(weights.q_final()), None);
    let mut backwards = Backwards::new(m, end.dimension(), samples.len(), values);
    backwards.keep(&recursion, |p| end.extend_value(p), |b| end.extend_vector(b));
    for (index, (sample, start)) in samples.iter().zip(starts).enumerate().rev() {
        check(index, sample, n, m)?;
        start.check(index, n)?;
        if start.dimension() != end.dimension() {
            backwards.gain = DMatrix::zeros(m, start.dimension());
        }
        let a = end.reduce(&sample.a) * start.basis();
        let b = end.reduce(&sample.b);
        let weights = weights.stage(index);
        let q = start.restrict(weights.q());
        let s = weights.s().map(|s| start.reduce(s));
        let x_linear = weights.x_linear().map(|linear| start.reduce_vector(linear));
        let stage = Stage { q: &q, s: s.as_ref(), x_linear: x_linear.as_ref(), ..weights.stage() };
        backwards.step(index, &mut recursion, &a, &b, stage, weights)?;
        backwards.gains.push(start.extend_gain(&backwards.gain));
        backwards.keep(&recursion, |p| start.extend_value(p), |b| start.extend_vector(b));
        end = start;
    }
    Ok(backwards.finish(end.extend_value(&recursion.value())))
}

/// What a solution gathers, in the order in which it is found: the end of the horizon first.
struct Backwards {
    map: Map,
    gain: DMatrix<f64>,
    offset: DVector<f64>,
    gains: Vec<DMatrix<f64>>,
    feedforward: Vec<DVector<f64>>,
    values: Option<Vec<(DMatrix<f64>, DVector<f64>)>>,
    reciprocal_conditions: Vec<f64>,
}

impl Backwards {
    fn new(m: usize, n: usize, samples: usize, values: Values) -> Self {
        Self {
            map: Map::default(),
            gain: DMatrix::zeros(m, n),
            offset: DVector::zeros(m),
            gains: Vec::with_capacity(samples),
            feedforward: Vec::with_capacity(samples),
            values: (values == Values::Keep).then(|| Vec::with_capacity(samples + 1)),
            reciprocal_conditions: Vec::with_capacity(samples),
        }
    }

    /// One sample back.
    fn step(
        &mut self,
        sample: usize,
        recursion: &mut LqRecursion,
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        stage: Stage<'_>,
        weights: &StageWeights,
    ) -> Result<(), RiccatiError> {
        self.map.set(a, b);
        let Self { map, gain, offset, .. } = self;
        recursion.step(map, stage, gain, offset).map_err(|NotConvex| {
            // Convex stages lose definiteness to overflow or round-off alone.
            if weights.is_convex() || !recursion.is_finite() {
                RiccatiError::Overflow { sample }
            } else {
                RiccatiError::NotConvex { sample }
            }
        })?;
        if !recursion.is_finite() || !all_finite(&self.gain) {
            return Err(RiccatiError::Overflow { sample });
        }
        self.feedforward.push(-&self.offset);
        self.reciprocal_conditions.push(recursion.reciprocal_condition());
        Ok(())
    }

    fn keep(
        &mut self,
        recursion: &LqRecursion,
        value: impl FnOnce(&DMatrix<f64>) -> DMatrix<f64>,
        linear: impl FnOnce(&DVector<f64>) -> DVector<f64>,
    ) {
        if let Some(values) = &mut self.values {
            values.push((value(&recursion.value()), linear(recursion.linear())));
        }
    }

    fn finish(mut self, value: DMatrix<f64>) -> FiniteHorizon {
        self.gains.reverse();
        self.feedforward.reverse();
        self.reciprocal_conditions.reverse();
        if let Some(values) = &mut self.values {
            values.reverse();
        }
        if self.feedforward.iter().all(|u| u.iter().all(|&u| u == 0.0)) {
            self.feedforward = Vec::new();
        }
        FiniteHorizon {
            gains: self.gains,
            feedforward: self.feedforward,
            values: self.values,
            value,
            reciprocal_conditions: self.reciprocal_conditions,
        }
    }
}

fn check_steps(samples: &[Sample], weights: &TrajectoryWeights) -> Result<(), RiccatiError> {
    match weights.steps() {
        Some(stages) if stages != samples.len() => {
            Err(RiccatiError::StageCount { samples: samples.len(), stages })
        }
        _ => Ok(()),
    }
}

pub(super) fn check(index: usize, sample: &Sample, n: usize, m: usize) -> Result<(), RiccatiError> {
    for (matrix, name, cols) in [(&sample.a, "A", n), (&sample.b, "B", m)] {
        if matrix.shape() != (n, cols) {
            return Err(RiccatiError::Dimension {
                matrix: name,
                sample: index,
                rows: matrix.nrows(),
                cols: matrix.ncols(),
                expected_rows: n,
                expected_cols: cols,
            });
        }
        if !all_finite(matrix) {
            return Err(RiccatiError::NotFinite { matrix: name, sample: index });
        }
    }
    Ok(())
}
