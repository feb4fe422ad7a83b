//! Constraints that say again what others say: the motion stays, multipliers have least norm.

use crate::common::{SPLITS, builtin, model, plant, wave, waving_input};
use nalgebra::{DMatrix, DVector};
use plantd_models::scene::{Axis, Constraint};
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, Initial, Linearization, Plant, Scene, StepError,
};

/// The four-bar with its pin stated twice.
fn doubled() -> Scene {
    let mut scene = builtin("four-bar");
    let Constraint::PointToPoint { a, b, axes, .. } = scene.constraints[0].clone() else {
        panic!()
    };
    let name = "pin_again".to_owned();
    scene.constraints.push(Constraint::PointToPoint { name, a, b, axes });
    scene
}

/// The four-bar with its pin stated in three axes, one of them across the plane of motion; turned
/// out of the coordinate planes or not.
fn out_of_plane(turned: bool) -> Scene {
    let mut scene = builtin("four-bar");
    let Constraint::PointToPoint { axes, .. } = &mut scene.constraints[0] else { panic!() };
    *axes = vec![Axis::X, Axis::Y, Axis::Z];
    if turned {
        // A quarter turn leaves cosines of 6e-17, an oblique turn nothing that is small.
        for angle in [std::f64::consts::FRAC_PI_2, 0.7] {
            let mut axis = plantd_models::scene::Frame {
                name: format!("turned{}", scene.frames.len()),
                parent: "world".to_owned(),
                translation: [0.0; 3],
                rotation: Some(plantd_models::scene::Rotation::Rpy([0.0, 0.0, angle])),
                joint: None,
                body: None,
                ..Default::default()
            };
            let name = axis.name.clone();
            for frame in scene.frames.iter_mut().filter(|f| f.parent == "world") {
                frame.parent.clone_from(&name);
            }
            axis.parent = "world".to_owned();
            scene.frames.push(axis);
        }
    }
    scene
}

/// The same mechanism turned about the vertical, without the redundant equation.
fn plain(redundant: &Scene) -> Scene {
    let mut scene = redundant.clone();
    scene.constraints.truncate(1);
    let Constraint::PointToPoint { axes, .. } = &mut scene.constraints[0] else { panic!() };
    *axes = vec![Axis::X, Axis::Z];
    scene
}

fn linearization(plant: &mut Plant, u: &[f64]) -> Linearization {
    let mut out = Linearization::new(&plant.model().clone());
    plant.linearize(u, &mut out).unwrap();
    out
}

#[test]
fn motion_and_linearization_are_those_without_redundant_equations() {
    for (redundant, count) in [(doubled(), 2), (out_of_plane(false), 1), (out_of_plane(true), 1)] {
        for split in SPLITS {
            let mut one = plant(&plain(&redundant), |s| s.force_split = split);
            let mut two = plant(&redundant, |s| s.force_split = split);
            for k in 0..100 {
                let u = waving_input(&one, k);
                assert_eq!(one.step(&u).unwrap().redundant_constraints, 0);
                let report = two.step(&u).unwrap();
                assert_eq!(report.redundant_constraints, count);
                assert!(report.constraint_reciprocal_condition > 1e-3, "{report:?}");
            }
            for (x, y) in one.q().iter().zip(two.q()).chain(one.p().iter().zip(two.p())) {
                assert!((x - y).abs() < 1e-10, "{x} instead of {y}");
            }
            let u = waving_input(&one, 101);
            let (first, second) = (linearization(&mut one, &u), linearization(&mut two, &u));
            let scale = first.a().amax();
            assert!((first.a() - second.a()).amax() < 1e-9 * scale, "A");
            assert!((first.b() - second.b()).amax() < 1e-9 * scale, "B");
        }
    }
}

/// `Dhᵀ λ` is the same impulse as without redundant equations, and no shorter `λ` gives it.
#[test]
fn multipliers_have_least_norm() {
    for redundant in [doubled(), out_of_plane(false), out_of_plane(true)] {
        let mut one = plant(&plain(&redundant), |_| ());
        let mut two = plant(&redundant, |_| ());
        wave(&mut one, 30);
        wave(&mut two, 30);
        let dh = [one.constraint_jacobian(), two.constraint_jacobian()];
        wave(&mut one, 1);
        wave(&mut two, 1);
        let impulse = dh[0].transpose() * DVector::from_column_slice(one.multipliers());
        let least = dh[1].transpose().svd(true, true).solve(&impulse, 1e-9).unwrap();
        for (lambda, least) in two.multipliers().iter().zip(least.iter()) {
            assert!((lambda - least).abs() < 1e-11, "{lambda} instead of {least}");
        }
    }
}

/// Collocation takes redundant equations as the midpoint rule does.
#[test]
fn collocation_has_redundant_equations() {
    for (redundant, count) in [(doubled(), 2), (out_of_plane(false), 1), (out_of_plane(true), 1)] {
        for order in [4, 8, 12, 16] {
            let mut one = plant(&plain(&redundant), |s| s.order = order);
            let mut two = plant(&redundant, |s| s.order = order);
            for k in 0..60 {
                let u = waving_input(&one, k);
                assert_eq!(one.step(&u).unwrap().redundant_constraints, 0);
                let report = two.step(&u).unwrap();
                assert_eq!((report.redundant_constraints, report.halvings), (count, 0));
                assert!(report.constraint_reciprocal_condition > 1e-5, "{report:?}");
            }
            for (x, y) in one.q().iter().zip(two.q()).chain(one.p().iter().zip(two.p())) {
                assert!((x - y).abs() < 1e-10, "order {order}: {x} instead of {y}");
            }
            let u = waving_input(&one, 61);
            let (first, second) = (linearization(&mut one, &u), linearization(&mut two, &u));
            let scale = first.a().amax();
            assert!((first.a() - second.a()).amax() < 1e-9 * scale, "A");
            assert!((first.b() - second.b()).amax() < 1e-9 * scale, "B");
            if count == 2 {
                let (whole, halves) = (one.multipliers(), two.multipliers());
                for c in 0..2 {
                    assert!((halves[c] - 0.5 * whole[c]).abs() < 1e-11, "{whole:?} {halves:?}");
                    assert!((halves[c] - halves[c + 2]).abs() < 1e-13, "{halves:?}");
                }
            }
        }
    }
}

/// Equations that are stated twice share what one of them carries, in derivatives too.
#[test]
fn doubled_equations_share_evenly() {
    let mut one = plant(&builtin("four-bar"), |_| ());
    let mut two = plant(&doubled(), |_| ());
    wave(&mut one, 20);
    wave(&mut two, 20);
    let lambda = two.multipliers();
    for c in 0..2 {
        assert!((lambda[c] - 0.5 * one.multipliers()[c]).abs() < 1e-11);
        assert!((lambda[c] - lambda[c + 2]).abs() < 1e-14);
    }
    let u = waving_input(&one, 21);
    let (first, second) = (linearization(&mut one, &u), linearization(&mut two, &u));
    let parts = [
        (first.multipliers_x(), second.multipliers_x()),
        (first.multipliers_u(), second.multipliers_u()),
    ];
    for (whole, halves) in parts {
        let scale = whole.amax();
        for share in [halves.rows(0, 2), halves.rows(2, 2)] {
            assert!((0.5 * &whole - share).amax() < 1e-9 * scale);
        }
    }
}

/// A slab that may sink and tilt on four legs.
fn table(load_at: [f64; 2]) -> Scene {
    let [x, y] = load_at;
    let mut text = format!(
        r#"
format = 1
name = "table"
gravity = [0.0, 0.0, -10.0]
[[frames]]
name = "height"
joint = {{ type = "prismatic", axis = [0.0, 0.0, 1.0] }}
[[frames]]
name = "pitch"
parent = "height"
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
[[frames]]
name = "slab"
parent = "pitch"
joint = {{ type = "revolute", axis = [1.0, 0.0, 0.0] }}
body = {{ mass = 3.0, inertia = [0.4, 0.5, 0.9] }}
[[frames]]
name = "load"
parent = "slab"
translation = [{x}, {y}, 0.1]
body = {{ mass = 1.0 }}
"#
    );
    for (leg, [x, y]) in LEGS.iter().enumerate() {
        text.push_str(&format!(
            r#"
[[constraints]]
type = "point_to_point"
name = "leg{leg}"
a = {{ frame = "slab", at = [{x}, {y}, -0.7] }}
b = {{ frame = "world", at = [{x}, {y}, -0.7] }}
axes = ["z"]
"#
        ));
    }
    Scene::from_toml(&text).unwrap()
}

const LEGS: [[f64; 2]; 4] = [[0.5, 0.3], [-0.5, 0.3], [-0.5, -0.3], [0.5, -0.3]];

#[test]
fn a_table_stands_on_four_legs() {
    for load in [[0.0, 0.0], [0.2, 0.1], [-0.4, 0.25]] {
        let mut plant = plant(&table(load), |_| ());
        for _ in 0..50 {
            let report = plant.step(&[]).unwrap();
            assert_eq!(report.redundant_constraints, 1);
        }
        assert!(plant.q().iter().all(|q| q.abs() < 1e-14), "{:?}", plant.q());
        // Least norm is the plane of forces that balances weight and moments.
        let weight = [30.0 + 10.0, 10.0 * load[0], 10.0 * load[1]];
        let h = plant.settings().time_step_s;
        for (leg, [x, y]) in LEGS.iter().enumerate() {
            let expected =
                weight[0] / 4.0 + weight[1] * x / (4.0 * 0.25) + weight[2] * y / (4.0 * 0.09);
            // What the constraint takes away from the forces that pull down.
            let force = -plant.multipliers()[leg] / h;
            assert!((force - expected).abs() < 1e-9, "leg {leg}: {force} N instead of {expected}");
        }
        let diagnosis = plant.diagnose();
        assert_eq!(diagnosis.redundant_constraints, ["leg3.z"]);
        assert_eq!((diagnosis.degrees_of_freedom, diagnosis.constraint_rank), (0, 3));
    }
}

/// Two strings from one point to one bob, whose lengths are prescribed.
const STRINGS: &str = r#"
format = 1
name = "strings"
gravity = [0.0, 0.0, -10.0]
[[frames]]
name = "x"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
[[frames]]
name = "z"
parent = "x"
joint = { type = "prismatic", axis = [0.0, 0.0, 1.0] }
body = { mass = 1.0 }
[[coordinates]]
name = "x"
initial = 0.6
[[coordinates]]
name = "z"
initial = -0.8
[[coordinates]]
name = "first"
kind = "prescribed"
initial = 1.0
[[coordinates]]
name = "second"
kind = "prescribed"
initial = 1.0
[[constraints]]
type = "distance"
name = "one"
a = { frame = "world" }
b = { frame = "z" }
length = "first"
[[constraints]]
type = "distance"
name = "two"
a = { frame = "world" }
b = { frame = "z" }
length = "second"
"#;

#[test]
fn constraints_that_contradict_each_other_are_named() {
    let mut plant = plant(&Scene::from_toml(STRINGS).unwrap(), |_| ());
    for k in 0..20 {
        let length = 1.0 + 0.001 * f64::from(k);
        let report = plant.step(&[length, length]).unwrap();
        assert_eq!(report.redundant_constraints, 1);
    }
    let before = plant.state();
    for (first, second) in [(1.02, 1.03), (1.02, 1.02 + 1e-7)] {
        match plant.step(&[first, second]).unwrap_err() {
            StepError::InconsistentConstraints { constraints, violation } => {
                assert_eq!(constraints, ["one", "two"]);
                // The best length is between the two.
                let half = 0.5 * (second * second - first * first).abs();
                assert!((violation - half).abs() < 1e-3 * half, "{violation} instead of {half}");
            }
            error => panic!("{error}"),
        }
        assert_eq!(plant.state(), before);
    }
    plant.step(&[1.02, 1.02]).unwrap();
}

/// A projection is not disturbed by equations that say the same, and says where they do not.
#[test]
fn projections_and_velocities_with_redundant_equations() {
    for redundant in [doubled(), out_of_plane(true)] {
        let mut one = plant(&plain(&redundant), |_| ());
        let mut two = plant(&redundant, |_| ());
        let guess = vec![-1.0, 0.4, -0.5];
        for plant in [&mut one, &mut two] {
            plant.initialize(&Initial::Projection { q: guess.clone(), hold: vec![] }).unwrap();
            let q = plant.q().to_vec();
            plant.initialize(&Initial::Velocity { q, v: vec![1.0, -2.0, 0.5] }).unwrap();
        }
        let (v, w) = (one.velocity(), two.velocity());
        for (x, y) in one.q().iter().zip(two.q()).chain(v.iter().zip(&w)) {
            assert!((x - y).abs() < 1e-12, "{x} and {y}");
        }
        assert!((two.constraint_jacobian() * DVector::from_vec(w)).amax() < 1e-13);
    }
}

/// Units do not make equations redundant: a mechanism of millimetres and grams, and one of
/// kilometres and tonnes.
#[test]
fn scale_is_not_redundancy() {
    let mut scene = builtin("four-bar");
    for (length, mass) in [(1e-3, 1e-3), (1e3, 1e6)] {
        let mut scaled = scene.clone();
        for frame in &mut scaled.frames {
            frame.translation.iter_mut().for_each(|x| *x *= length);
            let body = frame.body.as_mut().unwrap();
            body.mass *= mass;
            body.center_of_mass.iter_mut().for_each(|x| *x *= length);
            body.inertia.iter_mut().for_each(|x| *x *= mass * length * length);
        }
        let Constraint::PointToPoint { a, b, .. } = &mut scaled.constraints[0] else { panic!() };
        a.at.iter_mut().chain(&mut b.at).for_each(|x| *x *= length);
        scaled.gravity.iter_mut().flatten().for_each(|g| *g *= length);
        scaled.inputs.clear();
        scene.inputs.clear();
        let (mut small, mut large) = (plant(&scaled, |_| ()), plant(&scene, |_| ()));
        for _ in 0..50 {
            let (a, b) = (small.step(&[]).unwrap(), large.step(&[]).unwrap());
            assert_eq!((a.redundant_constraints, b.redundant_constraints), (0, 0));
            if a.factorizations > 0 && b.factorizations > 0 {
                let ratio = a.constraint_reciprocal_condition / b.constraint_reciprocal_condition;
                assert!((ratio - 1.0).abs() < 1e-6, "{ratio}");
                let ratio = a.reciprocal_condition / b.reciprocal_condition;
                assert!((ratio - 1.0).abs() < 1e-6, "{ratio}");
            }
        }
        for (x, y) in small.q().iter().zip(large.q()) {
            assert!((x - y).abs() < 1e-9, "{x} and {y}");
        }
    }
}

#[test]
fn regular_scenes_have_no_redundant_equations() {
    for name in plantd_models::builtin::NAMES {
        let mut plant = plant(&builtin(name), |_| ());
        let d = model(&builtin(name)).dimensions();
        let diagnosis = plant.diagnose();
        assert_eq!(diagnosis.redundant_constraints, [""; 0], "{name}");
        assert_eq!(diagnosis.degrees_of_freedom, d.dynamic - d.constraints, "{name}");
        if d.constraints == 0 {
            continue;
        }
        let dh: DMatrix<f64> = plant.constraint_jacobian().columns(0, d.dynamic).into_owned();
        assert_eq!(dh.rank(1e-9), d.constraints, "{name}");
    }
}

/// A beam on three equal cranks. The third pin fixes nothing that the others do not, but only where
/// they hold: elsewhere its equations are independent.
fn beam(third: &str) -> Scene {
    let crank = |name: &str, x: f64| {
        format!(
            r#"
[[frames]]
name = "{name}"
translation = [{x:?}, 0.0, 0.0]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = 0.5, center_of_mass = [0.0, 0.0, -0.2], inertia = [0.01, 0.01, 0.0] }}
[[coordinates]]
name = "{name}"
initial = 0.5
"#
        )
    };
    let pin = |name: &str, x: f64, axes: &str| {
        format!(
            r#"
[[constraints]]
type = "point_to_point"
name = "{name}_pin"
a = {{ frame = "beam", at = [{x:?}, 0.0, 0.0] }}
b = {{ frame = "{name}", at = [0.0, 0.0, -0.4] }}
axes = [{axes}]
"#
        )
    };
    let text = [
        "format = 1\nname = \"beam\"\ngravity = [0.0, 0.0, -9.8]\n".to_owned(),
        crank("first", 0.0),
        crank("second", 1.0),
        crank("third", 2.0),
        r#"
[[frames]]
name = "beam"
parent = "first"
translation = [0.0, 0.0, -0.4]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 2.0, center_of_mass = [0.8, 0.0, 0.1], inertia = [0.01, 0.7, 0.7] }
[[coordinates]]
name = "beam"
initial = -0.5
[[inputs]]
name = "torque"
coordinate = "first"
"#
        .to_owned(),
        pin("second", 1.0, r#""x", "z""#),
        pin("third", 2.0, third),
    ];
    Scene::from_toml(&text.concat()).unwrap()
}

#[test]
fn equations_that_are_redundant_on_the_manifold_only() {
    let mut one = plant(&beam(r#""x""#), |_| ());
    let mut two = plant(&beam(r#""x", "z""#), |_| ());
    assert_eq!(two.diagnose().redundant_constraints, ["third_pin.z"]);
    assert_eq!(two.diagnose().degrees_of_freedom, 1);
    for k in 0..300 {
        let u = [0.5 * (0.05 * f64::from(k)).sin()];
        let dh = [one.constraint_jacobian(), two.constraint_jacobian()];
        one.step(&u).unwrap();
        let report = two.step(&u).unwrap();
        assert_eq!(report.redundant_constraints, 1, "step {k}: {report:?}");
        let impulse = dh[0].transpose() * DVector::from_column_slice(one.multipliers());
        let least = dh[1].transpose().svd(true, true).solve(&impulse, 1e-9).unwrap();
        for (lambda, least) in two.multipliers().iter().zip(least.iter()) {
            assert!((lambda - least).abs() < 1e-10, "{lambda} instead of {least}");
        }
    }
    for (x, y) in one.q().iter().zip(two.q()) {
        assert!((x - y).abs() < 1e-10, "{x} instead of {y}");
    }
    let (v, w) = (one.velocity(), two.velocity());
    for (x, y) in v.iter().zip(&w) {
        assert!((x - y).abs() < 1e-10, "{x} instead of {y}");
    }
    // On the manifold the maps have one derivative: along tangents, and by momenta modulo gauge.
    let u = [0.2];
    let (first, second) = (linearization(&mut one, &u), linearization(&mut two, &u));
    let dh = two.constraint_jacobian();
    let tangent = plantd_math::null_space::tangent_basis(&dh);
    let mut directions = DMatrix::zeros(8, tangent.ncols() + 4);
    directions.view_mut((0, 0), (4, tangent.ncols())).copy_from(&tangent);
    directions.view_mut((4, tangent.ncols()), (4, 4)).fill_with_identity();
    // Momenta agree up to what the constraints of the next state absorb.
    one.step(&u).unwrap();
    let free = plantd_math::null_space::tangent_basis(&one.constraint_jacobian()).transpose();
    for (x, y) in [(first.a() * &directions, second.a() * &directions), (first.b(), second.b())] {
        let scale = x.amax();
        assert!((x.rows(0, 4) - y.rows(0, 4)).amax() < 1e-9 * scale, "q");
        assert!((&free * (x.rows(4, 4) - y.rows(4, 4))).amax() < 1e-9 * scale, "p");
    }
}

/// Second derivatives and continuous dynamics are those without redundant equations too.
#[test]
fn second_order_and_continuous_dynamics() {
    for redundant in [doubled(), out_of_plane(false), out_of_plane(true)] {
        let found = [plain(&redundant), redundant].map(|scene| {
            let mut plant = plant(&scene, |_| ());
            wave(&mut plant, 20);
            let model = plant.model().clone();
            let d = model.dimensions();
            let u = waving_input(&plant, 21);
            let weights: Vec<f64> = (0..d.state()).map(|i| (1.0 + i as f64).sin()).collect();
            let mut first = Linearization::new(&model);
            let mut out = Contraction::new(&model);
            plant
                .contract_second_order(
                    &u,
                    &weights,
                    &vec![0.0; d.constraints],
                    &mut first,
                    &mut out,
                )
                .unwrap();
            let point = ContinuousPoint {
                q: plant.q().to_vec(),
                v: plant.velocity(),
                inputs: u,
                prescribed_acceleration: vec![],
            };
            let continuous = Continuous::new(model).linearize(&point).unwrap();
            let acceleration = DVector::from_vec(continuous.value.acceleration);
            let jacobian = continuous.jacobian.rows(0, d.dynamic).into_owned();
            (out, acceleration, jacobian)
        });
        let [(one, a, da), (two, b, db)] = &found;
        for (x, y) in [(&one.xx, &two.xx), (&one.xu, &two.xu), (&one.uu, &two.uu), (da, db)] {
            assert!((x - y).amax() < 1e-8 * x.amax().max(1e-3), "{x} instead of {y}");
        }
        assert!((a - b).amax() < 1e-10 * a.amax());
    }
}

/// The four-bar with its rocker sawn in two lengthwise: one half hangs from the coupler, and a weld
/// of six equations joins the halves. Three of them act across the plane of motion.
///
/// Without redundant equations: the halves' tips coincide in the plane, and their angles agree.
fn welded(join: &str) -> Scene {
    let mut scene = builtin("four-bar");
    let four_bar = scene.clone();
    let initial =
        |name: &str| four_bar.coordinates.iter().find(|c| c.name == name).unwrap().initial;
    let angle = initial("rocker") - initial("crank") - initial("coupler");
    let rocker = scene.frames.iter_mut().find(|f| f.name == "rocker").unwrap();
    let body = rocker.body.as_mut().unwrap();
    body.mass *= 0.5;
    body.inertia.iter_mut().for_each(|x| *x *= 0.5);
    let halves = Scene::from_toml(&format!(
        r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "halves"
[[frames]]
name = "coupler"
[[frames]]
name = "rocker"
[[frames]]
name = "half"
parent = "coupler"
translation = [0.0, 0.0, -1.2]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = 0.5, center_of_mass = [0.0, 0.0, 0.5], inertia = [{0:?}, {0:?}, 0.0] }}
[[frames]]
name = "tip"
parent = "rocker"
translation = [0.0, 0.0, -1.0]
[[coordinates]]
name = "half"
initial = {angle:?}
{join}
"#,
        1.0 / 24.0
    ))
    .unwrap();
    scene.frames.extend_from_slice(&halves.frames[2..]);
    scene.coordinates.extend(halves.coordinates);
    scene.constraints = halves.constraints;
    scene.operating_points.clear();
    scene
}

#[test]
fn a_weld_in_a_planar_loop() {
    let planar = r#"
[[constraints]]
type = "point_to_point"
name = "tips"
a = { frame = "half" }
b = { frame = "tip" }
axes = ["x", "z"]
[[constraints]]
type = "coupling"
name = "angles"
terms = [
    { coordinate = "crank", coefficients = [1.0] },
    { coordinate = "coupler", coefficients = [1.0] },
    { coordinate = "half", coefficients = [1.0] },
    { coordinate = "rocker", coefficients = [-1.0] },
]
"#;
    let weld = "[[constraints]]\ntype = \"weld\"\nname = \"cut\"\na = \"half\"\nb = \"tip\"";
    let mut one = plant(&welded(planar), |_| ());
    let mut two = plant(&welded(weld), |_| ());
    let found = two.diagnose();
    assert_eq!((found.degrees_of_freedom, found.constraint_rank), (1, 3));
    assert_eq!(found.redundant_constraints.len(), 3, "{found:?}");
    for k in 0..100 {
        let u = waving_input(&one, k);
        one.step(&u).unwrap();
        let report = two.step(&u).unwrap();
        assert_eq!(report.redundant_constraints, 3, "{report:?}");
    }
    for (x, y) in one.q().iter().zip(two.q()) {
        assert!((x - y).abs() < 1e-10, "{x} and {y}");
    }
    let (e, f) = (one.diagnose(), two.diagnose());
    assert!((e.energy.kinetic_j - f.energy.kinetic_j).abs() < 1e-9);
    let rest = [&one, &two].map(|plant| {
        let request = plantd_models::SettleRequest { q: plant.q().to_vec(), ..Default::default() };
        plant.model().settle(&request).unwrap()
    });
    assert!((rest[0].potential_j - rest[1].potential_j).abs() < 1e-10, "{rest:?}");
    assert!(rest[1].stable, "{rest:?}");
}
