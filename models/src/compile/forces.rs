//! Forces and signals of a scene, resolved.

use std::collections::BTreeMap;

use plantd_math::spatial::{Force, Mat3, Vec3};
use plantd_scene as scene;
use plantd_scene::{Component, Scene};

use crate::compile::scene::{Layout, Places, settings};
use crate::model::mechanism::{
    Coordinate, CoordinateForce, CoordinateInput, CoordinateLaw, Forces, LinearDamper, LinearLaw,
    PathForce, PointForce, PointLaw, Resistance, Wrench, WrenchKind,
};
use crate::model::signal::{Signal, Target};
use crate::model::tree::{Attachment, Tree, WORLD};

impl Layout {
    /// A force on a coordinate.
    fn force_on(&self, coordinate: usize, law: CoordinateLaw) -> CoordinateForce {
        let component = |first: &usize| coordinate.checked_sub(*first).filter(|i| *i < 3);
        let mut balls = self.orientations.iter().map(component).enumerate();
        let ball = balls.find_map(|(orientation, component)| Some((orientation, component?)));
        CoordinateForce { coordinate, ball, law }
    }

    pub(super) fn coordinate_inputs(&self, scene: &Scene) -> Vec<CoordinateInput> {
        let mut inputs: Vec<CoordinateInput> = Vec::new();
        for (input, i) in scene.inputs.iter().enumerate() {
            let one = i.coordinate.iter().map(|name| (name, i.gain));
            let terms = i.terms.iter().map(|term| (&term.coordinate, term.gain));
            for (name, gain) in one.chain(terms) {
                inputs.push(CoordinateInput { input, coordinate: self.index[name], gain });
            }
        }
        for force in &scene.forces {
            let scene::Force::Servo { input, gain, .. } = force else { continue };
            let input = self.inputs[input.as_str()];
            for (coordinate, c) in self.servo_terms(force) {
                let same = |other: &&mut CoordinateInput| {
                    (other.input, other.coordinate) == (input, coordinate)
                };
                match inputs.iter_mut().find(same) {
                    Some(other) => other.gain += gain * c,
                    None => inputs.push(CoordinateInput { input, coordinate, gain: gain * c }),
                }
            }
        }
        inputs
    }

    /// Dynamic coordinates and factors of the sum of a servo.
    fn servo_terms(&self, force: &scene::Force) -> Vec<(usize, f64)> {
        let scene::Force::Servo { coordinate, terms, .. } = force else { return Vec::new() };
        let alone = coordinate.iter().map(|name| (self.index[name], 1.0));
        let all = alone.chain(self.linear(terms));
        all.filter(|(coordinate, _)| *coordinate < self.dynamic).collect()
    }

    /// Damping of the dynamic coordinates: their own, and of servos on one coordinate.
    pub(super) fn damping(&self, scene: &Scene) -> Vec<f64> {
        let own = |c: &Coordinate| settings(scene, &c.name).and_then(|s| s.damping);
        let coordinates = self.coordinates[..self.dynamic].iter();
        let mut damping: Vec<f64> = coordinates.map(|c| own(c).unwrap_or(scene.damping)).collect();
        for force in &scene.forces {
            if let scene::Force::Servo { coordinate: Some(name), damping: more, .. } = force {
                damping[self.index[name]] += more;
            }
        }
        if damping.iter().any(|c| *c != 0.0) { damping } else { Vec::new() }
    }

    /// Forces without effect are dropped; none if none is left.
    pub(super) fn forces(&self, scene: &Scene, tree: &Tree, index: &[usize]) -> Option<Forces> {
        let places = Places { layout: self, tree, index };
        let mut forces = Forces::default();
        for force in &scene.forces {
            places.add_force(force, &mut forces);
        }
        for spring in &scene.springs {
            places.add_damper_of_stop(spring, &mut forces);
        }
        for input in scene.inputs.iter().filter(|input| !input.points.is_empty()) {
            // A tension that does not follow the length acts along each segment by itself, and couples no others.
            let segments = places.segments(&input.points).into_iter();
            let alone = segments.filter(|ends| !ends.path.is_empty()).map(|ends| PathForce {
                segments: vec![ends],
                inputs: vec![(self.inputs[input.name.as_str()], input.gain)],
                resistance: Resistance::Constant(0.0),
            });
            forces.path_forces.extend(alone);
        }
        (forces.coupling() + forces.coordinate_forces.len() > 0).then_some(forces)
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
            | scene::Force::PathDamper { damping: 0.0, .. }
            | scene::Force::Drag { coefficient: 0.0, .. }
            | scene::Force::CoordinateDrag { coefficient: 0.0, cubic: 0.0, .. }
            | scene::Force::Friction { force: 0.0, .. } => {}
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
            scene::Force::CoordinateDrag { coordinate, coefficient, cubic } => {
                let law = CoordinateLaw::Drag([*coefficient, *cubic]);
                forces.coordinate_forces.push(layout.force_on(index[coordinate], law));
            }
            scene::Force::LinearDamper { terms, damping, input } => {
                let terms = layout.linear(terms);
                let input = input.as_ref().map(|name| layout.inputs[name.as_str()]);
                let law = LinearLaw::Damper { damping: *damping, input };
                forces.linear_dampers.push(LinearDamper { terms, law });
            }
            scene::Force::PathDamper { points, damping } => forces.path_forces.push(PathForce {
                segments: self.segments(points),
                inputs: Vec::new(),
                resistance: Resistance::Constant(*damping),
            }),
            scene::Force::Servo { terms, damping, constant, .. } => {
                // Its input, its spring and the damping of one coordinate are among those of coordinates.
                if !terms.is_empty() && *damping > 0.0 {
                    let (terms, damping) = (layout.linear(terms), *damping);
                    let law = LinearLaw::Damper { damping, input: None };
                    forces.linear_dampers.push(LinearDamper { terms, law });
                }
                if *constant != 0.0 {
                    let terms = layout.servo_terms(force).into_iter();
                    forces.coordinate_forces.extend(terms.map(|(coordinate, c)| {
                        layout.force_on(coordinate, CoordinateLaw::Constant(c * constant))
                    }));
                }
            }
            scene::Force::Friction { coordinate, terms, points, force, velocity } => {
                let (force, velocity) = (*force, *velocity);
                if let Some(name) = coordinate {
                    let law = CoordinateLaw::Friction { force, velocity };
                    forces.coordinate_forces.push(layout.force_on(index[name], law));
                } else if points.is_empty() {
                    let law = LinearLaw::Friction { force, velocity };
                    let terms = layout.linear(terms);
                    forces.linear_dampers.push(LinearDamper { terms, law });
                } else {
                    forces.path_forces.push(PathForce {
                        segments: self.segments(points),
                        inputs: Vec::new(),
                        resistance: Resistance::Friction { force, velocity },
                    });
                }
            }
        }
    }

    fn add_damper_of_stop(&self, spring: &scene::Spring, forces: &mut Forces) {
        let scene::Spring::Stop { coordinate, points, .. } = spring else { return };
        let Some(stop) = self.layout.stop(spring).filter(|stop| stop.damping > 0.0) else { return };
        match coordinate {
            Some(name) => {
                let force =
                    self.layout.force_on(self.layout.index[name], CoordinateLaw::Stop(stop));
                forces.coordinate_forces.push(force);
            }
            None => forces.path_forces.push(PathForce {
                segments: self.segments(points),
                inputs: Vec::new(),
                resistance: Resistance::Stop(stop),
            }),
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
