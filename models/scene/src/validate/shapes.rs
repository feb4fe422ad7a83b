//! Axes, rotations, bodies and splines.

use nalgebra::{Matrix3, Vector3, Vector4};
use plantd_math::spline::{Knot, Spline};

use crate::limits::MAX_KNOTS;
use crate::rotation::Rotation;
use crate::scene::Body;
use crate::validate::Check;

/// How far a quaternion or a rotation matrix may be from orthonormal: what seven digits leave.
const ORTHONORMAL_TOLERANCE: f64 = 1e-6;
/// Axes that differ by less than this angle, rad, count as parallel.
const PARALLEL: f64 = 1e-6;
/// Axes outside of this range of lengths are taken for mistakes; their squares stay normal numbers.
const AXIS_LENGTHS: std::ops::RangeInclusive<f64> = 1e-100..=1e100;

impl Check<'_> {
    pub(super) fn axis(&mut self, path: &str, axis: &[f64; 3]) {
        if !self.finite_all(path, axis) {
            return;
        }
        let length = Vector3::from(*axis).norm();
        if !AXIS_LENGTHS.contains(&length) {
            self.report(path, format!("has length {length}; it must have a direction"));
        }
    }

    pub(super) fn universal_axes(&mut self, path: &str, axes: &[[f64; 3]; 2]) {
        let before = self.problems.len();
        for (i, axis) in axes.iter().enumerate() {
            self.axis(&format!("{path}[{i}]"), axis);
        }
        let [a, b] = axes.map(|axis| Vector3::from(axis).normalize());
        if self.problems.len() == before && a.cross(&b).norm() < PARALLEL {
            self.report(path, "are parallel");
        }
    }

    pub(super) fn rotation(&mut self, path: &str, rotation: &Rotation) {
        match rotation {
            Rotation::Quaternion(wxyz) => {
                let path = format!("{path}.quaternion");
                let length = Vector4::from(*wxyz).norm();
                if self.finite_all(&path, wxyz) && (length - 1.0).abs() > ORTHONORMAL_TOLERANCE {
                    self.report(path, format!("has length {length}; must be 1"));
                }
            }
            Rotation::Matrix(rows) => self.rotation_matrix(format!("{path}.matrix"), rows),
            Rotation::Rpy(angles) => {
                self.finite_all(&format!("{path}.rpy"), angles);
            }
        }
    }

    fn rotation_matrix(&mut self, path: String, rows: &[[f64; 3]; 3]) {
        let mut finite = true;
        for (i, row) in rows.iter().enumerate() {
            finite &= self.finite_all(&format!("{path}[{i}]"), row);
        }
        if !finite {
            return;
        }
        let r = Matrix3::from_fn(|i, j| rows[i][j]);
        let defect = (r * r.transpose() - Matrix3::identity()).amax();
        if defect > ORTHONORMAL_TOLERANCE {
            self.report(path, format!("is not orthonormal: R Rᵀ differs from 1 by {defect:e}"));
        } else if r.determinant() < 0.0 {
            self.report(path, "is a reflection: its determinant is −1");
        }
    }

    pub(super) fn body(&mut self, path: &str, body: &Body) {
        self.not_negative(format!("{path}.mass"), body.mass);
        self.finite_all(&format!("{path}.center_of_mass"), &body.center_of_mass);
        let path = format!("{path}.inertia");
        let moments = &body.inertia;
        if !matches!(moments.len(), 0 | 3 | 6) {
            self.report(path, format!("has {} entries; must have none, 3 or 6", moments.len()));
            return;
        }
        self.finite_all(&path, moments);
    }

    /// That the knots make a spline.
    pub(super) fn knots(&mut self, path: String, knots: &[Knot]) {
        let before = self.problems.len();
        if knots.len() < 2 || knots.len() > MAX_KNOTS {
            let message = format!("has {} knots; must have 2 to {MAX_KNOTS}", knots.len());
            self.report(path, message);
            return;
        }
        for (i, knot) in knots.iter().enumerate() {
            let path = format!("{path}[{i}]");
            let increases = i == 0 || !(knot.x <= knots[i - 1].x) || !knot.x.is_finite();
            if self.finite(format!("{path}.x"), knot.x) && !increases {
                self.report(format!("{path}.x"), "is not greater than that of the knot before");
            }
            self.finite(format!("{path}.value"), knot.value);
            self.finite(format!("{path}.slope"), knot.slope.unwrap_or_default());
            self.finite(format!("{path}.curvature"), knot.curvature.unwrap_or_default());
        }
        if self.problems.len() == before && Spline::new(knots).is_none() {
            self.report(path, "do not determine a spline; give a slope or a curvature, or space the knots further apart");
        }
    }
}
