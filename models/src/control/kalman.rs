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

use nalgebra::{Complex, DMatrix};

use super::infinite_horizon::solve_without_cross;
use super::lq::reciprocal_condition;
use super::weights::check_symmetric;
use super::{
    RiccatiError, Sample, Tangent, Values, WeightsError, all_finite, finite_horizon,
    is_positive_semidefinite, symmetrize,
};

/// Covariances of white noise, per step.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseCovariances {
    process: Option<DMatrix<f64>>,
    input: Option<DMatrix<f64>>,
    measurement: DMatrix<f64>,
}

impl NoiseCovariances {
    /// `process` of the state, n × n, and `input` of the inputs, m × m, are symmetric positive
    /// semidefinite and zero when not given; `measurement`, r × r, is symmetric positive definite.
    pub fn new(
        process: Option<DMatrix<f64>>,
        input: Option<DMatrix<f64>>,
        mut measurement: DMatrix<f64>,
    ) -> Result<Self, NoiseError> {
        let process = process.map(|m| semidefinite("process", m)).transpose()?;
        let input = input.map(|m| semidefinite("input", m)).transpose()?;
        check("measurement", &mut measurement)?;
        if !measurement.is_empty() && measurement.clone().cholesky().is_none() {
            return Err(NoiseError::NotPositiveDefinite);
        }
        Ok(Self { process, input, measurement })
    }

    /// Of the state.
    pub fn process(&self) -> Option<&DMatrix<f64>> {
        self.process.as_ref()
    }
    /// Of the inputs.
    pub fn input(&self) -> Option<&DMatrix<f64>> {
        self.input.as_ref()
    }
    /// Of what is measured.
    pub fn measurement(&self) -> &DMatrix<f64> {
        &self.measurement
    }

    /// Refuses covariances of other numbers of states, inputs and outputs.
    fn check(&self, states: usize, inputs: usize, outputs: usize) -> Result<(), KalmanError> {
        let covariances = [
            ("process", self.process.as_ref(), states),
            ("input", self.input.as_ref(), inputs),
            ("measurement", Some(&self.measurement), outputs),
        ];
        for (covariance, given, expected) in covariances {
            if let Some(size) = given.map(DMatrix::nrows).filter(|&size| size != expected) {
                return Err(NoiseError::Dimension { covariance, size, expected }.into());
            }
        }
        Ok(())
    }

    /// `process + B input Bᵀ`.
    fn of_step(&self, b: &DMatrix<f64>) -> DMatrix<f64> {
        let n = b.nrows();
        let mut sum = self.process.clone().unwrap_or_else(|| DMatrix::zeros(n, n));
        if let Some(input) = &self.input {
            sum += b * (input * b.transpose());
        }
        symmetrize(&mut sum);
        sum
    }
}

/// Why covariances were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoiseError {
    /// A covariance is of another size than needed.
    #[error("covariance {covariance} is {size} x {size}; {expected} x {expected} is needed")]
    Dimension {
        /// `process`, `input`, `measurement` or `initial_covariance`.
        covariance: &'static str,
        /// Rows and columns.
        size: usize,
        /// Rows and columns that are needed.
        expected: usize,
    },
    /// A covariance is not square, not finite or not symmetric.
    #[error("covariance {covariance}: {problem}")]
    Malformed {
        /// As above.
        covariance: &'static str,
        /// What is wrong with it, and where.
        problem: String,
    },
    /// A covariance has a negative eigenvalue.
    #[error("covariance {covariance} has a negative eigenvalue")]
    Negative {
        /// As above.
        covariance: &'static str,
    },
    /// `measurement` has an eigenvalue that is not greater than zero.
    #[error(
        "covariance measurement is not positive definite; each output needs some noise, and no two \
         outputs the same"
    )]
    NotPositiveDefinite,
}

impl NoiseError {
    /// The covariance at fault: `process`, `input`, `measurement` or `initial_covariance`.
    pub fn covariance(&self) -> &'static str {
        match self {
            Self::Dimension { covariance, .. }
            | Self::Malformed { covariance, .. }
            | Self::Negative { covariance } => covariance,
            Self::NotPositiveDefinite => "measurement",
        }
    }
}

/// Why there is no filter.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum KalmanError {
    /// A covariance does not fit.
    #[error(transparent)]
    Noise(#[from] NoiseError),
    /// A mode that does not decay by itself does not show in the outputs.
    #[error(
        "not detectable: no output shows the mode with eigenvalue {real:+.6} {imaginary:+.6}i (modulus {modulus:.6}); measure something that moves with it"
    )]
    NotDetectable {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
        /// Modulus, about 1 or greater.
        modulus: f64,
    },
    /// A mode on the unit circle gets no noise, so that the best filter stops listening to it.
    #[error(
        "no process noise reaches the mode with eigenvalue {real:+.6} {imaginary:+.6}i on the unit circle: the filter would stop correcting it; give process or input noise that moves it"
    )]
    NotExcited {
        /// Real part of the eigenvalue of `A`.
        real: f64,
        /// Imaginary part.
        imaginary: f64,
    },
    /// Lists along a trajectory have other lengths than needed.
    #[error("{list} has {actual} entries for {samples} steps; {expected} are needed")]
    Count {
        /// `outputs`, `noise` or `tangents`.
        list: &'static str,
        /// Steps.
        samples: usize,
        /// Entries.
        actual: usize,
        /// Entries that are needed: `1 or ` the number of states, or the number of states.
        expected: String,
    },
    /// The matrices, or the numerical solution.
    #[error(transparent)]
    Riccati(RiccatiError),
}

impl From<RiccatiError> for KalmanError {
    /// In the words of filters: the dual problem's inputs are the outputs.
    fn from(error: RiccatiError) -> Self {
        match error {
            RiccatiError::NotStabilisable { real, imaginary, modulus } => {
                Self::NotDetectable { real, imaginary, modulus }
            }
            RiccatiError::NotDetectable { real, imaginary } => Self::NotExcited { real, imaginary },
            other => Self::Riccati(other),
        }
    }
}

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
    /// Relative residual of the Riccati equation, as in [`Regulator`](super::Regulator).
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
/// [`infinite_horizon`](super::infinite_horizon).
pub fn steady_state_kalman(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    c: &DMatrix<f64>,
    noise: &NoiseCovariances,
) -> Result<Kalman, KalmanError> {
    check_map(a, b, c, noise)?;
    solve(a, c, &noise.of_step(b), noise.measurement())
}

/// The same on the constraint manifold, at an equilibrium with that tangent space: noise counts only
/// as far as the tangent space holds it, corrections keep to the manifold, and the error's modes leave
/// out directions off it.
pub fn steady_state_kalman_on_manifold(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    c: &DMatrix<f64>,
    tangent: &Tangent,
    noise: &NoiseCovariances,
) -> Result<Kalman, KalmanError> {
    check_map(a, b, c, noise)?;
    tangent.check(0, a.nrows())?;
    let process = tangent.restrict(&noise.of_step(b));
    let (a, c) = (tangent.restrict_map(a), c * tangent.basis());
    let reduced = solve(&a, &c, &process, noise.measurement())?;
    Ok(Kalman {
        gain: tangent.basis() * &reduced.gain,
        predicted: tangent.extend_value(&reduced.predicted),
        filtered: tangent.extend_value(&reduced.filtered),
        ..reduced
    })
}

fn solve(
    a: &DMatrix<f64>,
    c: &DMatrix<f64>,
    process: &DMatrix<f64>,
    measurement: &DMatrix<f64>,
) -> Result<Kalman, KalmanError> {
    let dual = solve_without_cross(&a.transpose(), &c.transpose(), process, measurement)?;
    let (gain, reciprocal_condition) =
        correction(c, &dual.value, measurement).ok_or(RiccatiError::Overflow { sample: 0 })?;
    let filtered = correct(c, &gain, &dual.value, measurement);
    Ok(Kalman {
        gain,
        predicted: dual.value,
        filtered,
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
    let problem = Problem::new(samples, outputs, noise, initial)?;
    let mut forwards = Forwards::new(samples.len() + 1, covariances);
    let mut predicted = problem.initial.clone();
    for state in 0..=samples.len() {
        let (c, noise) = (problem.output(state)?, problem.noise(state));
        let step = forwards.correct(state, c, &predicted, noise)?;
        forwards.keep(&predicted, &step.filtered, DMatrix::clone);
        forwards.gains.push(step.gain);
        if let Some(sample) = problem.sample(state)? {
            predicted = predict(state, &sample.a, &step.filtered, &noise.of_step(&sample.b))?;
        }
    }
    Ok(forwards.finish())
}

/// The same on the constraint manifold: `tangents` has the tangent space of each state.
pub fn time_varying_kalman_on_manifold(
    samples: &[Sample],
    outputs: &[DMatrix<f64>],
    tangents: &[Tangent],
    noise: &[NoiseCovariances],
    initial: &DMatrix<f64>,
    covariances: Values,
) -> Result<KalmanTrajectory, KalmanError> {
    let problem = Problem::new(samples, outputs, noise, initial)?;
    let states = samples.len() + 1;
    if tangents.len() != states {
        let (samples, actual) = (samples.len(), tangents.len());
        return Err(RiccatiError::TangentCount { samples, actual }.into());
    }
    for (state, tangent) in tangents.iter().enumerate() {
        tangent.check(state, initial.nrows())?;
    }
    let mut forwards = Forwards::new(states, covariances);
    let mut predicted = tangents[0].restrict(&problem.initial);
    for (state, tangent) in tangents.iter().enumerate() {
        let (c, noise) = (problem.output(state)? * tangent.basis(), problem.noise(state));
        let step = forwards.correct(state, &c, &predicted, noise)?;
        forwards.keep(&predicted, &step.filtered, |p| tangent.extend_value(p));
        forwards.gains.push(tangent.basis() * step.gain);
        if let Some(sample) = problem.sample(state)? {
            let next = &tangents[state + 1];
            let a = next.reduce(&sample.a) * tangent.basis();
            let process = next.restrict(&noise.of_step(&sample.b));
            predicted = predict(state, &a, &step.filtered, &process)?;
        }
    }
    Ok(forwards.finish())
}

/// A problem along a trajectory, with lists of the right lengths.
struct Problem<'a> {
    samples: &'a [Sample],
    outputs: &'a [DMatrix<f64>],
    noise: &'a [NoiseCovariances],
    initial: DMatrix<f64>,
}

impl<'a> Problem<'a> {
    fn new(
        samples: &'a [Sample],
        outputs: &'a [DMatrix<f64>],
        noise: &'a [NoiseCovariances],
        initial: &DMatrix<f64>,
    ) -> Result<Self, KalmanError> {
        let states = samples.len() + 1;
        for (list, actual) in [("outputs", outputs.len()), ("noise", noise.len())] {
            if actual != 1 && actual != states {
                let (samples, expected) = (samples.len(), format!("1 or {states}"));
                return Err(KalmanError::Count { list, samples, actual, expected });
            }
        }
        let initial = semidefinite("initial_covariance", initial.clone())?;
        Ok(Self { samples, outputs, noise, initial })
    }

    fn noise(&self, state: usize) -> &'a NoiseCovariances {
        &self.noise[if self.noise.len() == 1 { 0 } else { state }]
    }

    /// `C` of a state, with the noise there checked too.
    fn output(&self, state: usize) -> Result<&'a DMatrix<f64>, KalmanError> {
        let c = &self.outputs[if self.outputs.len() == 1 { 0 } else { state }];
        let (noise, n) = (self.noise(state), self.initial.nrows());
        check_output(state, c, n)?;
        let nearest = self.samples.get(state).or(self.samples.last());
        let any = noise.input.as_ref().map_or(0, DMatrix::nrows);
        let inputs = nearest.map_or(any, |sample| sample.b.ncols());
        noise.check(n, inputs, c.nrows())?;
        Ok(c)
    }

    /// The map from a state to the next.
    fn sample(&self, state: usize) -> Result<Option<&'a Sample>, KalmanError> {
        let Some(sample) = self.samples.get(state) else { return Ok(None) };
        finite_horizon::check(state, sample, self.initial.nrows(), sample.b.ncols())?;
        Ok(Some(sample))
    }
}

/// What a solution gathers.
struct Forwards {
    gains: Vec<DMatrix<f64>>,
    covariances: Option<Vec<(DMatrix<f64>, DMatrix<f64>)>>,
    reciprocal_conditions: Vec<f64>,
}

struct Correction {
    gain: DMatrix<f64>,
    filtered: DMatrix<f64>,
}

impl Forwards {
    fn new(states: usize, covariances: Values) -> Self {
        Self {
            gains: Vec::with_capacity(states),
            covariances: (covariances == Values::Keep).then(|| Vec::with_capacity(states)),
            reciprocal_conditions: Vec::with_capacity(states),
        }
    }

    fn correct(
        &mut self,
        state: usize,
        c: &DMatrix<f64>,
        predicted: &DMatrix<f64>,
        noise: &NoiseCovariances,
    ) -> Result<Correction, KalmanError> {
        let (gain, reciprocal_condition) = correction(c, predicted, noise.measurement())
            .ok_or(RiccatiError::Overflow { sample: state })?;
        self.reciprocal_conditions.push(reciprocal_condition);
        let filtered = correct(c, &gain, predicted, noise.measurement());
        Ok(Correction { gain, filtered })
    }

    fn keep(
        &mut self,
        predicted: &DMatrix<f64>,
        filtered: &DMatrix<f64>,
        full: impl Fn(&DMatrix<f64>) -> DMatrix<f64>,
    ) {
        if let Some(covariances) = &mut self.covariances {
            covariances.push((full(predicted), full(filtered)));
        }
    }

    fn finish(self) -> KalmanTrajectory {
        let Self { gains, covariances, reciprocal_conditions } = self;
        KalmanTrajectory { gains, covariances, reciprocal_conditions }
    }
}

/// `P Cᵀ (C P Cᵀ + V)⁻¹` and the reciprocal condition of the bracket, or nothing if that is not
/// positive definite in floating point.
fn correction(
    c: &DMatrix<f64>,
    predicted: &DMatrix<f64>,
    measurement: &DMatrix<f64>,
) -> Option<(DMatrix<f64>, f64)> {
    let seen = c * predicted;
    let mut innovation = &seen * c.transpose() + measurement;
    symmetrize(&mut innovation);
    let factor = innovation.cholesky()?;
    let gain = factor.solve(&seen).transpose();
    all_finite(&gain).then(|| (gain, reciprocal_condition(&factor.l())))
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

fn check_map(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    c: &DMatrix<f64>,
    noise: &NoiseCovariances,
) -> Result<(), KalmanError> {
    let sample = Sample { a: a.clone(), b: b.clone() };
    finite_horizon::check(0, &sample, a.nrows(), b.ncols())?;
    check_output(0, c, a.nrows())?;
    noise.check(a.nrows(), b.ncols(), c.nrows())
}

fn check_output(sample: usize, c: &DMatrix<f64>, n: usize) -> Result<(), KalmanError> {
    let (rows, cols) = c.shape();
    if cols != n {
        let (expected_rows, expected_cols) = (rows, n);
        let matrix = "C";
        return Err(RiccatiError::Dimension {
            matrix,
            sample,
            rows,
            cols,
            expected_rows,
            expected_cols,
        }
        .into());
    }
    if all_finite(c) { Ok(()) } else { Err(RiccatiError::NotFinite { matrix: "C", sample }.into()) }
}

fn check(covariance: &'static str, m: &mut DMatrix<f64>) -> Result<(), NoiseError> {
    let size = m.nrows();
    check_symmetric(covariance, m, size).map_err(|error| {
        let problem = match error {
            WeightsError::Dimension { rows, cols, .. } => format!("is {rows} x {cols}, not square"),
            WeightsError::NotFinite { row, col, .. } => {
                format!("the number in row {row}, column {col} is not finite")
            }
            WeightsError::NotSymmetric { row, col, .. } => {
                format!("is not symmetric in row {row}, column {col}")
            }
            other => other.to_string(),
        };
        NoiseError::Malformed { covariance, problem }
    })
}

fn semidefinite(covariance: &'static str, mut m: DMatrix<f64>) -> Result<DMatrix<f64>, NoiseError> {
    check(covariance, &mut m)?;
    if is_positive_semidefinite(&m) { Ok(m) } else { Err(NoiseError::Negative { covariance }) }
}
