//! Springs of orientations, armatures and friction of an MJCF, against formulas.

use std::sync::Arc;

use nalgebra::{DVector, UnitQuaternion, Vector3};
use plantd_import::{Options, import};
use plantd_models::scene::{Force, Spring};
use plantd_models::{Continuous, ContinuousPoint, Model, Scene};

fn scene(text: &str) -> Scene {
    import(text, &Options::default()).unwrap_or_else(|e| panic!("{text}: {e}")).scene
}

/// Mass matrix, and the forces of all elements, at a point.
fn terms(scene: &Scene, q: &[f64], v: &[f64]) -> (nalgebra::DMatrix<f64>, DVector<f64>) {
    let model = Arc::new(Model::compile(scene).unwrap_or_else(|e| panic!("{e}")));
    let inputs = vec![0.0; model.dimensions().inputs];
    let point = ContinuousPoint {
        q: q.to_vec(),
        v: v.to_vec(),
        inputs,
        prescribed_acceleration: Vec::new(),
    };
    let terms = Continuous::new(model).terms(&point).unwrap();
    (terms.mass_matrix, DVector::from_vec(terms.passive))
}

fn problem(text: &str) -> String {
    import(text, &Options::default()).expect_err(text).problems[0].to_string()
}

const INERTIAL: &str = "<inertial pos='0 0 0' mass='1' diaginertia='2 2 2'/>";

/// Wheels of 2 kg·m² on hinges `a` and `b`, with what comes after.
fn wheels(after: &str) -> String {
    format!(
        "<mujoco><option gravity='0 0 0'/><worldbody><body><joint name='a' axis='0 1 0'/>{INERTIAL}</body>
        <body pos='0 1 0'><joint name='b' axis='0 1 0'/>{INERTIAL}<site name='rim' pos='0 0 1'/></body>
        <site name='post' pos='2 1 1'/></worldbody>{after}</mujoco>"
    )
}

#[test]
fn orientations_turn_back_by_their_rotation_vector() {
    let body = |joint: &str| {
        format!(
            "<mujoco><worldbody><body pos='1 2 3' quat='0.6 0 0.8 0'>{joint}{INERTIAL}</body></worldbody></mujoco>"
        )
    };
    let turn = [0.3, -1.2, 0.8];
    let ball = scene(&body("<joint name='j' type='ball' stiffness='3' springref='9'/>"));
    let (_, force) = terms(&ball, &turn, &[0.0; 3]);
    assert!((force + DVector::from_row_slice(&turn) * 3.0).amax() < 1e-13);
    let free = scene(&body("<joint name='j' type='free' stiffness='3'/>"));
    let home = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(0.6, 0.0, 0.8, 0.0));
    let own = UnitQuaternion::from_scaled_axis(Vector3::from(turn));
    let [x, y, z] = (home * own).scaled_axis().into();
    let (_, force) = terms(&free, &[1.5, 2.0, 2.0, x, y, z], &[0.0; 6]);
    let expected = [-1.5, 0.0, 3.0, -0.9, 3.6, -2.4];
    assert!((force - DVector::from_row_slice(&expected)).amax() < 1e-12);
    // I = 2: k = I / (τ ζ)².
    let given = scene(&body("<joint name='j' type='ball' springdamper='0.5 2'/>"));
    let [Spring::Orientation { stiffness, rest: None, .. }] = &given.springs[..] else {
        panic!("{:?}", given.springs)
    };
    assert!((stiffness - 2.0).abs() < 1e-12, "{stiffness}");
    let told = problem(&body("<joint name='j' type='ball' stiffness='3 1'/>"));
    assert!(told.contains("that of an orientation must be one number"), "{told}");
}

#[test]
fn rotors_turn_with_tendons_and_joints() {
    let tendon = |own: &str| {
        format!(
            "<tendon><fixed name='t' {own}><joint joint='a' coef='2'/><joint joint='b' coef='-1'/></fixed></tendon>"
        )
    };
    let motor = |own: &str| format!("{}<actuator><motor {own}/></actuator>", tendon(""));
    // Of a tendon's rotor 0.5, [4 −2; −2 1] times as much.
    for (text, [aa, ab, bb]) in [
        (tendon("armature='0.5'"), [2.0, -1.0, 0.5]),
        (motor("tendon='t' gear='3' armature='0.5'"), [18.0, -9.0, 4.5]),
        (motor("joint='a' gear='3' armature='0.5'"), [4.5, 0.0, 0.0]),
        (motor("jointinparent='b' gear='-2' armature='0.5'"), [0.0, 0.0, 2.0]),
    ] {
        let (mass, _) = terms(&scene(&wheels(&text)), &[0.1, 0.2], &[0.0; 2]);
        let expected = nalgebra::DMatrix::from_row_slice(2, 2, &[2.0 + aa, ab, ab, 2.0 + bb]);
        assert!((mass - expected).amax() < 1e-12, "{text}");
    }
    let v = [0.7_f64, -0.4];
    let rate = 2.0 * v[0] - v[1];
    for (text, expected) in [
        (motor("tendon='t' gear='3' damping='0.5'"), [-9.0 * rate, 4.5 * rate]),
        (
            motor("joint='a' gear='3' damping='1 2 3'"),
            [-9.0 * (v[0] + 2.0 * v[0] * v[0] + 3.0 * v[0].powi(3)), 0.0],
        ),
    ] {
        let (_, force) = terms(&scene(&wheels(&text)), &[0.1, 0.2], &v);
        assert!((force - DVector::from_row_slice(&expected)).amax() < 1e-12, "{text}");
    }
    // Gears do not count on orientations, and classes have rotors for all.
    let ball = format!(
        "<mujoco><default><motor armature='0.25'/></default><worldbody><body><joint name='j' type='ball'/>{INERTIAL}</body></worldbody>
        <actuator><motor joint='j' gear='0 3 0'/></actuator></mujoco>"
    );
    let (mass, _) = terms(&scene(&ball), &[0.0; 3], &[0.0; 3]);
    assert!((mass - nalgebra::DMatrix::identity(3, 3) * 2.25).amax() < 1e-12);
    let site = wheels("<actuator><motor site='rim' gear='1 0 0 0 0 0' armature='1'/></actuator>");
    assert!(problem(&site).contains("must act on a joint or a tendon"));
    let rope = "<tendon><spatial name='r' armature='1'><site site='rim'/><site site='post'/></spatial></tendon>";
    assert!(problem(&wheels(rope)).contains("a path: its inertia is another"));
}

#[test]
fn tendons_rub() {
    let sum = "<tendon><fixed frictionloss='3'><joint joint='a' coef='2'/><joint joint='b' coef='-1'/></fixed>
        <spatial frictionloss='4'><site site='rim'/><site site='post'/></spatial></tendon>";
    let options = Options { friction_velocity: 0.5, ..Options::default() };
    let scene = import(&wheels(sum), &options).unwrap().scene;
    let v = [0.7_f64, -0.4];
    let (rate, slide) = (2.0 * v[0] - v[1], -v[1]);
    let (_, force) = terms(&scene, &[0.0, 0.0], &v);
    let of_sum = 3.0 * (rate / 0.5).tanh();
    // The rim stands a metre above the axis, and moves towards the post with the wheel.
    let of_path = 4.0 * (slide / 0.5).tanh();
    let expected = [-2.0 * of_sum, of_sum + of_path];
    assert!((&force - DVector::from_row_slice(&expected)).amax() < 1e-12, "{force}");
    assert_eq!(scene.forces.iter().filter(|f| matches!(f, Force::Friction { .. })).count(), 2);
}
