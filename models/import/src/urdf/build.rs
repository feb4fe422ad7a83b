//! The scene of a robot.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use plantd_models::Scene;
use plantd_models::scene::{
    Body, Constraint, Coordinate, CoordinateKind, CouplingTerm, Force, Frame, Input,
    Joint as SceneJoint, Rotation,
};

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::names::{self, Names};
use crate::options::{Base, Inputs, Options};
use crate::report::Kind;
use crate::urdf::read::{Joint, JointKind, Origin, Robot, Turn};

/// Endings of the coordinates of joints that have several.
const FREE: [&str; 6] = ["_x", "_y", "_z", "_rx", "_ry", "_rz"];
const BALL: [&str; 3] = ["_rx", "_ry", "_rz"];
const PLANAR: [&str; 3] = ["_x", "_y", "_turn"];

/// A scene in the making.
struct Builder<'r, 'a, 'd> {
    reader: &'r mut Reader<'d>,
    robot: &'r Robot<'a>,
    options: &'r Options,
    scene: Scene,
    frames: Names,
    coordinates: Names,
    /// Name of the frame of each link.
    frame_of: Vec<String>,
    /// Names of the coordinates of each joint.
    moved: Vec<Vec<String>>,
}

/// Frames in the order of a walk that takes joints as they stand in the file, and what acts on them.
pub(super) fn scene(reader: &mut Reader<'_>, robot: &Robot<'_>, options: &Options) -> Scene {
    let mut builder = Builder {
        scene: Scene {
            format: 1,
            description: "Imported from URDF.".to_owned(),
            time_step_s: options.time_step_s,
            gravity: options.gravity,
            ..Scene::default()
        },
        frames: Names::new("frame", &["world"]),
        coordinates: Names::new("coordinate", &[]),
        frame_of: vec![String::new(); robot.links.len()],
        moved: vec![Vec::new(); robot.joints.len()],
        reader,
        robot,
        options,
    };
    builder.place_links();
    builder.place_bodies();
    builder.couple();
    builder.add_inputs();
    builder.name()
}

impl Builder<'_, '_, '_> {
    fn place_links(&mut self) {
        let robot = self.robot;
        let root = &robot.links[robot.root];
        if root.name == "world" {
            self.frame_of[robot.root] = "world".to_owned();
            if self.options.base == Base::Free {
                self.reader.fail(root.node, "the root is `world`: this file fixes its base itself");
            }
        } else {
            let joint = (self.options.base == Base::Free).then(|| {
                let stem = self.coordinates.add(root.name, &FREE);
                SceneJoint::Free { coordinate: Some(stem) }
            });
            let name = self.frames.add(root.name, &[""]);
            self.frame_of[robot.root].clone_from(&name);
            self.scene.frames.push(Frame { name, joint, ..frame_in("world") });
        }
        let mut open: Vec<usize> = robot.leaving[robot.root].iter().rev().copied().collect();
        while let Some(j) = open.pop() {
            self.place_joint(j);
            open.extend(robot.leaving[robot.joints[j].child].iter().rev());
        }
    }

    /// The frame of a joint's child, and what moves it.
    fn place_joint(&mut self, j: usize) {
        let robot = self.robot;
        let joint = &robot.joints[j];
        let axis = joint.axis;
        let endings: &[&str] = match joint.kind {
            JointKind::Fixed => &[],
            JointKind::Revolute | JointKind::Prismatic => &[""],
            JointKind::Planar => &PLANAR,
            JointKind::Spherical => &BALL,
            JointKind::Floating => &FREE,
        };
        let stem = match endings {
            [] => String::new(),
            endings => self.coordinates.add(joint.name, endings),
        };
        self.moved[j] = endings.iter().map(|ending| format!("{stem}{ending}")).collect();
        let coordinate = Some(stem.clone());
        let mut parent = self.frame_of[joint.parent].clone();
        let mut origin = joint.origin;
        let moves = match joint.kind {
            JointKind::Fixed => None,
            JointKind::Revolute => Some(SceneJoint::Revolute { axis, coordinate }),
            JointKind::Prismatic => Some(SceneJoint::Prismatic { axis, coordinate }),
            JointKind::Spherical => Some(SceneJoint::Ball { coordinate }),
            JointKind::Floating => Some(SceneJoint::Free { coordinate }),
            JointKind::Planar => {
                parent = self.place_slides(joint, &stem, parent);
                origin = Origin::default();
                Some(SceneJoint::Revolute { axis, coordinate: Some(format!("{stem}_turn")) })
            }
        };
        let name = self.frames.add(robot.links[joint.child].name, &[""]);
        self.frame_of[joint.child].clone_from(&name);
        self.scene.frames.push(Frame { name, joint: moves, ..placed(&parent, &origin) });
        self.resist(j);
    }

    /// The two slides of a planar joint, along what the shortest turn of z onto the axis makes of x and y.
    fn place_slides(&mut self, joint: &Joint<'_>, stem: &str, mut parent: String) -> String {
        let normal = Vector3::from(joint.axis);
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &normal).unwrap_or_else(|| {
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
        });
        let mut origin = joint.origin;
        for (along, ending) in [(Vector3::x(), "_x"), (Vector3::y(), "_y")] {
            let name = self.frames.add(&format!("{}{ending}", joint.name), &[""]);
            let coordinate = Some(format!("{stem}{ending}"));
            let slide = SceneJoint::Prismatic { axis: (turn * along).into(), coordinate };
            self.scene.frames.push(Frame {
                name: name.clone(),
                joint: Some(slide),
                ..placed(&parent, &origin)
            });
            (parent, origin) = (name, Origin::default());
        }
        parent
    }

    /// Damping and dry friction.
    fn resist(&mut self, j: usize) {
        let joint = &self.robot.joints[j];
        for name in &self.moved[j] {
            if joint.damping > 0.0 {
                self.scene.coordinates.push(setting(name, 0.0, Some(joint.damping)));
                self.reader.exact("damping of a coordinate");
            }
            if joint.friction > 0.0 {
                let velocity = self.options.friction_velocity;
                let message = format!(
                    "dry friction of joint `{}` is {} tanh(v / {velocity}): it creeps under load",
                    joint.name, joint.friction
                );
                self.reader.note(Kind::Approximated, joint.node, message);
                let (coordinate, force) = (name.clone(), joint.friction);
                self.scene.forces.push(Force::Friction { coordinate, force, velocity });
            }
        }
    }

    /// Bodies of links; those that are fixed to one another become one where one of them could not be a body
    /// alone.
    fn place_bodies(&mut self) {
        let robot = self.robot;
        let is_held = self.options.base == Base::Fixed || robot.links[robot.root].name == "world";
        let mut open = vec![robot.root];
        while let Some(carrier) = open.pop() {
            // What moves as one with this link, and where it stands in its frame.
            let (mut group, mut next) = (vec![(carrier, Isometry3::identity())], 0);
            while let Some(&(link, pose)) = group.get(next) {
                next += 1;
                for &j in &robot.leaving[link] {
                    let joint = &robot.joints[j];
                    if joint.kind == JointKind::Fixed {
                        group.push((joint.child, pose * joint.origin.pose()));
                    } else {
                        open.push(joint.child);
                    }
                }
            }
            group.retain(|(link, _)| robot.links[*link].inertia.is_some());
            if carrier == robot.root && is_held {
                for (link, _) in group {
                    let message = "a body that is fixed to the world: it does not move";
                    self.reader.note(Kind::NoEffect, robot.links[link].node, message);
                }
            } else {
                self.place_group(carrier, &group);
            }
        }
    }

    fn place_group(&mut self, carrier: usize, group: &[(usize, Isometry3<f64>)]) {
        let robot = self.robot;
        let own = |link: usize| robot.links[link].inertia.expect("links without are left out");
        if group.iter().all(|(link, _)| own(*link).is_possible()) {
            for (link, _) in group {
                self.place_body(*link, own(*link).body(false));
            }
            return;
        }
        let bodies: Vec<Inertia> = group.iter().map(|(link, pose)| own(*link).at(pose)).collect();
        let sum = Inertia::sum(&bodies);
        let is_possible = sum.is_possible();
        if is_possible {
            self.reader.exact("group of fixed links that is a body although one of them is not");
        } else {
            let (link, moments) = (&robot.links[carrier], sum.moments());
            let message = format!(
                "no body has the inertia of link `{}` and what is fixed to it: {moments:?} kg·m² violate a + b ≥ c",
                link.name
            );
            self.reader.refuse(link.node, message);
        }
        self.place_body(carrier, sum.body(!is_possible));
    }

    fn place_body(&mut self, link: usize, body: Body) {
        let name = &self.frame_of[link];
        if let Some(frame) = self.scene.frames.iter_mut().find(|frame| frame.name == *name) {
            frame.body = Some(body);
        }
    }

    /// Joints that mimic others: `q − multiplier q_of − offset = 0`, satisfied by the initial configuration.
    fn couple(&mut self) {
        let robot = self.robot;
        for j in 0..robot.joints.len() {
            let Some(mimic) = &robot.joints[j].mimic else { continue };
            let (own, other) = (&self.moved[j][0], &self.moved[mimic.of][0]);
            let term = |coordinate: &String, factor: f64| CouplingTerm {
                coordinate: coordinate.clone(),
                coefficients: vec![factor],
            };
            let mut terms = vec![term(own, 1.0)];
            if mimic.multiplier != 0.0 {
                terms.push(term(other, -mimic.multiplier));
            }
            let constant = -mimic.offset;
            self.scene.constraints.push(Constraint::Coupling {
                name: own.clone(),
                terms,
                constant,
            });
            self.reader.exact("mimic as a coupling");
            let initial = self.initial(j);
            if initial == 0.0 {
                continue;
            }
            match self.scene.coordinates.iter_mut().find(|known| known.name == *own) {
                Some(known) => known.initial = initial,
                None => self.scene.coordinates.push(setting(own, initial, None)),
            }
        }
    }

    /// Where a joint begins when all that mimic no other begin at zero.
    fn initial(&self, mut j: usize) -> f64 {
        let (mut factor, mut sum) = (1.0, 0.0);
        while let Some(mimic) = &self.robot.joints[j].mimic {
            sum += factor * mimic.offset;
            factor *= mimic.multiplier;
            j = mimic.of;
        }
        sum
    }

    fn add_inputs(&mut self) {
        let robot = self.robot;
        let can_be = |joint: &Joint<'_>| {
            matches!(joint.kind, JointKind::Revolute | JointKind::Prismatic)
                && joint.mimic.is_none()
        };
        let all = || {
            let joints = robot.joints.iter().enumerate().filter(|(_, joint)| can_be(joint));
            joints.map(|(j, _)| (j, 1.0)).collect::<Vec<_>>()
        };
        let chosen = match self.options.inputs {
            Inputs::None => Vec::new(),
            Inputs::All => all(),
            Inputs::AsTold if robot.actuated.is_empty() => all(),
            Inputs::AsTold => robot.actuated.clone(),
        };
        let mut names = Names::new("input", &[]);
        for (j, gain) in chosen {
            let joint = &robot.joints[j];
            let [coordinate] = &self.moved[j][..] else {
                let message = format!(
                    "joint `{}` has a drive; it does not move about or along one axis",
                    joint.name
                );
                self.reader.refuse(joint.node, message);
                continue;
            };
            let name = names.add(&format!("{coordinate}_drive"), &[""]);
            self.scene.inputs.push(Input { name, coordinate: Some(coordinate.clone()), gain });
        }
    }

    fn name(mut self) -> Scene {
        let changed = &mut self.reader.report.names;
        self.scene.name = names::of_scene(self.robot.name, changed);
        changed.append(&mut self.frames.changed);
        changed.append(&mut self.coordinates.changed);
        self.scene
    }
}

fn frame_in(parent: &str) -> Frame {
    Frame { parent: parent.to_owned(), ..Frame::default() }
}

fn placed(parent: &str, origin: &Origin) -> Frame {
    let rotation = match origin.rotation {
        Turn::Rpy([0.0, 0.0, 0.0]) => None,
        Turn::Rpy(angles) => Some(Rotation::Rpy(angles)),
        Turn::Quaternion(quaternion) => Some(Rotation::Quaternion(quaternion)),
    };
    Frame { translation: origin.xyz, rotation, ..frame_in(parent) }
}

fn setting(name: &str, initial: f64, damping: Option<f64>) -> Coordinate {
    Coordinate { name: name.to_owned(), kind: CoordinateKind::Dynamic, initial, damping }
}
