//! Forces: what they act on, and what they follow.

use crate::forces::{Component, Force, ScaledInput};
use crate::validate::Check;
use crate::words::UnknownName;

impl Check<'_> {
    pub(super) fn forces(&mut self) {
        for (i, force) in self.scene.forces.iter().enumerate() {
            let path = format!("forces[{i}]");
            match force {
                Force::BodyWrench { frame, force, torque }
                | Force::SpatialWrench { frame, force, torque }
                | Force::HybridWrench { frame, force, torque } => {
                    self.moved(&path, frame);
                    self.components(&format!("{path}.force"), force);
                    self.components(&format!("{path}.torque"), torque);
                    if force.iter().chain(torque).all(|c| *c == Component::default()) {
                        self.report(path, "is zero; it would have no effect");
                    }
                }
                Force::Thruster { frame, at, axis, input, gain } => {
                    self.moved(&path, frame);
                    self.finite_all(&format!("{path}.at"), at);
                    self.axis(&format!("{path}.axis"), axis);
                    self.known_input(format!("{path}.input"), input);
                    self.factor(format!("{path}.gain"), *gain, "input");
                }
                Force::TwoPointDamper { a, b, damping } => {
                    self.not_negative(format!("{path}.damping"), *damping);
                    if self.between(&path, a, b).is_some_and(|motion| !motion.dynamic) {
                        let message = "no dynamic coordinate moves its ends against each other";
                        self.report(path, message);
                    }
                }
                Force::Drag { frame, at, coefficient } => {
                    self.moved(&path, frame);
                    self.finite_all(&format!("{path}.at"), at);
                    self.not_negative(format!("{path}.coefficient"), *coefficient);
                }
                Force::CoordinateDrag { coordinate, coefficient, cubic } => {
                    self.dynamic_coordinate(format!("{path}.coordinate"), coordinate);
                    self.not_negative(format!("{path}.coefficient"), *coefficient);
                    self.not_negative(format!("{path}.cubic"), *cubic);
                }
                Force::LinearDamper { terms, damping, input } => {
                    self.linear_terms(&path, terms);
                    if let Some(input) = input {
                        self.known_input(format!("{path}.input"), input);
                    }
                    self.not_negative(format!("{path}.damping"), *damping);
                }
                Force::PathDamper { points, damping } => {
                    self.not_negative(format!("{path}.damping"), *damping);
                    self.moved_along(&path, points);
                }
                Force::Servo { coordinate, terms, input, gain, stiffness, damping, constant } => {
                    match coordinate {
                        Some(name) if terms.is_empty() => {
                            self.dynamic_coordinate(format!("{path}.coordinate"), name);
                            self.not_of_an_orientation(format!("{path}.coordinate"), name);
                        }
                        None if !terms.is_empty() => self.linear_terms(&path, terms),
                        _ => self.report(&path, "must have either `coordinate` or `terms`"),
                    }
                    self.known_input(format!("{path}.input"), input);
                    self.factor(format!("{path}.gain"), *gain, "input");
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    self.not_negative(format!("{path}.damping"), *damping);
                    self.finite(format!("{path}.constant"), *constant);
                }
                Force::Friction { coordinate, terms, points, force, velocity } => {
                    match coordinate {
                        Some(name) if terms.is_empty() && points.is_empty() => {
                            self.dynamic_coordinate(format!("{path}.coordinate"), name);
                        }
                        None if !terms.is_empty() && points.is_empty() => {
                            self.linear_terms(&path, terms);
                        }
                        None if terms.is_empty() && !points.is_empty() => {
                            self.moved_along(&path, points);
                        }
                        _ => self
                            .report(&path, "must have one of `coordinate`, `terms` and `points`"),
                    }
                    self.not_negative(format!("{path}.force"), *force);
                    self.positive(format!("{path}.velocity"), *velocity);
                }
            }
        }
    }

    /// That a frame exists and gives way to a force.
    fn moved(&mut self, path: &str, frame: &str) {
        let Some(carrier) = self.carrier(format!("{path}.frame"), frame) else { return };
        let motion = self.relative_motion(&[carrier, None], |_| true);
        if motion.is_some_and(|motion| !motion.dynamic) {
            let message = format!("no dynamic coordinate moves `{frame}`");
            self.report(format!("{path}.frame"), message);
        }
    }

    fn components(&mut self, path: &str, components: &[Component; 3]) {
        for (i, component) in components.iter().enumerate() {
            let path = format!("{path}[{i}]");
            match component {
                Component::Constant(value) => {
                    self.finite(path, *value);
                }
                Component::Input(name) => self.known_input(path, name),
                Component::Scaled(ScaledInput { input, gain }) => {
                    self.known_input(format!("{path}.input"), input);
                    self.factor(format!("{path}.gain"), *gain, "input");
                }
            }
        }
    }

    pub(super) fn known_input(&mut self, path: String, name: &str) {
        if !self.inputs.contains(name) {
            let name = UnknownName::among(name, &self.inputs);
            self.report(path, format!("there is no input {name}"));
        }
    }

    /// A factor of an input or a term, which would have no effect if it were zero.
    pub(super) fn factor(&mut self, path: String, factor: f64, of: &str) {
        if self.finite(path.clone(), factor) && factor == 0.0 {
            self.report(path, format!("is zero; the {of} would have no effect"));
        }
    }
}
