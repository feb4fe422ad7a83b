//! Drawings: poses against kinematics, boxes against inertias, and arrows against the generalized forces that
//! they stand for.

use std::sync::Arc;

use crate::common::{Numbers, builtin, floating, forced_tree, model, plant, random_tree, wave};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3, Vector6};
use plantd_models::drawing::{Arrow, ArrowKind, Drawing, Form, Instant, LineKind, Poses};
use plantd_models::scene::{Constraint, Force, Frame, Point};
use plantd_models::{Continuous, ContinuousPoint, Kinematics, Model, Scene};

fn elements() -> Vec<Scene> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    let mut paths: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let read = |path: &std::path::PathBuf| {
        Scene::from_toml(&std::fs::read_to_string(path).unwrap()).unwrap()
    };
    paths.iter().map(read).collect()
}

fn scenes() -> Vec<Scene> {
    let names = [
        "pendulum",
        "damped-pendulum",
        "double-pendulum",
        "cart-pole",
        "spherical-pendulum",
        "chain-3",
        "tree-7",
        "four-bar",
        "scissor-3",
        "marionette",
    ];
    let trees = (0..8).map(random_tree).chain((0..8).map(forced_tree));
    names.map(builtin).into_iter().chain([floating()]).chain(trees).chain(elements()).collect()
}

/// Numbers about a configuration.
struct Sample {
    q: Vec<f64>,
    v: Vec<f64>,
    inputs: Vec<f64>,
    multipliers: Vec<f64>,
}

impl Sample {
    fn new(model: &Model, q: &[f64], seed: u64) -> Self {
        let (d, mut random) = (model.dimensions(), Numbers::new(seed));
        let mut numbers = |count: usize| (0..count).map(|_| random.between(-1.0, 1.0)).collect();
        Self {
            q: q.to_vec(),
            v: numbers(d.coordinates()),
            inputs: numbers(d.inputs),
            multipliers: numbers(d.constraints),
        }
    }

    /// Near the initial configuration, on constraints or not.
    fn near_start(model: &Model, seed: u64) -> Self {
        let mut random = Numbers::new(seed ^ 0xd1a);
        let initial: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
        let change: Vec<f64> = initial.iter().map(|_| random.between(-0.4, 0.4)).collect();
        Self::new(model, &model.retract(&initial, &change), seed)
    }

    fn instant(&self) -> Instant<'_> {
        let Self { q, v, inputs, multipliers } = self;
        Instant { q, velocity: v, inputs, multipliers, time_step_s: 0.02 }
    }
}

fn close(found: &[f64], expected: &[f64], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1.0_f64, |scale, x| scale.max(x.abs()));
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        assert!((x - y).abs() <= 1e-11 * scale, "{what}[{i}]: {x} instead of {y}");
    }
}

#[test]
fn frames_are_where_kinematics_and_the_plant_have_them() {
    for scene in scenes() {
        let model = model(&scene);
        let drawing = Drawing::new(&model);
        let mut kinematics = Kinematics::new(Arc::clone(&model));
        let mut poses = drawing.poses();
        let check = |poses: &Poses, kinematics: &Kinematics, what: &str| {
            for (frame, pose) in drawing.frames().zip(&poses.frames) {
                let at = kinematics.motion(&kinematics.point(&frame.name, [0.0; 3]).unwrap());
                let expected = [&at.position[..], &at.orientation].concat();
                close(pose, &expected, &format!("{} {} {what}", scene.name, frame.name));
            }
        };
        check(&poses, &kinematics, "at the start");
        for seed in 0..3 {
            let sample = Sample::near_start(&model, seed);
            drawing.place(&sample.instant(), &mut poses);
            kinematics.place(&sample.q, &sample.v).unwrap();
            check(&poses, &kinematics, "near the start");
        }
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 20);
        let sample = Sample::new(&model, plant.q(), 1);
        drawing.place(&sample.instant(), &mut poses);
        for (frame, pose) in drawing.frames().zip(&poses.frames) {
            let at = plant.pose(&model.site(&frame.name, [0.0; 3]).unwrap());
            close(&pose[..3], &at.position, &scene.name);
            let [w, x, y, z] = [pose[3], pose[4], pose[5], pose[6]];
            let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let expected = UnitQuaternion::from_scaled_axis(Vector3::from(at.rotation));
            assert!(turn.angle_to(&expected) < 1e-7, "{} {}", scene.name, frame.name);
        }
    }
}

/// Of everything that a user may look at first: something, finite, of the size that is told.
#[test]
fn every_scene_shows_something() {
    for scene in scenes() {
        let name = &scene.name;
        let mut plant = plant(&scene, |_| ());
        let model = Arc::clone(plant.model());
        let drawing = Drawing::new(&model);
        wave(&mut plant, 20);
        let (q, v) = (plant.q().to_vec(), vec![0.1; plant.q().len()]);
        let inputs = vec![1.0; model.dimensions().inputs];
        let mut poses = drawing.poses();
        let (multipliers, time_step_s) = (plant.multipliers(), 0.01);
        let at = Instant { q: &q, velocity: &v, inputs: &inputs, multipliers, time_step_s };
        drawing.place(&at, &mut poses);
        assert!(drawing.frames().len() > 0, "{name}");
        assert!(drawing.frames().all(|frame| !frame.shapes.is_empty()), "{name}");
        let size = drawing.size_m();
        assert!(size.is_finite() && size > 0.0, "{name}: {size}");
        let numbers =
            [poses.frames.as_flattened(), poses.points.as_flattened(), poses.arrows.as_flattened()];
        assert!(numbers.iter().copied().flatten().all(|x| x.is_finite()), "{name}");
        assert_eq!(drawing.numbers(), numbers.iter().map(|n| n.len()).sum::<usize>(), "{name}");
        let points: usize = drawing.lines().iter().map(|line| line.points).sum();
        assert_eq!(points, poses.points.len(), "{name}");
        assert_eq!(drawing.arrows().len(), poses.arrows.len(), "{name}");
        for shape in drawing.frames().flat_map(|frame| &frame.shapes) {
            let lengths = match shape.form {
                Form::Box(size) | Form::Ellipsoid(size) => size.to_vec(),
                Form::Capsule { radius, .. } => vec![radius],
                Form::Cylinder { radius, length } => vec![radius, length],
                Form::Mesh { scale, .. } => scale.map(f64::abs).to_vec(),
            };
            assert!(lengths.iter().all(|x| *x > 0.0 && x.is_finite()), "{name}: {shape:?}");
        }
    }
}

/// `m/12 (l_y² + l_z²)` about x and so on, in the axes of the shape, is the inertia that the scene gives.
#[test]
fn boxes_have_the_inertia_that_they_stand_for() {
    let mut boxes = 0;
    for scene in (0..20).map(random_tree).chain(elements()) {
        let drawing = Drawing::new(&model(&scene));
        for drawn in drawing.frames() {
            let body = scene.frames.iter().find(|f| f.name == drawn.name).unwrap().body.as_ref();
            let [shape] = &drawn.shapes[..] else { continue };
            let (true, Some(body), Form::Box(size)) = (shape.stands_for_inertia, body, &shape.form)
            else {
                continue;
            };
            let least = size.iter().copied().fold(f64::INFINITY, f64::min);
            if least <= size.iter().copied().fold(0.0, f64::max) / 49.0 {
                continue;
            }
            let [x, y, z] = size.map(|l| l * l * body.mass / 12.0);
            let principal = Matrix3::from_diagonal(&Vector3::new(y + z, x + z, x + y));
            let [w, i, j, k] = shape.orientation;
            let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k))
                .to_rotation_matrix()
                .into_inner();
            let found = turn * principal * turn.transpose();
            let [xx, yy, zz, xy, xz, yz] = match body.inertia[..] {
                [xx, yy, zz] => [xx, yy, zz, 0.0, 0.0, 0.0],
                [xx, yy, zz, xy, xz, yz] => [xx, yy, zz, xy, xz, yz],
                _ => panic!("{}: a box for a point mass", scene.name),
            };
            let expected = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
            close(found.as_slice(), expected.as_slice(), &scene.name);
            assert!((found - expected).norm() <= 1e-12 * expected.norm(), "{}", scene.name);
            assert_eq!(shape.position, body.center_of_mass, "{}", scene.name);
            boxes += 1;
        }
    }
    assert!(boxes > 60, "a test of little: {boxes} boxes");
}

/// A point mass on a rod of one metre is one metre in size; its ball is seen beside it.
#[test]
fn sizes_are_those_of_the_mechanism() {
    let drawing = Drawing::new(&model(&builtin("pendulum")));
    assert!((drawing.size_m() - 1.0).abs() < 1e-12, "{}", drawing.size_m());
    let bob = drawing.frames().next().unwrap();
    let Form::Capsule { radius, length } = bob.shapes[0].form else { panic!("{bob:?}") };
    assert!((radius - 0.04).abs() < 1e-12 && length == 0.0, "{bob:?}");
    for (name, low, high) in
        [("chain-8", 1.0, 1.4), ("four-bar", 1.0, 4.0), ("marionette", 1.0, 6.0)]
    {
        let size = Drawing::new(&model(&builtin(name))).size_m();
        assert!((low..high).contains(&size), "{name}: {size}");
    }
}

#[test]
fn rods_can_be_seen_and_visuals_take_the_place_of_bodies() {
    let drawing = Drawing::new(&model(&builtin("four-bar")));
    let crank = drawing.frames().next().unwrap();
    let Form::Box(size) = crank.shapes[0].form else { panic!("{crank:?}") };
    // A uniform rod of half a metre.
    close(&size, &[0.01, 0.01, 0.5], "crank");
    let inputs = elements().into_iter().find(|scene| scene.name == "inputs").unwrap();
    let drawing = Drawing::new(&model(&inputs));
    let shapes: Vec<usize> = drawing.frames().map(|frame| frame.shapes.len()).collect();
    assert_eq!(shapes, [2, 1, 3]);
    assert!(drawing.frames().flat_map(|f| &f.shapes).all(|shape| !shape.stands_for_inertia));
    let finger = drawing.frames().last().unwrap();
    assert_eq!(finger.shapes[2].form, Form::Ellipsoid([0.02, 0.02, 0.04]));
    assert_eq!((finger.parent.as_str(), finger.mass_kg), ("palm", 0.1));
}

/// What an arrow exerts on a frame, as a generalized force.
fn exerted(kinematics: &Kinematics, frame: &str, arrow: &Arrow, pose: &[f64; 6]) -> Vec<f64> {
    let origin = kinematics.motion(&kinematics.point(frame, [0.0; 3]).unwrap());
    let [w, x, y, z] = origin.orientation;
    let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let away = Vector3::from_column_slice(&pose[..3]) - Vector3::from(origin.position);
    let point = kinematics.point(frame, turn.inverse_transform_vector(&away).into()).unwrap();
    let at = kinematics.motion(&point).position;
    close(&at, &pose[..3], "the point of the frame where the arrow is");
    let mut wrench = Vector6::zeros();
    wrench.fixed_rows_mut::<3>(if arrow.torque { 3 } else { 0 }).copy_from_slice(&pose[3..]);
    (kinematics.jacobian(&point).transpose() * wrench).as_slice().to_vec()
}

fn moves(kinematics: &Kinematics, frame: &str) -> bool {
    kinematics.jacobian(&kinematics.point(frame, [0.0; 3]).unwrap()).norm() > 0.0
}

/// Frames on which the arrow of an input or constraint acts, and those on which its opposite does.
type Acts = (String, Option<String>);

fn on_points(kinematics: &Kinematics, points: &[Point]) -> Vec<Acts> {
    let moving = points.iter().filter(|point| moves(kinematics, &point.frame));
    moving.map(|point| (point.frame.clone(), None)).collect()
}

fn on_coordinate(scene: &Scene, coordinate: &str) -> Acts {
    let has = |frame: &&Frame| frame.motions().iter().any(|(name, _)| name == coordinate);
    let frame = scene.frames.iter().find(has).unwrap();
    (frame.name.clone(), Some(frame.parent.clone()))
}

/// Where inputs act, in the order of the drawing.
fn inputs_act(scene: &Scene, kinematics: &Kinematics) -> Vec<Acts> {
    let mut acts = Vec::new();
    for input in &scene.inputs {
        let terms = input.terms.iter().map(|term| &term.coordinate);
        acts.extend(input.coordinate.iter().chain(terms).map(|name| on_coordinate(scene, name)));
        acts.extend(on_points(kinematics, &input.points));
    }
    for force in &scene.forces {
        let count = force.inputs().count();
        match force {
            Force::Servo { .. } => panic!("a servo is more than its input"),
            _ if count == 0 => {}
            _ => acts.extend(vec![(force.points()[0].frame.clone(), None); count]),
        }
    }
    acts
}

/// Sum of the generalized forces of the arrows of one kind.
fn total(
    drawing: &Drawing,
    poses: &Poses,
    kinematics: &Kinematics,
    kind: ArrowKind,
    acts: &[Acts],
) -> Vec<f64> {
    let arrows: Vec<_> =
        drawing.arrows().iter().zip(&poses.arrows).filter(|(a, _)| a.kind == kind).collect();
    let n = kinematics.model().dimensions().coordinates();
    let mut sum = vec![0.0; n];
    assert_eq!(arrows.len(), acts.len(), "{arrows:?}\n{acts:?}");
    for ((arrow, pose), (frame, against)) in arrows.into_iter().zip(acts) {
        let on = exerted(kinematics, frame, arrow, pose);
        let off = against.as_ref().map(|frame| exerted(kinematics, frame, arrow, pose));
        for (i, sum) in sum.iter_mut().enumerate() {
            *sum += on[i] - off.as_ref().map_or(0.0, |off| off[i]);
        }
    }
    sum
}

/// All arrows of inputs together exert what the equation of motion says of the inputs.
#[test]
fn arrows_of_inputs_are_their_generalized_forces() {
    let has_servo = |scene: &Scene| scene.forces.iter().any(|f| matches!(f, Force::Servo { .. }));
    let mut arrows = 0;
    for scene in scenes().into_iter().filter(|scene| !has_servo(scene)) {
        let model = model(&scene);
        let drawing = Drawing::new(&model);
        let mut kinematics = Kinematics::new(Arc::clone(&model));
        let mut poses = drawing.poses();
        let sample = Sample::near_start(&model, 7);
        kinematics.place(&sample.q, &sample.v).unwrap();
        drawing.place(&sample.instant(), &mut poses);
        let acts = inputs_act(&scene, &kinematics);
        let mut found = total(&drawing, &poses, &kinematics, ArrowKind::Input, &acts);
        found.truncate(model.dimensions().dynamic);
        let point = ContinuousPoint {
            q: sample.q.clone(),
            v: sample.v.clone(),
            inputs: sample.inputs.clone(),
            prescribed_acceleration: vec![0.0; model.dimensions().prescribed],
        };
        let terms = Continuous::new(Arc::clone(&model)).terms(&point).unwrap();
        close(&found, &terms.input[..found.len()], &scene.name);
        arrows += acts.len();
    }
    assert!(arrows > 60, "a test of little: {arrows} arrows");
}

/// A servo is drawn with its spring and damper: what it exerts.
#[test]
fn arrows_of_servos_are_all_that_they_exert() {
    let scene = elements().into_iter().find(|scene| scene.name == "servo").unwrap();
    let model = model(&scene);
    let drawing = Drawing::new(&model);
    let mut poses = drawing.poses();
    let sample = Sample::near_start(&model, 3);
    drawing.place(&sample.instant(), &mut poses);
    let value = |of: &[f64], name: &str| of[model.coordinate_index(name).unwrap()];
    let mut expected = Vec::new();
    for force in &scene.forces {
        let Force::Servo { coordinate, terms, input, gain, stiffness, damping, constant } = force
        else {
            panic!("{force:?}")
        };
        let alone = coordinate.iter().map(|name| (name.as_str(), 1.0));
        let terms: Vec<_> = alone
            .chain(terms.iter().map(|term| (term.coordinate.as_str(), term.coefficient)))
            .collect();
        let sum = |of: &[f64]| terms.iter().map(|(name, c)| c * value(of, name)).sum::<f64>();
        let u = sample.inputs[scene.inputs.iter().position(|i| i.name == *input).unwrap()];
        let force = gain * u - stiffness * sum(&sample.q) - damping * sum(&sample.v) + constant;
        expected.extend(terms.iter().map(|(_, c)| c * force));
    }
    // All hinges are about y.
    let found: Vec<f64> = poses.arrows.iter().map(|arrow| arrow[4]).collect();
    close(&found, &expected, "servos");
    assert!(drawing.arrows().iter().all(|arrow| arrow.torque), "{:?}", drawing.arrows());
}

/// Where constraints act, in the order of the drawing.
fn constraints_act(scene: &Scene, kinematics: &Kinematics) -> Vec<Acts> {
    let joined = |a: &str, b: &str| {
        let (on, off) = if moves(kinematics, a) { (a, b) } else { (b, a) };
        (on.to_owned(), Some(off.to_owned()))
    };
    let mut acts = Vec::new();
    for constraint in &scene.constraints {
        match constraint {
            Constraint::Distance { a, b, .. } => {
                acts.extend(on_points(kinematics, &[a.clone(), b.clone()]));
            }
            Constraint::PointToPoint { a, b, axes, .. } if axes.len() == 3 => {
                acts.push(joined(&a.frame, &b.frame));
            }
            Constraint::PointToPoint { a, b, .. } => {
                acts.extend(on_points(kinematics, &[a.clone(), b.clone()]));
            }
            Constraint::PointOnPlane { plane, point, .. } => {
                acts.push((point.frame.clone(), Some(plane.frame.clone())));
            }
            Constraint::Orientation { a, b, .. } => acts.push(joined(a, b)),
            Constraint::Weld { a, b, .. } => acts.extend([joined(a, b), joined(a, b)]),
            Constraint::Coupling { .. } => {}
            Constraint::PathLength { points, .. } => acts.extend(on_points(kinematics, points)),
        }
    }
    acts
}

/// All arrows of constraints together exert `−Dhᵀ λ / h`, on the constraints.
#[test]
fn arrows_of_constraints_are_their_generalized_forces() {
    let is_placed = |scene: &Scene| {
        let coupled = |c: &Constraint| matches!(c, Constraint::Coupling { .. });
        !scene.constraints.is_empty() && !scene.constraints.iter().any(coupled)
    };
    let (mut arrows, mut kinds) = (0, std::collections::BTreeSet::new());
    for scene in scenes().into_iter().filter(is_placed) {
        let mut plant = plant(&scene, |_| ());
        wave(&mut plant, 20);
        let model = Arc::clone(plant.model());
        let drawing = Drawing::new(&model);
        let mut kinematics = Kinematics::new(Arc::clone(&model));
        let mut poses = drawing.poses();
        let sample = Sample::new(&model, plant.q(), 5);
        kinematics.place(&sample.q, &sample.v).unwrap();
        drawing.place(&sample.instant(), &mut poses);
        let acts = constraints_act(&scene, &kinematics);
        let mut found = total(&drawing, &poses, &kinematics, ArrowKind::Constraint, &acts);
        found.truncate(model.dimensions().dynamic);
        let jacobian = plant.constraint_jacobian();
        let lambda = nalgebra::DVector::from_column_slice(&sample.multipliers);
        let expected = jacobian.transpose() * lambda * (-1.0 / 0.02);
        close(&found, &expected.as_slice()[..found.len()], &scene.name);
        arrows += acts.len();
        kinds.extend(scene.constraints.iter().map(|c| format!("{c:?}")[..7].to_owned()));
    }
    assert!(arrows > 20, "a test of little: {arrows} arrows");
    assert_eq!(kinds.len(), 6, "{kinds:?}");
}

#[test]
fn lines_go_where_their_elements_are() {
    let lines = |name: &str| {
        let scene = scenes().into_iter().find(|scene| scene.name == name).unwrap();
        let drawing = Drawing::new(&model(&scene));
        let lines = drawing.lines().iter();
        lines.map(|line| (line.kind, line.name.clone(), line.points)).collect::<Vec<_>>()
    };
    use LineKind::{Constraint, Link, Path, Spring};
    assert_eq!(lines("cart-pole"), [(Link, "pole".to_owned(), 2)]);
    let finger = lines("path-damper");
    assert!(finger.contains(&(Spring, String::new(), 3)), "{finger:?}");
    assert!(finger.contains(&(Path, "tendon".to_owned(), 3)), "{finger:?}");
    let strings = lines("marionette");
    let count = |kind| strings.iter().filter(|line| line.0 == kind).count();
    assert_eq!(count(Constraint), 6, "{strings:?}");

    // The string ends where its constraint has them: as far apart as it is long.
    let scene = builtin("marionette");
    let mut plant = plant(&scene, |_| ());
    wave(&mut plant, 20);
    let drawing = Drawing::new(plant.model());
    let sample = Sample::new(plant.model(), plant.q(), 1);
    let mut poses = drawing.poses();
    drawing.place(&sample.instant(), &mut poses);
    let mut first = 0;
    for line in drawing.lines() {
        let ends = [poses.points[first], poses.points[first + line.points - 1]];
        first += line.points;
        let of = |c: &&plantd_models::scene::Constraint| c.name() == line.name;
        let Some(constraint) = scene.constraints.iter().find(of) else { continue };
        let length = plant.model().coordinate_index(constraint.length_coordinate().unwrap());
        let apart = (Vector3::from(ends[0]) - Vector3::from(ends[1])).norm();
        assert!((apart - plant.q()[length.unwrap()]).abs() < 1e-12, "{}", line.name);
    }
}
