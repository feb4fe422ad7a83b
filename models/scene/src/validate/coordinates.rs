//! Coordinates, inputs and operating points: everything that refers to coordinates by name.

use std::collections::{BTreeMap, BTreeSet};

use crate::forces::Force;
use crate::inputs::Input;
use crate::limits::MAX_ARMATURE_TERMS;
use crate::linear_term::LinearTerm;
use crate::point::Point;
use crate::scene::{Constraint, CoordinateKind, Motion};
use crate::signals::Signal;
use crate::validate::Check;
use crate::words::UnknownName;

impl<'a> Check<'a> {
    pub(super) fn coordinates(&mut self) {
        let lengths = self.length_coordinates();
        let coupled = self.coupled_coordinates();
        // A signal has a start of its own.
        let driven: BTreeSet<_> = self.scene.signals.iter().map(Signal::drives).collect();
        let mut seen = BTreeMap::new();
        for (i, coordinate) in self.scene.coordinates.iter().enumerate() {
            let path = format!("coordinates[{i}]");
            let name = coordinate.name.as_str();
            self.name(format!("{path}.name"), name, &mut seen);
            let prescribed = coordinate.kind == CoordinateKind::Prescribed;
            if prescribed && lengths.contains(name) && !driven.contains(name) {
                self.positive(format!("{path}.initial"), coordinate.initial);
            } else {
                self.finite(format!("{path}.initial"), coordinate.initial);
            }
            if let Some(damping) = coordinate.damping {
                self.not_negative(format!("{path}.damping"), damping);
                if prescribed {
                    self.report(
                        format!("{path}.damping"),
                        "has no effect on a prescribed coordinate",
                    );
                }
            }
            self.not_negative(format!("{path}.armature"), coordinate.armature);
            if prescribed && coordinate.armature != 0.0 {
                let message = "has no effect on a prescribed coordinate";
                self.report(format!("{path}.armature"), message);
            }
            if let Some(limits) = coordinate.limits {
                self.interval(&format!("{path}.limits"), limits);
                self.not_of_an_orientation(format!("{path}.limits"), name);
            }
            let follows = lengths.contains(name) || coupled.contains(name);
            let used = self.movers.contains_key(name) || (prescribed && follows);
            if !used {
                let message = if follows {
                    format!("no joint moves by `{name}`; what is not a joint's must be prescribed")
                } else {
                    format!("no joint moves by `{name}` and no constraint follows it")
                };
                self.report(format!("{path}.name"), message);
            }
        }
    }

    /// Sums of coordinates that carry inertia.
    pub(super) fn armatures(&mut self) {
        for (i, armature) in self.scene.armatures.iter().enumerate() {
            let path = format!("armatures[{i}]");
            self.linear_terms(&path, &armature.terms);
            let count = armature.terms.len();
            if count > MAX_ARMATURE_TERMS {
                let message = format!("has {count} entries; at most {MAX_ARMATURE_TERMS}");
                self.report(format!("{path}.terms"), message);
            }
            for (k, term) in armature.terms.iter().enumerate() {
                if self.kinds.get(&term.coordinate) == Some(&CoordinateKind::Prescribed) {
                    let message = format!("coordinate `{}` is prescribed", term.coordinate);
                    self.report(format!("{path}.terms[{k}].coordinate"), message);
                }
            }
            self.not_negative(format!("{path}.armature"), armature.armature);
        }
    }

    /// Coordinates that are lengths of constraints.
    pub(super) fn length_coordinates(&self) -> BTreeSet<&'a str> {
        self.scene.constraints.iter().filter_map(Constraint::length_coordinate).collect()
    }

    /// Coordinates of couplings.
    fn coupled_coordinates(&self) -> BTreeSet<&'a str> {
        let terms = self.scene.constraints.iter().filter_map(|constraint| match constraint {
            Constraint::Coupling { terms, .. } => Some(terms),
            _ => None,
        });
        terms.flatten().map(|term| term.coordinate.as_str()).collect()
    }

    /// The prescribed coordinates.
    pub(super) fn prescribed(&self) -> impl Iterator<Item = &str> {
        let is_prescribed = |kind: &CoordinateKind| *kind == CoordinateKind::Prescribed;
        let kinds = self.kinds.iter().filter(move |(_, kind)| is_prescribed(kind));
        kinds.map(|(name, _)| name.as_str())
    }

    fn no_coordinate(&mut self, path: String, name: &str) {
        let name = UnknownName::among(name, self.kinds.keys());
        self.report(path, format!("there is no coordinate {name}"));
    }

    /// That a length names a prescribed coordinate, which is not an angle.
    pub(super) fn length_coordinate(&mut self, path: String, name: &str) {
        match self.kinds.get(name) {
            None => {
                let name = UnknownName::among(name, self.prescribed());
                self.report(path, format!("there is no prescribed coordinate {name}"));
                return;
            }
            Some(CoordinateKind::Dynamic) => {
                self.report(
                    path,
                    format!("coordinate `{name}` is dynamic; a length must be prescribed"),
                );
                return;
            }
            Some(CoordinateKind::Prescribed) => {}
        }
        if self.movers.get(name).is_some_and(|(_, motion)| motion.is_angle()) {
            self.report(path, format!("coordinate `{name}` is an angle"));
        }
    }

    /// That a force or spring acts on a coordinate that can give way.
    pub(super) fn dynamic_coordinate(&mut self, path: String, name: &str) {
        match self.kinds.get(name) {
            None => self.no_coordinate(path, name),
            Some(CoordinateKind::Prescribed) => {
                self.report(
                    path,
                    format!("coordinate `{name}` is prescribed; a force on it has no effect"),
                );
            }
            Some(CoordinateKind::Dynamic) => {}
        }
    }

    /// That the terms of a spring or force on a sum name different coordinates, one of them dynamic.
    pub(super) fn linear_terms(&mut self, path: &str, terms: &[LinearTerm]) {
        let mut seen = BTreeSet::new();
        let mut can_move = terms.is_empty();
        if terms.is_empty() {
            self.report(format!("{path}.terms"), "is empty; must have a term or more");
        }
        for (i, term) in terms.iter().enumerate() {
            let path = format!("{path}.terms[{i}]");
            let kind = self.coordinate_of_term(&path, &term.coordinate, &mut seen);
            can_move |= kind != Some(CoordinateKind::Prescribed);
            self.factor(format!("{path}.coefficient"), term.coefficient, "term");
        }
        if !can_move {
            let message = "are of prescribed coordinates alone; one must be dynamic";
            self.report(format!("{path}.terms"), message);
        }
    }

    /// That the coordinate of a term is there, means something alone, and has no term in `seen` yet; its kind.
    pub(super) fn coordinate_of_term<'n>(
        &mut self,
        path: &str,
        name: &'n str,
        seen: &mut BTreeSet<&'n str>,
    ) -> Option<CoordinateKind> {
        let (path, kind) = (format!("{path}.coordinate"), self.kinds.get(name).copied());
        if kind.is_none() {
            self.no_coordinate(path.clone(), name);
        } else if !seen.insert(name) {
            self.report(path.clone(), format!("coordinate `{name}` has a term already"));
        }
        self.not_of_an_orientation(path, name);
        kind
    }

    /// That a coordinate means something alone: a component of an orientation does not.
    pub(super) fn not_of_an_orientation(&mut self, path: String, name: &str) {
        if let Some((frame, Motion::Ball(_))) = self.movers.get(name) {
            let frame = &self.scene.frames[*frame].name;
            let message = format!("`{name}` is a component of the orientation of frame `{frame}`");
            self.report(path, message);
        }
    }

    pub(super) fn inputs(&mut self) {
        let used: BTreeSet<_> = self.scene.forces.iter().flat_map(Force::inputs).collect();
        let mut seen = BTreeMap::new();
        for (i, input) in self.scene.inputs.iter().enumerate() {
            let path = format!("inputs[{i}]");
            self.name(format!("{path}.name"), &input.name, &mut seen);
            if self.kinds.get(input.name.as_str()) == Some(&CoordinateKind::Prescribed) {
                let message = format!("`{}` is also a prescribed coordinate", input.name);
                self.report(format!("{path}.name"), message);
            }
            self.input_on(&path, input, used.contains(input.name.as_str()));
            if let Some(limits) = input.limits {
                self.interval(&format!("{path}.limits"), limits);
            }
            self.factor(format!("{path}.gain"), input.gain, "input");
        }
    }

    /// What an input acts on; `used` if a force follows it.
    fn input_on(&mut self, path: &str, input: &Input, used: bool) {
        let given = [input.coordinate.is_some(), !input.terms.is_empty(), !input.points.is_empty()];
        match given.iter().filter(|given| **given).count() {
            0 if !used => {
                let message = "acts on no coordinate and along no path, and no force uses it";
                self.report(path, message);
            }
            0 | 1 => {}
            _ => self.report(path, "must have one of `coordinate`, `terms` and `points`"),
        }
        if let Some(name) = &input.coordinate {
            self.dynamic_coordinate(format!("{path}.coordinate"), name);
        }
        let mut seen = BTreeSet::new();
        for (i, term) in input.terms.iter().enumerate() {
            let path = format!("{path}.terms[{i}]");
            self.dynamic_coordinate(format!("{path}.coordinate"), &term.coordinate);
            if !seen.insert(&term.coordinate) {
                let message = format!("coordinate `{}` has a term already", term.coordinate);
                self.report(format!("{path}.coordinate"), message);
            }
            self.factor(format!("{path}.gain"), term.gain, "term");
        }
        if !input.points.is_empty() {
            self.moved_along(path, &input.points);
        } else if input.coordinate.is_none() && input.gain != 1.0 {
            let message = "has no effect without a coordinate or points";
            self.report(format!("{path}.gain"), message);
        }
    }

    /// That a path has a length which a dynamic coordinate changes.
    pub(super) fn moved_along(&mut self, path: &str, points: &[Point]) {
        let motion = self.along(&format!("{path}.points"), points);
        if motion.is_some_and(|motion| !motion.dynamic) {
            let message = "no dynamic coordinate moves them relative to each other";
            self.report(format!("{path}.points"), message);
        }
    }

    pub(super) fn operating_points(&mut self) {
        let lengths = self.length_coordinates();
        let mut seen = BTreeMap::new();
        for (i, point) in self.scene.operating_points.iter().enumerate() {
            let path = format!("operating_points[{i}]");
            self.name(format!("{path}.name"), &point.name, &mut seen);
            if point.name == "initial" {
                self.report(format!("{path}.name"), "`initial` is the initial configuration");
            }
            for (name, &value) in &point.coordinates {
                let path = format!("{path}.coordinates.{name}");
                if !self.kinds.contains_key(name.as_str()) {
                    self.no_coordinate(path.clone(), name);
                }
                if lengths.contains(name.as_str()) {
                    self.positive(path, value);
                } else {
                    self.finite(path, value);
                }
            }
            for (name, &value) in &point.inputs {
                let path = format!("{path}.inputs.{name}");
                self.known_input(path.clone(), name);
                self.finite(path, value);
            }
        }
    }
}
