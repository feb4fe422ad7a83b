//! References from outside: discrete configuration trajectories of any planner, compared with the motions
//! of the plant, and replaced by one that follows them. Wholly in discrete time: nothing is
//! differentiated or interpolated.
//!
//! A row `q[k]` every time step is a motion of the plant if the discrete Euler-Lagrange equations hold
//! at each inner row,
//!
//! ```text
//! r[k] = p⁺[k] − p⁻[k] = Dh(q[k])ᵀ λ[k]
//! p⁺[k] = D2 Ld(q[k−1], q[k]) + F⁺(u[k−1])        the momentum that it arrives with
//! p⁻[k] = −D1 Ld(q[k], q[k+1]) − F⁻(u[k])         the momentum that it leaves with
//! ```
//!
//! and the constraints, `h(q[k]) = 0`, at every row. Where no inputs are given, those that explain the
//! most are found by least squares over the whole trajectory, in the norm of kinetic energy
//! (`rᵀ M⁻¹ r`, so that units do not matter); multipliers explain what they can, and what is left is
//! **unexplained**: a force that nobody exerts.
//!
//! Configurations alone do not determine everything. The momentum at the start is free, and takes up
//! whatever the first input exerts at the start of its step; with the symmetric split of forces an input
//! that alternates from step to step changes momenta only. Of all inputs that explain the motion equally
//! well those that change least from step to step are taken.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use plantd_math::null_space::tangent_basis;
use plantd_models::{
    Initial, InitialError, KnownStep, Linearization, Plant, Spare, State, StepError,
};

use crate::error::RiccatiError;
use crate::finite_horizon::{Sample, Values, finite_horizon, finite_horizon_on_manifold};
use crate::manifold::Tangent;
use crate::matrix::not_finite;
use crate::weights::Weights;
use crate::weights::error::WeightsError;

/// Weight of changes of the inputs, relative to what they explain: decides only between inputs that
/// explain a motion equally well.
const SMOOTHNESS: f64 = 1e-12;
/// Corrections of the least squares, after which smoothness has no say in what can be explained.
const CORRECTIONS: usize = 4;
/// What is added to the mass matrix, relative to its largest diagonal entry, where a coordinate has no
/// mass.
const MASSLESS: f64 = 1e-12;
/// Singular values of a constraint Jacobian below this, relative to the largest, are redundant.
const REDUNDANT: f64 = 1e-10;

/// Why a reference was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReferenceError {
    /// A matrix has the wrong shape.
    #[error("{what} is {rows} x {cols}; {expected_rows} x {expected_cols} is needed")]
    Dimension {
        /// `q` or `u`.
        what: &'static str,
        /// Rows it has.
        rows: usize,
        /// Columns it has.
        cols: usize,
        /// Rows that are needed.
        expected_rows: usize,
        /// Columns that are needed.
        expected_cols: usize,
    },
    /// The period of the plant has several steps or stages.
    #[error("a reference is compared with steps of order 2; the plant takes others")]
    Method,
    /// There is no step between the rows.
    #[error("q has {rows} rows; at least two are needed")]
    TooShort {
        /// Rows it has.
        rows: usize,
    },
    /// A number is NaN or infinite.
    #[error("{what} holds a number that is not finite in row {row}, column {col}")]
    NotFinite {
        /// `q` or `u`.
        what: &'static str,
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        col: usize,
    },
    /// The map has no derivatives at a step of the reference.
    #[error("step {step} of the reference cannot be linearized: {error}")]
    Linearization {
        /// The step.
        step: usize,
        /// Why.
        error: StepError,
    },
    /// Weights of the regulator have another size.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// There is no regulator about the reference.
    #[error("no regulator about the reference: {0}")]
    Regulator(#[from] RiccatiError),
    /// No motion can begin where the reference does.
    #[error("no motion begins at the first row of the reference: {0}")]
    Initial(#[from] InitialError),
    /// The motion that follows the reference ends.
    #[error(
        "the motion that follows the reference ends at step {step}: {error}; slow the reference down, or give the regulator other weights"
    )]
    Step {
        /// The step.
        step: usize,
        /// Why.
        error: StepError,
    },
}

/// How a configuration trajectory compares with the motions of the plant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Assessment {
    /// Largest violation `|h(q[k])|` of a constraint, in its unit. Inputs that prescribe other positions
    /// than `q` has count as well.
    pub constraint_violation: f64,
    /// The row.
    pub constraint_violation_step: usize,
    /// Name of the constraint, or of the prescribed coordinate; empty without any.
    pub constraint: String,
    /// Largest entry of a generalized force that neither inputs nor constraints exert, N or N·m.
    pub unexplained_force: f64,
    /// The row of that force.
    pub unexplained_force_step: usize,
    /// The coordinate of that entry; empty where nothing is left to explain.
    pub unexplained_force_coordinate: String,
    /// Largest acceleration that such a force makes, m/s² or rad/s².
    pub unexplained_acceleration: f64,
    /// The row of that acceleration.
    pub unexplained_step: usize,
    /// Its coordinate.
    pub unexplained_coordinate: String,
    /// Row k is `u[k]`: given, or those that fit best; n rows of ni + nk.
    pub inputs: DMatrix<f64>,
    /// Row k is `x[k] = (q, p, v)`, with the momentum that it leaves with; n + 1 rows of 2 nd + 2 nk.
    pub states: DMatrix<f64>,
    /// Row k is `λ[k]`; n rows of nc.
    pub multipliers: DMatrix<f64>,
}

impl Assessment {
    /// Whether unexplained acceleration and violation are at most `tolerance`.
    pub fn is_feasible(&self, tolerance: f64) -> bool {
        self.unexplained_acceleration <= tolerance && self.constraint_violation <= tolerance
    }
}

/// A motion of the plant that follows a reference.
#[derive(Clone, Debug, PartialEq)]
pub struct Projected {
    /// Initial state.
    pub initial: State,
    /// Row k is `u[k]`.
    pub inputs: DMatrix<f64>,
    /// Row k is `x[k]`; n + 1 rows.
    pub states: DMatrix<f64>,
    /// Largest difference in a coordinate between the motion and the reference, m or rad.
    pub deviation: f64,
    /// The row.
    pub deviation_step: usize,
    /// The coordinate.
    pub deviation_coordinate: String,
}

/// A row of a matrix.
fn row(matrix: &DMatrix<f64>, k: usize) -> Vec<f64> {
    matrix.row(k).iter().copied().collect()
}

fn check(
    what: &'static str,
    matrix: &DMatrix<f64>,
    expected_rows: usize,
    expected_cols: usize,
) -> Result<(), ReferenceError> {
    let (rows, cols) = matrix.shape();
    if (rows, cols) != (expected_rows, expected_cols) {
        return Err(ReferenceError::Dimension { what, rows, cols, expected_rows, expected_cols });
    }
    match not_finite(matrix.as_slice(), rows) {
        None => Ok(()),
        Some((row, col)) => Err(ReferenceError::NotFinite { what, row, col }),
    }
}

/// What one step says.
struct StepTerms {
    /// `p⁻` and `p⁺` without inputs.
    leaves: DVector<f64>,
    arrives: DVector<f64>,
    /// What unit inputs take from `p⁻` and give to `p⁺`.
    at_start: DMatrix<f64>,
    at_end: DMatrix<f64>,
}

/// What one inner row says: `r = r0 + before u[k−1] + after u[k]`, in the norm of kinetic energy and
/// without what constraints explain.
struct Node {
    factor: Cholesky<f64, Dyn>,
    /// `Dhᵀ` of the dynamic coordinates, in that norm.
    constraints: DMatrix<f64>,
    free: DMatrix<f64>,
    before: DMatrix<f64>,
    after: DMatrix<f64>,
    residual: DVector<f64>,
}

/// Compares a configuration trajectory with the motions of a plant. Row k of `q` is the configuration
/// at the end of step k, n + 1 rows of nd + nk; row k of `u`, if given, is the planned `u[k]`, n rows of
/// ni + nk, else inputs are fitted and prescribed positions are those of `q`. The reference begins at the
/// plant's count of steps.
///
/// Costs for each row a linearization, `nd` gradients, and O(nd³).
pub fn check_reference(
    plant: &Spare,
    q: &DMatrix<f64>,
    u: Option<&DMatrix<f64>>,
) -> Result<Assessment, ReferenceError> {
    Assess::new(plant, q, u)?.assess()
}

struct Assess<'a> {
    plant: Plant,
    q: &'a DMatrix<f64>,
    first_step: u64,
    steps: usize,
    /// With the inputs that are given, else zero.
    inputs: DMatrix<f64>,
    is_given: bool,
}

impl<'a> Assess<'a> {
    fn new(
        spare: &Spare,
        q: &'a DMatrix<f64>,
        u: Option<&DMatrix<f64>>,
    ) -> Result<Self, ReferenceError> {
        let plant = spare.plant();
        let d = plant.model().dimensions();
        let rows = q.nrows();
        if !plant.is_one_midpoint_step() {
            return Err(ReferenceError::Method);
        }
        if rows < 2 {
            return Err(ReferenceError::TooShort { rows });
        }
        check("q", q, rows, d.coordinates())?;
        let steps = rows - 1;
        let inputs = match u {
            Some(u) => {
                check("u", u, steps, d.input())?;
                u.clone()
            }
            None => DMatrix::from_fn(steps, d.input(), |k, j| match j.checked_sub(d.inputs) {
                None => 0.0,
                Some(prescribed) => q[(k + 1, d.dynamic + prescribed)],
            }),
        };
        let first_step = plant.step_index();
        Ok(Self { plant: plant.clone(), q, first_step, steps, inputs, is_given: u.is_some() })
    }

    /// Input of step `k` with the prescribed positions of the reference.
    fn input(&self, k: usize) -> Vec<f64> {
        let d = self.plant.model().dimensions();
        let mut u = row(&self.inputs, k);
        for (j, u) in u[d.inputs..].iter_mut().enumerate() {
            *u = self.q[(k + 1, d.dynamic + j)];
        }
        u
    }

    /// Has the plant evaluate step `k`, with multipliers.
    fn evaluate(
        &mut self,
        k: usize,
        multipliers: &[f64],
        evaluate: impl FnOnce(&mut Plant, &KnownStep<'_>) -> Result<(), StepError>,
    ) -> Result<(), ReferenceError> {
        let (q0, q1, u) = (row(self.q, k), row(self.q, k + 1), self.input(k));
        let index = self.first_step + k as u64;
        let step = KnownStep { index, q0: &q0, p0: None, q1: &q1, multipliers, u: &u };
        evaluate(&mut self.plant, &step)
            .map_err(|error| ReferenceError::Linearization { step: k, error })
    }

    fn terms(&mut self, k: usize, out: &mut Linearization) -> Result<StepTerms, ReferenceError> {
        let d = self.plant.model().dimensions();
        let none = vec![0.0; d.constraints];
        let (mut leaves, mut arrives) = (DVector::zeros(d.dynamic), DVector::zeros(d.dynamic));
        self.evaluate(k, &none, |plant, step| {
            plant.linearize_known(step, out)?;
            plant.momenta_of_known(step, leaves.as_mut_slice(), arrives.as_mut_slice())
        })?;
        let [at_start, at_end] = out.input_impulses();
        Ok(StepTerms { leaves, arrives, at_start, at_end })
    }

    fn node(&mut self, k: usize, before: &StepTerms, after: &StepTerms) -> Node {
        let nd = self.plant.model().dimensions().dynamic;
        let q = row(self.q, k);
        let mut mass = self.plant.mass_matrix_at(&q);
        let largest = if nd > 0 { mass.diagonal().amax() } else { 0.0 };
        let factor = loop {
            if let Some(factor) = mass.clone().cholesky() {
                break factor;
            }
            for i in 0..nd {
                mass[(i, i)] += MASSLESS * largest.max(f64::MIN_POSITIVE.sqrt());
            }
        };
        let white = |m: &DMatrix<f64>| {
            let mut m = m.clone();
            factor.l_dirty().solve_lower_triangular_mut(&mut m);
            m
        };
        let jacobian = self.plant.constraints_at(&q).1.columns(0, nd).transpose();
        let constraints = white(&jacobian);
        let free = tangent_basis(&constraints.transpose());
        let gap = DMatrix::from_column_slice(nd, 1, (&before.arrives - &after.leaves).as_slice());
        let residual = white(&gap).column(0).into_owned();
        let (before, after) = (white(&before.at_end), white(&after.at_start));
        let (before, after) = (free.tr_mul(&before), free.tr_mul(&after));
        Node { residual: free.tr_mul(&residual), before, after, constraints, free, factor }
    }

    fn assess(mut self) -> Result<Assessment, ReferenceError> {
        let model = self.plant.model().clone();
        let d = model.dimensions();
        let (n, nd, steps) = (d.coordinates(), d.dynamic, self.steps);
        let mut out = Linearization::new(&model);
        let mut terms = Vec::with_capacity(steps);
        for k in 0..steps {
            terms.push(self.terms(k, &mut out)?);
        }
        let nodes: Vec<_> = (1..steps).map(|k| self.node(k, &terms[k - 1], &terms[k])).collect();
        if !self.is_given && d.inputs > 0 {
            let found = fit(&nodes, steps, d.inputs);
            for (k, found) in found.iter().enumerate() {
                for j in 0..d.inputs {
                    self.inputs[(k, j)] = found[j];
                }
                // With the inputs in place what is left is known to all digits.
                terms[k] = self.terms(k, &mut out)?;
            }
        }
        let mut assessment = Assessment {
            inputs: self.inputs.clone(),
            states: DMatrix::zeros(steps + 1, d.state()),
            multipliers: DMatrix::zeros(steps, d.constraints),
            ..Assessment::default()
        };
        self.explain(&terms, &nodes, &mut assessment);
        self.find_states(&terms, &mut assessment);
        for k in 0..steps {
            for (j, coordinate) in model.coordinates()[nd..n].iter().enumerate() {
                let gap = self.inputs[(k, d.inputs + j)] - self.q[(k + 1, nd + j)];
                assessment.violate(gap.abs(), k + 1, &coordinate.name);
            }
        }
        Ok(assessment)
    }

    /// Multipliers of the inner rows, and what is left as a force and as the acceleration that it makes.
    fn explain(&self, terms: &[StepTerms], nodes: &[Node], assessment: &mut Assessment) {
        let (model, h) = (self.plant.model(), self.plant.settings().time_step_s);
        for (k, node) in (1..).zip(nodes) {
            let mut gap = &terms[k - 1].arrives - &terms[k].leaves;
            let multipliers = node.explain(&gap);
            assessment.multipliers.row_mut(k).copy_from(&multipliers.transpose());
            let l = node.factor.l_dirty();
            l.solve_lower_triangular_mut(&mut gap);
            let white = &node.free * node.free.tr_mul(&gap);
            let mut acceleration = white.clone();
            l.tr_solve_lower_triangular_mut(&mut acceleration);
            let force = node.factor.l() * white;
            for i in 0..force.len() {
                let (force, acceleration) = (force[i].abs() / h, acceleration[i].abs() / h);
                if force > assessment.unexplained_force {
                    assessment.unexplained_force = force;
                    assessment.unexplained_force_step = k;
                    assessment.unexplained_force_coordinate = model.coordinates()[i].name.clone();
                }
                if acceleration > assessment.unexplained_acceleration {
                    assessment.unexplained_acceleration = acceleration;
                    assessment.unexplained_step = k;
                    assessment.unexplained_coordinate = model.coordinates()[i].name.clone();
                }
            }
        }
        if self.steps > 1 {
            let first = assessment.multipliers.row(1).into_owned();
            assessment.multipliers.row_mut(0).copy_from(&first);
        }
    }

    /// The states, each with the momentum that it leaves with, and the violations there.
    fn find_states(&mut self, terms: &[StepTerms], assessment: &mut Assessment) {
        let model = self.plant.model().clone();
        let (nd, steps) = (model.dimensions().dynamic, self.steps);
        let h = self.plant.settings().time_step_s;
        for k in 0..=steps {
            let q = row(self.q, k);
            let (values, jacobian) = self.plant.constraints_at(&q);
            for (value, name) in values.iter().zip(model.constraint_names()) {
                assessment.violate(value.abs(), k, name);
            }
            let momentum = if k < steps {
                let lambda = assessment.multipliers.row(k).transpose();
                &terms[k].leaves + jacobian.columns(0, nd).tr_mul(&lambda)
            } else {
                terms[k - 1].arrives.clone()
            };
            let from = k.saturating_sub(1);
            let mut state = q;
            state.extend(momentum.iter());
            let change = model.difference(&row(self.q, from), &row(self.q, from + 1));
            state.extend(change[nd..].iter().map(|change| change / h));
            assessment.states.row_mut(k).copy_from_slice(&state);
        }
    }
}

impl Assessment {
    fn violate(&mut self, violation: f64, step: usize, name: &str) {
        if violation > self.constraint_violation || self.constraint.is_empty() {
            self.constraint_violation = violation;
            self.constraint_violation_step = step;
            name.clone_into(&mut self.constraint);
        }
    }
}

impl Node {
    /// The multipliers of least norm that explain the most of a gap.
    fn explain(&self, gap: &DVector<f64>) -> DVector<f64> {
        let count = self.constraints.ncols();
        if count == 0 {
            return DVector::zeros(0);
        }
        let mut white = gap.clone();
        self.factor.l_dirty().solve_lower_triangular_mut(&mut white);
        let svd = self.constraints.clone().svd(true, true);
        let smallest = REDUNDANT * svd.singular_values.amax();
        svd.solve(&white, smallest).unwrap_or_else(|_| DVector::zeros(count))
    }
}

/// Inputs that explain the most, by least squares: block-tridiagonal normal equations, with a touch of
/// smoothness, and corrections that take its bias away.
fn fit(nodes: &[Node], steps: usize, inputs: usize) -> Vec<DVector<f64>> {
    let mut diagonal = vec![DMatrix::zeros(inputs, inputs); steps];
    let mut upper = vec![DMatrix::zeros(inputs, inputs); steps.saturating_sub(1)];
    for (k, node) in (1..).zip(nodes) {
        diagonal[k - 1] += node.before.tr_mul(&node.before);
        diagonal[k] += node.after.tr_mul(&node.after);
        upper[k - 1] += node.before.tr_mul(&node.after);
    }
    for j in 0..inputs {
        let largest = diagonal.iter().fold(0.0_f64, |m, block| m.max(block[(j, j)]));
        let weight = SMOOTHNESS * if largest > 0.0 { largest } else { 1.0 };
        for k in 0..steps {
            let neighbours = f64::from(u8::from(k > 0)) + f64::from(u8::from(k + 1 < steps));
            diagonal[k][(j, j)] += weight * (neighbours + 1e-3);
            if k + 1 < steps {
                upper[k][(j, j)] -= weight;
            }
        }
    }
    // D[k] ← D[k] − U[k−1]ᵀ D[k−1]⁻¹ U[k−1]
    let mut factors: Vec<nalgebra::LU<f64, Dyn, Dyn>> = Vec::with_capacity(steps);
    for (k, mut block) in diagonal.into_iter().enumerate() {
        if let Some(before) = k.checked_sub(1) {
            let solved = factors[before].solve(&upper[before]);
            let solved = solved.unwrap_or_else(|| DMatrix::zeros(inputs, inputs));
            block -= upper[before].tr_mul(&solved);
        }
        factors.push(block.lu());
    }
    let mut found = vec![DVector::zeros(inputs); steps];
    for _ in 0..CORRECTIONS {
        let mut slope = vec![DVector::zeros(inputs); steps];
        for (k, node) in (1..).zip(nodes) {
            // `after` is what an input takes from the momentum that the row is left with.
            let left = &node.residual + &node.before * &found[k - 1] + &node.after * &found[k];
            slope[k - 1] -= node.before.tr_mul(&left);
            slope[k] -= node.after.tr_mul(&left);
        }
        for k in 1..steps {
            let solved = factors[k - 1].solve(&slope[k - 1]);
            let solved = solved.unwrap_or_else(|| DVector::zeros(inputs));
            let carried = upper[k - 1].tr_mul(&solved);
            slope[k] -= carried;
        }
        for k in (0..steps).rev() {
            if k + 1 < steps {
                let (head, tail) = slope.split_at_mut(k + 1);
                head[k] -= &upper[k] * &tail[0];
            }
            slope[k] = factors[k].solve(&slope[k]).unwrap_or_else(|| DVector::zeros(inputs));
        }
        for (found, change) in found.iter_mut().zip(&slope) {
            *found += change;
        }
    }
    found
}

/// Finds a motion of the plant that follows a reference: it begins at the first row, brought onto the
/// constraints, and is pulled along by a time-varying regulator about the reference itself,
/// `u[k] = u_ref[k] − K[k] (x[k] ⊖ x_ref[k])`. A reference that is a motion is found again.
///
/// `weights` are those of the regulator, identities if not given; on the manifold of the constraints
/// with `on_manifold`.
pub fn project(
    spare: &Spare,
    q: &DMatrix<f64>,
    assessment: &Assessment,
    weights: Option<&Weights>,
    on_manifold: bool,
) -> Result<Projected, ReferenceError> {
    let model = spare.plant().model().clone();
    let d = model.dimensions();
    let (n, nd) = (d.coordinates(), d.dynamic);
    let mut assess = Assess::new(spare, q, Some(&assessment.inputs))?;
    let steps = assess.steps;
    check("the states of the assessment", &assessment.states, steps + 1, d.state())?;
    check("the multipliers of the assessment", &assessment.multipliers, steps, d.constraints)?;
    let weights = match weights {
        Some(weights) => weights.clone().for_system(d.state(), d.input())?,
        None => Weights::diagonal(&vec![1.0; d.state()], &vec![1.0; d.input()])?,
    };

    let mut out = Linearization::new(&model);
    let (mut samples, mut tangents) = (Vec::with_capacity(steps), Vec::new());
    for k in 0..steps {
        let multipliers = row(&assessment.multipliers, k);
        assess.evaluate(k, &multipliers, |plant, step| plant.linearize_known(step, &mut out))?;
        samples.push(Sample { a: out.a(), b: out.b() });
    }
    let gains = if on_manifold && d.constraints > 0 {
        for k in 0..=steps {
            tangents.push(Tangent::new(&assess.plant.constraints_at(&row(q, k)).1, nd));
        }
        finite_horizon_on_manifold(&samples, &tangents, &weights.into(), Values::Drop)?.gains
    } else {
        finite_horizon(&samples, &weights.into(), Values::Drop)?.gains
    };

    let first = row(&assessment.states, 0);
    let start = Initial::Projection { q: first[..n].to_vec(), hold: vec![] };
    let mut plant = spare.clone().start(&start)?;
    let q0 = plant.q().to_vec();
    let (p, v) = (first[n..n + nd].to_vec(), first[n + nd..].to_vec());
    plant.initialize(&Initial::Momentum { q: q0, p, v })?;
    plant.set_step_index(spare.plant().step_index());

    let mut projected = Projected {
        initial: plant.state(),
        inputs: assessment.inputs.clone(),
        states: DMatrix::zeros(steps + 1, d.state()),
        deviation: 0.0,
        deviation_step: 0,
        deviation_coordinate: model.coordinates().first().map_or(String::new(), |c| c.name.clone()),
    };
    for k in 0..=steps {
        let x = plant.state().x();
        projected.states.row_mut(k).copy_from_slice(&x);
        let reference = row(&assessment.states, k);
        let mut error: Vec<f64> = x.iter().zip(&reference).map(|(x, r)| x - r).collect();
        error[..n].copy_from_slice(&model.difference(&reference[..n], &x[..n]));
        for (coordinate, error) in model.coordinates().iter().zip(&error) {
            if error.abs() > projected.deviation {
                projected.deviation = error.abs();
                projected.deviation_step = k;
                coordinate.name.clone_into(&mut projected.deviation_coordinate);
            }
        }
        if let Some(gain) = gains.get(k) {
            let u = assessment.inputs.row(k).transpose() - gain * DVector::from_vec(error);
            plant.step(u.as_slice()).map_err(|error| ReferenceError::Step { step: k, error })?;
            projected.inputs.row_mut(k).copy_from(&u.transpose());
        }
    }
    Ok(projected)
}
