//! The scene of a robot.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use plantd_models::Scene;
use plantd_models::scene::{
    Constraint, CouplingTerm, Frame, Input, Joint as SceneJoint, MAX_VISUALS,
};

use crate::document::Reader;
use crate::draft::{BALL, Draft, FREE, as_coordinates};
use crate::inertia::Inertia;
use crate::names::Names;
use crate::options::{Base, EARTH, Inputs, Options};
use crate::report::Kind;
use crate::urdf::read::{Joint, JointKind, Origin, Robot, rotation};
use crate::urdf::visuals::{Colors, visuals};

/// Endings of the coordinates of a planar joint.
const PLANAR: [&str; 3] = ["_x", "_y", "_turn"];

/// Makes the scene.
struct Builder<'r, 'a, 'd> {
    reader: &'r mut Reader<'d>,
    robot: &'r Robot<'a>,
    options: &'r Options,
    draft: Draft,
    /// The frame of each link; none for the world.
    frame_of: Vec<Option<usize>>,
    /// Names of the coordinates of each joint.
    moved: Vec<Vec<String>>,
}

/// Frames in the order of a walk that takes joints as they stand in the file, and what acts on them.
pub(super) fn scene(reader: &mut Reader<'_>, robot: &Robot<'_>, options: &Options) -> Scene {
    let gravity = options.gravity.unwrap_or(EARTH);
    let mut builder = Builder {
        draft: Draft::new("URDF", gravity, options.time_step_s.unwrap_or(0.001), options.stops),
        frame_of: vec![None; robot.links.len()],
        moved: vec![Vec::new(); robot.joints.len()],
        reader,
        robot,
        options,
    };
    builder.place_links();
    builder.place_bodies();
    builder.show_links();
    builder.couple();
    builder.add_inputs();
    builder.draft.finish(builder.reader, robot.name)
}

impl Builder<'_, '_, '_> {
    fn place_links(&mut self) {
        let robot = self.robot;
        let root = &robot.links[robot.root];
        if root.name == "world" {
            if self.options.base == Base::Free {
                self.reader.fail(root.node, "the root is `world`: this file fixes its base itself");
            }
        } else {
            let joint = (self.options.base == Base::Free).then(|| {
                let stem = self.draft.coordinates.add(root.name, &FREE);
                SceneJoint::Free { coordinate: Some(stem) }
            });
            self.frame_of[robot.root] = Some(self.draft.scene.frames.len());
            self.draft.frame(root.name, Frame { joint, ..frame_in("world") });
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
            endings => self.draft.coordinates.add(joint.name, endings),
        };
        self.moved[j] = endings.iter().map(|ending| format!("{stem}{ending}")).collect();
        let coordinate = Some(stem.clone());
        let parent = self.frame_of[joint.parent].map(|frame| &self.draft.scene.frames[frame].name);
        let mut parent = parent.map_or_else(|| "world".to_owned(), String::clone);
        let mut origin = joint.origin;
        let moves = match joint.kind {
            JointKind::Fixed => None,
            JointKind::Revolute => Some(SceneJoint::Revolute { axis, coordinate }),
            JointKind::Prismatic => Some(SceneJoint::Prismatic { axis, coordinate }),
            JointKind::Spherical => Some(SceneJoint::Ball { coordinate }),
            JointKind::Floating => {
                // In the world its coordinates are those of the world, and it begins at its origin.
                if parent == "world" {
                    let start = as_coordinates(&origin.pose());
                    for (name, value) in self.moved[j].clone().iter().zip(start) {
                        self.draft.begin(name, value);
                    }
                    origin = Origin::default();
                }
                Some(SceneJoint::Free { coordinate })
            }
            JointKind::Planar => {
                parent = self.place_slides(joint, &stem, parent);
                origin = Origin::default();
                Some(SceneJoint::Revolute { axis, coordinate: Some(format!("{stem}_turn")) })
            }
        };
        self.frame_of[joint.child] = Some(self.draft.scene.frames.len());
        let frame = Frame { joint: moves, ..placed(&parent, &origin) };
        self.draft.frame(robot.links[joint.child].name, frame);
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
            let coordinate = Some(format!("{stem}{ending}"));
            let slide = SceneJoint::Prismatic { axis: (turn * along).into(), coordinate };
            let frame = Frame { joint: Some(slide), ..placed(&parent, &origin) };
            parent = self.draft.frame(&format!("{}{ending}", joint.name), frame);
            origin = Origin::default();
        }
        parent
    }

    /// Damping, dry friction and limits.
    fn resist(&mut self, j: usize) {
        let Joint { name, node, damping, limits, friction, .. } = self.robot.joints[j];
        for coordinate in &self.moved[j] {
            self.draft.damp(self.reader, coordinate, damping);
            if let Some(limits) = limits {
                self.draft.limit(self.reader, (name, node), coordinate, limits);
            }
            if friction > 0.0 {
                let law = [friction, self.options.friction_velocity];
                self.draft.rub(self.reader, (name, node), coordinate, law);
            }
        }
    }

    /// Bodies of links. Those that are fixed to one another are judged together: one body.
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
            let bodies = group
                .into_iter()
                .filter_map(|(link, pose)| Some((link, pose, robot.links[link].inertia?)))
                .collect::<Vec<_>>();
            if carrier == robot.root && is_held {
                for (link, ..) in bodies {
                    let message = "a body that is fixed to the world: it does not move";
                    self.reader.note(Kind::NoEffect, robot.links[link].node, message);
                }
            } else {
                self.place_group(&bodies);
            }
        }
    }

    fn place_group(&mut self, bodies: &[(usize, Isometry3<f64>, Inertia)]) {
        let culprit = bodies.iter().find(|(.., inertia)| !inertia.is_possible());
        let sum = || Inertia::sum(bodies.iter().map(|(_, pose, inertia)| inertia.at(pose)));
        let mut any_inertia = false;
        if let Some(&(link, ..)) = culprit {
            let sum = sum();
            any_inertia = !sum.is_possible();
            if any_inertia {
                let (link, moments) = (&self.robot.links[link], sum.moments());
                let message = format!(
                    "no body has the inertia of link `{}` and what is fixed to it: {moments:?} kg·m² violate a + b ≥ c",
                    link.name
                );
                self.reader.refuse(link.node, message);
            } else {
                self.reader.exact("inertia that a body has with what is fixed to it only");
            }
        }
        for (link, _, inertia) in bodies {
            if let Some(frame) = self.frame_of[*link] {
                let allow = any_inertia && !inertia.is_possible();
                self.draft.scene.frames[frame].body = Some(inertia.body(allow));
            }
        }
    }

    /// What shows the links, as far as scenes have room for it.
    fn show_links(&mut self) {
        let colors = Colors::read(self.robot.node);
        let mut room = MAX_VISUALS;
        for (link, frame) in self.robot.links.iter().zip(&self.frame_of) {
            let mut shapes = visuals(self.reader, link.node, &colors, self.options);
            shapes.truncate(room);
            room -= shapes.len();
            if let Some(frame) = *frame {
                self.draft.scene.frames[frame].visuals = shapes;
            }
        }
    }

    /// Joints that mimic others: `q − multiplier q_of − offset = 0`, satisfied by the initial configuration.
    fn couple(&mut self) {
        let robot = self.robot;
        for j in 0..robot.joints.len() {
            let Some(mimic) = &robot.joints[j].mimic else { continue };
            let [own, other] = [j, mimic.of].map(|j| self.moved[j][0].clone());
            let term = |coordinate: &String, factor: f64| CouplingTerm {
                coordinate: coordinate.clone(),
                coefficients: vec![factor],
            };
            let mut terms = vec![term(&own, 1.0)];
            if mimic.multiplier != 0.0 {
                terms.push(term(&other, -mimic.multiplier));
            }
            let (name, constant) = (own.clone(), -mimic.offset);
            self.draft.scene.constraints.push(Constraint::Coupling { name, terms, constant });
            self.reader.exact("mimic as a coupling");
            let initial = self.initial(j);
            self.draft.begin(&own, initial);
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
            let limits = joint.effort.map(|effort| {
                self.reader.exact("effort limit of an input");
                [-effort / gain.abs(), effort / gain.abs()]
            });
            let coordinate = Some(coordinate.clone());
            self.draft.scene.inputs.push(Input {
                name,
                coordinate,
                gain,
                limits,
                ..Input::default()
            });
        }
    }
}

fn frame_in(parent: &str) -> Frame {
    Frame { parent: parent.to_owned(), ..Frame::default() }
}

fn placed(parent: &str, origin: &Origin) -> Frame {
    Frame { translation: origin.xyz, rotation: rotation(origin), ..frame_in(parent) }
}
