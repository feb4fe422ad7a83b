//! The tree of frames: names, parents, joints, inertia.

use std::collections::{BTreeMap, BTreeSet};

use crate::scene::{CoordinateKind, Joint, Motion};
use crate::validate::Check;
use crate::words::UnknownName;

impl Check<'_> {
    pub(super) fn frames(&mut self) {
        self.frame_names();
        self.parents();
        for index in 0..self.scene.frames.len() {
            self.frame_contents(index);
        }
        self.movers();
        self.kinds();
        self.orientations();
        if self.is_tree {
            self.inertia_beyond_joints();
        }
    }

    fn frame_names(&mut self) {
        let mut seen = BTreeMap::new();
        for (i, frame) in self.scene.frames.iter().enumerate() {
            let path = format!("frames[{i}].name");
            if frame.name == "world" {
                self.report(path.clone(), "`world` is the name of the root");
            }
            let before = self.problems.len();
            self.name(path, &frame.name, &mut seen);
            self.is_tree &= self.problems.len() == before;
            if frame.name != "world" {
                self.frames.entry(&frame.name).or_insert(i);
            }
        }
    }

    /// Resolves the parents, and reports unknown ones and each cycle once.
    fn parents(&mut self) {
        for (i, frame) in self.scene.frames.iter().enumerate() {
            let parent = self.frames.get(frame.parent.as_str()).copied();
            if parent.is_none() && frame.parent != "world" {
                self.is_tree = false;
                let parent = UnknownName::among(&frame.parent, self.frames.keys());
                self.report(format!("frames[{i}].parent"), format!("there is no frame {parent}"));
            }
            self.parents.push(parent);
        }
        // Walk up from every frame; `visit` says in which walk a frame was met first.
        let mut visit = vec![usize::MAX; self.parents.len()];
        for start in 0..self.parents.len() {
            let mut at = Some(start);
            while let Some(i) = at.filter(|&i| visit[i] == usize::MAX) {
                visit[i] = start;
                at = self.parents[i];
            }
            if let Some(i) = at.filter(|&i| visit[i] == start) {
                self.cycle(i);
            }
        }
    }

    fn cycle(&mut self, member: usize) {
        self.is_tree = false;
        let mut members = vec![member];
        let mut at = self.parents[member];
        while let Some(i) = at.filter(|&i| i != member) {
            members.push(i);
            at = self.parents[i];
        }
        let first = members.iter().copied().min().unwrap_or(member);
        let names: Vec<_> =
            members.iter().take(8).map(|&i| self.scene.frames[i].name.as_str()).collect();
        let message =
            format!("is part of a cycle of {} frames: {}", members.len(), names.join(" in "));
        self.report(format!("frames[{first}].parent"), message);
    }

    fn frame_contents(&mut self, index: usize) {
        let frame = &self.scene.frames[index];
        let path = format!("frames[{index}]");
        self.finite_all(&format!("{path}.translation"), &frame.translation);
        if let Some(rotation) = &frame.rotation {
            self.rotation(&format!("{path}.rotation"), rotation);
        }
        match &frame.joint {
            None | Some(Joint::Fixed {} | Joint::Ball { .. } | Joint::Free { .. }) => {}
            Some(Joint::Revolute { axis, .. } | Joint::Prismatic { axis, .. }) => {
                self.axis(&format!("{path}.joint.axis"), axis);
            }
            Some(Joint::Screw { axis, pitch, .. }) => {
                self.axis(&format!("{path}.joint.axis"), axis);
                self.finite(format!("{path}.joint.pitch"), *pitch);
            }
            Some(Joint::Universal { axes, .. }) => {
                self.universal_axes(&format!("{path}.joint.axes"), axes);
            }
        }
        if let Some(body) = &frame.body {
            self.body(&format!("{path}.body"), body);
        }
        for (i, visual) in frame.visuals.iter().enumerate() {
            self.visual(&format!("{path}.visuals[{i}]"), visual);
        }
    }

    /// Finds which joint each coordinate moves; one coordinate moves one joint.
    fn movers(&mut self) {
        for (i, frame) in self.scene.frames.iter().enumerate() {
            for (name, motion) in frame.motions() {
                let path = if name == frame.name {
                    format!("frames[{i}].joint")
                } else {
                    format!("frames[{i}].joint.coordinate")
                };
                if let Some(&(first, _)) = self.movers.get(&name) {
                    let other = &self.scene.frames[first].name;
                    let message = format!("coordinate `{name}` already moves frame `{other}`");
                    self.report(path, message);
                } else {
                    if name != frame.name {
                        self.spelling(path, &name);
                    }
                    self.movers.insert(name, (i, motion));
                }
            }
        }
    }

    fn kinds(&mut self) {
        for name in self.movers.keys() {
            self.kinds.insert(name.clone(), CoordinateKind::Dynamic);
        }
        for coordinate in &self.scene.coordinates {
            self.kinds.insert(coordinate.name.clone(), coordinate.kind);
        }
    }

    /// That the components of an orientation are all dynamic, or all prescribed and listed in a row.
    fn orientations(&mut self) {
        let prescribed: Vec<&str> = (self.scene.coordinates.iter())
            .filter(|c| c.kind == CoordinateKind::Prescribed)
            .map(|c| c.name.as_str())
            .collect();
        for (i, frame) in self.scene.frames.iter().enumerate() {
            let motions = frame.motions();
            let turns = motions.iter().filter(|(_, m)| matches!(m, Motion::Ball(_)));
            let names: Vec<&str> = turns.map(|(name, _)| name.as_str()).collect();
            let listed = names.iter().filter(|name| prescribed.contains(name)).count();
            if listed > 0 && !prescribed.windows(3).any(|row| row == names) {
                let message = format!(
                    "an orientation is prescribed as a whole: list {} in a row",
                    names.join(", ")
                );
                self.report(format!("frames[{i}].joint"), message);
            }
        }
    }

    /// A dynamic coordinate must move something that resists: mass for a slide, mass or inertia for
    /// a hinge. A mass on the axis of a hinge passes here; what is singular in every configuration is
    /// found once the scene is compiled.
    fn inertia_beyond_joints(&mut self) {
        let frames = &self.scene.frames;
        let has_mass = self.ancestors_of(|i| frames[i].body.as_ref().is_some_and(|b| b.mass > 0.0));
        let has_inertia = self.ancestors_of(|i| {
            frames[i].body.as_ref().is_some_and(|b| b.inertia.iter().any(|&x| x != 0.0))
        });
        let coordinates = self.scene.coordinates.iter();
        let with_armature = coordinates.filter(|coordinate| coordinate.armature > 0.0);
        let sums = self.scene.armatures.iter().filter(|sum| sum.armature > 0.0);
        let in_sums = sums.flat_map(|sum| &sum.terms).map(|term| term.coordinate.as_str());
        let armatures: BTreeSet<_> =
            with_armature.map(|c| c.name.as_str()).chain(in_sums).collect();
        for (i, frame) in frames.iter().enumerate() {
            for (name, motion) in frame.motions() {
                if self.kinds.get(&name) != Some(&CoordinateKind::Dynamic)
                    || armatures.contains(name.as_str())
                {
                    continue;
                }
                let slides = !motion.is_angle();
                if !has_mass[i] && (slides || !has_inertia[i]) {
                    let what = if slides { "mass" } else { "mass or inertia" };
                    let message =
                        format!("dynamic coordinate `{name}` moves nothing that has {what}");
                    self.report(format!("frames[{i}].joint"), message);
                }
            }
        }
    }

    /// Marks the frames for which `holds`, and all their ancestors.
    fn ancestors_of(&self, holds: impl Fn(usize) -> bool) -> Vec<bool> {
        let mut marked = vec![false; self.parents.len()];
        for i in (0..marked.len()).filter(|&i| holds(i)) {
            let mut at = Some(i);
            while let Some(j) = at.filter(|&j| !marked[j]) {
                marked[j] = true;
                at = self.parents[j];
            }
        }
        marked
    }
}
