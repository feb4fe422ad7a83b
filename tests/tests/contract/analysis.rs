//! Ranks, modes and frequency responses.

use std::f64::consts::TAU;

use plantd_client::{
    Client, Code, MatrixExt as _, StateExt as _, operating_point, present_state, v1,
};

use crate::support::*;

fn analyze(model: &str, point: &str) -> v1::AnalyzeRequest {
    v1::AnalyzeRequest {
        model: model.to_owned(),
        point: Some(operating_point(point)),
        ..Default::default()
    }
}

/// The pendulum swings, hanging, as the midpoint rule says: `2/h atan(w h / 2)` with `w² = g / l`.
#[tokio::test]
async fn the_pendulum_has_the_modes_of_the_textbook() {
    let (_server, client) = server().await;
    let hanging = client.analyze(analyze("pendulum", "hanging")).await.unwrap();
    assert_eq!(
        (hanging.order, hanging.controllability_rank, hanging.observability_rank),
        (2, 2, 2)
    );
    assert_eq!(hanging.outputs, ["theta", "p(theta)"]);
    assert_eq!(hanging.modes.len(), 2);
    let (w, h) = (f64::sqrt(9.8), 0.1);
    let expected = 2.0 / h * (w * h / 2.0).atan() / TAU;
    for mode in &hanging.modes {
        assert!((mode.natural_frequency_hz - expected).abs() < 1e-12, "{mode:?}");
        assert!(mode.damping_ratio.abs() < 1e-12 && (mode.modulus - 1.0).abs() < 1e-14, "{mode:?}");
    }
    let upright = client.analyze(analyze("pendulum", "upright")).await.unwrap();
    let growing = &upright.modes[0];
    let expected = (1.0 + w * h / 2.0) / (1.0 - w * h / 2.0);
    assert!((growing.real - expected).abs() < 1e-12 && growing.imaginary == 0.0, "{growing:?}");
    assert_eq!((growing.damping_ratio, upright.spectral_radius), (-1.0, growing.modulus));
    assert!(growing.time_constant_s < 0.0);
}

#[tokio::test]
async fn only_one_of_two_pendulums_is_reached_and_seen() {
    let (_server, client) = server().await;
    client.create_model(TWO_PENDULUMS).await.unwrap();
    let request = v1::AnalyzeRequest {
        outputs: vec!["right".to_owned()],
        ..analyze("two-pendulums", "initial")
    };
    let answer = client.analyze(request).await.unwrap();
    assert_eq!((answer.order, answer.controllability_rank, answer.observability_rank), (4, 2, 2));
    let request = v1::AnalyzeRequest {
        output_x: Some(v1::Matrix::from_rows(&[[1.0, 0.5, 0.0, 0.0]])),
        frequencies_hz: vec![1.0],
        ..analyze("two-pendulums", "initial")
    };
    let answer = client.analyze(request).await.unwrap();
    assert_eq!((answer.controllability_rank, answer.observability_rank), (2, 2));
    assert_eq!(answer.outputs, ["y0"]);
}

/// On its manifold the marionette has no directions that carry no motion, nor a four-bar.
#[tokio::test]
async fn constraints_take_directions_away() {
    let (_server, client) = server().await;
    let four_bar = client.analyze(analyze("four-bar", "initial")).await.unwrap();
    assert_eq!((four_bar.order, four_bar.controllability_rank, four_bar.modes.len()), (2, 2, 2));
    let full = v1::AnalyzeRequest {
        constraints: v1::ConstraintHandling::Full.into(),
        ..analyze("four-bar", "initial")
    };
    let full = client.analyze(full).await.unwrap();
    assert_eq!((full.order, full.modes.len()), (6, 6));
    assert!(full.modes[2..].iter().all(|mode| mode.modulus < 1e-6), "{:?}", full.modes);
    let marionette = client.analyze(analyze("marionette", "initial")).await.unwrap();
    // 40 coordinates on 6 constraints, 22 momenta modulo 6, 18 velocities; 16 free pairs.
    assert_eq!((marionette.order, marionette.modes.len()), (34 + 16 + 18, 32));
}

/// The response is that of the map: a sinusoid stepped until it is steady.
#[tokio::test]
async fn a_response_is_what_the_plant_does() {
    let (_server, client) = server().await;
    let frequency_hz = 0.7;
    let request = v1::AnalyzeRequest {
        outputs: vec!["theta".to_owned()],
        frequencies_hz: vec![0.0, frequency_hz],
        ..analyze("damped", "hanging")
    };
    let scene = client.get_model("pendulum").await.unwrap().scene_toml;
    let scene = scene
        .replace("\"pendulum\"", "\"damped\"")
        .replace("[[frames]]", "damping = 2.0\n[[frames]]");
    client.create_model(scene).await.unwrap();
    let answer = client.analyze(request).await.unwrap();
    let gain = |k: usize| {
        let r: &v1::FrequencyResponse = &answer.responses[k];
        (r.magnitude.as_ref().unwrap().at(0, 0), r.phase_rad.as_ref().unwrap().at(0, 0))
    };
    // A torque of 1 turns the hanging pendulum by 1 / (m g l).
    assert!((gain(0).0 - 1.0 / 9.8).abs() < 1e-13 && gain(0).1.abs() < 1e-13);

    let (amplitude, h) = (1e-5, 0.1);
    let phase = |k: usize| TAU * frequency_hz * h * k as f64;
    let inputs: Vec<_> = (0..400).map(|k| [amplitude * phase(k).sin()]).collect();
    let plant = client
        .create_plant(v1::CreatePlantRequest {
            model: "damped".to_owned(),
            initial: Some(at_velocity(&[0.0], &[0.0])),
            ..Default::default()
        })
        .await
        .unwrap();
    let request = v1::StepRequest {
        id: plant.id,
        u: Some(v1::Matrix::from_rows(&inputs)),
        all_states: true,
        ..Default::default()
    };
    let states = client.step(request).await.unwrap().states;
    let (magnitude, lag) = gain(1);
    for k in 300..400 {
        let expected = amplitude * magnitude * (phase(k) + lag).sin();
        assert!((states[k - 1].q[0] - expected).abs() < 1e-7 * amplitude, "step {k}");
    }
}

#[tokio::test]
async fn a_plant_is_looked_at_where_it_is() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let step = v1::StepRequest {
        id: id.clone(),
        u: Some(v1::Matrix::from_rows(&[[3.0]; 7])),
        ..Default::default()
    };
    let state = client.step(step).await.unwrap().states.remove(0);
    let here = v1::AnalyzeRequest { point: Some(present_state(&id)), ..Default::default() };
    let answer = client.analyze(here).await.unwrap();
    assert_eq!(bits(answer.state.as_ref().unwrap()), bits(&state));
    assert_eq!(answer.u, [3.0]);

    let request = v1::LinearizeRequest { point: Some(present_state(&id)), ..Default::default() };
    let linearized = client.linearize(request).await.unwrap();
    let mut driver = client.drive_linearized(&id).await.unwrap();
    let step = driver.step(&[3.0]).await.unwrap();
    assert_eq!(linearized.linearization, step.linearization);
    assert_eq!(linearized.next.unwrap().x(), step.state.unwrap().x());
}

#[tokio::test]
async fn bad_requests_name_their_field() {
    let (_server, client) = server_with(&["--limit", "frequencies=3"]).await;
    let changed = |change: &dyn Fn(&mut v1::AnalyzeRequest)| {
        let mut request = analyze("pendulum", "hanging");
        change(&mut request);
        request
    };
    let matrix = |rows: &[[f64; 2]]| Some(v1::Matrix::from_rows(rows));
    let lying = || Some(v1::Matrix { rows: u32::MAX, cols: 0, data: Vec::new() });
    for (request, field) in [
        (changed(&|r| r.outputs = vec!["theta".to_owned(), "phi".to_owned()]), "outputs[1]"),
        (changed(&|r| r.outputs = vec!["theta".to_owned(); 3]), "outputs"),
        (changed(&|r| r.output_x = Some(v1::Matrix::from_rows(&[[1.0; 3]]))), "output_x"),
        (changed(&|r| r.output_x = matrix(&[[1.0, f64::NAN]])), "output_x.data[1]"),
        (changed(&|r| r.output_x = lying()), "output_x.rows"),
        (changed(&|r| r.output_u = matrix(&[[1.0, 1.0]])), "output_u"),
        (
            changed(&|r| {
                r.outputs = vec!["theta".to_owned()];
                r.output_x = matrix(&[[1.0, 0.0]]);
            }),
            "outputs",
        ),
        (
            changed(&|r| {
                r.output_x = matrix(&[[1.0, 0.0]]);
                r.output_u = matrix(&[[1.0, 1.0]]);
            }),
            "output_u",
        ),
        (changed(&|r| r.frequencies_hz = vec![0.1, f64::INFINITY]), "frequencies_hz[1]"),
        (changed(&|r| r.constraints = 99), "constraints"),
        (changed(&|r| r.point = None), "point"),
        (changed(&|r| r.point = Some(operating_point("lying"))), "point.operating_point"),
    ] {
        assert_bad_field(client.analyze(request).await, field);
    }
    let nobody = changed(&|r| r.point = Some(present_state("nobody")));
    assert_not_found(client.analyze(nobody).await, "PLANT_NOT_FOUND");
    let many = changed(&|r| r.frequencies_hz = vec![0.1; 4]);
    let refused = client.analyze(many).await;
    assert!(refused.as_ref().unwrap_err().to_string().contains("frequencies"));
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    assert_pole(&client).await;
}

/// A free slider answers a constant force without end.
async fn assert_pole(client: &Client) {
    let slider = "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"slider\"\n[[frames]]\nname = \"block\"\n\
        joint = { type = \"prismatic\", axis = [1, 0, 0] }\nbody = { mass = 2 }\n\
        [[inputs]]\nname = \"push\"\ncoordinate = \"block\"\n";
    client.create_model(slider).await.unwrap();
    let request = v1::AnalyzeRequest { frequencies_hz: vec![0.0], ..analyze("slider", "initial") };
    let error = client.analyze(request.clone()).await.unwrap_err();
    assert_eq!((error.code(), error.reason()), (Some(Code::FailedPrecondition), "POLE"));
    let request = v1::AnalyzeRequest { frequencies_hz: vec![1e-3], ..request };
    let response = client.analyze(request).await.unwrap().responses.remove(0);
    // Far from the sampling frequency it is 1 / (m w²), in opposite phase.
    let (w, magnitude) = (TAU * 1e-3, response.magnitude.unwrap().at(0, 0));
    assert!((magnitude * 2.0 * w * w - 1.0).abs() < 1e-6, "{magnitude}");
}

/// The response of a velocity is that of its coordinate times the frequency: of the map, the midpoint's.
#[tokio::test]
async fn velocities_are_outputs_of_points_at_rest() {
    let (_server, client) = server().await;
    for (model, point, coordinate) in [
        ("cart-pole", "hanging", "x"),
        ("cart-pole", "upright", "theta"),
        ("four-bar", "rest", "crank"),
    ] {
        let at = client.get_model(model).await.unwrap();
        let frequency = 0.2;
        let request = v1::AnalyzeRequest {
            outputs: vec![coordinate.to_owned(), format!("v({coordinate})")],
            frequencies_hz: vec![frequency],
            ..analyze(model, point)
        };
        let answer = client.analyze(request).await.unwrap();
        assert_eq!(answer.outputs[1], format!("v({coordinate})"));
        let magnitude = answer.responses[0].magnitude.as_ref().unwrap();
        let ratio = magnitude.at(1, 0) / magnitude.at(0, 0);
        let h = at.time_step_s;
        let expected = 2.0 / h * (std::f64::consts::PI * frequency * h).tan();
        assert!((ratio / expected - 1.0).abs() < 1e-3, "{model}: {ratio} is not {expected}");
    }
    let wrong = v1::AnalyzeRequest {
        outputs: vec!["v(tetha)".to_owned()],
        ..analyze("cart-pole", "hanging")
    };
    assert_refused(
        client.analyze(wrong).await,
        Code::InvalidArgument,
        "INVALID_FIELD",
        "outputs[0]",
    );
    let id = plant(&client, "pendulum").await.id;
    let push = v1::StepRequest {
        id: id.clone(),
        u: Some(v1::Matrix::from_rows(&[[1.0]])),
        ..Default::default()
    };
    client.step(push).await.unwrap();
    let moving = v1::AnalyzeRequest {
        model: "pendulum".to_owned(),
        point: Some(present_state(&id)),
        outputs: vec!["v(theta)".to_owned()],
        ..Default::default()
    };
    assert_refused(client.analyze(moving).await, Code::InvalidArgument, "INVALID_FIELD", "outputs");
}
