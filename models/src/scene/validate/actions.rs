//! Springs and constraints: what acts between points.

use std::collections::{BTreeMap, BTreeSet};

use super::Check;
use crate::scene::{Axis, Constraint, CoordinateKind, Length, Point, Spring};

/// What moves two points relative to each other.
#[derive(Default)]
struct RelativeMotion {
    dynamic: bool,
    prescribed: bool,
}

impl Check<'_> {
    pub(super) fn springs(&mut self) {
        for (i, spring) in self.scene.springs.iter().enumerate() {
            let path = format!("springs[{i}]");
            match spring {
                Spring::TwoPoint { a, b, stiffness, rest_length } => {
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    self.not_negative(format!("{path}.rest_length"), *rest_length);
                    let motion = self.between(&path, a, b);
                    if motion.is_some_and(|m| !m.dynamic && !m.prescribed) {
                        self.report(path, "its ends do not move relative to each other");
                    }
                }
                Spring::Coordinate { coordinate, stiffness, rest } => {
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    self.finite(format!("{path}.rest"), *rest);
                    self.dynamic_coordinate(format!("{path}.coordinate"), coordinate);
                    self.not_of_an_orientation(format!("{path}.coordinate"), coordinate);
                }
            }
        }
    }

    pub(super) fn constraints(&mut self) {
        let mut seen = BTreeMap::new();
        for (i, constraint) in self.scene.constraints.iter().enumerate() {
            let path = format!("constraints[{i}]");
            self.name(format!("{path}.name"), constraint.name(), &mut seen);
            let (a, b) = constraint.points();
            if self.between(&path, a, b).is_some_and(|motion| !motion.dynamic) {
                let message = "no dynamic coordinate moves its points relative to each other";
                self.report(path.clone(), message);
            }
            match constraint {
                Constraint::Distance { length, .. } => {
                    self.length(format!("{path}.length"), length)
                }
                Constraint::PointToPoint { axes, .. } => self.axes(format!("{path}.axes"), axes),
            }
        }
    }

    fn length(&mut self, path: String, length: &Length) {
        match length {
            Length::Fixed(value) => self.positive(path, *value),
            Length::Coordinate(name) => self.length_coordinate(path, name),
        }
    }

    fn axes(&mut self, path: String, axes: &[Axis]) {
        let different: BTreeSet<_> = axes.iter().copied().collect();
        if axes.is_empty() || different.len() != axes.len() {
            self.report(path, "must be one to three different axes");
        }
    }

    /// Checks two points; tells what moves them relative to each other if both frames exist.
    fn between(&mut self, path: &str, a: &Point, b: &Point) -> Option<RelativeMotion> {
        let a = self.point(&format!("{path}.a"), a);
        let b = self.point(&format!("{path}.b"), b);
        let (a, b) = (a?, b?);
        self.is_tree.then(|| self.relative_motion(a, b))
    }

    /// Checks a point and finds its frame; the world has no index.
    fn point(&mut self, path: &str, point: &Point) -> Option<Option<usize>> {
        self.finite_all(&format!("{path}.at"), &point.at);
        if point.frame == "world" {
            return Some(None);
        }
        let frame = self.frames.get(point.frame.as_str()).copied();
        if frame.is_none() {
            self.report(format!("{path}.frame"), format!("there is no frame `{}`", point.frame));
        }
        frame.map(Some)
    }

    /// Joints on the path between two frames; those above both move both alike.
    fn relative_motion(&self, a: Option<usize>, b: Option<usize>) -> RelativeMotion {
        let above_a: BTreeSet<_> = self.upward(a).collect();
        let above_b: BTreeSet<_> = self.upward(b).collect();
        let mut motion = RelativeMotion::default();
        for &frame in above_a.symmetric_difference(&above_b) {
            for (name, _) in self.scene.frames[frame].motions() {
                match self.kinds.get(&name) {
                    Some(CoordinateKind::Prescribed) => motion.prescribed = true,
                    _ => motion.dynamic = true,
                }
            }
        }
        motion
    }

    /// A frame and its ancestors.
    fn upward(&self, frame: Option<usize>) -> impl Iterator<Item = usize> {
        std::iter::successors(frame, |&i| self.parents[i])
    }
}
