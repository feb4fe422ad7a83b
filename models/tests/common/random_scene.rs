//! Random scenes of every kind of joint, spring, force and constraint.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fmt::Write as _;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use plantd_models::Scene;
use plantd_models::scene::Motion;

use super::numbers::Numbers;

/// What a random scene is to have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Kind {
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

    /// Stops beyond whose range the mechanism starts, with dampers where it need not be conservative.
    fn stops(&mut self) {
        let damping = if self.kind == Kind::Any { self.random.between(0.0, 1.0) } else { 0.0 };
        let stiffness = self.random.between(5.0, 30.0);
        let law = format!("stiffness = {stiffness}\ndamping = {damping}\ntransition = 0.9");
        if self.random.below(3) == 0
            && let Some(coordinate) = self.dynamic_scalar()
        {
            let start = self.initial[&coordinate];
            self.line(&format!(
                "[[springs]]\ntype = \"stop\"\ncoordinate = \"{coordinate}\"\nrange = [{}, {}]\n{law}",
                start - 2.0,
                start - 0.3
            ));
        }
        if self.random.below(3) == 0 {
            let [(a, at_a), (b, at_b), (c, at_c)] = [0; 3].map(|_| self.point());
            let length = (at_a - at_b).norm() + (at_b - at_c).norm();
            self.line(&format!(
                "[[springs]]\ntype = \"stop\"\npoints = [{a}, {b}, {c}]\nrange = [-1.0, {}]\n{law}",
                0.7 * length
            ));
        }
    }

    /// Servos, and an input and a damper along a path.
    fn servos(&mut self) {
        if let Some(coordinate) = self.dynamic_scalar() {
            self.line(&format!(
                "[[forces]]\ntype = \"servo\"\ncoordinate = \"{coordinate}\"\ninput = \"u1\"\ngain = 3.0\nstiffness = 2.0\ndamping = 0.2\nconstant = 0.1"
            ));
        }
        if self.random.below(3) > 0 {
            return;
        }
        let [a, b, c] = [0; 3].map(|_| self.point().0);
        self.line(&format!(
            "[[forces]]\ntype = \"path_damper\"\npoints = [{a}, {b}, {c}]\ndamping = 0.3"
        ));
        self.line(&format!("[[inputs]]\nname = \"u2\"\npoints = [{a}, {c}]\ngain = 0.7"));
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
pub(crate) fn scene(seed: u64, kind: Kind) -> String {
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
    let mut gravity = Vector3::zeros();
    if kind != Kind::Floating && maker.random.below(4) > 0 {
        gravity = maker.vector(9.8);
    }
    maker.line(&format!("gravity = {}", list(&gravity)));
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
    maker.stops();
    if kind == Kind::Any {
        maker.servos();
    }
    let mut coordinates = String::new();
    for (name, value) in &maker.initial {
        if !maker.prescribed.contains(name) {
            let _ =
                writeln!(coordinates, "[[coordinates]]\nname = \"{name}\"\ninitial = {value:?}");
            if kind != Kind::Floating && maker.random.below(3) == 0 {
                let armature = maker.random.between(0.05, 0.3);
                let _ = writeln!(coordinates, "armature = {armature}");
            }
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
