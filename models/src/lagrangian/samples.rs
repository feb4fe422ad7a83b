//! What tests of elements share: their scenes, configurations, and differences.

use std::path::Path;

use plantd_math::rotation;
use plantd_math::scalar::{Dual, Scalar};
use plantd_math::spatial::{Mat3, Vec3};
use plantd_scene::{Coordinate, CoordinateKind, Scene, Spring};

use crate::lagrangian::kinematics::Poses;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;
use crate::model::tree::Tree;

/// Models of the scenes of all elements.
pub(crate) fn models() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/elements");
    let models = std::fs::read_dir(folder).unwrap().map(|entry| {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
    });
    models.collect()
}

/// Models of random trees of all joints, with every spring and constraint of points and frames between
/// random places of theirs.
pub(crate) fn random_models(count: u64) -> Vec<Model> {
    // Some are refused, because nothing moves between two of the places.
    (0..count).filter_map(|seed| Model::compile(&random_scene(seed)).ok()).collect()
}

/// Numbers that look random, the same on every run (SplitMix64).
struct Numbers(u64);

impl Numbers {
    /// Between 0 and 1.
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
    fn below(&mut self, n: usize) -> usize {
        (self.next() * n as f64) as usize
    }
    fn vector(&mut self) -> String {
        format!("{:?}", [0; 3].map(|_| 2.0 * self.next() - 1.0))
    }
    /// A frame of the first `n`, or the world.
    fn frame(&mut self, n: usize) -> String {
        match self.below(n + 1) {
            i if i == n => "\"world\"".to_owned(),
            i => format!("\"f{i}\""),
        }
    }
}

fn random_scene(seed: u64) -> Scene {
    const FRAMES: usize = 6;
    let mut random = Numbers(seed);
    let mut text = format!("format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"random-{seed}\"\n");
    let mut springs = String::new();
    for i in 0..FRAMES {
        let (parent, axis) = (random.frame(i), random.vector());
        let joint = match random.below(5) {
            0 => format!("type = \"prismatic\", axis = {axis}"),
            1 => format!("type = \"screw\", pitch = 0.3, axis = {axis}"),
            2 => {
                springs += &format!(
                    "[[springs]]\ntype = \"orientation\"\nframe = \"f{i}\"\nstiffness = 2.0\nrest = {{ rpy = [0.5, -0.2, {i}.0] }}\n"
                );
                "type = \"ball\"".to_owned()
            }
            _ => format!("type = \"revolute\", axis = {axis}"),
        };
        let [translation, rpy, center] = [0; 3].map(|_| random.vector());
        text += &format!(
            "[[frames]]\nname = \"f{i}\"\nparent = {parent}\ntranslation = {translation}\n\
             rotation = {{ rpy = {rpy} }}\njoint = {{ {joint} }}\n\
             body = {{ mass = 1.0, center_of_mass = {center}, inertia = [0.1, 0.1, 0.1] }}\n"
        );
    }
    let [a, b, c, d] = [0; 4].map(|_| {
        let (frame, at) = (random.frame(FRAMES), random.vector());
        format!("frame = {frame}, at = {at}")
    });
    text += &format!(
        r#"
        [[springs]]
        type = "two_point"
        a = {{ {a} }}
        b = {{ {b} }}
        stiffness = 2.0
        rest_length = 0.5
        [[springs]]
        type = "path"
        points = [{{ {a} }}, {{ {b} }}, {{ {c} }}, {{ {d} }}]
        stiffness = 2.0
        rest_length = 0.5
        [[constraints]]
        type = "distance"
        name = "distance"
        a = {{ {a} }}
        b = {{ {b} }}
        length = 1.0
        [[constraints]]
        type = "point_to_point"
        name = "pin"
        a = {{ {b} }}
        b = {{ {c} }}
        axes = ["x", "y", "z"]
        [[constraints]]
        type = "point_on_plane"
        name = "plane"
        plane = {{ {c}, normal = [0.3, -0.5, 0.8] }}
        point = {{ {d} }}
        [[constraints]]
        type = "path_length"
        name = "path"
        points = [{{ {b} }}, {{ {d} }}, {{ {a} }}, {{ {c} }}]
        length = 1.0
        [[constraints]]
        type = "weld"
        name = "weld"
        a = "f5"
        b = "f2"
        {springs}
        "#
    );
    Scene::from_toml(&text).unwrap()
}

/// A number between −1 and 1 that looks random.
pub(crate) fn wave(i: usize) -> f64 {
    (12.9898 * i as f64 + 0.3).sin()
}

/// Some coordinates are moved; what acts on them alone goes.
pub(crate) fn prescribe(scene: &mut Scene, names: &[&str]) {
    let is_moved = |name: &str| names.contains(&name);
    scene.coordinates.retain(|coordinate| !is_moved(&coordinate.name));
    scene.coordinates.extend(names.iter().map(|name| Coordinate {
        name: (*name).to_owned(),
        kind: CoordinateKind::Prescribed,
        ..Coordinate::default()
    }));
    scene.inputs.retain(|input| !input.coordinate.as_deref().is_some_and(is_moved));
    scene.springs.retain(|spring| match spring {
        Spring::Coordinate { coordinate, .. } => !is_moved(coordinate),
        _ => true,
    });
}

/// Friction, drag and stops of coordinates: a prefix and numbers.
pub(crate) fn rubbing(prefix: &str, count: usize) -> String {
    let mut text = String::new();
    for i in 0..count {
        text += &format!(
            "[[springs]]\ntype = \"stop\"\ncoordinate = \"{prefix}{i}\"\nrange = [-0.1, 0.1]\n\
             stiffness = 5.0\ndamping = 0.3\ntransition = 0.2\n\
             [[forces]]\ntype = \"friction\"\ncoordinate = \"{prefix}{i}\"\nforce = 0.1\nvelocity = 0.2\n\
             [[forces]]\ntype = \"coordinate_drag\"\ncoordinate = \"{prefix}{i}\"\n\
             coefficient = 0.2\ncubic = 0.1\n"
        );
    }
    text
}

/// Trees in oblique planes: hinges both ways about, sliders, bodies off the plane, two roots, and a floating
/// base of massless joints. `extra` goes on the coordinates.
pub(crate) fn oblique(n: usize, extra: &str) -> Model {
    let mut text = "format = 1\nname = \"oblique\"\ngravity = [1.0, -2.0, -9.0]\n".to_owned();
    for i in 0..n {
        let number = |k| wave(17 * i + k);
        let (parent, turn) = match i {
            0 | 5 => ("world".to_owned(), format!("[{}, {}, {}]", number(0), number(1), number(2))),
            // A floating base, and what hangs from it; then branches.
            1..5 => (format!("f{}", i - 1), format!("[0.0, 0.0, {}]", number(2))),
            _ => (format!("f{}", 5 + (i - 6) / 2), format!("[0.0, 0.0, {}]", number(2))),
        };
        let joint = match i {
            0 | 1 => format!("type = \"prismatic\", axis = [{}, {}, 0.0]", number(3), number(4)),
            _ if i % 4 == 3 => "type = \"revolute\", axis = [0.0, 0.0, -1.0]".to_owned(),
            _ if i % 7 == 6 => "type = \"prismatic\", axis = [0.6, 0.8, 0.0]".to_owned(),
            _ => "type = \"revolute\", axis = [0.0, 0.0, 1.0]".to_owned(),
        };
        let offset = format!("[{}, {}, {}]", number(5), number(6), number(7));
        text += &format!(
            "[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\ntranslation = {offset}\n\
             rotation = {{ rpy = {turn} }}\njoint = {{ {joint} }}\n"
        );
        if i > 1 {
            let center = format!("[{}, {}, {}]", number(8), number(9), number(10));
            text += &format!(
                "body = {{ mass = {}, center_of_mass = {center}, inertia = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03] }}\n",
                1.0 + number(11)
            );
        }
    }
    for i in 0..n {
        text += &format!("[[coordinates]]\nname = \"f{i}\"\ninitial = {}\n{extra}\n", wave(i));
    }
    Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
}

/// A configuration, with the orientations of ball joints.
pub(crate) struct Configuration<S> {
    pub(crate) q: Vec<S>,
    pub(crate) orientations: Vec<Mat3<S>>,
}

impl<S: Scalar> Configuration<S> {
    /// Poses of the joints of a tree.
    pub(crate) fn poses(&self, tree: &Tree) -> Poses<S> {
        let mut poses = Poses::new(tree);
        poses.evaluate(tree, &self.q, &self.orientations);
        poses
    }
}

/// A configuration off the initial one, and a direction.
pub(crate) fn configuration(model: &Model, sample: usize) -> (Configuration<f64>, Vec<f64>) {
    let wave = |i: usize, phase: f64| (1.7 * i as f64 + 2.9 * sample as f64 + phase).sin();
    let coordinates = model.coordinates().iter().enumerate();
    let q = coordinates.map(|(i, c)| c.initial + 0.3 * wave(i, 0.4)).collect::<Vec<_>>();
    let direction = (0..q.len()).map(|i| wave(i, 2.0)).collect();
    (Configuration { orientations: orientations(model, &q), q }, direction)
}

/// The configuration that lies `change` beyond another.
fn moved<S: Scalar>(model: &Model, at: &Configuration<f64>, change: &[S]) -> Configuration<S> {
    let turned = |(&i, turn): (&usize, &Mat3)| {
        Mat3::lift(*turn).times(&rotation::exp(Vec3([change[i], change[i + 1], change[i + 2]])))
    };
    Configuration {
        q: at.q.iter().zip(change).map(|(q, change)| *change + *q).collect(),
        orientations: model.orientations.iter().zip(&at.orientations).map(turned).collect(),
    }
}

/// `q + direction ε`.
pub(crate) fn along(
    model: &Model,
    at: &Configuration<f64>,
    direction: &[f64],
) -> Configuration<Dual> {
    let change: Vec<_> = direction.iter().map(|d| Dual::new(0.0, *d)).collect();
    moved(model, at, &change)
}

/// Derivative along a direction, by sixth-order central differences.
pub(crate) fn slope(
    model: &Model,
    at: &Configuration<f64>,
    direction: &[f64],
    mut f: impl FnMut(&Configuration<f64>) -> Vec<f64>,
) -> Vec<f64> {
    const DELTA: f64 = 5e-4;
    let stencil = [(1.0, 3.0 / 4.0), (2.0, -3.0 / 20.0), (3.0, 1.0 / 60.0)];
    let mut sum = Vec::new();
    for (offset, weight) in stencil {
        for sign in [1.0, -1.0] {
            let change: Vec<f64> = direction.iter().map(|d| sign * offset * DELTA * d).collect();
            let values = f(&moved(model, at, &change));
            sum.resize(values.len(), 0.0);
            sum.iter_mut().zip(values).for_each(|(s, x)| *s += sign * weight / DELTA * x);
        }
    }
    sum
}

/// The direction of one coordinate.
pub(crate) fn unit(n: usize, i: usize) -> Vec<f64> {
    (0..n).map(|j| if i == j { 1.0 } else { 0.0 }).collect()
}

pub(crate) fn assert_close(what: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1.0_f64, |m, x| m.max(x.abs()));
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        assert!((x - y).abs() < 1e-9 * scale, "{what} [{i}]: {x} instead of {y}");
    }
}
