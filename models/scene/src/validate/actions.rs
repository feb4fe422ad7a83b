//! Springs and constraints: what acts between points, frames and coordinates.

use std::collections::{BTreeMap, BTreeSet};

use crate::limits::MAX_POWER;
use crate::point::Point;
use crate::scene::{Axis, Constraint, CoordinateKind, CouplingTerm, Length, Motion, Plane, Spring};
use crate::validate::Check;
use crate::words::UnknownName;

/// A frame; the world has no index.
pub(super) type Carrier = Option<usize>;

/// What moves points or frames relative to each other.
#[derive(Default)]
pub(super) struct RelativeMotion {
    pub(super) dynamic: bool,
    pub(super) prescribed: bool,
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
                Spring::Spline { coordinate, knots } => {
                    self.dynamic_coordinate(format!("{path}.coordinate"), coordinate);
                    self.not_of_an_orientation(format!("{path}.coordinate"), coordinate);
                    self.knots(format!("{path}.knots"), knots);
                }
                Spring::LinearSpring { terms, stiffness, rest } => {
                    self.linear_terms(&path, terms);
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    self.finite(format!("{path}.rest"), *rest);
                }
                Spring::Path { points, stiffness, rest_length } => {
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    self.not_negative(format!("{path}.rest_length"), *rest_length);
                    let motion = self.along(&format!("{path}.points"), points);
                    if motion.is_some_and(|m| !m.dynamic && !m.prescribed) {
                        self.report(path, "its points do not move relative to each other");
                    }
                }
                Spring::Orientation { frame, stiffness, rest } => {
                    self.oriented(format!("{path}.frame"), frame);
                    self.not_negative(format!("{path}.stiffness"), *stiffness);
                    if let Some(rest) = rest {
                        self.rotation(&format!("{path}.rest"), rest);
                    }
                }
                Spring::Stop { .. } => self.stop(&path, spring),
            }
        }
    }

    /// That a frame has a joint with an orientation that the dynamics turns.
    fn oriented(&mut self, path: String, name: &str) {
        let Some(carrier) = self.carrier(path.clone(), name) else { return };
        let motions = carrier.map(|frame| self.scene.frames[frame].motions()).unwrap_or_default();
        let turn = motions.iter().find(|(_, motion)| matches!(motion, Motion::Ball(_)));
        match turn {
            None => self.report(path, format!("`{name}` has no ball joint and no free joint")),
            Some((turn, _)) => {
                if self.kinds.get(turn) == Some(&CoordinateKind::Prescribed) {
                    let message = format!(
                        "the orientation of `{name}` is prescribed; a spring has no effect on it"
                    );
                    self.report(path, message);
                }
            }
        }
    }

    /// A stop acts on a coordinate or along a path, and has a range, a stiffness and a transition or what
    /// they follow from.
    fn stop(&mut self, path: &str, spring: &Spring) {
        let Spring::Stop { coordinate, points, range, .. } = spring else { return };
        let Spring::Stop { stiffness, damping, transition, .. } = spring else { return };
        let Spring::Stop { settling_depth, settling_time_s, .. } = spring else { return };
        match coordinate {
            Some(name) if points.is_empty() => {
                self.dynamic_coordinate(format!("{path}.coordinate"), name);
                self.not_of_an_orientation(format!("{path}.coordinate"), name);
            }
            None if !points.is_empty() => self.moved_along(path, points),
            _ => self.report(path, "must have either `coordinate` or `points`"),
        }
        let settings = self.scene.coordinates.iter().find(|c| Some(&c.name) == coordinate.as_ref());
        match range {
            Some(range) => self.interval(&format!("{path}.range"), *range),
            None if settings.is_some_and(|settings| settings.limits.is_some()) => {}
            None => self.report(format!("{path}.range"), "is not given; no `limits` stand for it"),
        }
        for (name, value) in [("stiffness", stiffness), ("damping", damping)] {
            value.iter().for_each(|x| self.not_negative(format!("{path}.{name}"), *x));
        }
        for (name, value) in [
            ("transition", transition),
            ("settling_depth", settling_depth),
            ("settling_time_s", settling_time_s),
        ] {
            value.iter().for_each(|x| self.positive(format!("{path}.{name}"), *x));
        }
        let stated = [stiffness, damping, transition].iter().any(|x| x.is_some());
        match (stiffness, settling_depth, settling_time_s) {
            (Some(_), None, None) => {}
            (None, Some(_), Some(_)) if !stated && coordinate.is_some() => {}
            _ => self.report(
                path,
                "must have either `stiffness`, with or without `damping` and `transition`, or on a coordinate `settling_depth` and `settling_time_s`",
            ),
        }
    }

    pub(super) fn constraints(&mut self) {
        let mut seen = BTreeMap::new();
        for (i, constraint) in self.scene.constraints.iter().enumerate() {
            let path = format!("constraints[{i}]");
            self.name(format!("{path}.name"), constraint.name(), &mut seen);
            let motion = match constraint {
                Constraint::Distance { a, b, length, .. } => {
                    let motion = self.between(&path, a, b);
                    self.length(format!("{path}.length"), length);
                    motion
                }
                Constraint::PointToPoint { a, b, axes, .. } => {
                    let motion = self.between(&path, a, b);
                    self.axes(format!("{path}.axes"), axes);
                    motion
                }
                Constraint::PointOnPlane { plane, point, .. } => self.plane(&path, plane, point),
                Constraint::Orientation { a, b, .. } => self.aligned(&path, a, b, true),
                Constraint::Weld { a, b, .. } => self.aligned(&path, a, b, false),
                Constraint::Coupling { terms, constant, .. } => {
                    self.finite(format!("{path}.constant"), *constant);
                    self.terms(&format!("{path}.terms"), terms)
                }
                Constraint::PathLength { points, length, .. } => {
                    let motion = self.along(&format!("{path}.points"), points);
                    self.length(format!("{path}.length"), length);
                    motion
                }
            };
            if motion.is_some_and(|motion| !motion.dynamic) {
                let message = match constraint {
                    Constraint::Coupling { .. } => "couples no dynamic coordinate",
                    Constraint::Orientation { .. } => {
                        "no dynamic coordinate turns its frames relative to each other"
                    }
                    Constraint::Weld { .. } => {
                        "no dynamic coordinate moves its frames relative to each other"
                    }
                    _ => "no dynamic coordinate moves its points relative to each other",
                };
                self.report(path, message);
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

    fn plane(&mut self, path: &str, plane: &Plane, point: &Point) -> Option<RelativeMotion> {
        self.finite_all(&format!("{path}.plane.at"), &plane.at);
        self.axis(&format!("{path}.plane.normal"), &plane.normal);
        let a = self.carrier(format!("{path}.plane.frame"), &plane.frame);
        let b = self.point(&format!("{path}.point"), point);
        self.relative_motion(&[a?, b?], |_| true)
    }

    /// Two frames that a constraint aligns; with `turning`, slides do not count as motion.
    fn aligned(&mut self, path: &str, a: &str, b: &str, turning: bool) -> Option<RelativeMotion> {
        let a = self.carrier(format!("{path}.a"), a);
        let b = self.carrier(format!("{path}.b"), b);
        self.relative_motion(&[a?, b?], |motion| !turning || motion.is_angle())
    }

    fn terms(&mut self, path: &str, terms: &[CouplingTerm]) -> Option<RelativeMotion> {
        let mut motion = RelativeMotion::default();
        let mut seen = BTreeSet::new();
        let mut known = true;
        if terms.is_empty() {
            self.report(path, "is empty");
            return None;
        }
        for (i, term) in terms.iter().enumerate() {
            let path = format!("{path}[{i}]");
            match self.coordinate_of_term(&path, &term.coordinate, &mut seen) {
                Some(CoordinateKind::Dynamic) => motion.dynamic = true,
                Some(CoordinateKind::Prescribed) => motion.prescribed = true,
                None => known = false,
            }
            let path = format!("{path}.coefficients");
            if !self.finite_all(&path, &term.coefficients) {
                continue;
            }
            if term.coefficients.len() > MAX_POWER {
                let message =
                    format!("has {} entries; at most {MAX_POWER}", term.coefficients.len());
                self.report(path, message);
            } else if term.coefficients.iter().all(|c| *c == 0.0) {
                self.report(path, "are all zero");
            }
        }
        known.then_some(motion)
    }

    /// Checks two points; tells what moves them relative to each other if both frames exist.
    pub(super) fn between(&mut self, path: &str, a: &Point, b: &Point) -> Option<RelativeMotion> {
        let a = self.point(&format!("{path}.a"), a);
        let b = self.point(&format!("{path}.b"), b);
        self.relative_motion(&[a?, b?], |_| true)
    }

    /// Checks the points of a path; tells what moves them relative to each other.
    pub(super) fn along(&mut self, path: &str, points: &[Point]) -> Option<RelativeMotion> {
        if points.len() < 2 {
            self.report(path, "must be two or more points");
            return None;
        }
        for (i, ends) in points.windows(2).enumerate() {
            if ends[0] == ends[1] {
                self.report(format!("{path}[{}]", i + 1), "is the point before it");
            }
        }
        let carriers: Vec<_> = points
            .iter()
            .enumerate()
            .map(|(i, point)| self.point(&format!("{path}[{i}]"), point))
            .collect();
        let carriers: Vec<Carrier> = carriers.into_iter().collect::<Option<_>>()?;
        self.relative_motion(&carriers, |_| true)
    }

    /// Checks a point and finds its frame.
    pub(super) fn point(&mut self, path: &str, point: &Point) -> Option<Carrier> {
        self.finite_all(&format!("{path}.at"), &point.at);
        self.carrier(format!("{path}.frame"), &point.frame)
    }

    /// Finds a frame.
    pub(super) fn carrier(&mut self, path: String, name: &str) -> Option<Carrier> {
        if name == "world" {
            return Some(None);
        }
        let frame = self.frames.get(name).copied();
        if frame.is_none() {
            let name = UnknownName::among(name, self.frames.keys());
            self.report(path, format!("there is no frame {name}"));
        }
        frame.map(Some)
    }

    /// What of the motions that count is between frames: joints that carry some of them, but not all.
    pub(super) fn relative_motion(
        &self,
        carriers: &[Carrier],
        counts: impl Fn(&Motion) -> bool,
    ) -> Option<RelativeMotion> {
        if !self.is_tree {
            return None;
        }
        let mut carried: BTreeMap<usize, usize> = BTreeMap::new();
        for &carrier in carriers {
            for frame in std::iter::successors(carrier, |&i| self.parents[i]) {
                *carried.entry(frame).or_default() += 1;
            }
        }
        let mut motion = RelativeMotion::default();
        for (frame, count) in carried {
            if count == carriers.len() {
                continue;
            }
            for (name, of_joint) in self.scene.frames[frame].motions() {
                match self.kinds.get(&name) {
                    _ if !counts(&of_joint) => {}
                    Some(CoordinateKind::Prescribed) => motion.prescribed = true,
                    _ => motion.dynamic = true,
                }
            }
        }
        Some(motion)
    }
}
