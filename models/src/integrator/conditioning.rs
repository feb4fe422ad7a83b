//! How far a step is from a singularity: what pivots are measured against, and what to say when a
//! step fails.
//!
//! Pivots are compared with numbers that follow from the scene alone, so that neither units nor a
//! configuration decide what counts as zero:
//!
//! - a pivot of the Newton matrix with the largest inertia that its coordinate can have in any
//!   configuration (or with its own diagonal entry, where springs make that larger);
//! - a pivot of `S = Dh(q[k+1]) K⁻¹ Dh(q[k])ᵀ` with the steepest that its constraint gets over a
//!   sample of configurations.
//!
//! **Redundant or singular?** Equations that depend on others at the scene's initial configuration
//! (where that is only a guess, at one near it that satisfies the constraints),
//! and at configurations near it that satisfy the constraints, are redundant: they get least-norm
//! multipliers and are counted. Where fewer equations are independent than there, the configuration
//! is singular. A step names the constraints that lost their independence if its estimate falls below
//! the threshold of the settings, or if it cannot be solved and the estimate is far below that of the
//! initial configuration. Redundant equations that cannot be satisfied together are named as such.

use std::f64::consts::TAU;

use nalgebra::{DMatrix, DVector, SVD};

use crate::constraints::closure::Closure;
use crate::integrator::balls::orientations;
use crate::integrator::newton::Workspace;
use crate::integrator::settings::Settings;
use crate::model::mechanism::Model;
use crate::model::tree::{JointKind, Rotational, WORLD};
use crate::plant::facade::{PreciseState, StepError};

/// Configurations over which the steepness of a constraint is sampled.
const SAMPLES: usize = 8;
/// A constraint less steep than this fraction of the steepest is moved by no dynamic coordinate.
const FLAT: f64 = 1e-13;
/// Square of the distance from the others, relative to a row of full steepness, below which a row
/// depends on them.
pub(crate) const DEPENDENT: f64 = 1e-11;
/// A step that fails where the constraints' estimate is below this fraction of that of the initial
/// configuration fails because of it.
const SUSPECT: f64 = 1e-4;
/// Displacements from the initial configuration that tell whether it is a singular one, m or rad.
const DISPLACEMENTS: [f64; 3] = [0.02, -0.05, 0.11];
/// Corrections towards the constraints.
const CORRECTIONS: usize = 30;
/// Most equations for which dense decompositions are worth their time.
const MOST_EQUATIONS: usize = 128;
/// A correction shorter than this leads nowhere, m or rad.
const SHORT: f64 = 1e-9;
/// A constraint violated by more than this, in units of round-off, is violated.
const VIOLATED: f64 = 1e4;

/// References for pivots, and the independent equations.
#[derive(Clone, Debug, Default)]
pub(crate) struct Conditioning {
    /// Largest inertia of each dynamic coordinate, kg or kg·m²; zero where it moves none.
    pub(crate) inertia: Vec<f64>,
    /// One over the largest gradient of each equation in the metric of `inertia`; zero where no
    /// dynamic coordinate moves it.
    pub(crate) weight: Vec<f64>,
    /// Equations that are independent at the scene's initial configuration or near it, in their order.
    pub(crate) independent: Vec<usize>,
    /// The configuration where they are.
    pub(crate) regular: Vec<f64>,
}

/// Where corrections towards the constraints lead.
enum Reached {
    Satisfied,
    /// To where no correction reduces the violation.
    Violated,
    /// Nowhere.
    Lost,
}

impl Conditioning {
    pub(crate) fn new(model: &Model) -> Self {
        let inertia = inertia(model);
        let mut found = Self { inertia, ..Self::default() };
        if model.dimensions.constraints > 0 {
            found.weight = found.weights(model);
            found.find_independent(model);
        }
        found
    }

    /// Finds the independent equations at the initial configuration; where some depend on others, near
    /// it too, lest it be a singular one.
    fn find_independent(&mut self, model: &Model) {
        let d = model.dimensions;
        let mut closure = Closure::new(model);
        let mut q = sample(model, 0, 0.0);
        if !model.initial_violations.is_empty() && d.constraints <= MOST_EQUATIONS {
            // Off the constraints, redundant equations may be independent; how much they are goes with the
            // root of the violation.
            let mut near = q.clone();
            self.approach(model, &mut closure, &mut near, 1.0);
            let there = orientations(model, &near);
            if closure.violated(model, &near, &there).next().is_none() {
                q = near;
            }
        }
        self.independent = independent(&self.rows(model, &mut closure, &q));
        let deficient = self.independent.len() < d.constraints.min(d.dynamic);
        if deficient && d.constraints <= MOST_EQUATIONS {
            for size in DISPLACEMENTS {
                let mut near = q.clone();
                for (i, x) in near[..d.dynamic].iter_mut().enumerate() {
                    *x += size * (1.0 + i as f64).sin();
                }
                let reached = self.approach(model, &mut closure, &mut near, VIOLATED);
                if matches!(reached, Reached::Satisfied) {
                    let found = independent(&self.rows(model, &mut closure, &near));
                    if found.len() > self.independent.len() {
                        (self.independent, q) = (found, near);
                    }
                }
            }
        }
        self.regular = q;
    }

    /// Newton's method with the shortest correction towards the constraints, from `q`, until they are
    /// violated by no more than `enough`, in units of round-off.
    fn approach(
        &self,
        model: &Model,
        closure: &mut Closure,
        q: &mut Vec<f64>,
        enough: f64,
    ) -> Reached {
        let d = model.dimensions;
        for _ in 0..CORRECTIONS {
            let rows = self.rows(model, closure, q);
            closure.evaluate(model, q, &orientations(model, q));
            let value = DVector::from_fn(d.constraints, |c, _| {
                // What nothing moves keeps its size.
                let weight = self.weight[c];
                -closure.value[c] * if weight > 0.0 { weight } else { 1.0 }
            });
            if closure.violation() <= enough {
                return Reached::Satisfied;
            }
            let finite = rows.iter().chain(value.iter()).all(|x| x.is_finite());
            if rows.is_empty() || !finite {
                return Reached::Lost;
            }
            let Ok(step) = SVD::new(rows, true, true).solve(&value, DEPENDENT.sqrt()) else {
                return Reached::Lost;
            };
            let mut change = vec![0.0; d.coordinates()];
            for (j, x) in step.iter().enumerate() {
                change[j] = x / self.inertia_of(j).sqrt();
            }
            if change.iter().all(|x| x.abs() < SHORT) {
                return Reached::Violated;
            }
            *q = model.retract(q, &change);
        }
        Reached::Lost
    }

    /// Dynamic columns of `Dh(q)`, each row with its weight and each column by the root of its
    /// inertia: the rows of full steepness have length one.
    pub(crate) fn rows(&self, model: &Model, closure: &mut Closure, q: &[f64]) -> DMatrix<f64> {
        closure.evaluate(model, q, &orientations(model, q));
        closure.differentiate(model, q);
        let d = model.dimensions;
        DMatrix::from_fn(d.constraints, d.dynamic, |c, j| {
            let weight = self.weight.get(c).copied().unwrap_or(1.0);
            weight * closure.jacobian[c * d.coordinates() + j] / self.inertia_of(j).sqrt()
        })
    }

    /// Inertia of a coordinate; the largest one stands in where it moves none.
    pub(crate) fn inertia_of(&self, j: usize) -> f64 {
        let own = self.inertia[j];
        if own > 0.0 {
            return own;
        }
        let largest = self.inertia.iter().fold(0.0_f64, |a, b| a.max(*b));
        if largest > 0.0 { largest } else { 1.0 }
    }

    fn weights(&self, model: &Model) -> Vec<f64> {
        let mut closure = Closure::new(model);
        let mut steepest = vec![0.0_f64; model.dimensions.constraints];
        for k in 0..=SAMPLES {
            let q = sample(model, k, 0.0);
            let rows = self.rows(model, &mut closure, &q);
            for (steepest, row) in steepest.iter_mut().zip(rows.row_iter()) {
                *steepest = steepest.max(row.norm());
            }
        }
        let largest = steepest.iter().fold(0.0_f64, |a, b| a.max(*b));
        steepest.iter().map(|s| if *s > FLAT * largest { 1.0 / s } else { 0.0 }).collect()
    }
}

/// The initial configuration, and after it configurations that differ from it in all angles and, by
/// up to `slide`, in all lengths of the dynamic coordinates.
fn sample(model: &Model, k: usize, slide: f64) -> Vec<f64> {
    let mut q: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
    for (i, c) in model.coordinates[..model.dimensions.dynamic].iter().enumerate() {
        // Multiples of the golden ratio spread evenly.
        let fraction = ((k * (i + 1)) as f64 * 0.618_033_988_749_894_9).fract();
        q[i] += fraction * if c.is_angle { TAU } else { slide };
    }
    q
}

/// The largest inertia that each dynamic coordinate can have: every body of its subtree stretched
/// out as far as the joints between allow.
fn inertia(model: &Model) -> Vec<f64> {
    let mut inertia = vec![0.0; model.dimensions.dynamic];
    let joints = &model.dynamics.joints;
    for (b, carrier) in joints.iter().enumerate() {
        let body = &carrier.body;
        let largest_moment = match body.inertia {
            Rotational::None => continue,
            Rotational::Point => 0.0,
            Rotational::Isotropic(moment) => moment,
            // No principal moment exceeds the sum of the other two.
            Rotational::Full(tensor) => 0.5 * (tensor.xx + tensor.yy + tensor.zz),
        };
        let (mut reach, mut at) = (body.center.norm(), b);
        while at != WORLD {
            let joint = &joints[at];
            if let Some(inertia) = inertia.get_mut(joint.coordinate) {
                *inertia += match joint.kind {
                    JointKind::Prismatic => body.mass,
                    JointKind::Revolute | JointKind::Ball(_) => {
                        body.mass * reach * reach + largest_moment
                    }
                    JointKind::Screw(pitch) => {
                        body.mass * (reach * reach + pitch * pitch) + largest_moment
                    }
                };
            }
            reach += joint.translation.norm();
            if joint.kind == JointKind::Prismatic {
                reach += model.coordinates[joint.coordinate].initial.abs();
            }
            at = joint.parent;
        }
    }
    inertia
}

/// Scalar products of the chosen rows.
fn gram(rows: &DMatrix<f64>, chosen: &[usize]) -> DMatrix<f64> {
    let rows = rows.select_rows(chosen);
    &rows * rows.transpose()
}

/// Smallest singular value relative to the largest, or to one; one without any, zero for what is not
/// finite.
fn reciprocal_condition(matrix: &DMatrix<f64>) -> f64 {
    if matrix.is_empty() {
        return 1.0;
    }
    if !matrix.iter().all(|x| x.is_finite()) {
        return 0.0;
    }
    let singular_values = matrix.singular_values();
    singular_values.min() / singular_values.max().max(1.0)
}

/// Rows that do not depend on rows before them.
fn independent(rows: &DMatrix<f64>) -> Vec<usize> {
    let mut basis: Vec<DVector<f64>> = Vec::new();
    let mut independent = Vec::new();
    for (c, row) in rows.row_iter().enumerate() {
        let mut rest = row.transpose();
        // Twice is enough.
        for _ in 0..2 {
            for b in &basis {
                rest.axpy(-b.dot(&rest), b, 1.0);
            }
        }
        let length = rest.norm();
        if length * length > DEPENDENT {
            basis.push(rest / length);
            independent.push(c);
        }
    }
    independent
}

impl Model {
    /// Equations of constraints that are independent at the scene's initial configuration.
    pub(crate) fn constraint_rank(&self) -> usize {
        self.conditioning.independent.len()
    }

    /// A coordinate at which the Newton matrix is singular in every configuration, at rest: nothing
    /// resists it, for example because all that it turns lies on its axis.
    pub(crate) fn always_singular(&self) -> Option<&str> {
        let settings = Settings::new(self);
        let mut workspace = Workspace::new(self);
        let mut culprit = None;
        // Configurations where something is singular by chance are rare.
        for k in (0..=SAMPLES).rev() {
            workspace.q_mid = sample(self, k, 1.0);
            workspace.angles.copy_from_slice(&workspace.q_mid);
            workspace.orientations_mid = orientations(self, &workspace.q_mid);
            workspace.evaluate_lagrangian(self);
            match workspace.factor_newton_matrix(self, &settings) {
                Err(StepError::Singular { coordinate, .. }) => culprit = Some(coordinate),
                _ => return None,
            }
        }
        self.coordinates.iter().find(|c| Some(&c.name) == culprit.as_ref()).map(|c| c.name.as_str())
    }

    /// Names of the equations that depend on equations before them at `q`.
    pub(crate) fn redundant_equations(&self, q: &[f64]) -> Vec<String> {
        let independent = independent(&self.conditioning.rows(self, &mut Closure::new(self), q));
        let names = self.constraint_names.iter().enumerate();
        names.filter(|(c, _)| !independent.contains(c)).map(|(_, name)| name.clone()).collect()
    }

    /// Names of the equations that take part in the near-singularity of `matrix`, the rows and
    /// columns of which belong to the independent equations.
    fn names_of_singular(&self, matrix: DMatrix<f64>) -> Vec<String> {
        if matrix.is_empty() || !matrix.iter().all(|x| x.is_finite()) {
            return Vec::new();
        }
        let svd = SVD::new(matrix, true, false);
        let (Some(u), Some(smallest)) =
            (svd.u, svd.singular_values.iter().copied().reduce(f64::min))
        else {
            return Vec::new();
        };
        let cut = (10.0 * smallest).max(1e-3 * SUSPECT * svd.singular_values.max());
        let mut takes_part = vec![false; self.constraint_rank()];
        for (k, _) in svd.singular_values.iter().enumerate().filter(|(_, s)| **s <= cut) {
            for (c, part) in u.column(k).iter().enumerate() {
                takes_part[c] |= part.abs() > 0.1;
            }
        }
        let independent = self.conditioning.independent.iter().zip(takes_part);
        independent.filter(|(_, is)| *is).map(|(c, _)| self.constraint_names[*c].clone()).collect()
    }

    /// The error of a singular `S`, row-major as it was factored: `names` come from its smallest
    /// singular values.
    pub(crate) fn singular_constraints(
        &self,
        schur: &[f64],
        reciprocal_condition: f64,
    ) -> StepError {
        let nc = self.dimensions.constraints;
        let (chosen, weight) = (&self.conditioning.independent, &self.conditioning.weight);
        if chosen.len() > MOST_EQUATIONS {
            return StepError::SingularConstraints {
                constraints: Vec::new(),
                reciprocal_condition,
            };
        }
        let matrix = DMatrix::from_fn(chosen.len(), chosen.len(), |i, j| {
            let (i, j) = (chosen[i], chosen[j]);
            weight[i] * schur[i * nc + j] * weight[j]
        });
        let constraints = self.names_of_singular(matrix);
        StepError::SingularConstraints { constraints, reciprocal_condition }
    }

    /// Why a step from `state` to the prescribed positions in `q_end` could not be solved, where the
    /// constraints are the reason.
    pub(crate) fn explain(
        &self,
        error: StepError,
        state: &PreciseState,
        q_end: &[f64],
    ) -> StepError {
        let unsolved =
            matches!(error, StepError::NotConverged { .. } | StepError::NotFinite { .. });
        if !unsolved || !(1..=MOST_EQUATIONS).contains(&self.dimensions.constraints) {
            return error;
        }
        let mut closure = Closure::new(self);
        let conditioning = &self.conditioning;
        let [regular, gram] = [&conditioning.regular, &state.q]
            .map(|q| gram(&conditioning.rows(self, &mut closure, q), &conditioning.independent));
        let regular = reciprocal_condition(&regular);
        let reciprocal_condition = reciprocal_condition(&gram);
        if reciprocal_condition < SUSPECT * regular {
            let constraints = self.names_of_singular(gram);
            return StepError::SingularConstraints { constraints, reciprocal_condition };
        }
        // Is there a configuration that satisfies the constraints at the end of the step?
        let mut q = state.q.clone();
        q[self.dimensions.dynamic..].copy_from_slice(&q_end[self.dimensions.dynamic..]);
        match conditioning.approach(self, &mut closure, &mut q, VIOLATED) {
            Reached::Violated => {
                let relative = |c: usize| (closure.value[c] / closure.round_off[c]).abs();
                let names = self.constraint_names.iter().enumerate();
                let constraints = names
                    .filter(|(c, _)| relative(*c) > VIOLATED)
                    .map(|(_, n)| n.clone())
                    .collect();
                let violation = closure.value.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
                StepError::InconsistentConstraints { constraints, violation }
            }
            Reached::Satisfied | Reached::Lost => error,
        }
    }
}
