//! Tendons: sums of coordinates, and paths through sites.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use plantd_models::scene::{Force, LinearTerm, Spring};
use roxmltree::Node;

use crate::mjcf::build::Build;
use crate::mjcf::classes::Settings;
use crate::mjcf::rope::{Branch, Rope, Stop};
use crate::mjcf::tree::Joint;
use crate::report::Kind;

/// Tendons by name.
pub(super) struct Tendons<'a> {
    all: Vec<Tendon<'a>>,
    names: BTreeMap<String, usize>,
}

pub(super) struct Tendon<'a> {
    settings: Settings<'a>,
    pub(super) name: String,
    /// None where it cannot be taken over.
    pub(super) course: Option<Course>,
    pub(super) limits: Option<[f64; 2]>,
}

/// What a tendon's length is made of.
pub(super) enum Course {
    /// `L = Σ coefficient q`.
    Sum(Vec<Term>),
    /// From point to point.
    Path(Rope),
}

pub(super) struct Term {
    pub(super) joint: usize,
    pub(super) coordinate: String,
    pub(super) coefficient: f64,
}

impl Course {
    /// Its length where bodies have given poses and joints given values.
    fn length(&self, poses: &[Isometry3<f64>], value: impl Fn(usize) -> f64) -> f64 {
        match self {
            Self::Sum(terms) => terms.iter().map(|term| term.coefficient * value(term.joint)).sum(),
            Self::Path(rope) => rope.length(poses),
        }
    }
}

/// Terms as springs and dampers have them.
pub(super) fn linear(terms: &[Term]) -> Vec<LinearTerm> {
    let term = |term: &Term| LinearTerm {
        coordinate: term.coordinate.clone(),
        coefficient: term.coefficient,
    };
    terms.iter().map(term).collect()
}

impl<'a> Tendons<'a> {
    pub(super) fn read(build: &mut Build<'_, 'a, '_>) -> Self {
        let mut all = Self { all: Vec::new(), names: BTreeMap::new() };
        for (node, ending) in build.elements("tendon") {
            if let Some(own) = node.attribute("name").filter(|_| !ending.is_empty()) {
                build.copied_tendons.entry(own).or_default().push(ending.clone());
            }
            build.ending = ending;
            let name = build.name_of(node, "");
            if !name.is_empty() && all.names.insert(name.clone(), all.all.len()).is_some() {
                build.reader.fail(node, format!("there are two tendons `{name}`"));
            }
            let settings = build.classes.settings(
                build.reader,
                node,
                build.classes.root(build.reader, node),
                "tendon",
            );
            let course = match node.tag_name().name() {
                "fixed" => build.sum(node),
                "spatial" => build.path(node),
                _ => continue,
            };
            let by_range = build.compilers.of(build.reader, node).limits_by_range;
            let limits = settings.range(build.reader, "range", "limited", by_range);
            all.all.push(Tendon { settings, name, course, limits });
        }
        build.ending.clear();
        all
    }

    pub(super) fn named(&self, name: &str) -> Option<&Tendon<'a>> {
        self.names.get(name).map(|tendon| &self.all[*tendon])
    }
}

impl<'a> Build<'_, 'a, '_> {
    fn sum(&mut self, node: Node<'a, 'a>) -> Option<Course> {
        let mut terms: Vec<Term> = Vec::new();
        for child in node.children().filter(|child| child.has_tag_name("joint")) {
            let coefficient = self.reader.number(child, "coef");
            let joint = self.find(child, "joint", "joint", |build, name| build.tree.joint(name))?;
            if !self.tree.joints[joint].kind.is_single() {
                let message = "a tendon over a joint that does not move about or along one axis";
                self.reader.refuse(child, message);
                return None;
            }
            match terms.iter_mut().find(|term| term.joint == joint) {
                Some(term) => term.coefficient += coefficient,
                None => {
                    let coordinate = self.coordinates[joint][0].clone();
                    terms.push(Term { joint, coordinate, coefficient });
                }
            }
        }
        terms.retain(|term| term.coefficient != 0.0);
        if terms.is_empty() {
            self.reader.fail(node, "`fixed` has no joint with a `coef`");
            return None;
        }
        self.reader.exact("fixed tendon");
        Some(Course::Sum(terms))
    }

    fn path(&mut self, node: Node<'a, 'a>) -> Option<Course> {
        let mut branches = vec![Branch { divisor: 1.0, stops: Vec::new() }];
        for child in node.children().filter(Node::is_element) {
            match child.tag_name().name() {
                "site" => {
                    let found = |build: &Self, name: &str| {
                        build.tree.site(name).map(|site| (site.body, site.pose.translation.vector))
                    };
                    let (body, at) = self.find(child, "site", "site", found)?;
                    let point = self.point(body, at.into());
                    branches.last_mut()?.stops.push(Stop { body, point });
                }
                "geom" => {
                    let message = "a tendon that wraps around a shape: lead it through sites";
                    self.reader.refuse(child, message);
                    return None;
                }
                "pulley" => {
                    let divisor = self.reader.number(child, "divisor");
                    branches.push(Branch { divisor, stops: Vec::new() });
                }
                _ => {}
            }
        }
        // One that begins with a pulley has nothing before it.
        branches.retain(|branch| branch.divisor != 1.0 || !branch.stops.is_empty());
        if branches.is_empty() || branches.iter().any(|branch| branch.stops.len() < 2) {
            self.reader.fail(node, "each branch of `spatial` must lead through two sites or more");
            return None;
        }
        let Some(rope) = Rope::of(&branches) else {
            let message = "a tendon whose pulleys divide by other than whole numbers up to 64, or stand on other bodies than the ends of its branches: write a tendon for each branch";
            self.reader.refuse(node, message);
            return None;
        };
        self.reader.exact("spatial tendon");
        Some(Course::Path(rope))
    }

    /// Its length where joints are at their references.
    pub(super) fn length_at_home(&self, course: &Course) -> f64 {
        course.length(&self.home, |joint| self.tree.joints[joint].reference)
    }

    /// Springs and dampers of tendons.
    pub(super) fn stretch(&mut self, tendons: &Tendons<'a>) {
        let rest = |joint: &Joint<'_>| joint.rest;
        let at_rest = self.tree.poses(rest);
        for Tendon { settings, name, course, limits } in &tendons.all {
            let Some(course) = course else { continue };
            let node = settings.node();
            if limits.is_some() && self.physics.has("limit") {
                let message =
                    format!("tendon `{name}` moves past its limits, which nothing enforces");
                self.reader.note(Kind::Approximated, node, message);
            }
            let damping: [f64; 3] = settings.first_numbers(self.reader, "damping");
            let all: [f64; 3] = settings.first_numbers(self.reader, "stiffness");
            let several = all[1..] != [0.0; 2];
            let is_path = matches!(course, Course::Path(_));
            if all[0] < 0.0 || several || damping.iter().any(|d| *d < 0.0) {
                let message = format!(
                    "`stiffness` of tendon `{name}` must be one number, and no number of `damping` negative"
                );
                self.reader.refuse(node, message);
                continue;
            }
            if is_path && damping[1..] != [0.0; 2] {
                let message = format!("`damping` of tendon `{name}`, a path, must be one number");
                self.reader.refuse(node, message);
            }
            let stiffness = all[0];
            if self.physics.has("damper") {
                match course {
                    Course::Sum(terms) => self.add_damper(node, terms, damping),
                    Course::Path(rope) if damping[0] > 0.0 => {
                        self.reader.exact("damper of a tendon");
                        self.draft.scene.forces.push(Force::PathDamper {
                            points: rope.points(),
                            damping: damping[0] / (rope.times * rope.times),
                        });
                    }
                    Course::Path(_) => {}
                }
            }
            if stiffness > 0.0 && self.physics.has("spring") {
                let natural = course.length(&at_rest, |joint| self.tree.joints[joint].rest);
                let range = self.spring_range(settings).unwrap_or([natural; 2]);
                self.add_spring(settings, course, stiffness, range);
            }
        }
    }

    /// Armature and dry friction of tendons.
    pub(super) fn load(&mut self, tendons: &Tendons<'a>) {
        for Tendon { settings, name, course, .. } in &tendons.all {
            let Some(course) = course else { continue };
            let armature = settings.amount(self.reader, "armature");
            match course {
                Course::Sum(terms) => self.add_armature(terms, armature),
                Course::Path(_) if armature > 0.0 => {
                    let message = format!(
                        "`armature` of tendon `{name}`, a path: its inertia is another in each configuration, which it is not here"
                    );
                    self.reader.refuse(settings.node(), message);
                }
                Course::Path(_) => {}
            }
            let friction = settings.amount(self.reader, "frictionloss");
            if friction > 0.0 && self.physics.has("frictionloss") {
                self.rub(settings.node(), name, course, friction);
            }
        }
    }

    /// Dry friction of a tendon, made smooth. Over one joint it is the joint's own, `L = c q`.
    fn rub(&mut self, node: Node<'a, 'a>, name: &str, course: &Course, friction: f64) {
        let velocity = self.options.friction_velocity;
        let (terms, points, times) = match course {
            Course::Sum(terms) if terms.len() == 1 => {
                let Term { joint, coordinate, coefficient } = &terms[0];
                let c = coefficient.abs();
                let joint = self.tree.joints[*joint].name.clone();
                let law = [friction * c, velocity / c];
                return self.draft.rub(self.reader, (&joint, node), coordinate, law);
            }
            Course::Sum(terms) => (linear(terms), Vec::new(), 1.0),
            Course::Path(rope) => (Vec::new(), rope.points(), rope.times),
        };
        let message = format!(
            "dry friction of tendon `{name}` is {friction} tanh(v / {velocity}): it creeps under load"
        );
        self.reader.note(Kind::Approximated, node, message);
        let (force, velocity) = (friction / times, velocity * times);
        let friction = Force::Friction { coordinate: None, terms, points, force, velocity };
        self.draft.scene.forces.push(friction);
    }

    /// Lengths between which a tendon's spring is slack, if they are given.
    fn spring_range(&mut self, settings: &Settings<'a>) -> Option<[f64; 2]> {
        let text = settings.text("springlength")?;
        let [low, mut high] = settings.first_numbers(self.reader, "springlength");
        if text.split_ascii_whitespace().count() == 1 {
            high = low;
        }
        if low > high {
            self.reader.fail(settings.node(), "`springlength` must not decrease");
        }
        ([low, high] != [-1.0; 2]).then_some([low, high])
    }

    fn add_spring(
        &mut self,
        settings: &Settings<'a>,
        course: &Course,
        stiffness: f64,
        [low, high]: [f64; 2],
    ) {
        let spring = match course {
            Course::Sum(_) if low < high => {
                let message = "`springlength` with two lengths: a sum of joints has no stop";
                return self.reader.refuse(settings.node(), message);
            }
            Course::Sum(terms) => {
                Spring::LinearSpring { terms: linear(terms), stiffness, rest: low }
            }
            Course::Path(rope) if low < high => {
                let message = "`springlength` with two lengths: a `stop`, which comes in over a hundredth of the range";
                self.reader.note(Kind::Approximated, settings.node(), message);
                Spring::Stop {
                    coordinate: None,
                    points: rope.points(),
                    range: Some([low, high].map(|length| rope.path_length(length))),
                    stiffness: Some(stiffness / (rope.times * rope.times)),
                    damping: None,
                    transition: None,
                    settling_depth: None,
                    settling_time_s: None,
                }
            }
            Course::Path(rope) => Spring::Path {
                points: rope.points(),
                stiffness: stiffness / (rope.times * rope.times),
                rest_length: rope.path_length(low),
            },
        };
        self.reader.exact("spring of a tendon");
        self.draft.scene.springs.push(spring);
    }
}
