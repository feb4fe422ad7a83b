//! Lines through points: from frames to those that carry them, and what acts between points.

use std::collections::{BTreeMap, BTreeSet};

use plantd_scene::{Constraint, Force, Motion, Point, Scene};

use crate::drawing::rig::Rig;
use crate::drawing::shapes::Placed;
use crate::model::tree::Attachment;

/// What a line stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineKind {
    /// From a frame to the one that carries it, or to the centre of mass of its body.
    Link,
    /// A spring or a damper.
    Spring,
    /// A constraint: a rod, a string, a rope, or the gap between two points that coincide.
    Constraint,
    /// A path along which an input acts.
    Path,
}

/// A line through points.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// What it stands for.
    pub kind: LineKind,
    /// Name of the constraint, input or frame; empty for others.
    pub name: String,
    /// Number of its points, at least 2.
    pub points: usize,
}

/// Lines, and their points one after the other.
#[derive(Clone, Debug, Default)]
pub(super) struct Lines {
    pub(super) lines: Vec<Line>,
    pub(super) points: Vec<Attachment>,
}

impl Lines {
    pub(super) fn new(scene: &Scene, rig: &Rig, shown: &[Placed]) -> Self {
        let mut lines = Self::default();
        lines.add_links(scene, rig, shown);
        lines.add_springs(scene, rig);
        for constraint in &scene.constraints {
            lines.add_constraint(constraint, rig);
        }
        for input in scene.inputs.iter().filter(|input| !input.points.is_empty()) {
            let points = input.points.iter().map(|point| rig.point(point));
            lines.push(LineKind::Path, &input.name, points);
        }
        lines
    }

    fn push(&mut self, kind: LineKind, name: &str, points: impl IntoIterator<Item = Attachment>) {
        let before = self.points.len();
        self.points.extend(points);
        let points = self.points.len() - before;
        self.lines.push(Line { kind, name: name.to_owned(), points });
    }

    /// A frame is drawn back to its parent if it, or a frame that it carries, shows or holds something; one that
    /// slides, if its parent does so itself.
    fn add_links(&mut self, scene: &Scene, rig: &Rig, shown: &[Placed]) {
        let mut wanted: BTreeSet<&str> =
            shown.iter().map(|placed| placed.frame.name.as_str()).collect();
        let held = held_points(scene);
        wanted.extend(held.iter().map(|point| point.frame.as_str()));
        for constraint in &scene.constraints {
            wanted.extend(constraint.frames());
        }
        let parents: BTreeMap<&str, &str> =
            scene.frames.iter().map(|frame| (&*frame.name, &*frame.parent)).collect();
        let mut carried = BTreeSet::new();
        for mut name in wanted.iter().copied() {
            while carried.insert(name)
                && let Some(parent) = parents.get(name)
            {
                name = parent;
            }
        }
        for frame in scene.frames.iter().filter(|frame| frame.parent != "world") {
            let slides = |(_, motion): &(String, Motion)| {
                matches!(motion, Motion::Prismatic(_) | Motion::Screw(..))
            };
            let is_apart = frame.translation != [0.0; 3]
                || wanted.contains(frame.parent.as_str()) && frame.motions().iter().any(slides);
            if is_apart && carried.contains(frame.name.as_str()) {
                let ends = [&frame.parent, &frame.name].map(|name| rig.at(name, [0.0; 3]));
                self.push(LineKind::Link, &frame.name, ends);
            }
        }
        for Placed { frame, .. } in shown {
            let stand_ins = frame.shapes.iter().filter(|shape| shape.stands_for_inertia);
            for shape in stand_ins.filter(|shape| shape.position != [0.0; 3]) {
                let ends = [[0.0; 3], shape.position].map(|at| rig.at(&frame.name, at));
                self.push(LineKind::Link, &frame.name, ends);
            }
        }
    }

    /// Springs, stops and dampers between points; a damper beside a spring is one line with it.
    fn add_springs(&mut self, scene: &Scene, rig: &Rig) {
        let mut drawn = BTreeSet::new();
        let springs =
            scene.springs.iter().map(|s| s.points().into_iter().cloned().collect::<Vec<_>>());
        let is_between =
            |f: &&Force| matches!(f, Force::TwoPointDamper { .. } | Force::PathDamper { .. });
        let dampers = scene.forces.iter().filter(is_between).map(Force::points);
        for points in springs.chain(dampers) {
            let bits = |point: &Point| (point.frame.clone(), point.at.map(f64::to_bits));
            if points.len() > 1 && drawn.insert(points.iter().map(bits).collect::<Vec<_>>()) {
                self.push(LineKind::Spring, "", points.iter().map(|point| rig.point(point)));
            }
        }
    }

    fn add_constraint(&mut self, constraint: &Constraint, rig: &Rig) {
        let points: Vec<Attachment> = match constraint {
            Constraint::Distance { a, b, .. } | Constraint::PointToPoint { a, b, .. } => {
                vec![rig.point(a), rig.point(b)]
            }
            Constraint::Weld { a, b, .. } => vec![rig.at(a, [0.0; 3]), rig.at(b, [0.0; 3])],
            Constraint::PathLength { points, .. } => points.iter().map(|p| rig.point(p)).collect(),
            Constraint::PointOnPlane { .. }
            | Constraint::Orientation { .. }
            | Constraint::Coupling { .. } => return,
        };
        self.push(LineKind::Constraint, constraint.name(), points);
    }
}

/// Points at which something acts.
fn held_points(scene: &Scene) -> Vec<Point> {
    let springs = scene.springs.iter().flat_map(|s| s.points().into_iter().cloned());
    let forces = scene.forces.iter().flat_map(Force::points);
    let inputs = scene.inputs.iter().flat_map(|input| input.points.iter().cloned());
    springs.chain(forces).chain(inputs).collect()
}
