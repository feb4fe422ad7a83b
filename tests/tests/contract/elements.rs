//! What a scene can have, seen from outside: every element, ball joints, signals.

use std::path::Path;

use plantd_client::{
    MatrixExt as _, diagonal, difference, operating_point, present_state, rotations, v1,
};

use crate::support::*;

/// Every call that looks at a plant answers for every element's scene.
#[tokio::test]
async fn every_element_can_be_stepped_differentiated_and_analysed() {
    let (_server, client) = server().await;
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/scenes/elements");
    let mut files: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(files.len() > 10);
    for file in files {
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        let scene = std::fs::read_to_string(&file).unwrap();
        let model = client.create_model(scene).await.unwrap_or_else(|e| panic!("{name}: {e}"));
        let id = plant(&client, &model.name).await.id;
        let step = v1::StepRequest { id: id.clone(), hold: 20, ..Default::default() };
        let answer = client.step(step).await.unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(answer.states[0].step, 20, "{name}");
        let report = answer.report.unwrap();
        let conditions = [report.reciprocal_condition, report.constraint_reciprocal_condition];
        assert!(conditions.iter().all(|c| *c > 1e-14 && *c <= 1.0), "{name}: {report:?}");

        let point = Some(present_state(&id));
        let n = model.coordinates.len();
        let weights = Some(v1::ContractionWeights { x: vec![1.0; 2 * n], ..Default::default() });
        let request = v1::LinearizeSecondOrderRequest { point, weights, ..Default::default() };
        let second = client.linearize_second_order(request).await;
        let second = second.unwrap_or_else(|e| panic!("{name}: {e}"));
        let sum = second.contraction.unwrap().xx.unwrap();
        assert!(sum.data.iter().all(|entry| entry.is_finite()), "{name}");
        let request = v1::AnalyzeRequest { point: Some(present_state(&id)), ..Default::default() };
        let analysis = client.analyze(request).await.unwrap_or_else(|e| panic!("{name}: {e}"));
        let request = v1::DiagnoseRequest { id, ..Default::default() };
        let diagnosis = client.diagnose(request).await.unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(analysis.modes.len(), 2 * diagnosis.degrees_of_freedom as usize, "{name}");
        let request =
            v1::EvaluateDynamicsRequest { model: model.name, order: 2, ..Default::default() };
        let dynamics = client.evaluate_dynamics(request).await;
        let dynamics = dynamics.unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(dynamics.hessian.unwrap().data.iter().all(|entry| entry.is_finite()), "{name}");
    }
}

/// A stick that hangs on a ball joint, turned by three torques in its own axes.
const STICK: &str = r#"
format = 1
name = "stick"
gravity = [0.0, 0.0, -9.8]
time_step_s = 0.02

[[frames]]
name = "stick"
joint = { type = "ball" }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.02] }

[[inputs]]
name = "x"
coordinate = "stick_rx"

[[inputs]]
name = "y"
coordinate = "stick_ry"

[[inputs]]
name = "z"
coordinate = "stick_rz"

[[operating_points]]
name = "turned"
coordinates = { stick_rz = 3.0 }
"#;

/// Past half a turn the rotation vector jumps to the other side; a gain must not.
#[tokio::test]
async fn a_gain_turns_a_ball_joint_the_short_way() {
    let (_server, client) = server().await;
    let model = client.create_model(STICK).await.unwrap();
    let groups: Vec<_> = model.coordinates.iter().map(|c| c.rotation_group.as_str()).collect();
    assert_eq!((groups, rotations(&model)), (vec!["stick"; 3], vec![0]));
    let request = v1::SolveLqrRequest {
        model: "stick".to_owned(),
        point: Some(operating_point("turned")),
        weights: Some(v1::LqrWeights {
            q: Some(diagonal([[100.0; 3], [1.0; 3]].concat())),
            r: Some(diagonal([1.0; 3])),
            ..Default::default()
        }),
        ..Default::default()
    };
    let gain = client.solve_lqr(request).await.unwrap().gain.unwrap();
    assert_eq!(gain.rotations, [0]);
    let request = v1::CreatePlantRequest {
        model: "stick".to_owned(),
        initial: Some(at_velocity(&[0.0, 0.3, -3.0], &[0.0; 3])),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let mut state = plant.state.unwrap();
    let mut driver = client.drive(&plant.id).await.unwrap();
    let error = |state: &v1::State| difference(&gain.x_reference[..3], &state.q, &[0]);
    let norm = |v: &[f64]| v.iter().map(|e| e * e).sum::<f64>().sqrt();
    let mut largest = norm(&error(&state));
    assert!(largest < 0.7, "a third of a radian about each of two axes");
    for _ in 0..300 {
        state = driver.step_by(&gain, &state).await.unwrap().state.unwrap();
        largest = largest.max(norm(&error(&state)));
    }
    assert!(largest < 0.7, "it never went the long way: {largest}");
    assert!(norm(&error(&state)) < 1e-6, "{:?}", state.q);
}

#[tokio::test]
async fn signals_are_listed_and_drive_their_entries() {
    let (_server, client) = server().await;
    let scene = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "signalled"
time_step_s = 0.01

[[frames]]
name = "block"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
body = { mass = 2.0 }

[[frames]]
name = "lift"
joint = { type = "prismatic", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0 }

[[coordinates]]
name = "lift"
kind = "prescribed"

[[inputs]]
name = "push"
coordinate = "block"

[[signals]]
drives = "lift"
type = "sinusoid"
amplitude = 0.5
frequency_hz = 2.0

[[signals]]
drives = "push"
type = "constant"
value = 3.0
"#;
    let model = client.create_model(scene).await.unwrap();
    let signal = |drives: &str, u_index, kind: &str, replaces| v1::Signal {
        drives: drives.to_owned(),
        u_index,
        kind: kind.to_owned(),
        replaces,
    };
    let expected = [signal("lift", 1, "sinusoid", true), signal("push", 0, "constant", false)];
    assert_eq!(model.signals, expected);
    let id = plant(&client, "signalled").await.id;
    let step = v1::StepRequest {
        id,
        u: Some(v1::Matrix::from_rows(&[[1.0, 77.0]; 30])),
        all_states: true,
        ..Default::default()
    };
    for state in client.step(step).await.unwrap().states {
        let t = state.time_s;
        assert!((state.q[1] - 0.5 * (4.0 * std::f64::consts::PI * t).sin()).abs() < 1e-12);
        assert!((state.p[0] - 4.0 * t).abs() < 1e-12, "signal and input together");
    }
}
