//! Built-in scenes: TOML files of `scenes/`, and families that are generated for any size.

use std::f64::consts::{FRAC_PI_6, PI};

use plantd_math::trigonometry::sin_cos_of;

use crate::inputs::Input;
use crate::point::Point;
use crate::scene::{Axis, Body, Constraint, Coordinate, Frame, Joint, OperatingPoint, Scene};

/// Names of the built-in scenes. `chain-N`, `tree-N` and `scissor-N` stand for whole families, and there are
/// two more, `balls-N` and `walker-N`.
pub const NAMES: &[&str] = &[
    "pendulum",
    "damped-pendulum",
    "double-pendulum",
    "cart-pole",
    "spherical-pendulum",
    "chain-4",
    "tree-7",
    "four-bar",
    "scissor-4",
    "marionette",
];

/// Most links of a chain or bodies of a tree.
const MAX_LINKS: usize = 1024;
/// Most segments of a scissor.
const MAX_SEGMENTS: usize = 64;

/// Most legs of a walker.
const MAX_LEGS: usize = 64;

/// The built-in scene of that name; any `chain-N`, `tree-N` and `balls-N` with 1 ≤ N ≤ 1024,
/// `scissor-N` and `walker-N` with 1 ≤ N ≤ 64 exists.
pub fn scene(name: &str) -> Option<Scene> {
    let text = match name {
        "pendulum" => include_str!("../../scenes/pendulum.toml"),
        "damped-pendulum" => include_str!("../../scenes/damped-pendulum.toml"),
        "double-pendulum" => include_str!("../../scenes/double-pendulum.toml"),
        "cart-pole" => include_str!("../../scenes/cart-pole.toml"),
        "spherical-pendulum" => include_str!("../../scenes/spherical-pendulum.toml"),
        "four-bar" => include_str!("../../scenes/four-bar.toml"),
        "marionette" => include_str!("../../scenes/marionette.toml"),
        _ => return family(name),
    };
    // A test reads every file; an error here would be one of this crate, not of its caller.
    Scene::from_toml(text).ok()
}

fn family(name: &str) -> Option<Scene> {
    let (family, size) = name.rsplit_once('-')?;
    // Only the canonical spelling: a name stands for one scene and a scene for one name.
    let n: usize = size.parse().ok().filter(|n: &usize| n.to_string() == size)?;
    match family {
        "chain" if (1..=MAX_LINKS).contains(&n) => Some(chain(n)),
        "tree" if (1..=MAX_LINKS).contains(&n) => Some(tree(n)),
        "balls" if (1..=MAX_LINKS).contains(&n) => Some(balls(n)),
        "walker" if (1..=MAX_LEGS).contains(&n) => Some(walker(n)),
        "scissor" if (1..=MAX_SEGMENTS).contains(&n) => Some(scissor(n)),
        _ => None,
    }
}

fn empty(name: String, description: String) -> Scene {
    Scene {
        format: 1,
        name,
        description,
        time_step_s: 0.01,
        gravity: Some([0.0, 0.0, -9.8]),
        ..Scene::default()
    }
}

/// A frame that turns about the y axis, by a coordinate of its own name.
fn hinge(name: String, parent: &str, translation: [f64; 3], body: Body) -> Frame {
    Frame {
        name,
        parent: parent.to_owned(),
        translation,
        joint: Some(Joint::Revolute { axis: [0.0, 1.0, 0.0], coordinate: None }),
        body: Some(body),
        ..Frame::default()
    }
}

fn dynamic(name: String, initial: f64) -> Coordinate {
    Coordinate { name, initial, ..Coordinate::default() }
}

/// `n` uniform thin rods, 1 m and 1 kg together, hinged about one axis, released from horizontal.
fn chain(n: usize) -> Scene {
    let length = 1.0 / n as f64;
    let mass = length;
    let across = mass * length * length / 12.0;
    let link = |i: usize| format!("link{i}");
    let mut scene = empty(
        format!("chain-{n}"),
        format!(
            "{n} uniform thin rods, 1 m and 1 kg together, hinged about one axis, released 30 degrees from hanging."
        ),
    );
    for i in 0..n {
        let body = Body {
            mass,
            center_of_mass: [0.0, 0.0, -length / 2.0],
            inertia: vec![across, across, 0.0],
            ..Body::default()
        };
        let (parent, z) = if i == 0 { ("world".to_owned(), 0.0) } else { (link(i - 1), -length) };
        scene.frames.push(hinge(link(i), &parent, [0.0, 0.0, z], body));
    }
    // Short links swing fast: their time step shrinks with them.
    scene.time_step_s = (0.08 * length).min(0.01);
    scene.coordinates.push(dynamic(link(0), FRAC_PI_6));
    scene.inputs.push(Input {
        name: "torque".to_owned(),
        coordinate: Some(link(0)),
        ..Input::default()
    });
    for (name, angle) in [("hanging", 0.0), ("upright", PI)] {
        scene.operating_points.push(OperatingPoint {
            name: name.to_owned(),
            coordinates: [(link(0), angle)].into(),
            inputs: Default::default(),
        });
    }
    scene
}

/// A balanced binary tree of `n` boxes, hinged about the axes x, y and z by turns.
fn tree(n: usize) -> Scene {
    let mut scene = empty(
        format!("tree-{n}"),
        format!("Balanced binary tree of {n} boxes of 0.96 kg, hinged about x, y and z by turns."),
    );
    for i in 0..n {
        let name = format!("box{i}");
        let (parent, translation) = match i {
            0 => ("world".to_owned(), [0.0; 3]),
            _ => {
                let side = if i % 2 == 1 { 0.05 } else { -0.05 };
                (format!("box{}", (i - 1) / 2), [side, 0.02, -0.2])
            }
        };
        let mut axis = [0.0; 3];
        axis[((i + 1).ilog2() % 3) as usize] = 1.0;
        scene.frames.push(Frame {
            name: name.clone(),
            parent,
            translation,
            joint: Some(Joint::Revolute { axis, coordinate: None }),
            body: Some(Body {
                mass: 0.96,
                center_of_mass: [0.01, 0.005, -0.1],
                inertia: vec![0.003712, 0.003488, 0.0008],
                ..Body::default()
            }),
            ..Frame::default()
        });
        scene.coordinates.push(dynamic(name.clone(), 0.6 * sin_cos_of(0.7 + 1.3 * i as f64).0));
        scene.inputs.push(Input {
            name: format!("torque{i}"),
            coordinate: Some(name),
            ..Input::default()
        });
    }
    scene
}

/// A balanced binary tree of `n` boxes on ball joints.
fn balls(n: usize) -> Scene {
    let mut scene = empty(
        format!("balls-{n}"),
        format!("Balanced binary tree of {n} boxes of 1 kg on ball joints."),
    );
    for i in 0..n {
        let (parent, translation) = match i {
            0 => ("world".to_owned(), [0.0; 3]),
            _ => {
                let side = if i % 2 == 1 { 0.2 } else { -0.2 };
                (format!("box{}", (i - 1) / 2), [side, 0.05, -0.2])
            }
        };
        let name = format!("box{i}");
        scene.coordinates.push(dynamic(format!("{name}_rx"), 0.6 * sin_cos_of(0.7 + i as f64).0));
        scene.frames.push(Frame {
            name,
            parent,
            translation,
            joint: Some(Joint::Ball { coordinate: None }),
            body: Some(limb(1.0)),
            ..Frame::default()
        });
    }
    scene
}

/// A hull that floats, with `n` legs of three motors each around it.
fn walker(n: usize) -> Scene {
    let mut scene = empty(
        format!("walker-{n}"),
        format!("A hull of 5 kg that floats, with {n} legs of three hinges, each with a motor."),
    );
    scene.time_step_s = 0.002;
    scene.frames.push(Frame {
        name: "hull".to_owned(),
        joint: Some(Joint::Free { coordinate: None }),
        body: Some(limb(5.0)),
        parent: "world".to_owned(),
        ..Frame::default()
    });
    for leg in 0..n {
        let (sine, cosine) = sin_cos_of(2.0 * PI * leg as f64 / n as f64);
        let mut parent = "hull".to_owned();
        for (part, axis) in [("hip", [1.0, 0.0, 0.0]), ("knee", AXIS_Y), ("foot", AXIS_Y)] {
            let name = format!("{part}{leg}");
            let place = [0.2 * cosine, 0.2 * sine, 0.0];
            scene.frames.push(Frame {
                name: name.clone(),
                parent,
                translation: if part == "hip" { place } else { [0.0, 0.0, -0.2] },
                joint: Some(Joint::Revolute { axis, coordinate: None }),
                body: Some(limb(0.7)),
                ..Frame::default()
            });
            let angle = 0.3 * sin_cos_of(1.3 * scene.frames.len() as f64).0;
            scene.coordinates.push(dynamic(name.clone(), angle));
            scene.inputs.push(Input {
                name: format!("{name}_motor"),
                coordinate: Some(name.clone()),
                ..Input::default()
            });
            parent = name;
        }
    }
    scene
}

const AXIS_Y: [f64; 3] = [0.0, 1.0, 0.0];

/// A body that hangs from its joint.
fn limb(mass: f64) -> Body {
    Body {
        mass,
        center_of_mass: [0.01, 0.005, -0.1],
        inertia: [0.012, 0.010, 0.006].map(|inertia| inertia * mass).to_vec(),
        ..Body::default()
    }
}

/// A stack of `n` pairs of crossed links below a rail: one pair's upper ends hang from a fixed hinge
/// and from a slider, each further pair from the ends of the pair above.
///
/// The tree has two strands, each of which changes sides at every pair; point-to-point constraints
/// join the middles of each pair.
fn scissor(n: usize) -> Scene {
    const LENGTH: f64 = 5.0;
    const OPENING: f64 = PI / 20.0;
    let mut scene = empty(
        format!("scissor-{n}"),
        format!(
            "{n} pairs of crossed links of 5 m below a rail, nearly flat, opening under gravity."
        ),
    );
    let link = || Body {
        mass: 1.0,
        center_of_mass: [LENGTH / 2.0, 0.0, 0.0],
        inertia: vec![1.0, 1.0, 1.0],
        ..Body::default()
    };
    scene.frames.push(Frame {
        name: "slider".to_owned(),
        parent: "world".to_owned(),
        joint: Some(Joint::Prismatic { axis: [1.0, 0.0, 0.0], coordinate: None }),
        body: Some(Body { mass: 1.0, ..Body::default() }),
        ..Frame::default()
    });
    scene.coordinates.push(dynamic("slider".to_owned(), LENGTH * sin_cos_of(OPENING).1));
    // Seen from its parent link, every link but the first of a strand folds back by twice the opening.
    for (start, first_is_right) in [("slider", true), ("world", false)] {
        let mut parent = start.to_owned();
        for i in 0..n {
            let right = first_is_right == (i % 2 == 0);
            let name = format!("{}{i}", if right { "right" } else { "left" });
            let at = if i == 0 { 0.0 } else { LENGTH };
            let angle = match (i, right) {
                (0, true) => PI - OPENING,
                (0, false) => OPENING,
                (_, true) => PI - 2.0 * OPENING,
                (_, false) => PI + 2.0 * OPENING,
            };
            scene.frames.push(hinge(name.clone(), &parent, [at, 0.0, 0.0], link()));
            scene.coordinates.push(dynamic(name.clone(), angle));
            parent = name;
        }
    }
    for i in 0..n {
        let middle =
            |side: &str| Point { frame: format!("{side}{i}"), at: [LENGTH / 2.0, 0.0, 0.0] };
        scene.constraints.push(Constraint::PointToPoint {
            name: format!("pivot{i}"),
            a: middle("left"),
            b: middle("right"),
            axes: vec![Axis::X, Axis::Z],
        });
    }
    scene.inputs.push(Input {
        name: "force".to_owned(),
        coordinate: Some("slider".to_owned()),
        ..Input::default()
    });
    scene
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scene_is_valid_and_bears_its_name() {
        for name in NAMES.iter().copied().chain([
            "chain-1",
            "chain-1024",
            "tree-1024",
            "scissor-64",
            "balls-7",
            "walker-4",
            "walker-64",
        ]) {
            let scene = scene(name).unwrap_or_else(|| panic!("{name} does not exist"));
            assert_eq!(scene.name, name);
            assert_eq!(scene.validate(), [], "{name}");
        }
    }

    #[test]
    fn only_canonical_names_exist() {
        for name in
            ["", "chain", "chain-", "chain-0", "chain-04", "chain-+4", "chain-1025", "chain--4"]
        {
            assert!(scene(name).is_none(), "{name}");
        }
        for name in ["scissor-0", "scissor-65", "pendulum-1", "Pendulum", "scene.schema"] {
            assert!(scene(name).is_none(), "{name}");
        }
    }
}
