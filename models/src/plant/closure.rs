//! Constraints at one end of a step: values, Jacobian and second derivatives.
//!
//! With `d = a − b` for the two points of a constraint:
//! distance `h = |d|² − l²`, `h_i = 2 d·d_i`, `h_ij = 2 (d_i·d_j + d·d_ij)`;
//! point to point `h = d·e`, `h_i = d_i·e`, `h_ij = d_ij·e`.

use crate::model::{Constraint, ConstraintKind, Model};
use crate::plant::kinematics::Poses;
use crate::plant::springs::Separation;
use crate::scalar::Scalar;
use crate::spatial::{Mat3, Vec3};

/// The constraints at a configuration.
#[derive(Clone, Debug)]
pub(crate) struct Closure<S = f64> {
    pub(crate) poses: Poses<S>,
    /// Values `h`, one per equation.
    pub(crate) value: Vec<S>,
    /// Round-off of each value: what `h` may be at an exact solution.
    pub(crate) round_off: Vec<f64>,
    /// `Dh`, row-major, nc by nd + nk.
    pub(crate) jacobian: Vec<S>,
    /// Change of `h` by round-off of the coordinates, from the last Jacobian.
    coordinate_round_off: Vec<f64>,
}

impl<S: Scalar> Closure<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let nc = model.constraints.len();
        Self {
            poses: Poses::new(&model.closure),
            value: vec![S::ZERO; nc],
            round_off: vec![0.0; nc],
            jacobian: vec![S::ZERO; nc * model.dimensions.coordinates()],
            coordinate_round_off: vec![0.0; nc],
        }
    }

    /// Values at `q`, with the orientations of ball joints.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, model: &Model, q: &[S], orientations: &[Mat3<S>]) {
        self.poses.evaluate(&model.closure, q, orientations);
        for (c, constraint) in model.constraints.iter().enumerate() {
            let at = constraint.points.separation(&model.closure, &self.poses);
            let (value, magnitude) = match constraint.kind {
                ConstraintKind::Distance(length) => distance(&at, S::constant(length)),
                ConstraintKind::DrivenDistance(coordinate) => distance(&at, q[coordinate]),
                ConstraintKind::Axis(axis) => (at.difference[axis], at.magnitude),
            };
            self.value[c] = value;
            self.round_off[c] = f64::EPSILON * magnitude + self.coordinate_round_off[c];
        }
    }

    /// Takes over how round-off of the coordinates changes the values, until the next Jacobian.
    pub(crate) fn expect_round_off_of(&mut self, other: &Self) {
        self.coordinate_round_off.copy_from_slice(&other.coordinate_round_off);
    }

    /// Jacobian at the configuration of the last [`Closure::evaluate`].
    #[inline(never)]
    pub(crate) fn differentiate(&mut self, model: &Model, q: &[S]) {
        let n = model.dimensions.coordinates();
        for (c, constraint) in model.constraints.iter().enumerate() {
            let at = constraint.points.separation(&model.closure, &self.poses);
            let row = &mut self.jacobian[c * n..][..n];
            let weight = constraint.weight(&at);
            for joint in &constraint.points.path {
                row[joint.coordinate] = S::ZERO;
            }
            if let ConstraintKind::DrivenDistance(length) = constraint.kind {
                row[length] = q[length] * -2.0;
            }
            for joint in &constraint.points.path {
                let gradient = joint.gradient(&model.closure, &self.poses, &at);
                row[joint.coordinate] += weight.dot(gradient);
            }
            let moved: f64 = constraint
                .points
                .path
                .iter()
                .map(|joint| (row[joint.coordinate] * q[joint.coordinate]).value().abs())
                .sum();
            self.coordinate_round_off[c] = f64::EPSILON * moved;
        }
    }

    /// Largest violation in units of its round-off.
    pub(crate) fn violation(&self) -> f64 {
        let relative = |(value, round_off): (&S, &f64)| {
            let value = value.value();
            if value == 0.0 { 0.0 } else { value.abs() / round_off }
        };
        self.value.iter().zip(&self.round_off).map(relative).fold(0.0, larger)
    }

    /// `out_i −= Σ_c Dh[c, i] λ_c` for the dynamic coordinates.
    #[inline(never)]
    pub(crate) fn subtract_impulses(&self, model: &Model, multipliers: &[S], out: &mut [S]) {
        let n = model.dimensions.coordinates();
        for (c, constraint) in model.constraints.iter().enumerate() {
            let (row, lambda) = (&self.jacobian[c * n..][..n], multipliers[c]);
            for joint in &constraint.points.path {
                if let Some(entry) = out.get_mut(joint.coordinate) {
                    *entry -= row[joint.coordinate] * lambda;
                }
            }
        }
    }

    /// Writes `Σ_c λ_c D²h_c`, rows and columns over all coordinates, row-major.
    #[inline(never)]
    pub(crate) fn hessian(&self, model: &Model, multipliers: &[S], out: &mut [S]) {
        let n = model.dimensions.coordinates();
        let (tree, poses) = (&model.closure, &self.poses);
        out.fill(S::ZERO);
        for (constraint, &lambda) in model.constraints.iter().zip(multipliers) {
            let at = constraint.points.separation(tree, poses);
            let weight = constraint.weight(&at);
            let squared = !matches!(constraint.kind, ConstraintKind::Axis(_));
            for row in &constraint.points.path {
                let row_gradient = row.gradient(tree, poses, &at);
                for column in &constraint.points.path {
                    let gradient = column.gradient(tree, poses, &at);
                    let second = row.second(row_gradient, tree, poses, (column, gradient));
                    let mut value = weight.dot(second);
                    if squared {
                        value += gradient.dot(row_gradient) * 2.0;
                    }
                    out[row.coordinate * n + column.coordinate] += lambda * value;
                }
            }
            if let ConstraintKind::DrivenDistance(length) = constraint.kind {
                out[length * n + length] -= lambda * 2.0;
            }
        }
    }
}

impl Constraint {
    /// Derivative of the value by the difference of the points.
    fn weight<S: Scalar>(&self, at: &Separation<S>) -> Vec3<S> {
        match self.kind {
            ConstraintKind::Distance(_) | ConstraintKind::DrivenDistance(_) => {
                at.difference.scaled(2.0)
            }
            ConstraintKind::Axis(axis) => {
                let mut direction = Vec3::ZERO;
                direction.0[axis] = S::ONE;
                direction
            }
        }
    }
}

fn distance<S: Scalar>(at: &Separation<S>, length: S) -> (S, f64) {
    let square = at.difference.dot(at.difference);
    let squared_length = length * length;
    let round_off = 2.0 * square.value().sqrt() * at.magnitude + squared_length.value();
    (square - squared_length, round_off)
}

/// The larger of two numbers; a NaN wins, so that it is never taken for converged.
pub(crate) fn larger(a: f64, b: f64) -> f64 {
    if b > a || b.is_nan() { b } else { a }
}
