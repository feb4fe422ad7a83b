//! Weights of the cost.

pub(crate) mod error;
#[cfg(test)]
mod tests;

use std::ops::Deref;

use nalgebra::{DMatrix, DVector};

use crate::lq::stage::Stage;
use crate::matrix::{congruent, is_positive_semidefinite, not_finite, symmetrize};
use crate::weights::error::WeightsError;

/// Asymmetry, relative to the largest entry, that counts as round-off of whoever made the matrix.
const ASYMMETRY: f64 = 1e-9;
/// What rounding may take from the least eigenvalue of `Q − S R⁻¹ Sᵀ` where `Q` has a unit diagonal.
const CROSS_ROUND_OFF: f64 = 1e-12;

/// Weights of one step,
///
/// ```text
/// ½ xᵀQx + xᵀSu + ½ uᵀRu + x_linearᵀ x + u_linearᵀ u
/// ```
///
/// with `Q` n × n, `R` m × m, `S` n × m; what is not given is zero.
#[derive(Clone, Debug, PartialEq)]
pub struct StageWeights {
    q: DMatrix<f64>,
    r: DMatrix<f64>,
    s: Option<DMatrix<f64>>,
    x_linear: Option<DVector<f64>>,
    u_linear: Option<DVector<f64>>,
    /// Checked to be convex, with `R` positive definite.
    is_convex: bool,
}

/// Weights of `Σ ½ xᵀQx + xᵀSu + ½ uᵀRu` with `½ xᵀ Q_f x` at the end of a finite horizon.
///
/// `Q` and `Q_f` are symmetric positive semidefinite, `R` is symmetric positive definite, and so
/// that no step is worth less than nothing, `Q − S R⁻¹ Sᵀ` is positive semidefinite; the
/// constructors see to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    stage: StageWeights,
    q_final: DMatrix<f64>,
}

/// Weights along a trajectory: constant or each step its own, with `½ xᵀ Q_f x` at the
/// end.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryWeights {
    /// One, or one for each step.
    stages: Vec<StageWeights>,
    is_constant: bool,
    q_final: DMatrix<f64>,
}

/// Which momentum weights weigh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Momentum {
    /// The state's own.
    #[default]
    State,
    /// The projected one, [`Plant::projected_momentum`](plantd_models::Plant::projected_momentum). Without
    /// constraints it is the state's own.
    Projected,
}

impl StageWeights {
    /// Convex weights of a step for as many states as `q` has rows and as many inputs as `r` has:
    /// `R` is positive definite and `Q − S R⁻¹ Sᵀ` positive semidefinite.
    pub fn new(
        q: DMatrix<f64>,
        r: DMatrix<f64>,
        s: Option<DMatrix<f64>>,
        x_linear: Option<DVector<f64>>,
        u_linear: Option<DVector<f64>>,
    ) -> Result<Self, WeightsError> {
        let mut stage = Self::symmetric(q, r, s, x_linear, u_linear)?;
        stage.check_convex()?;
        stage.is_convex = true;
        Ok(stage)
    }

    /// Weights that need not be convex: shapes, symmetry of `Q` and `R`, and finiteness are all that
    /// is checked. For problems that are convex as a whole.
    pub fn symmetric(
        mut q: DMatrix<f64>,
        mut r: DMatrix<f64>,
        s: Option<DMatrix<f64>>,
        x_linear: Option<DVector<f64>>,
        u_linear: Option<DVector<f64>>,
    ) -> Result<Self, WeightsError> {
        let (states, inputs) = (q.nrows(), r.nrows());
        check_symmetric("q", &mut q, states)?;
        check_symmetric("r", &mut r, inputs)?;
        if let Some(s) = &s {
            check_entries("s", s.shape(), (states, inputs), s.as_slice())?;
        }
        for (weight, linear, size) in
            [("x_linear", &x_linear, states), ("u_linear", &u_linear, inputs)]
        {
            if let Some(linear) = linear {
                check_entries(weight, linear.shape(), (size, 1), linear.as_slice())?;
            }
        }
        Ok(Self { q, r, s, x_linear, u_linear, is_convex: false })
    }

    fn check_convex(&self) -> Result<(), WeightsError> {
        if !is_positive_semidefinite(&self.q) {
            return Err(WeightsError::Negative { weight: "q" });
        }
        if self.inputs() == 0 {
            return Ok(());
        }
        let factor = self.r.clone().cholesky().ok_or(WeightsError::NotPositiveDefinite)?;
        let Some(s) = &self.s else { return Ok(()) };
        // In units in which q's diagonal is one, since s may span as many decades as q.
        let scales = self.q.diagonal().map(|d| if d > 0.0 { d.sqrt().recip() } else { 1.0 });
        let mut scaled_s = s.clone();
        let mut schur = self.q.clone();
        for row in 0..schur.nrows() {
            scaled_s.row_mut(row).scale_mut(scales[row]);
            schur.row_mut(row).scale_mut(scales[row]);
            schur.column_mut(row).scale_mut(scales[row]);
        }
        schur -= &scaled_s * factor.solve(&scaled_s.transpose());
        for row in 0..schur.nrows() {
            schur[(row, row)] += CROSS_ROUND_OFF;
            // A state without weight must have no cross term.
            if self.q[(row, row)] == 0.0 && scaled_s.row(row).amax() > 0.0 {
                return Err(WeightsError::CrossTooLarge);
            }
        }
        symmetrize(&mut schur);
        schur.cholesky().map(|_| ()).ok_or(WeightsError::CrossTooLarge)
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.q.nrows()
    }
    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.r.nrows()
    }
    /// State weight `Q`.
    pub fn q(&self) -> &DMatrix<f64> {
        &self.q
    }
    /// Input weight `R`.
    pub fn r(&self) -> &DMatrix<f64> {
        &self.r
    }
    /// Cross term `S`, states × inputs.
    pub fn s(&self) -> Option<&DMatrix<f64>> {
        self.s.as_ref()
    }
    /// Linear term of the state.
    pub fn x_linear(&self) -> Option<&DVector<f64>> {
        self.x_linear.as_ref()
    }
    /// Linear term of the input.
    pub fn u_linear(&self) -> Option<&DVector<f64>> {
        self.u_linear.as_ref()
    }
    /// Whether [`StageWeights::new`] or [`Weights`] saw that the stage is convex.
    pub fn is_convex(&self) -> bool {
        self.is_convex
    }

    /// As the recursion takes them.
    pub(crate) fn stage(&self) -> Stage<'_> {
        Stage {
            q: &self.q,
            r: &self.r,
            s: self.s.as_ref(),
            x_linear: self.x_linear.as_ref(),
            u_linear: self.u_linear.as_ref(),
        }
    }
}

impl Weights {
    /// Weights for as many states as `q` has rows and as many inputs as `r` has; `q_final` is `q`
    /// when not given.
    pub fn new(
        q: DMatrix<f64>,
        r: DMatrix<f64>,
        q_final: Option<DMatrix<f64>>,
    ) -> Result<Self, WeightsError> {
        let stage = StageWeights::new(q, r, None, None, None)?;
        let q_final = match q_final {
            None => stage.q.clone(),
            Some(q_final) => check_final(q_final, stage.states())?,
        };
        Ok(Self { stage, q_final })
    }

    /// Diagonal weights, with `q_final = q`.
    pub fn diagonal(q: &[f64], r: &[f64]) -> Result<Self, WeightsError> {
        let matrix = |d: &[f64]| DMatrix::from_diagonal(&DVector::from_column_slice(d));
        Self::new(matrix(q), matrix(r), None)
    }

    /// These weights with the cross term `xᵀSu`, `S` states × inputs.
    pub fn with_cross(self, s: DMatrix<f64>) -> Result<Self, WeightsError> {
        let StageWeights { q, r, .. } = self.stage;
        let stage = StageWeights::new(q, r, Some(s), None, None)?;
        Ok(Self { stage, q_final: self.q_final })
    }

    /// Weights of a system with `states` and `inputs`, or the dimension that does not fit.
    pub fn for_system(self, states: usize, inputs: usize) -> Result<Self, WeightsError> {
        self.stage.check_system(states, inputs)?;
        Ok(self)
    }

    /// Weights of `x` in place of those of `y`, where `dy = T dx`: `TᵀQT`, `TᵀS` and `Tᵀ Q_f T`, with `T`
    /// square. For [`Momentum::Projected`], `T` is
    /// [`Plant::projection_by_state`](plantd_models::Plant::projection_by_state). Refuses another size, and numbers
    /// that are not finite. Costs `4 n³`.
    pub fn pull_back(&self, t: &DMatrix<f64>) -> Result<Self, WeightsError> {
        let stage = self.stage.pull_back(t)?;
        Ok(Self { stage, q_final: congruent(t, &self.q_final) })
    }

    /// Weights of each step.
    pub fn stage(&self) -> &StageWeights {
        &self.stage
    }
    /// Final weight `Q_f`.
    pub fn q_final(&self) -> &DMatrix<f64> {
        &self.q_final
    }
}

/// The weights of each step.
impl Deref for Weights {
    type Target = StageWeights;

    fn deref(&self) -> &StageWeights {
        &self.stage
    }
}

impl StageWeights {
    /// Stays convex if it is.
    fn pull_back(&self, t: &DMatrix<f64>) -> Result<Self, WeightsError> {
        let n = self.states();
        check_entries("q", t.shape(), (n, n), t.as_slice())?;
        Ok(Self {
            q: congruent(t, &self.q),
            r: self.r.clone(),
            s: self.s.as_ref().map(|s| t.tr_mul(s)),
            x_linear: self.x_linear.as_ref().map(|linear| t.tr_mul(linear)),
            u_linear: self.u_linear.clone(),
            is_convex: self.is_convex,
        })
    }

    pub(crate) fn check_system(&self, states: usize, inputs: usize) -> Result<(), WeightsError> {
        for (weight, size, expected) in [("q", self.states(), states), ("r", self.inputs(), inputs)]
        {
            if size != expected {
                return Err(WeightsError::Dimension {
                    weight,
                    rows: size,
                    cols: size,
                    expected_rows: expected,
                    expected_cols: expected,
                });
            }
        }
        Ok(())
    }
}

impl TrajectoryWeights {
    /// Constant weights; `q_final` is `stage.q` when not given, and positive
    /// semidefinite either way.
    pub fn constant(
        stage: StageWeights,
        q_final: Option<DMatrix<f64>>,
    ) -> Result<Self, WeightsError> {
        let q_final = q_final.unwrap_or_else(|| stage.q.clone());
        let q_final = check_final(q_final, stage.states())?;
        Ok(Self { stages: vec![stage], is_constant: true, q_final })
    }

    /// Each step its own weights, all of the same numbers of states and inputs, with a positive
    /// semidefinite `q_final`.
    pub fn per_step(
        stages: Vec<StageWeights>,
        q_final: DMatrix<f64>,
    ) -> Result<Self, WeightsError> {
        let first = stages.first().ok_or(WeightsError::NoSteps)?;
        let (states, inputs) = (first.states(), first.inputs());
        for (step, stage) in stages.iter().enumerate() {
            stage
                .check_system(states, inputs)
                .map_err(|error| WeightsError::Step { step, error: Box::new(error) })?;
        }
        let q_final = check_final(q_final, states)?;
        Ok(Self { stages, is_constant: false, q_final })
    }

    /// Weights of `x` in place of those of `y`, where `dy = T[k] dx` at step `k`: [`Weights::pull_back`]
    /// with a `T` of each step and of the end. Refuses another number of steps, too.
    pub fn pull_back(&self, t: &[DMatrix<f64>]) -> Result<Self, WeightsError> {
        let (last, t) = t.split_last().ok_or(WeightsError::NoSteps)?;
        if let Some(weights) = self.steps().filter(|weights| *weights != t.len()) {
            return Err(WeightsError::Steps { weights, steps: t.len() });
        }
        let n = self.states();
        check_entries("q_final", last.shape(), (n, n), last.as_slice())?;
        let stages = t.iter().enumerate().map(|(k, t)| self.stage(k).pull_back(t));
        let stages = stages.collect::<Result<_, _>>()?;
        Ok(Self { stages, is_constant: false, q_final: congruent(last, &self.q_final) })
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.q_final.nrows()
    }
    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.stages.first().map_or(0, StageWeights::inputs)
    }
    /// Number of steps; none when the weights are the same at each.
    pub fn steps(&self) -> Option<usize> {
        (!self.is_constant).then_some(self.stages.len())
    }
    /// Weights of step `k`.
    ///
    /// # Panics
    /// If each step has its own and there is no step `k`.
    pub fn stage(&self, k: usize) -> &StageWeights {
        &self.stages[if self.is_constant { 0 } else { k }]
    }
    /// Final weight `Q_f`.
    pub fn q_final(&self) -> &DMatrix<f64> {
        &self.q_final
    }
}

impl From<Weights> for TrajectoryWeights {
    fn from(weights: Weights) -> Self {
        Self { stages: vec![weights.stage], is_constant: true, q_final: weights.q_final }
    }
}

impl From<&Weights> for TrajectoryWeights {
    fn from(weights: &Weights) -> Self {
        weights.clone().into()
    }
}

fn check_final(mut q_final: DMatrix<f64>, states: usize) -> Result<DMatrix<f64>, WeightsError> {
    check_symmetric("q_final", &mut q_final, states)?;
    if !is_positive_semidefinite(&q_final) {
        return Err(WeightsError::Negative { weight: "q_final" });
    }
    Ok(q_final)
}

/// Checks shape and finiteness of a matrix whose columns follow one another in `entries`.
fn check_entries(
    weight: &'static str,
    (rows, cols): (usize, usize),
    (expected_rows, expected_cols): (usize, usize),
    entries: &[f64],
) -> Result<(), WeightsError> {
    if (rows, cols) != (expected_rows, expected_cols) {
        return Err(WeightsError::Dimension { weight, rows, cols, expected_rows, expected_cols });
    }
    match not_finite(entries, rows) {
        Some((row, col)) => Err(WeightsError::NotFinite { weight, row, col }),
        None => Ok(()),
    }
}

/// Checks a square matrix and takes its symmetric part.
pub(super) fn check_symmetric(
    weight: &'static str,
    m: &mut DMatrix<f64>,
    expected: usize,
) -> Result<(), WeightsError> {
    check_entries(weight, m.shape(), (expected, expected), m.as_slice())?;
    let tolerance = ASYMMETRY * if expected > 0 { m.amax() } else { 0.0 };
    for col in 0..expected {
        for row in 0..col {
            if (m[(row, col)] - m[(col, row)]).abs() > tolerance {
                return Err(WeightsError::NotSymmetric { weight, row, col });
            }
        }
    }
    symmetrize(m);
    Ok(())
}
