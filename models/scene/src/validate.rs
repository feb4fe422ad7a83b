//! Validation: every error of a scene at once, each with its path.

mod actions;
mod coordinates;
mod forces;
mod frames;
mod shapes;
mod signals;
#[cfg(test)]
mod tests;
mod visuals;

use std::collections::{BTreeMap, BTreeSet};

use crate::forces::Force;
use crate::limits::{
    MAX_CONSTRAINTS, MAX_COORDINATES, MAX_COUPLING_TERMS, MAX_FORCES, MAX_FRAMES, MAX_INPUTS,
    MAX_LINEAR_TERMS, MAX_NAME_BYTES, MAX_OPERATING_POINTS, MAX_PATH_POINTS, MAX_SIGNAL_POINTS,
    MAX_SIGNALS, MAX_SPRINGS, MAX_VISUALS,
};
use crate::scene::{Constraint, CoordinateKind, Motion, Problem, Scene, Spring};
use crate::signals::Signal;

impl Scene {
    /// Everything that is wrong with what the scene says. Compiling it finds the rest: masses that no
    /// coordinate could move, constraints that no configuration fulfils.
    pub fn validate(&self) -> Vec<Problem> {
        let mut check = Check::new(self);
        check.limits();
        if !check.problems.is_empty() {
            // The rest of the work grows with the sizes that are out of bounds.
            return check.problems;
        }
        check.header();
        check.frames();
        check.coordinates();
        check.armatures();
        check.springs();
        check.inputs();
        check.forces();
        check.signals();
        check.constraints();
        check.operating_points();
        check.problems
    }
}

/// A validation in progress: the scene, its names resolved, and the problems so far.
struct Check<'a> {
    scene: &'a Scene,
    problems: Vec<Problem>,
    inputs: BTreeSet<&'a str>,
    /// Index of the first frame of each name.
    frames: BTreeMap<&'a str, usize>,
    /// Parent of each frame; none for children of the world and of unknown parents.
    parents: Vec<Option<usize>>,
    /// Whether names and parents form a tree, so that ancestors may be walked.
    is_tree: bool,
    /// The first frame that each coordinate moves, and how.
    movers: BTreeMap<String, (usize, Motion)>,
    /// Kind of every coordinate that a joint or an entry of `coordinates` names.
    kinds: BTreeMap<String, CoordinateKind>,
}

impl<'a> Check<'a> {
    fn new(scene: &'a Scene) -> Self {
        Self {
            scene,
            problems: Vec::new(),
            inputs: scene.inputs.iter().map(|input| input.name.as_str()).collect(),
            frames: BTreeMap::new(),
            parents: Vec::new(),
            is_tree: true,
            movers: BTreeMap::new(),
            kinds: BTreeMap::new(),
        }
    }

    fn report(&mut self, path: impl Into<String>, message: impl Into<String>) {
        self.problems.push(Problem { path: path.into(), message: message.into() });
    }

    fn limits(&mut self) {
        let scene = self.scene;
        let joints: usize = scene.frames.iter().map(|f| f.motions().len()).sum();
        let signal_points: usize = scene.signals.iter().map(Signal::points).sum();
        let equations: usize = scene.constraints.iter().map(Constraint::equations).sum();
        let armature_terms = scene.armatures.iter().map(|armature| armature.terms.len()).sum();
        let (mut cord_points, mut spring_terms) = (0, 0);
        for spring in &scene.springs {
            match spring {
                Spring::Path { points, .. } | Spring::Stop { points, .. } => {
                    cord_points += points.len();
                }
                Spring::LinearSpring { terms, .. } => spring_terms += terms.len(),
                _ => {}
            }
        }
        let (mut path_points, mut coupling_terms) = (0, 0);
        for constraint in &scene.constraints {
            match constraint {
                Constraint::PathLength { points, .. } => path_points += points.len(),
                Constraint::Coupling { terms, .. } => coupling_terms += terms.len(),
                _ => {}
            }
        }
        let (mut force_points, mut force_terms) = (0, 0);
        for force in &scene.forces {
            match force {
                Force::LinearDamper { terms, .. } | Force::Servo { terms, .. } => {
                    force_terms += terms.len();
                }
                Force::PathDamper { points, .. } => force_points += points.len(),
                Force::Friction { terms, points, .. } => {
                    force_terms += terms.len();
                    force_points += points.len();
                }
                _ => {}
            }
        }
        let input_terms = scene.inputs.iter().map(|input| input.terms.len()).sum();
        let input_points = scene.inputs.iter().map(|input| input.points.len()).sum();
        let visuals = scene.frames.iter().map(|frame| frame.visuals.len()).sum();
        let equations = scene.constraints.len().max(equations);
        for (path, what, count, most) in [
            ("frames", "frames", scene.frames.len(), MAX_FRAMES),
            ("frames", "joints", joints, MAX_COORDINATES),
            ("coordinates", "coordinates", scene.coordinates.len(), MAX_COORDINATES),
            ("armatures", "terms of sums", armature_terms, MAX_LINEAR_TERMS),
            ("springs", "springs", scene.springs.len(), MAX_SPRINGS),
            ("springs", "points of paths", cord_points, MAX_PATH_POINTS),
            ("springs", "terms of sums", spring_terms, MAX_LINEAR_TERMS),
            ("forces", "terms of sums", force_terms, MAX_LINEAR_TERMS),
            ("forces", "points of paths", force_points, MAX_PATH_POINTS),
            ("inputs", "inputs", scene.inputs.len(), MAX_INPUTS),
            ("inputs", "terms", input_terms, MAX_LINEAR_TERMS),
            ("inputs", "points of paths", input_points, MAX_PATH_POINTS),
            ("frames", "visuals", visuals, MAX_VISUALS),
            ("forces", "forces", scene.forces.len(), MAX_FORCES),
            ("signals", "signals", scene.signals.len(), MAX_SIGNALS),
            ("signals", "knots and times", signal_points, MAX_SIGNAL_POINTS),
            ("constraints", "constraints", equations, MAX_CONSTRAINTS),
            ("constraints", "points of paths", path_points, MAX_PATH_POINTS),
            ("constraints", "terms of couplings", coupling_terms, MAX_COUPLING_TERMS),
            (
                "operating_points",
                "operating_points",
                scene.operating_points.len(),
                MAX_OPERATING_POINTS,
            ),
        ] {
            if count > most {
                self.report(path, format!("{count} {what}; at most {most} are allowed"));
            }
        }
    }

    fn header(&mut self) {
        let scene = self.scene;
        if scene.format != 1 {
            self.report(
                "format",
                format!("version {} is not known; this is version 1", scene.format),
            );
        }
        let is_plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
        if scene.name.is_empty()
            || scene.name.len() > MAX_NAME_BYTES
            || !scene.name.bytes().all(is_plain)
        {
            let message =
                format!("must be 1 to {MAX_NAME_BYTES} lower-case letters, digits and hyphens");
            self.report("name", message);
        }
        self.positive("time_step_s".into(), scene.time_step_s);
        match &scene.gravity {
            Some(gravity) => {
                self.finite_all("gravity", gravity);
            }
            None => self.report(
                "gravity",
                "is not given; write `gravity = [0.0, 0.0, -9.81]` where z points up, `gravity = [0.0, 0.0, 0.0]` for none",
            ),
        }
        self.not_negative("damping".into(), scene.damping);
    }

    /// The syntax of a name, and that `seen` does not have it yet.
    fn name(&mut self, path: String, name: &'a str, seen: &mut BTreeMap<&'a str, usize>) {
        self.spelling(path.clone(), name);
        if let Some(first) = seen.get(name) {
            self.report(path, format!("`{name}` is also the name of number {first}"));
        } else {
            seen.insert(name, seen.len());
        }
    }

    fn spelling(&mut self, path: String, name: &str) {
        let is_plain = |b: u8| b.is_ascii_alphanumeric() || b == b'-' || b == b'_';
        if name.is_empty() || name.len() > MAX_NAME_BYTES || !name.bytes().all(is_plain) {
            let message = format!(
                "must be 1 to {MAX_NAME_BYTES} ASCII letters, digits, hyphens and underscores"
            );
            self.report(path, message);
        }
    }

    fn finite(&mut self, path: String, x: f64) -> bool {
        if !x.is_finite() {
            self.report(path, format!("is {x}; must be a finite number"));
        }
        x.is_finite()
    }

    fn finite_all(&mut self, path: &str, xs: &[f64]) -> bool {
        let mut all = true;
        for (i, &x) in xs.iter().enumerate() {
            all &= self.finite(format!("{path}[{i}]"), x);
        }
        all
    }

    fn positive(&mut self, path: String, x: f64) {
        if self.finite(path.clone(), x) && x <= 0.0 {
            self.report(path, format!("is {x}; must be greater than zero"));
        }
    }

    fn not_negative(&mut self, path: String, x: f64) {
        if self.finite(path.clone(), x) && x < 0.0 {
            self.report(path, format!("is {x}; must not be negative"));
        }
    }

    /// Two finite numbers, the second greater than the first.
    fn interval(&mut self, path: &str, [low, high]: [f64; 2]) {
        if self.finite_all(path, &[low, high]) && low >= high {
            self.report(path, format!("is [{low}, {high}]; the second must be greater"));
        }
    }
}
