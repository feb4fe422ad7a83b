//! Forces and signals of a scene, resolved.

use std::collections::BTreeMap;

use crate::compile::scene::{Layout, Places};
use crate::math::spatial::{Force, Mat3, Vec3};
use crate::model::mechanism::{
    CoordinateForce, CoordinateInput, CoordinateLaw, Forces, LinearDamper, PointForce, PointLaw,
    Wrench, WrenchKind,
};
use crate::model::signal::{Signal, Target};
use crate::model::tree::{Attachment, Tree, WORLD};
use crate::scene;
use crate::scene::Scene;
use crate::scene::forces::Component;

impl Layout {
    pub(super) fn coordinate_inputs(&self, scene: &Scene) -> Vec<CoordinateInput> {
        let mut inputs = Vec::new();
        for (input, i) in scene.inputs.iter().enumerate() {
            let one = i.coordinate.iter().map(|name| (name, i.gain));
            let terms = i.terms.iter().map(|term| (&term.coordinate, term.gain));
            for (name, gain) in one.chain(terms) {
                inputs.push(CoordinateInput { input, coordinate: self.index[name], gain });
            }
        }
        inputs
    }

    /// Forces without effect are dropped; none if none is left.
    pub(super) fn forces(&self, scene: &Scene, tree: &Tree, index: &[usize]) -> Option<Forces> {
        let places = Places { layout: self, tree, index };
        let mut forces = Forces::default();
        for force in &scene.forces {
            places.add_force(force, &mut forces);
        }
        let Forces { wrenches, point_forces, coordinate_forces, linear_dampers } = &forces;
        let velocity_forces = point_forces.len() + coordinate_forces.len() + linear_dampers.len();
        (wrenches.len() + velocity_forces > 0).then_some(forces)
    }

    pub(super) fn signals(&self, scene: &Scene) -> Vec<Signal> {
        let target = |name: &str| match self.inputs.get(name) {
            Some(&input) => Target::Input(input),
            None => Target::Prescribed(self.index[name] - self.dynamic),
        };
        scene.signals.iter().map(|signal| Signal::new(target(signal.drives()), signal)).collect()
    }
}

impl Places<'_> {
    fn add_force(&self, force: &scene::Force, forces: &mut Forces) {
        let (layout, index) = (self.layout, &self.layout.index);
        match force {
            scene::Force::TwoPointDamper { damping: 0.0, .. }
            | scene::Force::LinearDamper { damping: 0.0, .. }
            | scene::Force::Drag { coefficient: 0.0, .. }
            | scene::Force::CoordinateDrag { coefficient: 0.0, .. }
            | scene::Force::Friction { force: 0.0, .. } => {}
            scene::Force::PathDamper { .. } | scene::Force::Servo { .. } => {}
            scene::Force::BodyWrench { frame, force, torque } => {
                forces.wrenches.push(self.wrench(WrenchKind::Body, frame, force, torque));
            }
            scene::Force::SpatialWrench { frame, force, torque } => {
                forces.wrenches.push(self.wrench(WrenchKind::Spatial, frame, force, torque));
            }
            scene::Force::HybridWrench { frame, force, torque } => {
                forces.wrenches.push(self.wrench(WrenchKind::Hybrid, frame, force, torque));
            }
            scene::Force::Thruster { frame, at, axis, input, gain } => {
                let axis = layout.frames[frame].rotation.apply(Vec3(*axis));
                let thrust = Force { n: Vec3::ZERO, f: axis * (gain / axis.norm()) };
                let at = self.attachment(frame, *at);
                forces.wrenches.push(Wrench {
                    kind: WrenchKind::Body,
                    at,
                    path: self.tree.path(at.joint),
                    constant: Force::default(),
                    inputs: vec![(self.layout.inputs[input.as_str()], thrust)],
                });
            }
            scene::Force::TwoPointDamper { a, b, damping } => {
                let ends = self.between(layout.attachment(a), layout.attachment(b));
                let law = PointLaw::Damper(*damping);
                forces.point_forces.push(PointForce { ends, law });
            }
            scene::Force::Drag { frame, at, coefficient } => {
                let still = Attachment { joint: WORLD, point: Vec3::ZERO };
                let ends = self.between(layout.fixed(frame, *at), still);
                let law = PointLaw::Drag(*coefficient);
                forces.point_forces.push(PointForce { ends, law });
            }
            scene::Force::CoordinateDrag { coordinate, coefficient } => {
                let (coordinate, law) = (index[coordinate], CoordinateLaw::Drag(*coefficient));
                forces.coordinate_forces.push(CoordinateForce { coordinate, law });
            }
            scene::Force::LinearDamper { terms, damping } => {
                let terms = layout.linear(terms);
                forces.linear_dampers.push(LinearDamper { terms, damping: *damping });
            }
            scene::Force::Friction { coordinate, force, velocity } => {
                let law = CoordinateLaw::Friction { force: *force, velocity: *velocity };
                let coordinate = index[coordinate];
                forces.coordinate_forces.push(CoordinateForce { coordinate, law });
            }
        }
    }

    fn attachment(&self, frame: &str, at: [f64; 3]) -> Attachment {
        self.resolve(self.layout.fixed(frame, at))
    }

    fn wrench(
        &self,
        kind: WrenchKind,
        frame: &str,
        force: &[Component; 3],
        torque: &[Component; 3],
    ) -> Wrench {
        let axes = match kind {
            WrenchKind::Body => self.layout.frames[frame].rotation,
            WrenchKind::Spatial | WrenchKind::Hybrid => Mat3::IDENTITY,
        };
        let mut constant = Force::default();
        let mut inputs: BTreeMap<usize, Force> = BTreeMap::new();
        for (i, axis) in axes.0.into_iter().enumerate() {
            let along = |n: Vec3, f: Vec3| Force { n, f };
            for (component, unit) in
                [(&torque[i], along(axis, Vec3::ZERO)), (&force[i], along(Vec3::ZERO, axis))]
            {
                match component.input() {
                    None => constant = constant.add_scaled(component.constant(), unit),
                    Some((name, gain)) => {
                        let total = inputs.entry(self.layout.inputs[name]).or_default();
                        *total = total.add_scaled(gain, unit);
                    }
                }
            }
        }
        let at = self.attachment(frame, [0.0; 3]);
        let path = self.tree.path(at.joint);
        Wrench { kind, at, path, constant, inputs: inputs.into_iter().collect() }
    }
}
