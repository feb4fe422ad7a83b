//! Frames, joints and bodies of the scene.

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use plantd_models::scene::{
    Component, CoordinateKind, Force, Frame, Joint as SceneJoint, Knot, Spring,
};

use crate::draft::{BALL, FREE, as_coordinates};
use crate::mjcf::build::Build;
use crate::mjcf::tree::{Joint, JointKind, rotation};
use crate::report::Kind;

/// How far from rest a spring of third order is exact, rad or m.
const REACH: f64 = 10.0;

impl Build<'_, '_, '_> {
    /// Frames of all bodies, each after what moves it.
    pub(super) fn place_bodies(&mut self) {
        let tree = self.tree;
        self.frames = tree
            .bodies
            .iter()
            .map(|body| {
                let name = if body.name.is_empty() { "body" } else { &body.name };
                self.draft.frames.add(name, &[""])
            })
            .collect();
        for body in 0..tree.bodies.len() {
            self.place_body(body);
        }
    }

    fn place_body(&mut self, b: usize) {
        let tree = self.tree;
        let body = &tree.bodies[b];
        let mut parent = self.frame(body.parent);
        // Where the next frame stands in the last one.
        let mut place = body.pose;
        let mut joint = None;
        if body.is_mocap {
            joint = Some(self.prescribe(b));
            place = Isometry3::identity();
        }
        for (k, &j) in body.joints.iter().enumerate() {
            let (at, moves, rest) = self.place_joint(j, place);
            place = rest;
            let carrier;
            if k + 1 == body.joints.len() && place == Isometry3::identity() {
                (joint, place) = (Some(moves), at);
                carrier = self.frames[b].clone();
            } else {
                let frame = Frame { joint: Some(moves), ..frame_at(&parent, &at) };
                let name = &self.coordinates[j][0];
                let name = name.strip_suffix("_x").unwrap_or(name).to_owned();
                parent = self.draft.frame(&name, frame);
                carrier = parent.clone();
            }
            self.carriers[j] = carrier;
            self.spring(j);
        }
        let name = self.frames[b].clone();
        let is_moved = body.is_mocap || tree.is_moved(Some(b));
        let inertia =
            body.inertia.filter(|inertia| inertia.mass != 0.0 || inertia.tensor.amax() != 0.0);
        if inertia.is_some() && !is_moved {
            let message = "a body that is fixed to the world: it does not move";
            self.reader.note(Kind::NoEffect, body.node, message);
        }
        let inertia = inertia.filter(|_| is_moved);
        self.draft.scene.frames.push(Frame {
            name: name.clone(),
            joint,
            body: inertia.map(|inertia| inertia.body(!inertia.is_possible())),
            visuals: body.visuals.clone(),
            ..frame_at(&parent, &place)
        });
        if let Some(inertia) = inertia.filter(|inertia| body.lift * inertia.mass != 0.0) {
            let place = Isometry3::from(Translation3::from(inertia.center));
            let at = self.draft.frame(&format!("{name}_lift"), frame_at(&name, &place));
            let weight = self.physics.gravity.map(|g| -g * inertia.mass * body.lift);
            self.draft.scene.forces.push(Force::HybridWrench {
                frame: at,
                force: weight.map(Component::Constant),
                torque: Default::default(),
            });
            self.reader.exact("compensation of gravity");
        }
    }

    /// A mocap body goes where its inputs say.
    fn prescribe(&mut self, b: usize) -> SceneJoint {
        let body = &self.tree.bodies[b];
        let stem = self.draft.coordinates.add(&self.frames[b], &FREE);
        let start = as_coordinates(&body.pose);
        for (ending, value) in FREE.iter().zip(start) {
            let setting = self.draft.setting(&format!("{stem}{ending}"));
            setting.kind = CoordinateKind::Prescribed;
            setting.initial = value;
        }
        self.reader.exact("mocap body as prescribed");
        SceneJoint::Free { coordinate: Some(stem) }
    }

    /// Where a joint's frame stands if the body without it is at `place`, the joint, and where the body is in that
    /// frame.
    fn place_joint(
        &mut self,
        j: usize,
        place: Isometry3<f64>,
    ) -> (Isometry3<f64>, SceneJoint, Isometry3<f64>) {
        let joint = &self.tree.joints[j];
        let body = &self.tree.bodies[joint.body];
        let (endings, what): (&[&str], _) = match joint.kind {
            JointKind::Free => (&FREE, "free joint"),
            JointKind::Ball => (&BALL, "ball joint"),
            JointKind::Slide => (&[""], "slide"),
            JointKind::Hinge => (&[""], "hinge"),
        };
        self.reader.exact(what);
        let name = if joint.name.is_empty() { &self.frames[joint.body] } else { &joint.name };
        let stem = self.draft.coordinates.add(name, endings);
        self.coordinates[j] = endings.iter().map(|ending| format!("{stem}{ending}")).collect();
        let (axis, coordinate) = (joint.axis.into_inner().into(), Some(stem.clone()));
        let anchor = Translation3::from(joint.anchor);
        let back = Isometry3::from(anchor.inverse());
        let result = match joint.kind {
            JointKind::Free => {
                for (ending, value) in FREE.iter().zip(as_coordinates(&body.pose)) {
                    self.draft.begin(&format!("{stem}{ending}"), value);
                }
                (Isometry3::identity(), SceneJoint::Free { coordinate }, Isometry3::identity())
            }
            JointKind::Ball => (place * anchor, SceneJoint::Ball { coordinate }, back),
            JointKind::Slide => {
                let shift = Translation3::from(joint.axis.scale(-joint.reference));
                (place * shift, SceneJoint::Prismatic { axis, coordinate }, Isometry3::identity())
            }
            JointKind::Hinge => {
                let turn = UnitQuaternion::from_axis_angle(&joint.axis, -joint.reference);
                (place * anchor * turn, SceneJoint::Revolute { axis, coordinate }, back)
            }
        };
        if joint.kind.is_single() {
            self.draft.begin(&stem, joint.reference);
        }
        self.resist(j);
        result
    }

    /// Springs, dampers, friction, limits and armature of a joint.
    fn resist(&mut self, j: usize) {
        let joint = &self.tree.joints[j];
        let Joint { node, name, damping, armature, friction, limits, .. } = joint;
        let who = (name.as_str(), *node);
        for coordinate in &self.coordinates[j] {
            if *armature > 0.0 {
                self.draft.setting(coordinate).armature = *armature;
                self.reader.exact("armature");
            }
            if self.physics.has("damper") && joint.spring_damper.is_none() {
                self.draft.damp(self.reader, coordinate, damping[0]);
                let [_, coefficient, cubic] = *damping;
                if coefficient > 0.0 || cubic > 0.0 {
                    let coordinate = coordinate.clone();
                    let drag = Force::CoordinateDrag { coordinate, coefficient, cubic };
                    self.draft.scene.forces.push(drag);
                    self.reader.exact("damping with powers of the velocity");
                }
            }
            if *friction > 0.0 && self.physics.has("frictionloss") {
                let law = [*friction, self.options.friction_velocity];
                self.draft.rub(self.reader, who, coordinate, law);
            }
            if let Some(limits) = limits.filter(|_| self.physics.has("limit")) {
                self.draft.limit(self.reader, who, coordinate, limits);
            }
        }
        if damping.iter().any(|d| *d < 0.0) {
            self.reader.refuse(*node, format!("`damping` of joint `{name}` is negative"));
        }
    }

    fn spring(&mut self, j: usize) {
        let Joint { node, name, kind, stiffness, rest, spring_damper, .. } = &self.tree.joints[j];
        let (rest, [first, second, third]) = (*rest, *stiffness);
        let is_none = *stiffness == [0.0; 3] || spring_damper.is_some();
        if is_none || !self.physics.has("spring") {
            return;
        }
        if !kind.is_single() {
            if first < 0.0 || [second, third] != [0.0; 2] {
                let message = format!(
                    "`stiffness` of joint `{name}`: that of an orientation must be one number, not negative"
                );
                return self.reader.refuse(*node, message);
            }
            return self.turn_back(j, first);
        }
        let coordinate = self.coordinates[j][0].clone();
        if [second, third] == [0.0; 2] && first > 0.0 {
            self.reader.exact("spring of a coordinate");
            let spring = Spring::Coordinate { coordinate, stiffness: first, rest };
            return self.draft.scene.springs.push(spring);
        }
        if third != 0.0 {
            let message = format!(
                "the spring of joint `{name}` is exact up to {REACH} from its rest, and a parabola beyond"
            );
            self.reader.note(Kind::Approximated, *node, message);
        }
        // −(k₁ x + k₂ x² + k₃ x³) and its derivatives.
        let knot = |x: f64| Knot {
            x: rest + x,
            value: -x * (first + x * (second + x * third)),
            slope: Some(-(first + x * (2.0 * second + x * 3.0 * third))),
            curvature: Some(-(2.0 * second + x * 6.0 * third)),
        };
        self.reader.exact("spring with several stiffnesses");
        let knots = vec![knot(-REACH), knot(0.0), knot(REACH)];
        self.draft.scene.springs.push(Spring::Spline { coordinate, knots });
    }

    /// A spring of a ball joint, or of all of a free one, which is at rest where it is in the file.
    fn turn_back(&mut self, j: usize, stiffness: f64) {
        let joint = &self.tree.joints[j];
        let mut rest = None;
        if joint.kind == JointKind::Free {
            let home = &self.tree.bodies[joint.body].pose;
            rest = rotation(&home.rotation);
            let slides = self.coordinates[j].iter().zip(home.translation.vector.iter());
            let springs = slides.map(|(coordinate, &rest)| Spring::Coordinate {
                coordinate: coordinate.clone(),
                stiffness,
                rest,
            });
            self.draft.scene.springs.extend(springs);
        }
        let frame = self.carriers[j].clone();
        self.draft.scene.springs.push(Spring::Orientation { frame, stiffness, rest });
        self.reader.exact("spring of an orientation");
    }

    /// Springs and dampers that are given by a time constant `τ` and a damping ratio `ζ`: with the inertia
    /// `I = 1 / (M⁻¹)_ii` in the configuration of the file `k = I / (τ ζ)²`, `d = 2 I / τ`.
    pub(super) fn adjust_springs(&mut self) {
        let tree = self.tree;
        for (j, joint) in tree.joints.iter().enumerate() {
            let Some([time, ratio]) = joint.spring_damper else { continue };
            let coordinates = self.coordinates[j].clone();
            let Some(mobility) = self.mobility() else {
                let message =
                    "`springdamper`: the mass matrix at the start is not positive definite";
                return self.reader.fail(joint.node, message);
            };
            let rate = |name: &String| mobility.along(std::iter::once((name.as_str(), 1.0)));
            let inertia = coordinates.len() as f64 / coordinates.iter().map(rate).sum::<f64>();
            for coordinate in &coordinates {
                self.draft.damp(self.reader, coordinate, 2.0 * inertia / time);
            }
            let stiffness = inertia / (time * ratio).powi(2);
            match &coordinates[..] {
                [coordinate] => self.draft.scene.springs.push(Spring::Coordinate {
                    coordinate: coordinate.clone(),
                    stiffness,
                    rest: joint.rest,
                }),
                _ => self.turn_back(j, stiffness),
            }
            self.reader.exact("spring and damper by time constant");
        }
    }
}

/// A frame in another, without a name.
pub(super) fn frame_at(parent: &str, place: &Isometry3<f64>) -> Frame {
    Frame {
        parent: parent.to_owned(),
        translation: place.translation.vector.into(),
        rotation: rotation(&place.rotation),
        ..Frame::default()
    }
}
