//! Singularities, section VI of the paper: where the Newton matrix or the constraints lose rank.

use std::f64::consts::{FRAC_PI_2, PI};

use crate::common::exact::Mechanism;
use crate::common::{Numbers, builtin, plant, wave};
use nalgebra::{DMatrix, Matrix2};
use plantd_models::{Initial, Linearization, Plant, Scene, StepError};

const MASS: f64 = 1.3;
const LENGTH: f64 = 0.7;
const GRAVITY: f64 = 9.81;

/// The paper's spherical pendulum: azimuth about the vertical, then polar angle from hanging.
fn spherical_pendulum() -> Scene {
    Scene::from_toml(&format!(
        r#"
format = 1
name = "spherical"
gravity = [0.0, 0.0, -{GRAVITY}]
[[frames]]
name = "azimuth"
joint = {{ type = "revolute", axis = [0.0, 0.0, 1.0] }}
[[frames]]
name = "polar"
parent = "azimuth"
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = {MASS}, center_of_mass = [0.0, 0.0, -{LENGTH}] }}
[[coordinates]]
name = "polar"
initial = 1.0
"#
    ))
    .unwrap()
}

/// `M[k+1]` of the spherical pendulum in closed form, with `φ` the azimuth and `θ` the polar angle.
fn closed_form(q0: [f64; 2], q1: [f64; 2], dt: f64) -> Matrix2<f64> {
    let (turn, sum) = (q1[0] - q0[0], q0[1] + q1[1]);
    let (sin, cos) = (0.5 * sum).sin_cos();
    let inertia = MASS * LENGTH * LENGTH / dt;
    let coupling = 0.5 * inertia * sum.sin() * turn;
    let polar = -inertia
        * (1.0 - 0.25 * sum.cos() * turn * turn + dt * dt * GRAVITY / (4.0 * LENGTH) * cos);
    Matrix2::new(-inertia * sin * sin, -coupling, coupling, polar)
}

/// `det M = (m r²/dt)² sin²((θ0+θ1)/2) [1 + ¼(2 + cos(θ0+θ1)) Δφ² + dt² g/(4r) cos((θ0+θ1)/2)]`.
fn bracket(q0: [f64; 2], q1: [f64; 2], dt: f64) -> f64 {
    let (turn, sum) = (q1[0] - q0[0], q0[1] + q1[1]);
    1.0 + 0.25 * (2.0 + sum.cos()) * turn * turn
        + dt * dt * GRAVITY / (4.0 * LENGTH) * (0.5 * sum).cos()
}

fn at_step(scene: &Scene, time_step_s: f64) -> Plant {
    plant(scene, |s| (s.time_step_s, s.halvings) = (time_step_s, 0))
}

#[test]
fn newton_matrix_of_the_spherical_pendulum_is_the_papers() {
    let mut random = Numbers::new(1);
    for dt in [0.001, 0.01, 0.3, 0.6, 1.5] {
        let mut plant = at_step(&spherical_pendulum(), dt);
        for _ in 0..50 {
            let [q0, q1] = [0; 2].map(|_| [0; 2].map(|_| random.between(-PI, PI)));
            let found = plant.newton_matrix(&q0, &q1);
            let expected = closed_form(q0, q1, dt);
            let scale = expected.amax();
            for (x, y) in found.iter().zip(expected.iter()) {
                assert!((x - y).abs() < 1e-13 * scale, "{found} instead of {expected}");
            }
            let sin = (0.5 * (q0[1] + q1[1])).sin();
            let determinant =
                (MASS * LENGTH * LENGTH / dt).powi(2) * sin * sin * bracket(q0, q1, dt);
            assert!((found.determinant() - determinant).abs() < 1e-12 * scale * scale);
        }
    }
}

/// The bracket has no zero for `dt < 2 √(r/g)`, whatever the turn about the vertical, and has one
/// above: upright, without turn.
#[test]
fn the_bound_on_the_time_step() {
    let bound = 2.0 * (LENGTH / GRAVITY).sqrt();
    let sign = |dt: f64, polar: f64, turn: f64| {
        let mut plant = at_step(&spherical_pendulum(), dt);
        let matrix = plant.newton_matrix(&[-0.5 * turn, polar - 0.1], &[0.5 * turn, polar + 0.1]);
        let sin_squared = polar.sin().powi(2);
        matrix.determinant() / sin_squared / (MASS * LENGTH * LENGTH / dt).powi(2)
    };
    for k in 1..40 {
        let polar = PI * f64::from(k) / 40.0;
        for turn in [0.0, 0.01, 0.5, 2.0, 5.0] {
            assert!(sign(0.999 * bound, polar, turn) > 0.0, "{polar} {turn}");
        }
    }
    assert!(sign(1.01 * bound, 0.999 * PI, 0.0) < 0.0);
    // A turn about the vertical only helps.
    assert!(sign(1.01 * bound, 0.999 * PI, 0.5) > 0.0);
    // Where it vanishes.
    let mut plant = at_step(&spherical_pendulum(), bound);
    let matrix = plant.newton_matrix(&[0.3, PI - 0.1], &[0.3, PI + 0.1]);
    let inertia = MASS * LENGTH * LENGTH / bound;
    assert!(matrix[(1, 1)].abs() < 1e-14 * inertia, "{matrix}");
}

/// Consecutive configurations that mirror each other about a pole have their midpoint on it.
#[test]
fn symmetric_consecutive_configurations_are_singular() {
    let dt = 0.01;
    let mut plant = at_step(&spherical_pendulum(), dt);
    let inertia = MASS * LENGTH * LENGTH / dt;
    // About the lower pole, across it, and about the upper one; gravity acts on the polar angle
    // alone and vanishes at the poles.
    for (center, swing) in [(0.0, 0.0), (0.0, 0.1), (0.0, 1e-3), (PI, 0.2), (-PI, 0.05)] {
        let matrix = plant.newton_matrix(&[0.3, center - swing], &[0.4, center + swing]);
        assert!(matrix.determinant().abs() < 1e-25 * inertia * inertia);
        let momentum = Initial::Momentum {
            q: vec![0.3, center - swing],
            p: vec![0.0, inertia * 2.0 * swing],
            v: vec![],
        };
        plant.initialize(&momentum).unwrap();
        let before = plant.state();
        let mut out = Linearization::new(&plant.model().clone());
        for error in [plant.step(&[]).unwrap_err(), plant.linearize(&[], &mut out).unwrap_err()] {
            match error {
                StepError::Singular { coordinate, pivot } => {
                    assert_eq!(coordinate, "azimuth");
                    assert!(pivot < 1e-14, "{pivot}");
                }
                error => panic!("{error}"),
            }
        }
        assert_eq!(plant.state(), before);
        // A little off, it is regular, and the estimate is the square of the distance.
        let off = 3e-4;
        plant
            .initialize(&Initial::Momentum {
                q: vec![0.3, center - swing + off],
                p: vec![0.0, inertia * 2.0 * swing],
                v: vec![],
            })
            .unwrap();
        let estimate = plant.linearize(&[], &mut out).unwrap().reciprocal_condition;
        assert!(estimate > 0.5 * off * off && estimate < 2.0 * off * off, "{estimate}");
    }
}

/// The built-in spherical pendulum has its poles where the second hinge turns the rod into the axis
/// of the first.
#[test]
fn the_builtin_spherical_pendulum_is_singular_at_its_pole() {
    let mut plant = plant(&builtin("spherical-pendulum"), |_| ());
    let estimates: Vec<f64> = [0.3, 1.0, 1.5, FRAC_PI_2]
        .map(|pitch| {
            plant.initialize(&Initial::Velocity { q: vec![0.2, pitch], v: vec![0.0; 2] }).unwrap();
            plant.diagnose().mass_matrix_reciprocal_condition
        })
        .into();
    for (estimate, pitch) in estimates.iter().zip([0.3_f64, 1.0, 1.5, FRAC_PI_2]) {
        assert!((estimate - pitch.cos().powi(2)).abs() < 1e-15, "{estimate} at {pitch}");
    }
}

/// A point on a plane, held at a distance from the origin; without gravity.
fn planar_pendulum() -> Scene {
    Scene::from_toml(&format!(
        r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "planar"
[[frames]]
name = "x"
joint = {{ type = "prismatic", axis = [1.0, 0.0, 0.0] }}
[[frames]]
name = "y"
parent = "x"
joint = {{ type = "prismatic", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = {MASS} }}
[[coordinates]]
name = "x"
initial = {LENGTH}
[[constraints]]
type = "distance"
name = "rod"
a = {{ frame = "y" }}
b = {{ frame = "world" }}
length = {LENGTH}
"#
    ))
    .unwrap()
}

/// `M = −(m/dt) 1` and `Dh(q1) M⁻¹ Dh(q0)ᵀ = −(4 dt/m)(x1 x0 + y1 y0)`.
#[test]
fn planar_pendulum_in_cartesian_coordinates() {
    let dt = 0.05;
    let mut plant = at_step(&planar_pendulum(), dt);
    let at = |angle: f64| vec![LENGTH * angle.cos(), LENGTH * angle.sin()];
    let mut jacobian = |q: &[f64]| {
        plant.initialize(&Initial::Velocity { q: q.to_vec(), v: vec![0.0; 2] }).unwrap();
        plant.constraint_jacobian()
    };
    for turn in [0.0, 0.3, 1.0, 1.57, FRAC_PI_2, 1.58, 2.0, 3.0] {
        let (q0, q1) = (at(0.4), at(0.4 + turn));
        let (d0, d1) = (jacobian(&q0), jacobian(&q1));
        let matrix = at_step(&planar_pendulum(), dt).newton_matrix(&q0, &q1);
        let expected = DMatrix::identity(2, 2) * (-MASS / dt);
        assert!((&matrix - expected).amax() < 1e-14 * MASS / dt);
        let schur = (d1 * matrix.try_inverse().unwrap() * d0.transpose())[(0, 0)];
        let closed = -4.0 * dt / MASS * LENGTH * LENGTH * turn.cos();
        assert!((schur - closed).abs() < 1e-15, "{schur} instead of {closed}");
        assert_eq!(schur < -1e-15, turn < FRAC_PI_2, "the sign changes at a quarter turn only");
    }
}

/// A step with momentum across the rod turns by `asin(dt v/l)`: from a quarter turn on there is
/// nothing to turn to.
#[test]
fn a_quarter_turn_in_one_step_is_singular() {
    let dt = 0.05;
    let swing = |speed: f64, singular_below: f64| {
        let mut plant = plant(&planar_pendulum(), |s| {
            (s.time_step_s, s.halvings) = (dt, 0);
            s.singular_below = singular_below;
        });
        let p = vec![0.0, MASS * speed];
        plant.initialize(&Initial::Momentum { q: vec![LENGTH, 0.0], p, v: vec![] }).unwrap();
        let result = plant.step(&[]);
        (plant, result)
    };
    for turn in [0.1_f64, 0.8, 1.4, 1.55] {
        let (mut plant, report) = swing(LENGTH / dt * turn.sin(), 1e-14);
        let found = plant.q()[1].atan2(plant.q()[0]);
        assert!((found - turn).abs() < 1e-9, "{found} instead of {turn}");
        // Estimates are those of the factorization, at most an iteration back.
        let estimate = report.unwrap().constraint_reciprocal_condition;
        assert!((estimate / turn.cos() - 1.0).abs() < 1.0, "{estimate} at {turn}");
        let mut out = Linearization::new(&plant.model().clone());
        let report = plant.linearize(&[], &mut out).unwrap();
        assert!(report.constraint_reciprocal_condition > 0.0);
    }
    // Exactly a quarter turn: the two solutions of a step meet.
    let (_, result) = swing(LENGTH / dt, 1e-6);
    match result.unwrap_err() {
        StepError::SingularConstraints { constraints, reciprocal_condition } => {
            assert_eq!(constraints, ["rod"]);
            assert!(reciprocal_condition < 1e-6);
        }
        error => panic!("{error}"),
    }
    // Beyond there is none.
    let (_, result) = swing(1.01 * LENGTH / dt, 1e-14);
    assert!(result.is_err());
}

/// A scissor that opens under gravity comes to hang as one line, where the conditions that its
/// pivots put on heights vanish.
#[test]
fn a_scissor_that_settles_on_a_singular_point_names_its_constraints() {
    for pairs in [1, 2, 4] {
        let scene = Scene { damping: 3.0, ..builtin(&format!("scissor-{pairs}")) };
        let mut plant = plant(&scene, |_| ());
        let mut lowest: f64 = 1.0;
        let error = (0..20_000).find_map(|_| match plant.step(&[0.0]) {
            Ok(report) => {
                lowest = lowest.min(report.constraint_reciprocal_condition);
                None
            }
            Err(error) => Some(error),
        });
        match error.expect("it comes to the singular point") {
            StepError::SingularConstraints { constraints, reciprocal_condition } => {
                let heights: Vec<_> = (0..pairs).map(|i| format!("pivot{i}.z")).collect();
                assert_eq!(constraints, heights);
                assert!(reciprocal_condition < 1e-8, "{reciprocal_condition}");
            }
            error => panic!("{error}"),
        }
        assert!(lowest < 1e-8, "the estimate has told: {lowest}");
        assert!(plant.q()[0].abs() < 1e-3, "it hangs: {:?}", plant.q());
    }
}

/// A scene that begins on a singular point does not take its missing equations for redundant ones.
#[test]
fn a_scene_that_begins_on_a_singular_point() {
    let mut scene = builtin("scissor-2");
    for coordinate in &mut scene.coordinates {
        coordinate.initial = match coordinate.name.as_str() {
            "slider" => 0.0,
            "right0" | "left0" => FRAC_PI_2,
            _ => 0.0,
        };
    }
    let mut plant = plant(&scene, |_| ());
    let found = plant.diagnose();
    assert_eq!((found.constraint_rank, found.degrees_of_freedom), (2, 3));
    assert!(found.constraint_reciprocal_condition < 1e-14, "{found:?}");
    match plant.step(&[1.0]).unwrap_err() {
        StepError::SingularConstraints { constraints, .. } => {
            assert_eq!(constraints, ["pivot0.z", "pivot1.z"]);
        }
        error => panic!("{error}"),
    }
}

/// The threshold decides what counts as singular.
#[test]
fn thresholds_turn_estimates_into_errors() {
    let mut regular = plant(&builtin("four-bar"), |_| ());
    let u = [0.3];
    let report = regular.step(&u).unwrap();
    let (matrix, constraints) =
        (report.reciprocal_condition, report.constraint_reciprocal_condition);
    assert!(matrix > 0.0 && matrix < 1.0 && constraints > 0.0 && constraints <= 1.0);
    let with = |threshold: f64| {
        plant(&builtin("four-bar"), |s| s.singular_below = threshold).step(&u).map(|_| ())
    };
    assert_eq!(with(0.99 * matrix.min(constraints)), Ok(()));
    if matrix < constraints {
        assert!(matches!(with(1.01 * matrix), Err(StepError::Singular { .. })));
    } else {
        let error = with(1.01 * constraints);
        assert!(matches!(error, Err(StepError::SingularConstraints { .. })), "{error:?}");
    }
    let mut marionette = plant(&builtin("marionette"), |_| ());
    wave(&mut marionette, 20);
}

/// A pendulum whose rod may turn about itself, with its bob and damping.
fn spinning(bob_at: f64, inertia: f64, damping: f64) -> Result<(), String> {
    let text = format!(
        r#"
format = 1
name = "spinning"
gravity = [0.0, 0.0, -9.81]
[[frames]]
name = "swing"
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
[[frames]]
name = "rod"
parent = "swing"
joint = {{ type = "revolute", axis = [0.0, 0.0, 1.0], coordinate = "spin" }}
body = {{ mass = 1.0, center_of_mass = [{bob_at}, 0.0, -0.8], inertia = [0.1, 0.1, {inertia}] }}
[[coordinates]]
name = "spin"
damping = {damping}
"#
    );
    let scene = Scene::from_toml(&text).unwrap();
    match plantd_models::Model::compile(&scene) {
        Ok(_) => {
            let mut plant = plant(&scene, |_| ());
            plant.step(&[]).map(|_| ()).map_err(|error| error.to_string())
        }
        Err(error) => {
            assert_eq!(error.problems[0].path, "frames[1].joint");
            Err(error.problems[0].message.clone())
        }
    }
}

/// What can never move is refused with the scene; what resists, by whatever means, is not.
#[test]
fn mass_on_the_axis_of_its_hinge_is_refused() {
    let message = spinning(0.0, 0.0, 0.0).unwrap_err();
    assert!(message.contains("nothing resists coordinate `spin`"), "{message}");
    for (bob_at, inertia, damping) in [(1e-3, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 0.1)] {
        assert_eq!(spinning(bob_at, inertia, damping), Ok(()));
    }
}

/// A scissor of so many pairs with its links at an angle to the rail, and how it moves with that angle.
fn scissor(pairs: usize, opening: f64) -> [Vec<f64>; 2] {
    let (mut q, mut slopes) = (vec![5.0 * opening.cos()], vec![-5.0 * opening.sin()]);
    for (i, right) in
        [0, 1].into_iter().flat_map(|side| (0..pairs).map(move |i| (i, (i + side) % 2 == 0)))
    {
        let slope = if right { -1.0 } else { 1.0 } * if i == 0 { 1.0 } else { 2.0 };
        let closed = if right || i > 0 { PI } else { 0.0 };
        q.push(closed + slope * opening);
        slopes.push(slope);
    }
    [q, slopes]
}

/// A parallelogram of hinges with its cranks at an angle to its base.
fn parallelogram(angle: f64) -> Scene {
    let crank = |name: &str, at: f64| {
        format!(
            r#"
[[frames]]
name = "{name}"
translation = [{at}, 0.0, 0.0]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = {MASS}, center_of_mass = [0.3, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }}
[[coordinates]]
name = "{name}"
initial = {angle}
"#
        )
    };
    let (crank, rocker) = (crank("crank", 0.0), crank("rocker", 1.1));
    Scene::from_toml(&format!(
        r#"
format = 1
name = "parallelogram"
time_step_s = 0.01
gravity = [0.0, 0.0, -{GRAVITY}]
{crank}
[[frames]]
name = "coupler"
parent = "crank"
translation = [{LENGTH}, 0.0, 0.0]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = 1.2, center_of_mass = [0.6, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }}
[[coordinates]]
name = "coupler"
initial = -{angle}
{rocker}
[[constraints]]
type = "point_to_point"
name = "pin"
a = {{ frame = "coupler", at = [1.1, 0.0, 0.0] }}
b = {{ frame = "rocker", at = [{LENGTH}, 0.0, 0.0] }}
axes = ["x", "z"]
"#
    ))
    .unwrap()
}

/// Past and next to singular configurations multipliers and their derivatives are as exact as the whole
/// matrix `[K −A0ᵀ; A1 0]` makes them with complete pivoting. What both are off by is the round-off of
/// `h(q[k+1])` over the square of the distance.
#[test]
fn multipliers_are_as_exact_as_those_of_the_whole_matrix() {
    let mut random = Numbers::new(5);
    let mut check = |scene: &Scene, place: &dyn Fn(f64) -> [Vec<f64>; 2]| {
        let mechanism = Mechanism::new(scene);
        let mut plant = plant(scene, |s| s.halvings = 0);
        let mut start = |distance: f64, rate: f64, steps: usize| {
            let [q, slopes] = place(distance);
            let v = slopes.iter().map(|slope| slope * rate).collect();
            plant.initialize(&Initial::Velocity { q, v }).unwrap();
            let errors: Vec<_> = (0..steps).map(|_| mechanism.errors(&mut plant)).collect();
            // Single errors of either may be small by chance.
            for (what, part) in ["multipliers", "derivatives"].iter().zip(0..) {
                let mean = |which: usize| {
                    let logarithms = errors.iter().map(|e| e[part][which].max(1e-16).ln());
                    (logarithms.sum::<f64>() / steps as f64).exp()
                };
                let (found, whole) = (mean(0), mean(1));
                let name = &scene.name;
                assert!(
                    found < 3.0 * whole,
                    "{name} from {distance:e}: {what} to {found:e}, not to {whole:e}"
                );
            }
        };
        // Twenty-five steps before and after.
        start(-0.155, 0.613, 50);
        for distance in [1e-3, 1e-4, 1e-5, 3e-6, 1e-6] {
            start(distance * random.between(0.9, 1.1), distance, 2);
        }
    };
    for pairs in [1, 2, 4] {
        let place = |distance: f64| scissor(pairs, FRAC_PI_2 + distance);
        check(&builtin(&format!("scissor-{pairs}")), &place);
    }
    let place = |angle: f64| [vec![angle, -angle, angle], vec![1.0, -1.0, 1.0]];
    check(&parallelogram(1.0), &place);
}
