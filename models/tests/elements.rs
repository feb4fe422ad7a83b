//! Every element: its scene in `scenes/elements`, its section in `scenes/ELEMENTS.md`, derivatives,
//! conservation, and closed forms.

use std::path::Path;

use crate::common::{linearization, plant, wave};
use nalgebra::DMatrix;
use plantd_models::scene::{CoordinateKind, Spring};
use plantd_models::{Initial, InitialError, Linearization, Plant, Scene};

const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
const PAGE: &str = include_str!("../scenes/ELEMENTS.md");

/// Definitions of the schema whose variants are elements, and their chapters.
const CHAPTERS: [(&str, &str); 5] = [
    ("Joint", "Joints"),
    ("Spring", "Springs"),
    ("Constraint", "Constraints"),
    ("Force", "Forces"),
    ("Signal", "Signals"),
];

/// All scenes of the folder.
fn scenes() -> Vec<Scene> {
    let mut scenes = Vec::new();
    for entry in std::fs::read_dir(FOLDER).unwrap() {
        let path = entry.unwrap().path();
        let scene = Scene::from_toml(&std::fs::read_to_string(&path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert_eq!(path.file_stem(), Some(scene.name.as_ref()), "a scene bears its file's name");
        scenes.push(scene);
    }
    scenes.sort_by(|a, b| a.name.cmp(&b.name));
    scenes
}

fn scene(name: &str) -> Scene {
    let path = Path::new(FOLDER).join(name).with_extension("toml");
    Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// Nothing does work on it from outside, and nothing takes energy.
fn is_conservative(scene: &Scene) -> bool {
    let damps = |spring: &Spring| match spring {
        Spring::Stop { damping, settling_time_s, .. } => {
            damping.is_some() || settling_time_s.is_some()
        }
        _ => false,
    };
    let rest = Scene { springs: Vec::new(), constraints: Vec::new(), ..scene.clone() };
    let text = rest.to_toml();
    scene.damping == 0.0
        && !scene.springs.iter().any(damps)
        && scene
            .coordinates
            .iter()
            .all(|c| c.kind == CoordinateKind::Dynamic && c.damping.unwrap_or_default() == 0.0)
        && !["[[forces]]", "[[inputs]]", "[[signals]]"].iter().any(|part| text.contains(part))
}

/// Variants of a tagged enum of the schema.
fn variants(definition: &str) -> Vec<String> {
    let schema = Scene::json_schema();
    let variants = schema["$defs"][definition]["oneOf"].as_array().unwrap().clone();
    let tag = |variant: &serde_json::Value| {
        variant["properties"]["type"]["const"].as_str().unwrap().to_owned()
    };
    variants.iter().map(tag).collect()
}

#[test]
fn every_element_has_a_section_and_a_scene() {
    let texts: Vec<String> = scenes().iter().map(|s| serde_json::to_string(s).unwrap()).collect();
    for (definition, chapter) in CHAPTERS {
        let chapter = PAGE.split("\n## ").find(|part| part.starts_with(chapter)).unwrap();
        for element in variants(definition) {
            let is_section =
                |line: &str| line.starts_with("### ") && line.contains(&format!("`{element}`"));
            assert!(chapter.lines().any(is_section), "ELEMENTS.md has no section `{element}`");
            let used = format!("\"type\":\"{element}\"");
            assert!(texts.iter().any(|text| text.contains(&used)), "no scene has `{element}`");
        }
    }
}

#[test]
fn every_scene_moves() {
    for scene in scenes() {
        let mut plant = plant(&scene, |_| ());
        let start = plant.q().to_vec();
        wave(&mut plant, 100);
        let moved = start.iter().zip(plant.q()).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
        assert!(moved > 1e-3, "{} does not move", scene.name);
        assert!(plant.q().iter().all(|x| x.is_finite()), "{}", scene.name);
    }
}

#[test]
fn every_linearization_agrees_with_differences() {
    for scene in scenes() {
        linearization::check(&scene);
    }
}

/// `Aᵀ J A = J` with `J = [[0, 1], [−1, 0]]`; momenta of orientations, in the body's own axes, have another
/// `J`.
#[test]
fn maps_of_conservative_scenes_are_symplectic() {
    let conservative = scenes().into_iter().filter(is_conservative);
    for scene in conservative.filter(|scene| scene.constraints.is_empty()) {
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 30);
        let model = plant.model().clone();
        if !model.orientations().is_empty() {
            continue;
        }
        let n = model.dimensions().dynamic;
        let mut out = Linearization::new(&model);
        plant.linearize(&[], &mut out).unwrap();
        let a = out.a();
        let j = DMatrix::from_fn(2 * n, 2 * n, |row, column| {
            f64::from(u8::from(column == row + n)) - f64::from(u8::from(row == column + n))
        });
        let defect = (a.transpose() * &j * &a - &j).amax();
        let size = a.amax().max(1.0);
        assert!(defect <= 1e-14 * n as f64 * size * size, "{}: {defect:e}", scene.name);
    }
}

fn total_energy(plant: &mut Plant) -> f64 {
    let energy = plant.energy();
    energy.kinetic_j + energy.potential_j
}

/// Energy is the work balance of springs and constraints: it swings by a part of second order in the
/// time step and does not drift. Constraints hold to round-off all the way.
#[test]
fn energy_is_kept_to_second_order_and_constraints_to_round_off() {
    for scene in scenes().into_iter().filter(is_conservative) {
        let mut worst = [0.0_f64; 2];
        for (worst, refinement) in worst.iter_mut().zip([1, 2]) {
            let mut plant = plant(&scene, |s| s.time_step_s = 2e-3 / f64::from(refinement));
            let start = total_energy(&mut plant);
            for step in 0..1000 * refinement {
                let report = plant.step(&[]).unwrap_or_else(|e| panic!("{}: {e}", scene.name));
                let violation = report.constraint_residual;
                assert!(violation < 1e3, "{} step {step}: {violation}", scene.name);
                *worst = worst.max((total_energy(&mut plant) - start).abs());
            }
        }
        let [coarse, fine] = worst;
        let ratio = coarse / fine;
        assert!(ratio > 3.0 && ratio < 5.0, "{}: {coarse:e} and {fine:e} J", scene.name);
    }
}

/// A scene of frames that slide along world axes or turn about y, and what acts on them.
fn mechanism(frames: &[&str], actions: &str) -> Scene {
    let mut text = "format = 1\nname = \"test\"\ntime_step_s = 0.01\n".to_owned();
    text.push_str("gravity = [0.0, 0.0, -9.81]\n");
    for frame in frames {
        text.push_str(&format!("[[frames]]\n{frame}\n"));
    }
    text.push_str(actions);
    Scene::from_toml(&text).unwrap_or_else(|e| panic!("{e}\n{text}"))
}

/// From rest with a constant acceleration `a` of coordinate `i`: `q = ½ a t²`, exactly.
fn accelerates(scene: &Scene, u: &[f64], coordinate: &str, acceleration: f64) {
    let mut plant = plant(scene, |_| ());
    let i = plant.model().coordinate_index(coordinate).unwrap();
    let start = plant.q()[i];
    for _ in 0..100 {
        plant.step(u).unwrap();
    }
    let moved = plant.q()[i] - start;
    let expected = 0.5 * acceleration * plant.time_s().powi(2);
    assert!((moved - expected).abs() < 1e-11 * expected.abs(), "{moved} instead of {expected}");
}

/// Through gears with `q1 = −3 q2` the second rotor's inertia appears as a ninth at the first.
#[test]
fn a_gear_pair_reflects_inertia() {
    let rotor = |name: &str, inertia: f64| {
        format!(
            "name = \"{name}\"\njoint = {{ type = \"revolute\", axis = [0.0, 1.0, 0.0] }}\nbody = {{ mass = 1.0, inertia = [{inertia}, {inertia}, {inertia}] }}"
        )
    };
    let scene = mechanism(
        &[&rotor("first", 0.02), &rotor("second", 0.9)],
        r#"
        [[inputs]]
        name = "torque"
        coordinate = "first"
        [[constraints]]
        type = "coupling"
        name = "teeth"
        terms = [
            { coordinate = "first", coefficients = [1.0] },
            { coordinate = "second", coefficients = [3.0] },
        ]
        "#,
    );
    let acceleration = 0.6 / (0.02 + 0.9 / 9.0);
    accelerates(&scene, &[0.6], "first", acceleration);
    accelerates(&scene, &[0.6], "second", -acceleration / 3.0);
}

/// Atwood's machine: `a = g (m1 − m2)/(m1 + m2)`.
#[test]
fn a_rope_over_a_pulley_makes_an_atwood_machine() {
    let weight = |name: &str, x: f64, mass: f64| {
        format!(
            "name = \"{name}\"\ntranslation = [{x}, 0.0, -4.0]\njoint = {{ type = \"prismatic\", axis = [0.0, 0.0, 1.0] }}\nbody = {{ mass = {mass} }}"
        )
    };
    let scene = mechanism(
        &[&weight("left", 0.0, 3.0), &weight("right", 0.4, 2.0)],
        r#"
        [[constraints]]
        type = "path_length"
        name = "rope"
        points = [
            { frame = "left" },
            { frame = "world" },
            { frame = "world", at = [0.4, 0.0, 0.0] },
            { frame = "right" },
        ]
        length = 8.4
        "#,
    );
    accelerates(&scene, &[], "left", -9.81 / 5.0);
    accelerates(&scene, &[], "right", 9.81 / 5.0);
}

const POINT_MASS: [&str; 3] = [
    "name = \"x\"\njoint = { type = \"prismatic\", axis = [1.0, 0.0, 0.0] }",
    "name = \"y\"\nparent = \"x\"\njoint = { type = \"prismatic\", axis = [0.0, 1.0, 0.0] }",
    "name = \"z\"\nparent = \"y\"\njoint = { type = \"prismatic\", axis = [0.0, 0.0, 1.0] }\nbody = { mass = 2.0 }",
];

/// Down a plane that falls 4 on 3: `a = g sin α` along it.
#[test]
fn a_bead_slides_down_a_plane() {
    let scene = mechanism(
        &POINT_MASS,
        r#"
        [[constraints]]
        type = "point_on_plane"
        name = "slope"
        plane = { frame = "world", normal = [4.0, 0.0, 3.0] }
        point = { frame = "z" }
        "#,
    );
    accelerates(&scene, &[], "x", 9.81 * 0.8 * 0.6);
    accelerates(&scene, &[], "z", -9.81 * 0.8 * 0.8);
}

/// A spline through a line is a linear spring.
#[test]
fn a_straight_spline_is_a_coordinate_spring() {
    let arm = "name = \"arm\"\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.0] }\nbody = { mass = 1.0, center_of_mass = [0.5, 0.0, 0.0] }";
    let linear = mechanism(
        &[arm],
        "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"arm\"\nstiffness = 8.0\nrest = 0.25\n",
    );
    let spline = mechanism(
        &[arm],
        r#"
        [[springs]]
        type = "spline"
        coordinate = "arm"
        knots = [
            { x = 0.25, value = 0.0 },
            { x = 0.5, value = -2.0 },
            { x = 1.25, value = -8.0, curvature = 0.0 },
        ]
        "#,
    );
    let [mut linear, mut spline] = [linear, spline].map(|scene| plant(&scene, |_| ()));
    for _ in 0..500 {
        linear.step(&[]).unwrap();
        spline.step(&[]).unwrap();
        assert!((linear.q()[0] - spline.q()[0]).abs() < 1e-12);
        let (a, b) = (linear.energy(), spline.energy());
        assert!((a.potential_j - b.potential_j).abs() < 1e-12, "{a:?} {b:?}");
    }
}

/// A cord through an eye that lies on the straight line between its ends is a two-point spring.
#[test]
fn a_path_without_corner_is_a_two_point_spring() {
    let weight = "name = \"weight\"\ntranslation = [0.0, 0.0, -1.0]\njoint = { type = \"prismatic\", axis = [0.0, 0.0, 1.0] }\nbody = { mass = 2.0 }";
    let cord = mechanism(
        &[weight],
        r#"
        [[springs]]
        type = "path"
        points = [{ frame = "world" }, { frame = "world", at = [0.0, 0.0, -0.3] }, { frame = "weight" }]
        stiffness = 100.0
        rest_length = 0.9
        "#,
    );
    let spring = mechanism(
        &[weight],
        r#"
        [[springs]]
        type = "two_point"
        a = { frame = "weight" }
        b = { frame = "world" }
        stiffness = 100.0
        rest_length = 0.9
        "#,
    );
    let [mut cord, mut spring] = [cord, spring].map(|scene| plant(&scene, |_| ()));
    for _ in 0..500 {
        cord.step(&[]).unwrap();
        spring.step(&[]).unwrap();
        assert!((cord.q()[0] - spring.q()[0]).abs() < 1e-12);
        let (a, b) = (cord.energy(), spring.energy());
        assert!((a.potential_j - b.potential_j).abs() < 1e-12, "{a:?} {b:?}");
    }
}

/// A welded body moves as one that is part of the link, up to the error of the time step.
#[test]
fn a_welded_body_moves_as_if_it_were_part_of_the_link() {
    let welded = scene("weld");
    let mut one_piece = welded.clone();
    one_piece.constraints.clear();
    let bob = one_piece.frames.pop().unwrap();
    one_piece.frames.truncate(3);
    one_piece.coordinates.clear();
    one_piece.frames[2].body = bob.body;
    let apart = |h: f64| {
        let [mut a, mut b] = [&welded, &one_piece].map(|scene| plant(scene, |s| s.time_step_s = h));
        for _ in 0..(0.5 / h).round() as u32 {
            a.step(&[]).unwrap();
            b.step(&[]).unwrap();
        }
        a.q().iter().zip(b.q()).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()))
    };
    let (coarse, fine) = (apart(4e-3), apart(2e-3));
    assert!(fine < 1e-4 && coarse / fine > 3.5, "{coarse:e} {fine:e}");
}

#[test]
fn configurations_without_direction_or_wrongly_aligned_are_refused() {
    let refused = |scene: &Scene, change: &[(&str, f64)]| {
        let mut plant = plant(scene, |_| ());
        let mut q = plant.q().to_vec();
        for (name, value) in change {
            q[plant.model().coordinate_index(name).unwrap()] = *value;
        }
        let p = vec![0.0; plant.p().len()];
        plant.initialize(&Initial::Momentum { q, p, v: Vec::new() }).unwrap_err()
    };
    let rope = refused(&scene("path-length"), &[("weight", 0.0), ("bob_z", 0.0), ("bob_x", 3.0)]);
    assert!(matches!(&rope, InitialError::Degenerate { constraint, .. } if constraint == "rope"));
    // Half a turn about x, and a third of a turn about the diagonal of the axes.
    let (half, quarter) = (std::f64::consts::PI, std::f64::consts::FRAC_PI_2);
    for turns in [[half, 0.0, 0.0], [0.0, half, 0.0], [0.0, 0.0, half], [quarter, 0.0, quarter]] {
        let change = ["wheel", "inner", "outer"].into_iter().zip(turns);
        let error = refused(&scene("orientation"), &change.collect::<Vec<_>>());
        let found = matches!(&error, InitialError::Degenerate { constraint, .. } if constraint == "aligned");
        assert!(found, "{turns:?}: {error}");
    }
}

const ARM: &str = "name = \"arm\"\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.0] }";

/// An armature on the first hinge is a moment of inertia about its axis.
#[test]
fn an_armature_is_inertia_about_its_axis() {
    let body = |inertia: f64| {
        format!(
            "{ARM}\nbody = {{ mass = 1.0, center_of_mass = [0.4, 0.0, -0.3], inertia = [0.3, {inertia}, 0.3] }}"
        )
    };
    let hand = "name = \"hand\"\nparent = \"arm\"\ntranslation = [0.0, 0.1, -0.5]\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.2] }\nbody = { mass = 0.5, center_of_mass = [0.1, 0.0, -0.3] }";
    let rotor = "[[coordinates]]\nname = \"arm\"\narmature = 0.25\n";
    let pairs = [
        (mechanism(&[&body(0.2)], rotor), mechanism(&[&body(0.45)], "")),
        (mechanism(&[&body(0.2), hand], rotor), mechanism(&[&body(0.45), hand], "")),
    ];
    for (with_rotor, with_inertia) in pairs {
        for order in [2, 4] {
            let [mut a, mut b] =
                [&with_rotor, &with_inertia].map(|scene| plant(scene, |s| s.order = order));
            for _ in 0..300 {
                a.step(&[]).unwrap();
                b.step(&[]).unwrap();
            }
            let apart = a.q().iter().zip(b.q()).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
            assert!(apart < 1e-11 && a.q()[0].abs() > 0.1, "{apart:e}");
            let (a, b) = (a.energy(), b.energy());
            assert!((a.kinetic_j - b.kinetic_j).abs() < 1e-10, "{a:?} {b:?}");
        }
    }
}

/// However a step solves, its linearization is that of its steps, and energy is kept.
#[test]
fn armatures_are_in_every_solver() {
    for name in ["chain-8", "tree-7", "scissor-4", "marionette", "four-bar"] {
        let mut scene = plantd_models::builtin::scene(name).unwrap();
        let model = crate::common::model(&scene);
        for (i, c) in model.coordinates().iter().enumerate() {
            if c.kind == CoordinateKind::Prescribed {
                continue;
            }
            let armature = 0.1 + 0.05 * i as f64;
            match scene.coordinates.iter_mut().find(|listed| listed.name == c.name) {
                Some(listed) => listed.armature = armature,
                None => scene.coordinates.push(plantd_models::scene::Coordinate {
                    name: c.name.clone(),
                    armature,
                    ..Default::default()
                }),
            }
        }
        linearization::check(&scene);
    }
}

/// Two wheels with one rotor behind them: a mass matrix by hand, and no work from outside.
#[test]
fn an_armature_of_a_sum_couples_its_coordinates() {
    let wheel = |name: &str, inertia: f64| {
        format!(
            "name = \"{name}\"\njoint = {{ type = \"revolute\", axis = [0.0, 1.0, 0.0] }}\nbody = {{ mass = 1.0, inertia = [0.9, {inertia}, 0.9] }}"
        )
    };
    let (one, two) = (wheel("one", 0.5), wheel("two", 0.75));
    let terms = "[[armatures]]\narmature = 0.2\nterms = [{ coordinate = \"one\", coefficient = 2.0 }, { coordinate = \"two\", coefficient = -1.0 }]\n[[inputs]]\nname = \"u\"\ncoordinate = \"one\"\n";
    let scene = mechanism(&[&one, &two], terms);
    // M = [0.5 + 0.8, −0.4; −0.4, 0.75 + 0.2]
    let det = 1.3 * 0.95 - 0.16;
    accelerates(&scene, &[3.0], "one", 3.0 * 0.95 / det);
    accelerates(&scene, &[3.0], "two", 3.0 * 0.4 / det);
    for order in [2, 4] {
        let mut plant = plant(&scene, |s| s.order = order);
        let v = vec![1.5, -0.5];
        plant.initialize(&Initial::Velocity { q: vec![0.1, 0.2], v: v.clone() }).unwrap();
        let kinetic = 0.25 * v[0] * v[0] + 0.375 * v[1] * v[1] + 0.1 * (2.0 * v[0] - v[1]).powi(2);
        assert!((plant.energy().kinetic_j - kinetic).abs() < 1e-14);
        for _ in 0..200 {
            plant.step(&[0.0]).unwrap();
        }
        assert!((plant.energy().kinetic_j - kinetic).abs() < 1e-12, "order {order}");
    }
    // One term is an armature of the coordinate itself.
    let term =
        "[[armatures]]\narmature = 0.2\nterms = [{ coordinate = \"one\", coefficient = 2.0 }]\n";
    let alone = mechanism(&[&one], term);
    let own = mechanism(&[&one], "[[coordinates]]\nname = \"one\"\narmature = 0.8\n");
    let [alone, own] = [&alone, &own].map(|scene| {
        let mut plant = plant(scene, |_| ());
        plant.initialize(&Initial::Velocity { q: vec![0.0], v: vec![1.0] }).unwrap();
        plant.p()[0]
    });
    assert!((alone - own).abs() < 1e-15, "{alone} {own}");
}

/// About one axis it is a spring of the angle; about two of one inertia each keeps its energy, up to half a
/// turn and next to it.
#[test]
fn a_spring_of_an_orientation_turns_back_the_shorter_way() {
    let ball = "name = \"ball\"\njoint = { type = \"ball\" }\nbody = { mass = 1.0, inertia = [0.3, 0.3, 0.3] }";
    let spring = "[[springs]]\ntype = \"orientation\"\nframe = \"ball\"\nstiffness = 2.0\nrest = { rpy = [0.5, 0.0, 0.0] }\n";
    let scene = mechanism(&[ball], spring);
    let mut at = plant(&scene, |_| ());
    for (start, energy) in [
        (1.5, 1.0),
        (0.5, 0.0),
        (0.5 - 3.0, 9.0),
        (0.5 + 4.0, (4.0 - std::f64::consts::TAU).powi(2)),
    ] {
        at.initialize(&Initial::Velocity { q: vec![start, 0.0, 0.0], v: vec![0.0; 3] }).unwrap();
        assert!((at.energy().potential_j - energy).abs() < 1e-13, "{start}");
        let p = at.p()[0];
        at.step(&[]).unwrap();
        let moved = at.p()[0] - p;
        let back = (start - 0.5 + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU)
            - std::f64::consts::PI;
        assert!(moved * back <= 0.0 && (moved == 0.0) == (back == 0.0), "{start}: {moved}");
    }
    // ω² = k / I: a period later it is where it was.
    let step = std::f64::consts::TAU * (0.3_f64 / 2.0).sqrt() / 500.0;
    let mut swing = plant(&scene, |s| {
        s.order = 4;
        s.time_step_s = step;
    });
    let q = vec![0.5 + 2.9, 0.0, 0.0];
    swing.initialize(&Initial::Velocity { q: q.clone(), v: vec![0.0; 3] }).unwrap();
    for _ in 0..500 {
        swing.step(&[]).unwrap();
    }
    let beyond = swing.model().difference(&q, swing.q());
    assert!(beyond.iter().all(|x| x.abs() < 1e-6), "{beyond:?}");
    // At half a turn all numbers are finite, and the step goes on.
    let half = vec![0.5 + std::f64::consts::PI, 0.0, 0.0];
    swing.initialize(&Initial::Velocity { q: half, v: vec![0.0, 0.3, 0.0] }).unwrap();
    let mut out = Linearization::new(&swing.model().clone());
    swing.linearize(&[], &mut out).unwrap();
    assert!(out.a().iter().all(|x| x.is_finite()));
    for _ in 0..100 {
        swing.step(&[]).unwrap();
        assert!(swing.energy().potential_j <= std::f64::consts::PI.powi(2) + 1e-9);
    }
}

/// Friction of a sum of one coordinate, and along a path that it alone changes, is its own; so is cubic drag.
#[test]
fn friction_of_sums_and_paths() {
    let cart = "name = \"cart\"\njoint = { type = \"prismatic\", axis = [1.0, 0.0, 0.0] }\nbody = { mass = 2.0 }";
    let friction = |what: &str| {
        let law = "[[forces]]\ntype = \"friction\"\nforce = 3.0\nvelocity = 0.5\n";
        mechanism(&[cart], &format!("{law}{what}\n"))
    };
    let path = "points = [{ frame = \"world\", at = [-2.0, 0.0, 0.0] }, { frame = \"cart\" }]";
    let moved = |scene: &Scene| {
        let mut plant = plant(scene, |_| ());
        plant.initialize(&Initial::Velocity { q: vec![0.0], v: vec![0.8] }).unwrap();
        for _ in 0..50 {
            plant.step(&[]).unwrap();
        }
        plant.q()[0]
    };
    let own = moved(&friction("coordinate = \"cart\""));
    for other in ["terms = [{ coordinate = \"cart\", coefficient = -1.0 }]", path] {
        assert!((moved(&friction(other)) - own).abs() < 1e-13, "{other}");
    }
    let drag = "[[forces]]\ntype = \"coordinate_drag\"\ncoordinate = \"cart\"\ncoefficient = 0.5\ncubic = 0.25\n[[inputs]]\nname = \"u\"\ncoordinate = \"cart\"\n";
    let mut falling = plant(&mechanism(&[cart], drag), |_| ());
    falling.initialize(&Initial::Velocity { q: vec![0.0], v: vec![-2.0] }).unwrap();
    // 4 N hold a speed of 2 m/s: 0.5 · 4 + 0.25 · 8.
    for _ in 0..50 {
        falling.step(&[-4.0]).unwrap();
    }
    assert!((falling.p()[0] + 4.0).abs() < 1e-12, "{}", falling.p()[0]);
}

/// A servo is an input, a spring and a damper.
#[test]
fn a_servo_is_an_input_with_a_spring_and_a_damper() {
    let arm = format!("{ARM}\nbody = {{ mass = 1.0, center_of_mass = [0.4, 0.0, 0.0] }}");
    let servo = "[[inputs]]\nname = \"u\"\n[[forces]]\ntype = \"servo\"\ninput = \"u\"\ngain = 9.0\nstiffness = 8.0\ndamping = 0.5\nconstant = 0.3\n";
    let alone = mechanism(&[&arm], &format!("{servo}coordinate = \"arm\"\n"));
    let sum = "terms = [{ coordinate = \"arm\", coefficient = -1.0 }]\n";
    let sum = mechanism(&[&arm], &format!("{servo}{sum}"));
    let parts = |gain: f64| {
        mechanism(
            &[&arm],
            &format!(
                "[[inputs]]\nname = \"u\"\ncoordinate = \"arm\"\ngain = {gain}\n[[coordinates]]\nname = \"arm\"\ndamping = 0.5\n[[springs]]\ntype = \"coordinate\"\ncoordinate = \"arm\"\nstiffness = 8.0\n"
            ),
        )
    };
    // A constant force is an input that is always there.
    for (servo, parts, sign) in [(alone, parts(9.0), 1.0), (sum, parts(-9.0), -1.0)] {
        let [mut a, mut b] = [&servo, &parts].map(|scene| plant(scene, |_| ()));
        for k in 0..300 {
            let u = (0.05 * f64::from(k)).sin();
            a.step(&[u]).unwrap();
            b.step(&[u + 0.3 / 9.0]).unwrap();
        }
        assert!((a.q()[0] - b.q()[0]).abs() < 1e-12 && a.q()[0].abs() > 1e-2, "{sign}");
    }
}

/// `terms` push each coordinate by its gain; along a path the force is that of its tension.
#[test]
fn inputs_act_on_sums_and_along_paths() {
    let slide = |name: &str, mass: f64| {
        format!(
            "name = \"{name}\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\nbody = {{ mass = {mass} }}"
        )
    };
    let frames = [slide("one", 2.0), slide("two", 3.0)];
    let terms = "[[inputs]]\nname = \"u\"\nterms = [{ coordinate = \"one\", gain = 0.5 }, { coordinate = \"two\", gain = -2.0 }]\n";
    let scene = mechanism(&[&frames[0], &frames[1]], terms);
    accelerates(&scene, &[6.0], "one", 1.5);
    accelerates(&scene, &[6.0], "two", -4.0);
    // From the wall to the first cart and back to a hook on it: both segments shorten as it moves on.
    let path = "[[inputs]]\nname = \"u\"\ngain = 1.5\npoints = [{ frame = \"world\", at = [9.0, 0.0, 0.0] }, { frame = \"one\" }, { frame = \"world\", at = [8.0, 0.0, 0.0] }]\n";
    let scene = mechanism(&[&frames[0], &frames[1]], path);
    accelerates(&scene, &[-2.0], "one", 3.0);
}

/// A gain of a component is that of the input.
#[test]
fn a_component_of_a_wrench_has_a_gain() {
    let wheel = "name = \"wheel\"\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.0] }\nbody = { mass = 1.0, inertia = [0.2, 0.2, 0.2] }";
    let torque = "[[inputs]]\nname = \"u\"\n[[forces]]\ntype = \"body_wrench\"\nframe = \"wheel\"\ntorque = [0.0, { input = \"u\", gain = -0.03 }, 0.0]\n";
    accelerates(&mechanism(&[wheel], torque), &[2.0], "wheel", -0.3);
}
