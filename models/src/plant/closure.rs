//! Constraints at one end of a step: values, Jacobian and second derivatives.
//!
//! With `d = a − b` for the two points of a constraint:
//! distance `h = |d|² − l²`, `h_i = 2 d·d_i`, `h_ij = 2 (d_i·d_j + d·d_ij)`;
//! point to point `h = d·e`, `h_i = d_i·e`, `h_ij = d_ij·e`.

use crate::model::{Constraint, ConstraintKind, Model};
use crate::plant::kinematics::Poses;
use crate::plant::springs::Separation;
use crate::spatial::Vec3;

/// The constraints at a configuration.
#[derive(Clone, Debug)]
pub(crate) struct Closure {
    pub(crate) poses: Poses,
    /// Values `h`, one per equation.
    pub(crate) value: Vec<f64>,
    /// Round-off of each value: what `h` may be at an exact solution.
    pub(crate) round_off: Vec<f64>,
    /// `Dh`, row-major, nc by nd + nk.
    pub(crate) jacobian: Vec<f64>,
    /// Change of `h` by round-off of the coordinates, from the last Jacobian.
    coordinate_round_off: Vec<f64>,
}

impl Closure {
    pub(crate) fn new(model: &Model) -> Self {
        let nc = model.constraints.len();
        Self {
            poses: Poses::new(&model.closure),
            value: vec![0.0; nc],
            round_off: vec![0.0; nc],
            jacobian: vec![0.0; nc * model.dimensions.coordinates()],
            coordinate_round_off: vec![0.0; nc],
        }
    }

    /// Values at `q`.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, model: &Model, q: &[f64]) {
        self.poses.evaluate(&model.closure, q);
        for (c, constraint) in model.constraints.iter().enumerate() {
            let at = constraint.points.separation(&model.closure, &self.poses);
            let (value, magnitude) = match constraint.kind {
                ConstraintKind::Distance(length) => distance(&at, length),
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
    pub(crate) fn differentiate(&mut self, model: &Model, q: &[f64]) {
        let n = model.dimensions.coordinates();
        for (c, constraint) in model.constraints.iter().enumerate() {
            let at = constraint.points.separation(&model.closure, &self.poses);
            let row = &mut self.jacobian[c * n..][..n];
            let weight = constraint.weight(&at);
            for joint in &constraint.points.path {
                row[joint.coordinate] = 0.0;
            }
            if let ConstraintKind::DrivenDistance(length) = constraint.kind {
                row[length] = -2.0 * q[length];
            }
            for joint in &constraint.points.path {
                let gradient = joint.gradient(&model.closure, &self.poses, &at);
                row[joint.coordinate] += weight.dot(gradient);
            }
            let moved: f64 = constraint
                .points
                .path
                .iter()
                .map(|joint| (row[joint.coordinate] * q[joint.coordinate]).abs())
                .sum();
            self.coordinate_round_off[c] = f64::EPSILON * moved;
        }
    }

    /// Largest violation in units of its round-off.
    pub(crate) fn violation(&self) -> f64 {
        let relative = |(value, round_off): (&f64, &f64)| {
            if *value == 0.0 { 0.0 } else { value.abs() / round_off }
        };
        self.value.iter().zip(&self.round_off).map(relative).fold(0.0, larger)
    }

    /// `out_i −= Σ_c Dh[c, i] λ_c` for the dynamic coordinates.
    #[inline(never)]
    pub(crate) fn subtract_impulses(&self, model: &Model, multipliers: &[f64], out: &mut [f64]) {
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
    pub(crate) fn hessian(&self, model: &Model, multipliers: &[f64], out: &mut [f64]) {
        let n = model.dimensions.coordinates();
        out.fill(0.0);
        for (constraint, lambda) in model.constraints.iter().zip(multipliers) {
            let at = constraint.points.separation(&model.closure, &self.poses);
            let weight = constraint.weight(&at);
            let squared = !matches!(constraint.kind, ConstraintKind::Axis(_));
            for (k, below) in constraint.points.path.iter().enumerate() {
                let gradient = below.gradient(&model.closure, &self.poses, &at);
                for above in &constraint.points.path[..=k] {
                    let second = above.second(&model.closure, &self.poses, below, gradient);
                    let mut value = weight.dot(second);
                    if squared {
                        let other = above.gradient(&model.closure, &self.poses, &at);
                        value += 2.0 * gradient.dot(other);
                    }
                    let (i, j) = (above.coordinate, below.coordinate);
                    out[i * n + j] += lambda * value;
                    if i != j {
                        out[j * n + i] += lambda * value;
                    }
                }
            }
            if let ConstraintKind::DrivenDistance(length) = constraint.kind {
                out[length * n + length] -= 2.0 * lambda;
            }
        }
    }
}

impl Constraint {
    /// Derivative of the value by the difference of the points.
    fn weight(&self, at: &Separation) -> Vec3 {
        match self.kind {
            ConstraintKind::Distance(_) | ConstraintKind::DrivenDistance(_) => at.difference * 2.0,
            ConstraintKind::Axis(axis) => {
                let mut direction = Vec3::ZERO;
                direction.0[axis] = 1.0;
                direction
            }
        }
    }
}

fn distance(at: &Separation, length: f64) -> (f64, f64) {
    let d = at.difference;
    (d.dot(d) - length * length, 2.0 * d.norm() * at.magnitude + length * length)
}

/// The larger of two numbers; a NaN wins, so that it is never taken for converged.
pub(crate) fn larger(a: f64, b: f64) -> f64 {
    if b > a || b.is_nan() { b } else { a }
}
