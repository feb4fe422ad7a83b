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
use plantd_math::pivoted_lu::DEPENDENT;

use crate::constraints::closure::Closure;
use crate::constraints::projection::{Limits, Reached, project};
use crate::model::conditioning::Conditioning;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;
use crate::model::tree::{JointKind, Rotational, WORLD};

/// Configurations over which the steepness of a constraint is sampled.
pub(crate) const SAMPLES: usize = 8;
/// A constraint less steep than this fraction of the steepest is moved by no dynamic coordinate.
pub(crate) const FLAT: f64 = 1e-13;
/// A step that fails where the constraints' estimate is below this fraction of that of the initial
/// configuration fails because of it.
pub(crate) const SUSPECT: f64 = 1e-4;
/// Displacements from the initial configuration that tell whether it is a singular one, m or rad.
pub(crate) const DISPLACEMENTS: [f64; 3] = [0.02, -0.05, 0.11];
/// Corrections towards the constraints.
const CORRECTIONS: usize = 30;
/// Most equations for which dense decompositions are worth their time.
pub(crate) const MOST_EQUATIONS: usize = 128;
/// A correction shorter than this leads nowhere, m or rad.
const SHORT: f64 = 1e-9;
/// A constraint violated by more than this, in units of round-off, is violated.
pub(crate) const VIOLATED: f64 = 1e4;

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
    pub(crate) fn find_independent(&mut self, model: &Model) {
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
    pub(crate) fn approach(
        &self,
        model: &Model,
        closure: &mut Closure,
        q: &mut Vec<f64>,
        enough: f64,
    ) -> Reached {
        let limits = Limits {
            corrections: CORRECTIONS,
            enough,
            floor: enough,
            longest: f64::INFINITY,
            shortest: SHORT,
            round_off_is_fresh: true,
        };
        let correction = |closure: &Closure| {
            let rows = self.weigh(model, closure);
            let value = DVector::from_fn(closure.value.len(), |c, _| {
                // What nothing moves keeps its size.
                let weight = self.weight[c];
                -closure.value[c] * if weight > 0.0 { weight } else { 1.0 }
            });
            let finite = rows.iter().chain(value.iter()).all(|x| x.is_finite());
            if rows.is_empty() || !finite {
                return None;
            }
            let step = SVD::new(rows, true, true).solve(&value, DEPENDENT.sqrt()).ok()?;
            let scaled = step.iter().enumerate().map(|(j, x)| x / self.inertia_of(j).sqrt());
            Some(scaled.collect())
        };
        project(model, closure, q, &limits, correction).0
    }

    /// Dynamic columns of `Dh(q)`, each row with its weight and each column by the root of its
    /// inertia: the rows of full steepness have length one.
    pub(crate) fn rows(&self, model: &Model, closure: &mut Closure, q: &[f64]) -> DMatrix<f64> {
        closure.evaluate(model, q, &orientations(model, q));
        closure.differentiate(model, q);
        self.weigh(model, closure)
    }

    /// What [`Conditioning::rows`] says at the last Jacobian.
    pub(crate) fn weigh(&self, model: &Model, closure: &Closure) -> DMatrix<f64> {
        let d = model.dimensions;
        DMatrix::from_fn(d.constraints, d.dynamic, |c, j| {
            let weight = self.weight.get(c).copied().unwrap_or(1.0);
            weight * closure.jacobian[c * d.coordinates() + j] / self.inertia_of(j).sqrt()
        })
    }

    pub(crate) fn weights(&self, model: &Model) -> Vec<f64> {
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
pub(crate) fn sample(model: &Model, k: usize, slide: f64) -> Vec<f64> {
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
pub(crate) fn inertia(model: &Model) -> Vec<f64> {
    let mut inertia = vec![0.0; model.dimensions.dynamic];
    // The others of a sum may turn the other way as fast, for each that has an inertia of its own.
    model.armature.entries().for_each(|a| inertia[a.row] += a.inertia.abs());
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
pub(crate) fn gram(rows: &DMatrix<f64>, chosen: &[usize]) -> DMatrix<f64> {
    let rows = rows.select_rows(chosen);
    &rows * rows.transpose()
}

/// Smallest singular value relative to the largest, or to one; one without any, zero for what is not
/// finite.
pub(crate) fn reciprocal_condition(matrix: &DMatrix<f64>) -> f64 {
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
pub(crate) fn independent(rows: &DMatrix<f64>) -> Vec<usize> {
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
    /// Names of the equations that depend on equations before them at `q`.
    pub(crate) fn redundant_equations(&self, q: &[f64]) -> Vec<String> {
        let independent = independent(&self.conditioning.rows(self, &mut Closure::new(self), q));
        let names = self.constraint_names.iter().enumerate();
        names.filter(|(c, _)| !independent.contains(c)).map(|(_, name)| name.clone()).collect()
    }
}
