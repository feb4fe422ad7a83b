//! Derivatives against dual numbers, which differentiate the forces themselves.

use plantd_math::scalar::Dual;
use plantd_math::spatial::{Mat3, Vec3};
use plantd_scene::Scene;

use crate::lagrangian::forces::*;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::mechanism::Model;

/// Every force, on a tree with oblique hinges and slides and a ball joint; `shaken` is prescribed.
const EVERYTHING: &str = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "everything"
[[frames]]
name = "shaken"
translation = [3, -2, 5]
joint = { type = "prismatic", axis = [1, 2, -1] }
[[frames]]
name = "a"
parent = "shaken"
rotation = { rpy = [0.4, 0.2, -0.9] }
joint = { type = "revolute", axis = [1, -1, 0.5] }
body = { mass = 1, center_of_mass = [0.1, 0.2, 0.3], inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "b"
parent = "a"
translation = [0.3, 0.5, -0.1]
joint = { type = "revolute", axis = [0.2, 0.1, 1] }
body = { mass = 1, center_of_mass = [0.1, 0, 0.3], inertia = [0.1, 0.1, 0.1] }
[[frames]]
name = "c"
parent = "b"
translation = [0.1, 0.2, 0.6]
joint = { type = "prismatic", axis = [1, 1, 0.3] }
body = { mass = 1 }
[[frames]]
name = "d"
parent = "a"
translation = [-0.4, 0.2, 0.3]
joint = { type = "revolute", axis = [0.5, 1, 0.3] }
body = { mass = 1, center_of_mass = [0.1, 0, 0.3] }
[[frames]]
name = "wrist"
parent = "c"
translation = [0.2, 0.1, 0.3]
joint = { type = "ball" }
body = { mass = 1, center_of_mass = [0.1, 0, 0.3], inertia = [0.1, 0.2, 0.2] }
[[frames]]
name = "slide"
parent = "wrist"
translation = [0.1, 0.3, -0.2]
joint = { type = "prismatic", axis = [1, 2, 3] }
body = { mass = 1 }
[[frames]]
name = "tool"
parent = "slide"
translation = [0.2, -0.3, 0.4]
rotation = { rpy = [1, 2, 3] }
[[coordinates]]
name = "shaken"
kind = "prescribed"
[[inputs]]
name = "u"
[[inputs]]
name = "w"
[[forces]]
type = "body_wrench"
frame = "tool"
force = [0.3, "u", 0.7]
torque = ["w", -0.3, "u"]
[[forces]]
type = "spatial_wrench"
frame = "tool"
force = [0.3, "u", 0.7]
torque = ["w", -0.3, "u"]
[[forces]]
type = "hybrid_wrench"
frame = "tool"
force = [0.3, "u", 0.7]
torque = ["w", -0.3, "u"]
[[forces]]
type = "thruster"
frame = "d"
at = [0.1, 0.2, 0.3]
axis = [3, -2, 1]
input = "w"
[[forces]]
type = "two_point_damper"
a = { frame = "tool", at = [0.1, 0.2, 0.3] }
b = { frame = "d", at = [0.3, -0.2, 0.1] }
damping = 2
[[forces]]
type = "two_point_damper"
a = { frame = "world", at = [1, 2, 3] }
b = { frame = "b", at = [0.3, -0.2, 0.1] }
damping = 2
[[forces]]
type = "drag"
frame = "tool"
at = [0.3, -0.2, 0.1]
coefficient = 1.5
[[forces]]
type = "coordinate_drag"
coordinate = "d"
coefficient = 0.5
cubic = 0.3
[[forces]]
type = "friction"
terms = [{ coordinate = "shaken", coefficient = 0.4 }, { coordinate = "d", coefficient = -2 }, { coordinate = "c", coefficient = 1.5 }]
force = 0.7
velocity = 0.8
[[forces]]
type = "friction"
points = [{ frame = "tool" }, { frame = "d", at = [0.1, 0.2, 0] }, { frame = "world", at = [1, 0, 2] }]
force = 0.7
velocity = 0.8
[[forces]]
type = "linear_damper"
damping = 0.6
terms = [{ coordinate = "shaken", coefficient = 0.4 }, { coordinate = "d", coefficient = -2 }, { coordinate = "c", coefficient = 1.5 }]
[[forces]]
type = "linear_damper"
damping = 0.3
input = "u"
terms = [{ coordinate = "b", coefficient = 0.7 }, { coordinate = "d", coefficient = -1.5 }]
[[forces]]
type = "friction"
coordinate = "b"
force = 0.5
velocity = 0.3
[[forces]]
type = "path_damper"
points = [{ frame = "tool", at = [0.1, 0.2, 0.3] }, { frame = "d", at = [0.3, -0.2, 0.1] }, { frame = "world", at = [1, 2, 3] }]
damping = 1.3
[[inputs]]
name = "tendon"
points = [{ frame = "tool" }, { frame = "b", at = [0.3, -0.2, 0.1] }, { frame = "d", at = [0.1, 0.1, 0.1] }]
gain = -0.8
[[springs]]
type = "stop"
points = [{ frame = "tool", at = [0.1, 0.2, 0.3] }, { frame = "a" }, { frame = "world" }]
range = [0, 1]
stiffness = 1
damping = 0.7
transition = 50
[[springs]]
type = "stop"
coordinate = "d"
range = [-9, -3]
stiffness = 1
damping = 0.7
transition = 9
[[forces]]
type = "servo"
terms = [{ coordinate = "b", coefficient = 0.4 }, { coordinate = "d", coefficient = -2 }]
input = "u"
stiffness = 2
damping = 0.4
constant = 0.2
"#;

/// A mechanism somewhere in motion.
struct Case<S> {
    model: Model,
    q: Vec<S>,
    v: Vec<S>,
    u: Vec<S>,
}

/// What [`Case::with`] gives to a function.
type Seen<'a, S> = (&'a Forces, &'a Instant<'a, S>);

impl<S: Scalar> Case<S> {
    fn new(text: &str, speed: f64) -> Self {
        let model = Model::compile(&Scene::from_toml(text).unwrap()).unwrap();
        let d = model.dimensions();
        let wave = |n: usize, size: f64, phase: f64| -> Vec<S> {
            (0..n).map(|i| S::constant(size * (1.7 * i as f64 + phase).sin())).collect()
        };
        let n = d.coordinates();
        Self { q: wave(n, 0.8, 0.3), v: wave(n, speed, 1.0), u: wave(d.inputs, 1.0, 2.0), model }
    }

    fn with<T>(&self, see: impl FnOnce(Seen<'_, S>) -> T) -> T {
        let tree = &self.model.dynamics;
        let (mut poses, mut momenta) = (Poses::new(tree), Momenta::new(tree));
        let mut unused = vec![S::ZERO; self.model.dimensions().dynamic];
        // Turned by a little more than a constant, in the ball joint's own axes.
        let orientation = |&i: &usize| {
            let [x, y, z] = [0, 1, 2].map(|a| self.q[i + a] - self.q[i + a].value());
            let i = S::ONE;
            let more = Mat3::from_rows([[i, -z, y], [z, i, -x], [-y, x, i]]);
            Mat3::lift(plantd_math::rotation::exp(Vec3([0.4, -0.9, 0.7]))).times(&more)
        };
        let orientations: Vec<_> = self.model.orientations.iter().map(orientation).collect();
        poses.evaluate(tree, &self.q, &orientations);
        let unused_v = &mut unused.clone();
        momenta.gradient(tree, &poses, &self.v, None, &mut unused, unused_v);
        let instant = Instant {
            tree,
            poses: &poses,
            momenta: &momenta,
            q: &self.q,
            velocity: &self.v,
            inputs: &self.u,
        };
        see((self.model.forces.as_ref().unwrap(), &instant))
    }

    fn force(&self) -> Vec<S> {
        let mut force = vec![S::ZERO; self.model.dimensions().dynamic];
        self.with(|(forces, at)| forces.add(at, &mut force));
        force
    }

    /// `∂f/∂q`, `∂f/∂v` (columns of all coordinates) and `∂f/∂u`, row by row.
    fn derivatives(&self) -> [Vec<Vec<S>>; 3] {
        let d = self.model.dimensions();
        let zeros = |columns: usize| vec![vec![S::ZERO; columns]; d.dynamic];
        let [mut by_q, mut by_v] = [zeros(d.coordinates()), zeros(d.coordinates())];
        let mut by_u = zeros(d.inputs);
        self.with(|(forces, at)| {
            forces.for_each_derivative(at, |i, j, q, v| {
                if i < d.dynamic {
                    by_q[i][j] += q;
                    by_v[i][j] += v;
                }
            });
            forces.for_each_input_derivative(at, |i, k, u| {
                if i < d.dynamic {
                    by_u[i][k] += u;
                }
            });
        });
        [by_q, by_v, by_u]
    }
}

#[test]
fn derivatives_are_those_of_the_forces() {
    for speed in [1.3, 1e-3, 30.0] {
        let found = Case::<f64>::new(EVERYTHING, speed).derivatives();
        for (part, found) in found.iter().enumerate() {
            for column in 0..found[0].len() {
                let mut case = Case::<Dual>::new(EVERYTHING, speed);
                [&mut case.q, &mut case.v, &mut case.u][part][column].eps = 1.0;
                for (row, force) in case.force().iter().enumerate() {
                    let (x, y) = (found[row][column], force.eps);
                    let close = (x - y).abs() < 1e-13 * (1.0 + speed * speed);
                    assert!(close, "part {part} [{row}, {column}] is {x} instead of {y}");
                }
            }
        }
    }
}

/// Second derivatives along directions, by dual numbers, are within their bound, and not far below.
#[test]
fn second_derivatives_are_bounded() {
    for (speed, [moved, faster]) in [(1.3, [0.5, 0.0]), (1e-2, [0.5, 30.0]), (30.0, [0.5, 1e3])] {
        let mut case = Case::<Dual>::new(EVERYTHING, speed);
        let n = case.q.len();
        let direction: Vec<f64> = (0..n).map(|i| (2.3 * i as f64 + 0.4).sin()).collect();
        let extent: f64 = direction.iter().map(|x| x.abs()).sum();
        for (i, x) in direction.iter().enumerate() {
            (case.q[i].eps, case.v[i].eps) = (moved * x / extent, faster * x / extent);
        }
        let [by_q, by_v, _] = case.derivatives();
        let along = |row: &[Dual], changes: &[Dual]| -> f64 {
            row.iter().zip(changes).map(|(slope, x)| slope.eps * x.eps).sum()
        };
        let rows = by_q.iter().zip(&by_v);
        let second = rows.map(|(q, v)| (along(q, &case.q) + along(v, &case.v)).abs());
        let most = second.fold(0.0, f64::max);
        let bound = Case::<f64>::new(EVERYTHING, speed)
            .with(|(forces, at)| forces.second_derivative(at, [moved, faster]));
        assert!(most <= bound && bound < 1e5 * most, "{most:e} {bound:e}");
    }
}

/// The forces are not zero, and a damper acts on what is beside its ends' common ancestors alone.
#[test]
fn every_part_is_there() {
    let [by_q, by_v, by_u] = Case::<f64>::new(EVERYTHING, 1.3).derivatives();
    for matrix in [&by_q, &by_v] {
        for row in matrix {
            assert!(row.iter().filter(|x| **x != 0.0).count() >= 3, "{matrix:?}");
        }
    }
    assert!(by_u.iter().flatten().filter(|x| **x != 0.0).count() >= 6, "{by_u:?}");
}

/// At rest and where a damper's ends coincide nothing is infinite, to the third derivative.
#[test]
fn no_derivative_is_infinite_at_rest() {
    type Third = Dual<Dual<Dual>>;
    // The origin of `d` is on its axis.
    let coincident = EVERYTHING
        .replace("{ frame = \"tool\", at = [0.1, 0.2, 0.3] }", "{ frame = \"d\" }")
        .replace(
            "{ frame = \"d\", at = [0.3, -0.2, 0.1] }",
            "{ frame = \"a\", at = [-0.4, 0.2, 0.3] }",
        );
    let finite = |x: &Third| {
        let parts = [x.re, x.eps].map(|x| [x.re, x.eps].map(|x| [x.re, x.eps]));
        parts.as_flattened().as_flattened().iter().all(|x: &f64| x.is_finite())
    };
    for (text, speed) in [
        (EVERYTHING, 0.0),
        (&coincident, 0.0),
        (&coincident, 1.0),
        (EVERYTHING, 1e-60),
        (EVERYTHING, 1e-49),
    ] {
        for column in 0..9 {
            let mut case = Case::<Third>::new(text, speed);
            for x in [&mut case.q[column], &mut case.v[column]] {
                x.eps.re.re = 1.0;
                x.re.eps.re = 1.0;
                x.re.re.eps = 1.0;
            }
            assert!(case.force().iter().all(finite), "{speed} {column}");
            let derivatives = case.derivatives();
            assert!(derivatives.iter().flatten().flatten().all(finite), "{speed} {column}");
        }
    }
}
