//! Thousands of random scenes of every kind of joint, spring, force and constraint: derivatives of
//! first and second order along random directions, the symplectic form, momenta, energy.

mod common;

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::sync::Arc;

use common::Numbers;
use nalgebra::{DMatrix, DVector, Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use plantd_models::scene::Motion;
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, ForceSplit, Initial, Linearization, Model, Plant,
    Scene, Settings,
};

/// What a random scene is to have.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    /// Everything.
    Any,
    /// No forces.
    Conservative,
    /// One free body carries all others, and nothing touches the world.
    Floating,
}

/// A scene in the making: TOML, and where its frames are.
struct Maker {
    random: Numbers,
    text: String,
    initial: BTreeMap<String, f64>,
    prescribed: Vec<String>,
    /// Coordinates of hinges and slides.
    scalars: Vec<String>,
    frames: Vec<(String, Isometry3<f64>)>,
    dynamic: usize,
    kind: Kind,
}

impl Maker {
    fn vector(&mut self, size: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.random.between(-size, size))
    }

    fn line(&mut self, line: &str) {
        self.text.push_str(line);
        self.text.push('\n');
    }

    /// A frame below a random one, with a joint and a body.
    fn frame(&mut self, index: usize) {
        let name = format!("f{index}");
        let floating = self.kind == Kind::Floating;
        let lowest = usize::from(floating && index > 0);
        let choice = lowest + self.random.below(index + 1 - lowest);
        let (parent, parent_pose) = match choice {
            0 => ("world".to_owned(), Isometry3::identity()),
            i => self.frames[i - 1].clone(),
        };
        let (translation, rpy) = (self.vector(0.6), self.vector(PI));
        let axis = self.vector(1.0);
        let other = self.vector(1.0);
        let kind = if floating && index == 0 { 9 } else { self.random.below(10) };
        let pitch = self.random.between(-0.2, 0.2);
        let joint = match kind {
            0..=2 => format!("{{ type = \"revolute\", axis = {} }}", list(&axis)),
            3 | 4 => format!("{{ type = \"prismatic\", axis = {} }}", list(&axis)),
            5 => format!("{{ type = \"screw\", axis = {}, pitch = {pitch} }}", list(&axis)),
            6 => format!("{{ type = \"universal\", axes = [{}, {}] }}", list(&axis), list(&other)),
            7 | 8 => "{ type = \"ball\" }".to_owned(),
            _ => "{ type = \"free\" }".to_owned(),
        };
        let [a, b, c] = [0; 3].map(|_| self.random.between(0.1, 0.3));
        let mass = self.random.between(0.5, 2.0);
        let center = self.vector(0.3);
        let frame = format!(
            "[[frames]]\nname = \"{name}\"\nparent = \"{parent}\"\ntranslation = {}\nrotation = {{ rpy = {} }}\njoint = {joint}\nbody = {{ mass = {mass}, center_of_mass = {}, inertia = [{}, {}, {}, 0.01, -0.01, 0.005] }}\n",
            list(&translation),
            list(&rpy),
            list(&center),
            b + c,
            a + c,
            a + b,
        );
        let alone = Scene::from_toml(&format!(
            "format = 1\nname = \"x\"\n{}",
            frame.replace(&format!("parent = \"{parent}\"\n"), "")
        ))
        .unwrap();
        self.text.push_str(&frame);
        let rotation = UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]);
        let mut pose =
            parent_pose * Isometry3::from_parts(Translation3::from(translation), rotation);
        let prescribed = !floating && index > 0 && kind < 9 && self.random.below(6) == 0;
        let mut turn = Vector3::zeros();
        for (coordinate, motion) in alone.frames[0].motions() {
            let value = self.random.between(-0.8, 0.8);
            let slide = |axis: Vector3<f64>| Isometry3::translation(axis[0], axis[1], axis[2]);
            match motion {
                Motion::Revolute(axis) => {
                    let axis = Vector3::from(axis).normalize();
                    pose *= UnitQuaternion::new(axis * value);
                    self.scalars.push(coordinate.clone());
                }
                Motion::Prismatic(axis) => {
                    pose *= slide(Vector3::from(axis).normalize() * value);
                    self.scalars.push(coordinate.clone());
                }
                Motion::Screw(axis, pitch) => {
                    let axis = Vector3::from(axis).normalize();
                    pose *= UnitQuaternion::new(axis * value);
                    pose *= slide(axis * (pitch * value));
                    self.scalars.push(coordinate.clone());
                }
                Motion::Ball(component) => {
                    turn[component] = value;
                    if component == 2 {
                        pose *= UnitQuaternion::new(turn);
                    }
                }
            }
            if prescribed {
                self.prescribed.push(coordinate.clone());
            } else {
                self.dynamic += 1;
            }
            self.initial.insert(coordinate, value);
        }
        self.frames.push((name, pose));
    }

    /// A point on a random frame; in a floating scene never on the world. Its place in the world, too.
    fn point(&mut self) -> (String, Point3<f64>) {
        let floating = usize::from(self.kind == Kind::Floating);
        let at = self.vector(0.5);
        match floating + self.random.below(self.frames.len() + 1 - floating) {
            0 => (format!("{{ frame = \"world\", at = {} }}", list(&at)), at.into()),
            i => {
                let (name, pose) = &self.frames[i - 1];
                (format!("{{ frame = \"{name}\", at = {} }}", list(&at)), pose * Point3::from(at))
            }
        }
    }

    fn springs(&mut self) {
        for _ in 0..self.random.below(3) {
            let stiffness = self.random.between(1.0, 40.0);
            let rest = self.random.between(0.0, 0.4);
            let points = [0; 3].map(|_| self.point().0);
            let [a, b, c] = &points;
            let text = match self.random.below(4) {
                0 | 1 => format!(
                    "type = \"two_point\"\na = {a}\nb = {b}\nstiffness = {stiffness}\nrest_length = {rest}"
                ),
                2 => format!(
                    "type = \"path\"\npoints = [{a}, {b}, {c}]\nstiffness = {stiffness}\nrest_length = {rest}"
                ),
                _ => {
                    let Some(coordinate) = self.dynamic_scalar() else { continue };
                    format!(
                        "type = \"spline\"\ncoordinate = \"{coordinate}\"\nknots = [{{ x = -2.0, value = 9.0 }}, {{ x = 0.1, value = 0.5, slope = -3.0 }}, {{ x = 1.5, value = -8.0 }}]"
                    )
                }
            };
            self.line(&format!("[[springs]]\n{text}"));
        }
    }

    fn dynamic_scalar(&mut self) -> Option<String> {
        let floating = self.kind == Kind::Floating;
        let dynamic: Vec<_> = (self.scalars.iter())
            .filter(|c| !(self.prescribed.contains(c) || floating && c.starts_with("f0")))
            .cloned()
            .collect();
        (!dynamic.is_empty()).then(|| dynamic[self.random.below(dynamic.len())].clone())
    }

    fn forces(&mut self) {
        self.line("[[inputs]]\nname = \"u0\"\n[[inputs]]\nname = \"u1\"");
        let frame = self.frames[self.random.below(self.frames.len())].0.clone();
        let axis = list(&self.vector(1.0));
        self.line(&format!(
            "[[forces]]\ntype = \"thruster\"\nframe = \"{frame}\"\nat = [0.1, 0.0, 0.2]\naxis = {axis}\ninput = \"u0\""
        ));
        let kind = ["body_wrench", "spatial_wrench", "hybrid_wrench"][self.random.below(3)];
        let frame = self.frames[self.random.below(self.frames.len())].0.clone();
        self.line(&format!(
            "[[forces]]\ntype = \"{kind}\"\nframe = \"{frame}\"\nforce = [\"u1\", 0.3, -0.2]\ntorque = [0.1, \"u0\", 0.0]"
        ));
        for _ in 0..self.random.below(3) {
            let ([a, b], c) = ([0; 2].map(|_| self.point().0), self.random.between(0.05, 0.5));
            let frame = self.frames[self.random.below(self.frames.len())].0.clone();
            let text = match self.random.below(4) {
                0 => format!("type = \"two_point_damper\"\na = {a}\nb = {b}\ndamping = {c}"),
                1 => format!(
                    "type = \"drag\"\nframe = \"{frame}\"\nat = [0.2, 0.1, 0.0]\ncoefficient = {c}"
                ),
                more => {
                    let Some(coordinate) = self.dynamic_scalar() else { continue };
                    if more == 2 {
                        format!(
                            "type = \"friction\"\ncoordinate = \"{coordinate}\"\nforce = {c}\nvelocity = 0.5"
                        )
                    } else {
                        format!(
                            "type = \"coordinate_drag\"\ncoordinate = \"{coordinate}\"\ncoefficient = {c}"
                        )
                    }
                }
            };
            self.line(&format!("[[forces]]\n{text}"));
        }
    }

    /// Constraints that hold in the initial configuration.
    fn constraints(&mut self) {
        let mut free = self.dynamic;
        for c in 0..self.random.below(3) {
            let ((a, at_a), (b, at_b), (m, at_m)) = (self.point(), self.point(), self.point());
            let length = (at_a - at_b).norm();
            let head = format!("[[constraints]]\nname = \"c{c}\"\n");
            let (text, equations) = match self.random.below(5) {
                0 => (format!("type = \"distance\"\na = {a}\nb = {b}\nlength = {length}"), 1),
                1 => {
                    let length = (at_a - at_m).norm() + (at_m - at_b).norm();
                    (
                        format!(
                            "type = \"path_length\"\npoints = [{a}, {m}, {b}]\nlength = {length}"
                        ),
                        1,
                    )
                }
                2 => {
                    // The plane through where the point is.
                    let (name, pose) = &self.frames[self.random.below(self.frames.len())];
                    let at = list(&pose.inverse_transform_point(&at_b).coords);
                    let name = name.clone();
                    let normal = list(&self.vector(1.0));
                    (
                        format!(
                            "type = \"point_on_plane\"\nplane = {{ frame = \"{name}\", at = {at}, normal = {normal} }}\npoint = {b}"
                        ),
                        1,
                    )
                }
                3 => {
                    let (name, pose) = &self.frames[self.random.below(self.frames.len())];
                    let at = list(&pose.inverse_transform_point(&at_b).coords);
                    let axes = ["[\"x\"]", "[\"x\", \"z\"]", "[\"x\", \"y\", \"z\"]"];
                    // A world axis alone would hold a floating scene.
                    let count = if self.kind == Kind::Floating { 2 } else { self.random.below(3) };
                    (
                        format!(
                            "type = \"point_to_point\"\na = {{ frame = \"{name}\", at = {at} }}\nb = {b}\naxes = {}",
                            axes[count]
                        ),
                        count + 1,
                    )
                }
                _ => {
                    let Some(one) = self.dynamic_scalar() else { continue };
                    let Some(two) = self.dynamic_scalar() else { continue };
                    if one == two {
                        continue;
                    }
                    let (p, q) = (self.initial[&one], self.initial[&two]);
                    let constant = -(p + 0.3 * p * p - 0.7 * q);
                    (
                        format!(
                            "type = \"coupling\"\nterms = [{{ coordinate = \"{one}\", coefficients = [1.0, 0.3] }}, {{ coordinate = \"{two}\", coefficients = [-0.7] }}]\nconstant = {constant}"
                        ),
                        1,
                    )
                }
            };
            if free <= equations {
                return;
            }
            free -= equations;
            self.line(&format!("{head}{text}"));
        }
    }
}

fn list(v: &Vector3<f64>) -> String {
    format!("[{:?}, {:?}, {:?}]", v[0], v[1], v[2])
}

/// The scene of a seed.
fn scene(seed: u64, kind: Kind) -> String {
    let mut maker = Maker {
        random: Numbers::new(seed),
        text: format!("format = 1\nname = \"random-{seed}\"\n"),
        initial: BTreeMap::new(),
        prescribed: Vec::new(),
        scalars: Vec::new(),
        frames: Vec::new(),
        dynamic: 0,
        kind,
    };
    if kind != Kind::Floating && maker.random.below(4) > 0 {
        let gravity = list(&maker.vector(9.8));
        maker.line(&format!("gravity = {gravity}"));
    }
    if kind == Kind::Any {
        let damping = maker.random.between(0.0, 0.2);
        maker.line(&format!("damping = {damping}"));
    }
    for i in 0..=maker.random.below(4) {
        maker.frame(i);
    }
    maker.springs();
    if kind == Kind::Any {
        maker.forces();
    }
    maker.constraints();
    let mut coordinates = String::new();
    for (name, value) in &maker.initial {
        if !maker.prescribed.contains(name) {
            let _ =
                writeln!(coordinates, "[[coordinates]]\nname = \"{name}\"\ninitial = {value:?}");
        }
    }
    for name in &maker.prescribed {
        let value = maker.initial[name];
        let _ = writeln!(
            coordinates,
            "[[coordinates]]\nname = \"{name}\"\nkind = \"prescribed\"\ninitial = {value:?}"
        );
    }
    maker.text + &coordinates
}

/// A plant of a random scene in motion, with the input of its next step; none where the scene makes no
/// sense (two ends of a spring on one body) or stands at a singular point.
fn moving(seed: u64, kind: Kind, split: ForceSplit) -> Option<(Plant, Vec<f64>)> {
    let text = scene(seed, kind);
    let model = Arc::new(Model::compile(&Scene::from_toml(&text).unwrap()).ok()?);
    let settings = Settings { time_step_s: 0.005, force_split: split, ..Settings::new(&model) };
    let mut plant = Plant::new(model.clone(), settings).ok()?;
    let d = model.dimensions();
    let mut random = Numbers::new(!seed);
    let v: Vec<f64> = (0..d.coordinates())
        .map(|i| if i < d.dynamic { random.between(-1.0, 1.0) } else { 0.0 })
        .collect();
    let q = plant.q().to_vec();
    plant.initialize(&Initial::Velocity { q, v }).ok()?;
    let mut u = Vec::new();
    for k in 0..4 {
        let forces = (0..d.inputs).map(|i| (f64::from(k) + i as f64).sin());
        let change: Vec<f64> = (0..d.coordinates())
            .map(
                |i| if i < d.dynamic { 0.0 } else { 0.004 * (i as f64 + 0.3 * f64::from(k)).cos() },
            )
            .collect();
        let next = model.retract(plant.q(), &change);
        u = forces.chain(next[d.dynamic..].iter().copied()).collect();
        if k < 3 {
            plant.step(&u).ok()?;
        }
    }
    let report = plant.clone().step(&u).ok()?;
    let regular =
        report.constraint_reciprocal_condition > 1e-3 && report.redundant_constraints == 0;
    regular.then_some((plant, u))
}

/// Sixth-order central difference.
fn slope(delta: f64, mut along: impl FnMut(f64) -> DVector<f64>) -> DVector<f64> {
    let stencil = [(1.0, 3.0 / 4.0), (2.0, -3.0 / 20.0), (3.0, 1.0 / 60.0)];
    stencil
        .into_iter()
        .map(|(k, weight)| (along(k * delta) - along(-k * delta)) * (weight / delta))
        .reduce(|a, b| a + b)
        .unwrap()
}

/// A random displacement of state and input that keeps the constraints.
struct Direction {
    q: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
}

impl Direction {
    fn new(plant: &Plant, seed: u64) -> Self {
        let d = plant.model().dimensions();
        let mut random = Numbers::new(seed ^ 0x5eed);
        let mut some = |n: usize, size: f64| -> Vec<f64> {
            (0..n).map(|_| random.between(-size, size)).collect()
        };
        let constrained = d.constraints > 0;
        Self {
            q: some(d.coordinates(), if constrained { 0.0 } else { 1.0 }),
            p: some(d.dynamic, 0.3),
            u: some(d.input(), 1.0),
        }
    }

    fn state(&self) -> DVector<f64> {
        let rest = vec![0.0; self.q.len() - self.p.len()];
        DVector::from_vec([&self.q[..], &self.p, &rest].concat())
    }

    fn input(&self) -> DVector<f64> {
        DVector::from_row_slice(&self.u)
    }

    /// Puts a plant where it is after `s` along the direction, and returns the input there.
    fn go(&self, plant: &mut Plant, from: &Plant, u: &[f64], s: f64) -> Vec<f64> {
        let model = from.model();
        let d = model.dimensions();
        let scaled: Vec<f64> = self.q.iter().map(|x| s * x).collect();
        let q = model.retract(from.q(), &scaled);
        let p = from.p().iter().zip(&self.p).map(|(p, x)| p + s * x).collect();
        plant.initialize(&Initial::Momentum { q, p, v: from.v().to_vec() }).unwrap();
        let mut end = from.q().to_vec();
        end[d.dynamic..].copy_from_slice(&u[d.inputs..]);
        let mut change = vec![0.0; d.coordinates()];
        for (change, x) in change[d.dynamic..].iter_mut().zip(&self.u[d.inputs..]) {
            *change = s * x;
        }
        let end = model.retract(&end, &change);
        let forces = u[..d.inputs].iter().zip(&self.u).map(|(u, x)| u + s * x);
        forces.chain(end[d.dynamic..].iter().copied()).collect()
    }
}

/// Checks one scene; whether there was one.
fn derivatives(seed: u64, split: ForceSplit) -> bool {
    let Some((plant, u)) = moving(seed, Kind::Any, split) else { return false };
    let model = plant.model().clone();
    let (d, direction) = (model.dimensions(), Direction::new(&plant, seed));
    let mut moved = plant.clone();
    let mut end = plant.clone();
    // From the same rounded state as the displaced ones.
    let same = direction.go(&mut end, &plant, &u, 0.0);
    let mut first = Linearization::new(&model);
    end.step_and_linearize(&same, &mut first).unwrap();
    let (dx, du) = (direction.state(), direction.input());
    let multipliers = first.multipliers_x() * &dx + first.multipliers_u() * &du;
    let x = first.a() * &dx + first.b() * &du;
    let n = d.coordinates();
    // What prescribed coordinates and their velocities do is not in question.
    let predicted: Vec<f64> =
        [&x.as_slice()[..d.dynamic], &x.as_slice()[n..n + d.dynamic], multipliers.as_slice()]
            .concat();
    let mut differences = |delta: f64| {
        slope(delta, |s| {
            let u = direction.go(&mut moved, &plant, &u, s);
            moved.step(&u).unwrap_or_else(|e| panic!("{seed}: {e}"));
            let q = model.difference(end.q(), moved.q());
            DVector::from_vec([&q[..d.dynamic], moved.p(), moved.multipliers()].concat())
        })
    };
    let predicted = DVector::from_vec(predicted);
    let ranges = [0..d.dynamic, d.dynamic..2 * d.dynamic, 2 * d.dynamic..predicted.len()];
    // Where motion is rough, differences need a shorter step.
    let errors = [4e-4, 5e-5, 8e-6].map(|delta| {
        let found = differences(delta);
        let error = |range: &std::ops::Range<usize>| {
            let part = |v: &DVector<f64>| v.rows(range.start, range.len()).into_owned();
            let (found, predicted) = (part(&found), part(&predicted));
            if found.is_empty() {
                0.0
            } else {
                (&found - predicted).amax() / found.amax().max(1e-2)
            }
        };
        ranges.iter().map(error).fold(0.0, f64::max)
    });
    assert!(
        errors.iter().any(|error| *error < 2e-7),
        "{seed} {split:?}: {errors:?}\n{}",
        scene(seed, Kind::Any)
    );
    second_derivatives(seed, &plant, &u, &direction);
    true
}

/// `dᵀ (Σ z_i ∂²f_i) d` against the change of `zᵀ ∂f d` along `d`.
fn second_derivatives(seed: u64, plant: &Plant, u: &[f64], direction: &Direction) {
    let model = plant.model().clone();
    let d = model.dimensions();
    let mut random = Numbers::new(seed ^ 0xad);
    let z: Vec<f64> = (0..d.state()).map(|_| random.between(-1.0, 1.0)).collect();
    let w: Vec<f64> = (0..d.constraints).map(|_| random.between(-1.0, 1.0)).collect();
    let (mut first, mut second) = (Linearization::new(&model), Contraction::new(&model));
    let mut moved = plant.clone();
    let same = direction.go(&mut moved, plant, u, 0.0);
    moved.contract_second_order(&same, &z, &w, &mut first, &mut second).unwrap();
    let (dx, du) = (direction.state(), direction.input());
    let curvature = (dx.transpose() * &second.xx * &dx)[0]
        + 2.0 * (dx.transpose() * &second.xu * &du)[0]
        + (du.transpose() * &second.uu * &du)[0];
    let (z, w) = (DVector::from_vec(z), DVector::from_vec(w));
    let mut differences = |delta: f64| {
        slope(delta, |s| {
            let u = direction.go(&mut moved, plant, u, s);
            moved.linearize(&u, &mut first).unwrap_or_else(|e| panic!("{seed}: {e}"));
            let x = first.a() * &dx + first.b() * &du;
            let multipliers = first.multipliers_x() * &dx + first.multipliers_u() * &du;
            DVector::from_element(1, z.dot(&x) + w.dot(&multipliers))
        })[0]
    };
    let found = [5e-4, 6e-5, 8e-6].map(&mut differences);
    let size = first.a().amax().max(first.multipliers_u().amax()).max(1.0);
    let allowed = 5e-7 * size.max(curvature.abs());
    assert!(
        found.iter().any(|found| (curvature - found).abs() < allowed),
        "{seed}: {curvature} {found:?}\n{}",
        scene(seed, Kind::Any)
    );
}

#[test]
fn derivatives_of_random_scenes() {
    let made = (0..4000).filter(|seed| {
        derivatives(*seed, if seed % 3 == 0 { ForceSplit::Paper } else { ForceSplit::Symmetric })
    });
    let made = made.count();
    assert!(made > 2200, "{made}");
}

/// `δq ∧ δp` is kept for displacements that keep the constraints; in the body axes of ball joints the
/// form is `[−[p], 1; −1, 0]`.
#[test]
fn conservative_scenes_are_symplectic() {
    let mut made = 0;
    for seed in 0..1200 {
        let Some((mut plant, u)) = moving(seed, Kind::Conservative, ForceSplit::Symmetric) else {
            continue;
        };
        let model = plant.model().clone();
        let (d, n) = (model.dimensions(), model.dimensions().coordinates());
        let balls: Vec<usize> =
            (0..d.dynamic).filter(|i| model.coordinates()[*i].name.ends_with("_rx")).collect();
        let form = |p: &[f64]| {
            let nd = d.dynamic;
            let mut form = DMatrix::zeros(2 * nd, 2 * nd);
            for i in 0..nd {
                form[(i, nd + i)] = 1.0;
                form[(nd + i, i)] = -1.0;
            }
            for &i in &balls {
                let p = Vector3::new(p[i], p[i + 1], p[i + 2]);
                form.view_mut((i, i), (3, 3)).copy_from(&-p.cross_matrix());
            }
            form
        };
        let jacobian = plant.constraint_jacobian().columns(0, d.dynamic).into_owned();
        let mut kept = DMatrix::identity(d.dynamic, d.dynamic);
        if d.constraints > 0 {
            kept -= jacobian.clone().pseudo_inverse(1e-10).unwrap() * jacobian;
        }
        let mut first = Linearization::new(&model);
        let before = form(plant.p());
        plant.step_and_linearize(&u, &mut first).unwrap();
        let after = form(plant.p());
        let a = first.a();
        let rows: Vec<usize> = (0..d.dynamic).chain(n..n + d.dynamic).collect();
        let a = a.select_rows(&rows).select_columns(&rows);
        let mut tangent = DMatrix::identity(2 * d.dynamic, 2 * d.dynamic);
        tangent.view_mut((0, 0), (d.dynamic, d.dynamic)).copy_from(&kept);
        let a = a * &tangent;
        let defect = a.transpose() * after * &a - tangent.transpose() * before * &tangent;
        let size = a.amax().powi(2).max(1.0);
        assert!(
            defect.amax() < 1e-11 * size,
            "{seed}: {:e}\n{}",
            defect.amax(),
            scene(seed, Kind::Conservative)
        );
        made += 1;
    }
    assert!(made > 700, "{made}");
}

#[test]
fn floating_scenes_keep_their_momenta() {
    let mut made = 0;
    for seed in 0..600 {
        let Some((mut plant, u)) = moving(seed, Kind::Floating, ForceSplit::Symmetric) else {
            continue;
        };
        let momenta = |plant: &mut Plant| {
            let d = plant.diagnose();
            (Vector3::from(d.linear_momentum), Vector3::from(d.angular_momentum))
        };
        let (linear, angular) = momenta(&mut plant);
        for _ in 0..20 {
            if plant.step(&u).is_err() {
                break;
            }
        }
        let (p, l) = momenta(&mut plant);
        let size = 1.0 + linear.norm() + angular.norm();
        let drift = (p - linear).norm().max((l - angular).norm());
        assert!(drift < 1e-11 * size, "{seed}: {drift:e}\n{}", scene(seed, Kind::Floating));
        made += 1;
    }
    assert!(made > 200, "{made}");
}

/// Without forces the continuous dynamics keep the energy.
#[test]
fn conservative_scenes_keep_their_energy() {
    let mut made = 0;
    for seed in 0..600 {
        let Some((mut plant, _)) = moving(seed, Kind::Conservative, ForceSplit::Symmetric) else {
            continue;
        };
        let model = plant.model().clone();
        if model.dimensions().prescribed > 0 || model.dimensions().constraints > 0 {
            continue;
        }
        let (q, v) = (plant.q().to_vec(), plant.velocity());
        let at = ContinuousPoint { q: q.clone(), v: v.clone(), ..ContinuousPoint::default() };
        let Ok(found) = Continuous::new(model.clone()).evaluate(&at) else { continue };
        let size = plant.energy().kinetic_j.abs() + plant.energy().potential_j.abs() + 1.0;
        let power = slope(1e-3, |s| {
            let turned: Vec<f64> =
                v.iter().zip(&found.acceleration).map(|(v, a)| s * v + 0.5 * s * s * a).collect();
            let v = v.iter().zip(&found.acceleration).map(|(v, a)| v + s * a).collect();
            let q = model.retract(&q, &turned);
            let mut energy = f64::NAN;
            if plant.initialize(&Initial::Velocity { q, v }).is_ok() {
                let e = plant.energy();
                energy = e.kinetic_j + e.potential_j;
            }
            DVector::from_element(1, energy)
        })[0];
        assert!(power.abs() < 1e-7 * size, "{seed}: {power}\n{}", scene(seed, Kind::Conservative));
        made += 1;
    }
    assert!(made > 100, "{made}");
}
