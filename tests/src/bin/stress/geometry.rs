//! Violations of constraints, from the scene by forward kinematics of its own.

use std::collections::HashMap;

use nalgebra::{
    Isometry3, Matrix3, Point3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3,
};
use plantd_models::scene::{Axis, Constraint, Length, Motion, Point, Rotation};
use plantd_models::{Model, Scene};

/// A scene and the places of its coordinates.
pub(crate) struct Geometry {
    scene: Scene,
    coordinates: HashMap<String, usize>,
    /// Frames, parents first, with their parents.
    order: Vec<(usize, Option<usize>)>,
    frames: HashMap<String, usize>,
}

impl Geometry {
    pub(crate) fn new(model: &Model) -> Self {
        let scene = model.scene().clone();
        let frames: HashMap<_, _> =
            scene.frames.iter().enumerate().map(|(i, frame)| (frame.name.clone(), i)).collect();
        let mut order: Vec<(usize, Option<usize>)> = Vec::new();
        let mut placed = vec![false; frames.len()];
        while order.len() < frames.len() {
            for (i, frame) in scene.frames.iter().enumerate().filter(|(i, _)| !placed[*i]) {
                let parent = frames.get(&frame.parent).copied();
                if parent.is_none_or(|parent| order.iter().any(|(other, _)| *other == parent)) {
                    order.push((i, parent));
                }
            }
            order.iter().for_each(|(i, _)| placed[*i] = true);
        }
        let names = model.coordinates().iter().enumerate();
        let coordinates = names.map(|(i, coordinate)| (coordinate.name.clone(), i)).collect();
        Self { scene, coordinates, order, frames }
    }

    fn poses(&self, q: &[f64]) -> Vec<Isometry3<f64>> {
        let mut poses = vec![Isometry3::identity(); self.scene.frames.len()];
        for &(i, parent) in &self.order {
            let frame = &self.scene.frames[i];
            let mut pose = parent.map_or(Isometry3::identity(), |parent| poses[parent]);
            pose *= Translation3::from(frame.translation);
            if let Some(rotation) = &frame.rotation {
                pose *= quaternion(rotation);
            }
            let mut turn = Vector3::zeros();
            for (name, motion) in frame.motions() {
                let value = q[self.coordinates[&name]];
                match motion {
                    Motion::Revolute(axis) => {
                        pose *= UnitQuaternion::new(Vector3::from(axis).normalize() * value);
                    }
                    Motion::Prismatic(axis) => {
                        pose *= Translation3::from(Vector3::from(axis).normalize() * value);
                    }
                    Motion::Screw(axis, pitch) => {
                        let axis = Vector3::from(axis).normalize();
                        pose *= UnitQuaternion::new(axis * value);
                        pose *= Translation3::from(axis * (pitch * value));
                    }
                    Motion::Ball(component) => turn[component] = value,
                }
            }
            poses[i] = pose * UnitQuaternion::new(turn);
        }
        poses
    }

    /// The worst violation of a constraint, relative to the size of the mechanism.
    pub(crate) fn violation(&self, q: &[f64]) -> f64 {
        let poses = self.poses(q);
        let pose = |name: &str| match self.frames.get(name) {
            Some(&i) => poses[i],
            None => Isometry3::identity(),
        };
        let place = |point: &Point| pose(&point.frame) * Point3::from(point.at);
        let size = poses.iter().map(|pose| pose.translation.vector.norm()).fold(0.0, f64::max);
        let length = |length: &Length| match length {
            Length::Fixed(value) => *value,
            Length::Coordinate(name) => q[self.coordinates[name]],
        };
        let mut worst = 0.0_f64;
        let mut note = |violation: f64| {
            // A NaN stays.
            worst = if violation.abs() <= worst { worst } else { violation.abs() };
        };
        for constraint in &self.scene.constraints {
            match constraint {
                Constraint::Distance { a, b, length: expected, .. } => {
                    let (a, b, expected) = (place(a), place(b), length(expected));
                    let size = size + a.coords.norm() + b.coords.norm();
                    note(((a - b).norm() - expected) / size);
                }
                Constraint::PathLength { points, length: expected, .. } => {
                    let points: Vec<_> = points.iter().map(place).collect();
                    let path: f64 = points.windows(2).map(|pair| (pair[0] - pair[1]).norm()).sum();
                    note((path - length(expected)) / (size + path));
                }
                Constraint::PointToPoint { a, b, axes, .. } => {
                    let (a, b) = (place(a), place(b));
                    let size = size + a.coords.norm() + b.coords.norm();
                    for axis in axes {
                        let component = match axis {
                            Axis::X => 0,
                            Axis::Y => 1,
                            Axis::Z => 2,
                        };
                        note((a - b)[component] / size);
                    }
                }
                Constraint::PointOnPlane { plane, point, .. } => {
                    let frame = pose(&plane.frame);
                    let (a, b) = (frame * Point3::from(plane.at), place(point));
                    let size = size + a.coords.norm() + b.coords.norm();
                    let normal = (frame * Vector3::from(plane.normal)).normalize();
                    note(normal.dot(&(a - b)) / size);
                }
                Constraint::Orientation { a, b, .. } => note(misalignment(&pose(a), &pose(b))),
                Constraint::Weld { a, b, .. } => {
                    let (a, b) = (pose(a), pose(b));
                    note((a.translation.vector - b.translation.vector).norm() / size);
                    note(misalignment(&a, &b));
                }
                Constraint::Coupling { terms, constant, .. } => {
                    let (mut sum, mut size) = (*constant, constant.abs());
                    for term in terms {
                        let q = q[self.coordinates[&term.coordinate]];
                        for (coefficient, power) in term.coefficients.iter().zip(1..) {
                            sum += coefficient * q.powi(power);
                            size += (coefficient * q.powi(power)).abs();
                        }
                    }
                    if size > 0.0 {
                        note(sum / size);
                    }
                }
            }
        }
        worst
    }
}

/// Angle between two orientations, rad.
fn misalignment(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.rotation.inverse() * b.rotation).scaled_axis().norm()
}

fn quaternion(rotation: &Rotation) -> UnitQuaternion<f64> {
    match rotation {
        Rotation::Quaternion([w, x, y, z]) => {
            UnitQuaternion::from_quaternion(Quaternion::new(*w, *x, *y, *z))
        }
        Rotation::Matrix(rows) => {
            let matrix = Matrix3::from_fn(|i, j| rows[i][j]);
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
        }
        Rotation::Rpy([roll, pitch, yaw]) => UnitQuaternion::from_euler_angles(*roll, *pitch, *yaw),
    }
}
