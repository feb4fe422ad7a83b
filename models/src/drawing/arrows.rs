//! Arrows: forces and torques of inputs, and of constraints, where they act.
//!
//! An arrow is `Σ s_k e_k` with strengths `s` and vectors `e`. The force of an equation `h` of a constraint on a
//! point `x` is `−λ/h_t ∂h/∂x`, with the impulse `λ` of a step of `h_t` seconds:
//!
//! ```text
//! distance          h = |a − b|² − l²       on a: −2 (a − b)      on b: 2 (a − b)
//! point to point    h = (a − b)·e           on a: −e              on b: e
//! point on plane    h = n·(a − b)           on the plane: −n      on b: n
//! orientation       h = u_a·w_b             on a: w × u           on b: u × w     (torques)
//! weld              h = (a − b)·x_a         on a: −x_a            on b: x_a, and the torques
//! path length       h = Σ |d_s| − l         on x: −∂L/∂x
//! ```
//!
//! A coupling of coordinates acts at no place. Of two points that coincide and move both, the arrow is that on the
//! first; the other is its opposite.

use plantd_math::spatial::Vec3;
use plantd_scene::{Component, Constraint, Force, Point, Scene};

use crate::drawing::rig::{Direction, Rig};
use crate::lagrangian::kinematics::Poses as JointPoses;
use crate::model::tree::{Attachment, WORLD};

/// What an arrow stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArrowKind {
    /// An input that acts.
    Input,
    /// A constraint force.
    Constraint,
}

/// An arrow.
#[derive(Clone, Debug, PartialEq)]
pub struct Arrow {
    /// What it stands for.
    pub kind: ArrowKind,
    /// Name of the input, or of the constraint.
    pub name: String,
    /// A torque about its direction, N·m, and not a force, N.
    pub torque: bool,
}

/// A state, as far as a drawing depends on it.
#[derive(Clone, Copy, Debug)]
pub struct Instant<'a> {
    /// Configuration, nd + nk.
    pub q: &'a [f64],
    /// Velocities, nd + nk; or none, which leaves out the damping of servos.
    pub velocity: &'a [f64],
    /// Inputs that act, ni; more entries are of no interest.
    pub inputs: &'a [f64],
    /// Constraint impulses of the last step, nc.
    pub multipliers: &'a [f64],
    /// Duration of that step, s.
    pub time_step_s: f64,
}

/// A factor of a vector.
#[derive(Clone, Debug)]
enum Strength {
    /// An input, times a gain.
    Input { input: usize, gain: f64 },
    /// Of a servo, times its coefficient of the coordinate.
    Servo { servo: usize, coefficient: f64 },
    /// The force `λ/h_t` of an equation, times a factor.
    Equation { equation: usize, factor: f64 },
}

/// A vector.
#[derive(Clone, Debug)]
enum Vector {
    /// Fixed in a joint or in the world.
    Fixed(Direction),
    /// `a − b`.
    Difference([Attachment; 2]),
    /// `u × w`.
    Cross([Direction; 2]),
    /// `∂L/∂x` of the length of a path by one of its points, between its neighbours.
    Tangent { point: Attachment, neighbours: [Option<Attachment>; 2] },
}

/// Where an arrow acts, and what is summed up for it.
#[derive(Clone, Debug)]
struct Rule {
    at: Attachment,
    terms: Vec<(Strength, Vector)>,
}

/// `gain u − stiffness s − damping ds/dt + constant`, `s = Σ c_i q_i`.
#[derive(Clone, Debug)]
struct Servo {
    terms: Vec<(usize, f64)>,
    input: usize,
    gain: f64,
    stiffness: f64,
    damping: f64,
    constant: f64,
}

/// Arrows with what makes them.
#[derive(Clone, Debug, Default)]
pub(super) struct Arrows {
    pub(super) arrows: Vec<Arrow>,
    rules: Vec<Rule>,
    servos: Vec<Servo>,
}

const ORIGIN: [f64; 3] = [0.0; 3];
const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

impl Arrows {
    pub(super) fn new(scene: &Scene, rig: &Rig) -> Self {
        let mut arrows = Self::default();
        for (input, of) in scene.inputs.iter().enumerate() {
            let alone = of.coordinate.iter().map(|name| (name, of.gain));
            for (name, gain) in alone.chain(of.terms.iter().map(|t| (&t.coordinate, t.gain))) {
                let strength = Strength::Input { input, gain };
                arrows.push_on_coordinate(&of.name, rig, rig.coordinate(name), strength);
            }
            let strength = Strength::Input { input, gain: of.gain };
            arrows.push_along((ArrowKind::Input, &of.name), &of.points, rig, &strength);
        }
        for force in &scene.forces {
            arrows.add_force(force, scene, rig);
        }
        let mut equation = 0;
        for constraint in &scene.constraints {
            arrows.add_constraint(constraint, equation, rig);
            equation += constraint.equations();
        }
        arrows
    }

    /// Where each arrow acts.
    pub(super) fn places(&self) -> impl Iterator<Item = &Attachment> {
        self.rules.iter().map(|rule| &rule.at)
    }

    /// Writes where each arrow acts and what it is.
    pub(super) fn evaluate(
        &self,
        rig: &Rig,
        poses: &JointPoses,
        at: &Instant<'_>,
        out: &mut [[f64; 6]],
    ) {
        for (rule, out) in self.rules.iter().zip(out) {
            let mut sum = Vec3::ZERO;
            for (strength, vector) in &rule.terms {
                sum += vector.at(rig, poses) * self.strength(strength, at);
            }
            let Vec3([x, y, z]) = rig.place(poses, &rule.at);
            let Vec3([a, b, c]) = sum;
            *out = [x, y, z, a, b, c];
        }
    }

    fn strength(&self, strength: &Strength, at: &Instant<'_>) -> f64 {
        match *strength {
            Strength::Input { input, gain } => gain * at.inputs[input],
            Strength::Servo { servo, coefficient } => coefficient * self.servos[servo].force(at),
            Strength::Equation { equation, factor } => {
                factor * at.multipliers[equation] / at.time_step_s
            }
        }
    }

    fn push(
        &mut self,
        (kind, name): (ArrowKind, &str),
        torque: bool,
        at: Attachment,
        terms: Vec<(Strength, Vector)>,
    ) {
        self.arrows.push(Arrow { kind, name: name.to_owned(), torque });
        self.rules.push(Rule { at, terms });
    }

    /// Along the axis of the joint of a coordinate, or about it.
    fn push_on_coordinate(&mut self, name: &str, rig: &Rig, coordinate: usize, strength: Strength) {
        let Some((joint, axis)) = rig.axis(coordinate) else { return };
        let at = Attachment { joint, point: Vec3::ZERO };
        let terms = vec![(strength, Vector::Fixed(axis))];
        self.push((ArrowKind::Input, name), rig.turns(joint), at, terms);
    }

    /// On each point of a path that moves: `strength · ∂L/∂x`.
    fn push_along(
        &mut self,
        of: (ArrowKind, &str),
        points: &[Point],
        rig: &Rig,
        strength: &Strength,
    ) {
        let points: Vec<Attachment> = points.iter().map(|point| rig.point(point)).collect();
        for (index, &at) in points.iter().enumerate().filter(|(_, at)| at.joint != WORLD) {
            let before = index.checked_sub(1).map(|i| points[i]);
            let neighbours = [before, points.get(index + 1).copied()];
            let tangent = Vector::Tangent { point: at, neighbours };
            self.push(of, false, at, vec![(strength.clone(), tangent)]);
        }
    }

    fn add_force(&mut self, force: &Force, scene: &Scene, rig: &Rig) {
        let input = |name: &str| scene.inputs.iter().position(|input| input.name == name);
        match force {
            Force::BodyWrench { frame, force, torque } => {
                let axis = |i: usize| rig.direction(frame, AXES[i]);
                self.add_wrench(scene, rig.at(frame, ORIGIN), axis, [force, torque]);
            }
            Force::HybridWrench { frame, force, torque } => {
                let at = rig.at(frame, ORIGIN);
                self.add_wrench(scene, at, Direction::of_world, [force, torque]);
            }
            Force::SpatialWrench { force, torque, .. } => {
                let at = rig.at("world", ORIGIN);
                self.add_wrench(scene, at, Direction::of_world, [force, torque]);
            }
            Force::Thruster { frame, at, axis, input: name, gain } => {
                let Some(input) = input(name) else { return };
                let gain = gain / Vec3(*axis).norm();
                let along = Vector::Fixed(rig.direction(frame, *axis));
                let terms = vec![(Strength::Input { input, gain }, along)];
                self.push((ArrowKind::Input, name), false, rig.at(frame, *at), terms);
            }
            Force::Servo { coordinate, terms, input: name, gain, stiffness, damping, constant } => {
                let Some(input) = input(name) else { return };
                let alone = coordinate.iter().map(|name| (rig.coordinate(name), 1.0));
                let others = terms.iter().map(|t| (rig.coordinate(&t.coordinate), t.coefficient));
                let terms: Vec<(usize, f64)> = alone.chain(others).collect();
                let servo = self.servos.len();
                for &(coordinate, coefficient) in terms.iter().filter(|(i, _)| *i < rig.dynamic) {
                    let strength = Strength::Servo { servo, coefficient };
                    self.push_on_coordinate(name, rig, coordinate, strength);
                }
                let (gain, stiffness, damping, constant) = (*gain, *stiffness, *damping, *constant);
                self.servos.push(Servo { terms, input, gain, stiffness, damping, constant });
            }
            Force::TwoPointDamper { .. }
            | Force::Drag { .. }
            | Force::CoordinateDrag { .. }
            | Force::LinearDamper { .. }
            | Force::PathDamper { .. }
            | Force::Friction { .. } => {}
        }
    }

    /// An arrow for each component that is an input.
    fn add_wrench(
        &mut self,
        scene: &Scene,
        at: Attachment,
        axis: impl Fn(usize) -> Direction,
        components: [&[Component; 3]; 2],
    ) {
        for (torque, components) in [false, true].into_iter().zip(components) {
            for (i, component) in components.iter().enumerate() {
                let Some((name, gain)) = component.input() else { continue };
                let Some(input) = scene.inputs.iter().position(|input| input.name == name) else {
                    continue;
                };
                let terms = vec![(Strength::Input { input, gain }, Vector::Fixed(axis(i)))];
                self.push((ArrowKind::Input, name), torque, at, terms);
            }
        }
    }

    /// `equation` is the first of the constraint's.
    fn add_constraint(&mut self, constraint: &Constraint, equation: usize, rig: &Rig) {
        let of = (ArrowKind::Constraint, constraint.name());
        match constraint {
            Constraint::Distance { a, b, .. } => {
                let ends = [rig.point(a), rig.point(b)];
                for (at, factor) in ends.into_iter().zip([-2.0, 2.0]) {
                    if at.joint != WORLD {
                        let strength = Strength::Equation { equation, factor };
                        self.push(of, false, at, vec![(strength, Vector::Difference(ends))]);
                    }
                }
            }
            Constraint::PointToPoint { a, b, axes, .. } => {
                let ends = [rig.point(a), rig.point(b)];
                let axes: Vec<Direction> =
                    axes.iter().map(|axis| Direction::of_world(*axis as usize)).collect();
                if axes.len() == AXES.len() {
                    self.push_at_joined(of, ends, equation, &axes);
                    return;
                }
                for (at, factor) in ends.into_iter().zip([-1.0, 1.0]) {
                    if at.joint != WORLD {
                        self.push_axes(of, at, (equation, factor), &axes);
                    }
                }
            }
            Constraint::PointOnPlane { plane, point, .. } => {
                let at = rig.point(point);
                let factor = if at.joint == WORLD { -1.0 } else { 1.0 };
                let normal = Vector::Fixed(rig.direction(&plane.frame, plane.normal));
                let strength = Strength::Equation { equation, factor };
                self.push(of, false, at, vec![(strength, normal)]);
            }
            Constraint::Orientation { a, b, .. } => self.push_turn(of, [a, b], equation, rig),
            Constraint::Weld { a, b, .. } => {
                let ends = [rig.at(a, ORIGIN), rig.at(b, ORIGIN)];
                let axes = AXES.map(|axis| rig.direction(a, axis));
                self.push_at_joined(of, ends, equation, &axes);
                self.push_turn(of, [a, b], equation + 3, rig);
            }
            Constraint::Coupling { .. } => {}
            Constraint::PathLength { points, .. } => {
                let strength = Strength::Equation { equation, factor: -1.0 };
                self.push_along(of, points, rig, &strength);
            }
        }
    }

    /// The force on the first of two points that coincide, if it moves, else on the second.
    fn push_at_joined(
        &mut self,
        of: (ArrowKind, &str),
        [a, b]: [Attachment; 2],
        equation: usize,
        axes: &[Direction],
    ) {
        let (at, factor) = if a.joint == WORLD { (b, 1.0) } else { (a, -1.0) };
        self.push_axes(of, at, (equation, factor), axes);
    }

    /// A force of equations in a row, each along its axis.
    fn push_axes(
        &mut self,
        of: (ArrowKind, &str),
        at: Attachment,
        (equation, factor): (usize, f64),
        axes: &[Direction],
    ) {
        let terms = axes.iter().enumerate().map(|(i, axis)| {
            (Strength::Equation { equation: equation + i, factor }, Vector::Fixed(*axis))
        });
        self.push(of, false, at, terms.collect());
    }

    /// The torque on the first of two frames that turn together, if it moves, else on the second.
    fn push_turn(
        &mut self,
        of: (ArrowKind, &str),
        [a, b]: [&String; 2],
        equation: usize,
        rig: &Rig,
    ) {
        let [at_a, at_b] = [a, b].map(|frame| rig.at(frame, ORIGIN));
        let (at, factor) = if at_a.joint == WORLD { (at_b, 1.0) } else { (at_a, -1.0) };
        // Those that the constraint is made of: `y_a·z_b`, `z_a·x_b`, `x_a·y_b`.
        let pairs = [(1, 2), (2, 0), (0, 1)].into_iter().enumerate();
        let terms = pairs.map(|(i, (u, w))| {
            let cross = Vector::Cross([rig.direction(a, AXES[u]), rig.direction(b, AXES[w])]);
            (Strength::Equation { equation: equation + i, factor }, cross)
        });
        self.push(of, true, at, terms.collect());
    }
}

impl Vector {
    fn at(&self, rig: &Rig, poses: &JointPoses) -> Vec3 {
        let place = |at: &Attachment| rig.place(poses, at);
        match self {
            Self::Fixed(direction) => direction.in_world(poses),
            Self::Difference([a, b]) => place(a) - place(b),
            Self::Cross([u, w]) => u.in_world(poses).cross(w.in_world(poses)),
            Self::Tangent { point, neighbours } => {
                let away_from = |other: &Attachment| {
                    let difference = place(point) - place(other);
                    let length = difference.norm();
                    if length > 0.0 { difference * (1.0 / length) } else { Vec3::ZERO }
                };
                let directions = neighbours.iter().flatten().map(away_from);
                directions.fold(Vec3::ZERO, |sum, direction| sum + direction)
            }
        }
    }
}

impl Servo {
    fn force(&self, at: &Instant<'_>) -> f64 {
        let sum = |of: &[f64]| -> f64 {
            self.terms.iter().map(|&(i, c)| c * of.get(i).copied().unwrap_or_default()).sum()
        };
        self.gain * at.inputs[self.input]
            - self.stiffness * sum(at.q)
            - self.damping * sum(at.velocity)
            + self.constant
    }
}
