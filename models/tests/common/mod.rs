//! Mechanisms and helpers that the tests of motion share.

pub(crate) mod exact;
pub(crate) mod linearization;
mod numbers;
pub(crate) mod random_scene;

use std::f64::consts::PI;
use std::path::Path;
use std::sync::Arc;

pub(crate) use numbers::Numbers;
use plantd_models::scene::{
    Body, Component, Coordinate, CoordinateKind, Force, Frame, Input, Joint, Point, Rotation,
    Scene, Spring,
};
use plantd_models::{ForceSplit, Model, Plant, Settings, builtin};

/// Both ways to split forces.
pub(crate) const SPLITS: [ForceSplit; 2] = [ForceSplit::Symmetric, ForceSplit::Paper];

/// The folder `models`, from each of the crates in it.
pub(crate) fn folder() -> &'static Path {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    package.ancestors().find(|folder| folder.ends_with("models")).expect("a folder of this name")
}

/// A built-in scene.
pub(crate) fn builtin(name: &str) -> Scene {
    builtin::scene(name).unwrap_or_else(|| panic!("no scene {name}"))
}

/// The scene of each element, without those whose ball joints have no coordinates to displace.
pub(crate) fn elements_with_coordinates() -> Vec<Scene> {
    let folder = folder().join("scenes/elements");
    let mut paths: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let read = |path: &std::path::PathBuf| {
        Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
    };
    let has_coordinates = |scene: &Scene| {
        let turns =
            |frame: &Frame| matches!(frame.joint, Some(Joint::Ball { .. } | Joint::Free { .. }));
        !scene.frames.iter().any(turns)
    };
    paths.iter().map(read).filter(has_coordinates).collect()
}

/// A compiled scene.
pub(crate) fn model(scene: &Scene) -> Arc<Model> {
    Arc::new(Model::compile(scene).unwrap_or_else(|e| panic!("{}: {e}", scene.name)))
}

/// A plant at its scene's initial configuration.
pub(crate) fn plant(scene: &Scene, change: impl FnOnce(&mut Settings)) -> Plant {
    let model = model(scene);
    let mut settings = Settings::new(&model);
    change(&mut settings);
    Plant::new(model, settings).unwrap_or_else(|e| panic!("{}: {e}", scene.name))
}

/// Ways to step a scene: all orders that there are, and substeps.
pub(crate) fn methods(scene: &Scene) -> Vec<Settings> {
    let model = model(scene);
    let usual = Settings::new(&model);
    let ways = [(2, 1), (2, 3), (4, 1), (4, 2), (6, 1), (8, 1), (12, 1)];
    let ways = ways.map(|(order, substeps)| Settings { order, substeps, ..usual });
    let is_possible = |settings: &Settings| Plant::new(Arc::clone(&model), *settings).is_ok();
    ways.into_iter().filter(is_possible).collect()
}

/// The input of step `k`: every force and prescribed position waves about its start.
pub(crate) fn waving_input(plant: &Plant, k: u64) -> Vec<f64> {
    let d = plant.model().dimensions();
    let phase = |i: usize| (0.1 * k as f64 + i as f64).sin() - (i as f64).sin();
    let forces = (0..d.inputs).map(|i| 0.5 * phase(i));
    let prescribed = plant.model().coordinates()[d.dynamic..].iter().enumerate();
    forces.chain(prescribed.map(|(i, c)| c.initial + 0.02 * phase(i))).collect()
}

/// Steps with [`waving_input`], so that nothing is at rest or symmetric any more.
pub(crate) fn wave(plant: &mut Plant, steps: u64) {
    for _ in 0..steps {
        let k = plant.step_index();
        let u = waving_input(plant, k + 1);
        plant.step(&u).unwrap_or_else(|e| panic!("{} step {k}: {e}", plant.model().scene().name));
    }
}

/// Weights at −3, −2, −1, 1, 2, 3 steps of central differences: error δ⁶.
pub(crate) const STENCIL: [(f64, f64); 6] = [
    (-3.0, -1.0 / 60.0),
    (-2.0, 3.0 / 20.0),
    (-1.0, -3.0 / 4.0),
    (1.0, 3.0 / 4.0),
    (2.0, -3.0 / 20.0),
    (3.0, 1.0 / 60.0),
];

/// Derivative at 0 of what `along` makes of a displacement, by sixth-order differences.
pub(crate) fn slope(delta: f64, mut along: impl FnMut(f64) -> Vec<f64>) -> Vec<f64> {
    let mut sum = Vec::new();
    for (offset, weight) in STENCIL {
        let values = along(offset * delta);
        sum.resize(values.len(), 0.0);
        sum.iter_mut().zip(values).for_each(|(s, x)| *s += weight / delta * x);
    }
    sum
}

/// A tree of random shape: oblique hinges and slides, full inertia tensors, springs along and across
/// its branches, damping, forces, and now and then a prescribed joint.
pub(crate) fn random_tree(seed: u64) -> Scene {
    let mut random = Numbers::new(seed);
    let mut scene = Scene {
        format: 1,
        name: format!("random-{seed}"),
        description: String::new(),
        time_step_s: 0.01,
        gravity: Some(random.vector(9.8)),
        damping: random.between(0.0, 0.3),
        frames: Vec::new(),
        coordinates: Vec::new(),
        armatures: Vec::new(),
        springs: Vec::new(),
        inputs: Vec::new(),
        forces: Vec::new(),
        signals: Vec::new(),
        constraints: Vec::new(),
        operating_points: Vec::new(),
    };
    let joints = 2 + random.below(5);
    for i in 0..joints {
        let frame = random_frame(&mut random, i);
        let prescribed = i > 0 && random.below(4) == 0;
        scene.coordinates.push(Coordinate {
            name: frame.name.clone(),
            kind: if prescribed { CoordinateKind::Prescribed } else { CoordinateKind::Dynamic },
            initial: random.between(-1.0, 1.0),
            ..Coordinate::default()
        });
        if !prescribed {
            let (name, coordinate) = (format!("force{i}"), Some(frame.name.clone()));
            scene.inputs.push(Input {
                name,
                coordinate,
                gain: random.between(0.5, 2.0),
                ..Input::default()
            });
        }
        scene.frames.push(frame);
    }
    let (first, last) = (point(&mut random, 0), point(&mut random, joints - 1));
    let (stiffness, rest_length) = (random.between(1.0, 30.0), random.between(0.0, 0.5));
    scene.springs.push(Spring::TwoPoint { a: first, b: last.clone(), stiffness, rest_length });
    let anchor = Point { frame: "world".to_owned(), at: random.vector(2.0) };
    scene.springs.push(Spring::TwoPoint { a: anchor, b: last, stiffness, rest_length });
    scene.springs.push(Spring::Coordinate {
        coordinate: "joint0".to_owned(),
        stiffness: random.between(0.0, 10.0),
        rest: 0.3,
    });
    scene
}

fn point(random: &mut Numbers, joint: usize) -> Point {
    Point { frame: format!("joint{joint}"), at: random.vector(1.0) }
}

fn random_frame(random: &mut Numbers, index: usize) -> Frame {
    let parent = match random.below(index + 1) {
        0 => "world".to_owned(),
        i => format!("joint{}", i - 1),
    };
    let axis = random.vector(1.0);
    let joint = if random.below(3) == 0 {
        Joint::Prismatic { axis, coordinate: None }
    } else {
        Joint::Revolute { axis, coordinate: None }
    };
    // Moments of a box, then a shear small enough to keep them possible.
    let [a, b, c] = [0; 3].map(|_| random.between(0.1, 0.3));
    let [ab, ac, bc] = random.vector(0.02);
    Frame {
        name: format!("joint{index}"),
        parent,
        translation: random.vector(0.7),
        rotation: Some(Rotation::Rpy(random.vector(PI))),
        joint: Some(joint),
        body: Some(Body {
            mass: random.between(0.5, 2.0),
            center_of_mass: random.vector(0.4),
            inertia: vec![b + c, a + c, a + b, ab, ac, bc],
            ..Body::default()
        }),
        ..Frame::default()
    }
}

/// Forces of every kind on a random tree: its inputs move to wrenches and thrusters, and dampers and
/// drag act between and at random points.
pub(crate) fn forced_tree(seed: u64) -> Scene {
    let mut scene = random_tree(seed);
    let mut random = Numbers::new(seed ^ 0x5eed);
    let last = scene.frames.len() - 1;
    for name in ["wx", "wy", "thrust"] {
        let name = name.to_owned();
        scene.inputs.push(Input { name, ..Input::default() });
    }
    let frame = |random: &mut Numbers| format!("joint{}", random.below(last + 1));
    let vector = |random: &mut Numbers| [0; 3].map(|_| random.between(-1.0, 1.0));
    let wrench = |random: &mut Numbers| {
        [0; 3].map(|_| match random.below(4) {
            0 => Component::Input("wx".to_owned()),
            1 => Component::Input("wy".to_owned()),
            _ => Component::Constant(random.between(-1.0, 1.0)),
        })
    };
    let dynamic: Vec<String> = scene.inputs.iter().filter_map(|i| i.coordinate.clone()).collect();
    let forces = [
        Force::BodyWrench {
            frame: frame(&mut random),
            force: wrench(&mut random),
            torque: wrench(&mut random),
        },
        Force::SpatialWrench {
            frame: frame(&mut random),
            force: wrench(&mut random),
            torque: wrench(&mut random),
        },
        Force::HybridWrench {
            frame: frame(&mut random),
            force: wrench(&mut random),
            torque: wrench(&mut random),
        },
        Force::Thruster {
            frame: frame(&mut random),
            at: vector(&mut random),
            axis: vector(&mut random),
            input: "thrust".to_owned(),
            gain: 1.5,
        },
        Force::TwoPointDamper {
            a: Point { frame: "joint0".to_owned(), at: vector(&mut random) },
            b: Point { frame: format!("joint{last}"), at: vector(&mut random) },
            damping: 2.0,
        },
        Force::TwoPointDamper {
            a: Point { frame: "world".to_owned(), at: vector(&mut random) },
            b: Point { frame: frame(&mut random), at: vector(&mut random) },
            damping: 1.0,
        },
        Force::Drag { frame: frame(&mut random), at: vector(&mut random), coefficient: 0.8 },
        Force::CoordinateDrag { coordinate: dynamic[0].clone(), coefficient: 0.5, cubic: 0.2 },
        Force::Friction {
            coordinate: Some(dynamic[0].clone()),
            terms: Vec::new(),
            points: Vec::new(),
            force: 0.4,
            velocity: 0.5,
        },
    ];
    // What a prescribed root carries does not give way.
    for force in forces {
        scene.forces.push(force);
        if scene.validate().iter().any(|problem| problem.path.starts_with("forces")) {
            scene.forces.pop();
        }
    }
    let used: Vec<String> =
        scene.forces.iter().flat_map(Force::inputs).map(str::to_owned).collect();
    scene.inputs.retain(|i| i.coordinate.is_some() || used.contains(&i.name));
    scene
}

/// A rope of rods hinged about x and y by turns, with ball joints on the way and a slide that is moved, and springs of
/// both between bodies and the world; `more` goes on it. It goes by generators.
pub(crate) fn pulled_rope(more: &str) -> Scene {
    Scene::from_toml(&(rope_of_18() + PULLS + more)).unwrap()
}

/// The same rope, with what acts across several of its joints, from bodies above.
pub(crate) fn braced_rope(more: &str) -> Scene {
    Scene::from_toml(&(rope_of_18() + BRACES + more)).unwrap()
}

fn rope_of_18() -> String {
    let mut text =
        "format = 1\nname = \"pulled-rope\"\ngravity = [0.5, 0.0, -9.8]\ntime_step_s = 0.01\n"
            .to_owned();
    for i in 0..18 {
        let (parent, z) =
            if i == 0 { ("world".to_owned(), 0.0) } else { (format!("f{}", i - 1), -0.3) };
        let joint = match i {
            5 => "type = \"prismatic\", axis = [0.2, 1.0, 0.1]",
            8 | 14 => "type = \"ball\"",
            _ if i % 2 == 0 => "type = \"revolute\", axis = [1.0, 0.0, 0.0]",
            _ => "type = \"revolute\", axis = [0.0, 1.0, 0.0]",
        };
        text += &format!(
            "[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\ntranslation = [0.0, 0.0, {z}]\njoint = {{ {joint} }}\n\
             body = {{ mass = 0.4, center_of_mass = [0.02, 0.0, -0.15], inertia = [0.02, 0.025, 0.01] }}\n"
        );
    }
    text + "[[coordinates]]\nname = \"f5\"\nkind = \"prescribed\"\n"
}

/// Springs of [`pulled_rope`], to the world.
const PULLS: &str = r#"
[[springs]]
type = "two_point"
a = { frame = "f17", at = [0.0, 0.1, -0.3] }
b = { frame = "world", at = [0.5, 0.3, -4.0] }
stiffness = 6.0
rest_length = 0.4
[[springs]]
type = "two_point"
a = { frame = "world", at = [-0.5, 0.2, -2.0] }
b = { frame = "f9" }
stiffness = 4.0
[[springs]]
type = "orientation"
frame = "f8"
stiffness = 0.7
"#;

/// Springs and a tendon of [`braced_rope`].
const BRACES: &str = r#"
[[inputs]]
name = "tendon"
points = [{ frame = "f9", at = [0.1, 0.05, -0.2] }, { frame = "f9", at = [0.1, 0.0, -0.3] }, { frame = "f13", at = [0.05, 0.1, -0.1] }]
gain = 1.5
[[springs]]
type = "two_point"
a = { frame = "f3", at = [0.0, 0.1, -0.3] }
b = { frame = "world", at = [0.5, 0.3, -1.0] }
stiffness = 6.0
rest_length = 0.4
[[springs]]
type = "two_point"
a = { frame = "f4", at = [0.1, 0.05, -0.2] }
b = { frame = "f9", at = [0.05, 0.1, -0.1] }
stiffness = 30.0
rest_length = 0.4
[[springs]]
type = "path"
points = [{ frame = "f16", at = [0.1, 0.05, -0.2] }, { frame = "f13", at = [0.05, 0.1, -0.1] }, { frame = "f16", at = [-0.1, 0.2, 0.1] }]
stiffness = 20.0
rest_length = 0.15
[[springs]]
type = "orientation"
frame = "f8"
stiffness = 0.7
"#;

/// Dampers of [`braced_rope`], a wrench, and drag.
pub(crate) const BRAKES: &str = r#"
[[inputs]]
name = "thrust"
[[forces]]
type = "two_point_damper"
a = { frame = "f9", at = [0.0, 0.1, -0.3] }
b = { frame = "f4", at = [0.1, 0.3, -0.2] }
damping = 0.6
[[forces]]
type = "path_damper"
points = [{ frame = "f13", at = [0.1, 0.05, -0.2] }, { frame = "f15", at = [0.05, 0.1, -0.1] }, { frame = "f13", at = [-0.1, 0.2, 0.1] }]
damping = 0.7
[[forces]]
type = "drag"
frame = "f2"
at = [0.1, 0.0, -0.2]
coefficient = 0.3
[[forces]]
type = "body_wrench"
frame = "f4"
force = [0.3, "thrust", 0.2]
torque = ["thrust", -0.1, 0.1]
"#;

/// What does not come from a potential, for [`pulled_rope`].
pub(crate) const PUSHES: &str = r#"
[[inputs]]
name = "thrust"
[[forces]]
type = "two_point_damper"
a = { frame = "f16", at = [0.0, 0.1, -0.3] }
b = { frame = "world", at = [0.5, 0.3, -4.0] }
damping = 0.6
[[forces]]
type = "drag"
frame = "f15"
at = [0.1, 0.0, -0.2]
coefficient = 0.3
[[forces]]
type = "body_wrench"
frame = "f14"
force = [0.3, "thrust", 0.2]
torque = ["thrust", -0.1, 0.1]
[[forces]]
type = "spatial_wrench"
frame = "f12"
force = [0.3, "thrust", 0.2]
torque = ["thrust", -0.1, 0.1]
[[forces]]
type = "hybrid_wrench"
frame = "f17"
force = [0.3, "thrust", 0.2]
torque = ["thrust", -0.1, 0.1]
"#;

/// One of its ball joints is moved.
pub(crate) const MOVED_BALL: &str = r#"
[[coordinates]]
name = "f14_rx"
kind = "prescribed"
[[coordinates]]
name = "f14_ry"
kind = "prescribed"
[[coordinates]]
name = "f14_rz"
kind = "prescribed"
"#;

/// Springs, dampers and a tendon across one hinge and across one ball joint.
pub(crate) const ACROSS: &str = r#"
[[inputs]]
name = "tendon"
points = [{ frame = "f2", at = [0.1, 0.05, -0.2] }, { frame = "f2", at = [0.1, 0.0, -0.3] }, { frame = "f3", at = [0.05, 0.1, -0.1] }]
gain = 1.5
[[inputs]]
name = "muscle"
points = [{ frame = "f7", at = [0.1, 0.05, -0.2] }, { frame = "f8", at = [0.05, 0.1, -0.1] }]
[[springs]]
type = "two_point"
a = { frame = "f10", at = [0.1, 0.05, -0.2] }
b = { frame = "f9", at = [0.05, 0.1, -0.1] }
stiffness = 30.0
rest_length = 0.1
[[springs]]
type = "path"
points = [{ frame = "f13", at = [0.1, 0.05, -0.2] }, { frame = "f14", at = [0.05, 0.1, -0.1] }]
stiffness = 20.0
rest_length = 0.15
[[forces]]
type = "path_damper"
points = [{ frame = "f10", at = [0.1, 0.05, -0.2] }, { frame = "f11", at = [0.05, 0.1, -0.1] }]
damping = 0.7
[[forces]]
type = "two_point_damper"
a = { frame = "f8", at = [0.1, 0.05, -0.2] }
b = { frame = "f7", at = [0.05, 0.1, -0.1] }
damping = 0.6
"#;

/// A body that floats freely, with two arms; no gravity.
pub(crate) fn floating() -> Scene {
    Scene::from_toml(FLOATING).unwrap()
}

const FLOATING: &str = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "floating"

[[frames]]
name = "x"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
[[frames]]
name = "y"
parent = "x"
joint = { type = "prismatic", axis = [0.0, 1.0, 0.0] }
[[frames]]
name = "z"
parent = "y"
joint = { type = "prismatic", axis = [0.0, 0.0, 1.0] }
[[frames]]
name = "yaw"
parent = "z"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
[[frames]]
name = "pitch"
parent = "yaw"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
[[frames]]
name = "hull"
parent = "pitch"
joint = { type = "revolute", axis = [1.0, 0.0, 0.0], coordinate = "roll" }
body = { mass = 3.0, center_of_mass = [0.1, 0.0, 0.2], inertia = [0.3, 0.4, 0.5, 0.05, 0.0, 0.02] }
[[frames]]
name = "left"
parent = "hull"
translation = [0.0, 0.5, 0.0]
joint = { type = "revolute", axis = [1.0, 0.0, 0.5] }
body = { mass = 0.7, center_of_mass = [0.0, 0.4, 0.0], inertia = [0.02, 0.0, 0.02] }
[[frames]]
name = "right"
parent = "hull"
translation = [0.0, -0.5, 0.0]
joint = { type = "revolute", axis = [0.2, 1.0, 0.5] }
body = { mass = 0.9, center_of_mass = [0.3, -0.4, 0.0], inertia = [0.02, 0.01, 0.02] }

[[springs]]
type = "two_point"
a = { frame = "left", at = [0.0, 0.8, 0.0] }
b = { frame = "right", at = [0.0, -0.8, 0.0] }
stiffness = 5.0
rest_length = 1.0
"#;
