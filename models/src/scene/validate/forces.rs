//! Forces: what they act on, and what they follow.

use std::collections::BTreeSet;

use crate::scene::forces::{Component, Force};
use crate::scene::validate::Check;

impl Check<'_> {
    pub(super) fn forces(&mut self) {
        let inputs: BTreeSet<_> = self.scene.inputs.iter().map(|i| i.name.as_str()).collect();
        for (i, force) in self.scene.forces.iter().enumerate() {
            let path = format!("forces[{i}]");
            match force {
                Force::BodyWrench { frame, force, torque }
                | Force::SpatialWrench { frame, force, torque }
                | Force::HybridWrench { frame, force, torque } => {
                    self.moved(&path, frame);
                    self.components(&format!("{path}.force"), force, &inputs);
                    self.components(&format!("{path}.torque"), torque, &inputs);
                    if force.iter().chain(torque).all(|c| *c == Component::default()) {
                        self.report(path, "is zero; it would have no effect");
                    }
                }
                Force::Thruster { frame, at, axis, input, gain } => {
                    self.moved(&path, frame);
                    self.finite_all(&format!("{path}.at"), at);
                    self.axis(&format!("{path}.axis"), axis);
                    self.known_input(format!("{path}.input"), input, &inputs);
                    self.factor(format!("{path}.gain"), *gain);
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
                Force::CoordinateDrag { coordinate, coefficient } => {
                    self.dynamic_coordinate(format!("{path}.coordinate"), coordinate);
                    self.not_negative(format!("{path}.coefficient"), *coefficient);
                }
                Force::LinearDamper { terms, damping } => {
                    self.linear_terms(&path, terms);
                    self.not_negative(format!("{path}.damping"), *damping);
                }
                Force::Friction { coordinate, force, velocity } => {
                    self.dynamic_coordinate(format!("{path}.coordinate"), coordinate);
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

    fn components(&mut self, path: &str, components: &[Component; 3], inputs: &BTreeSet<&str>) {
        for (i, component) in components.iter().enumerate() {
            let path = format!("{path}[{i}]");
            match component {
                Component::Constant(value) => {
                    self.finite(path, *value);
                }
                Component::Input(name) => self.known_input(path, name, inputs),
            }
        }
    }

    fn known_input(&mut self, path: String, name: &str, inputs: &BTreeSet<&str>) {
        if !inputs.contains(name) {
            self.report(path, format!("there is no input `{name}`"));
        }
    }

    /// A factor of an input, without which the input would have no effect.
    fn factor(&mut self, path: String, gain: f64) {
        if self.finite(path.clone(), gain) && gain == 0.0 {
            self.report(path, "is zero; the input would have no effect");
        }
    }
}
