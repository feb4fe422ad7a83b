//! Requests that cannot be met.

use plantd_client::{Code, MatrixExt as _, diagonal, operating_point, v1};

use crate::support::*;

#[tokio::test]
async fn a_malformed_scene_is_refused_with_all_its_errors() {
    let (_server, client) = server().await;
    let scene = r#"
        format = 1
        name = "faulty"
        gravity = [0.0, nan, 0.0]

        [[frames]]
        name = "arm"
        joint = { type = "revolute", axis = [0.0, 0.0, 0.0] }
        body = { mass = -1.0 }

        [[frames]]
        name = "hand"
        parent = "elbow"

        [[inputs]]
        name = "torque"
        coordinate = "shoulder"
    "#;
    let expected = [
        "gravity[1]",
        "frames[0].joint.axis",
        "frames[0].body.mass",
        "frames[1].parent",
        "inputs[0].coordinate",
    ];
    let checked = client.validate_scene(scene).await.unwrap();
    assert!(checked.model.is_none());
    let paths: Vec<_> = checked.problems.iter().map(|p| p.path.as_str()).collect();
    for path in expected {
        assert!(paths.contains(&path), "no `{path}` among {paths:?}");
        let created = client.create_model(scene).await;
        assert_refused(created, Code::InvalidArgument, "INVALID_SCENE", path);
    }
    let error = client.create_model(scene).await.unwrap_err();
    let fields: Vec<_> = error.violations().iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, paths, "validation and creation see the same errors");
}

#[tokio::test]
async fn a_scene_that_cannot_be_read_names_the_place() {
    let (_server, client) = server().await;
    for (scene, path) in [
        ("format = 1\nname = [", ""),
        ("{ \"format\": 1, \"name\": \"x\", \"frames\": [{\"name\": 3}] }", "frames[0].name"),
        ("format = 1\nname = \"x\"\nmass = 2\nframes = []", "mass"),
    ] {
        let answer = client.validate_scene(scene).await.unwrap();
        assert_eq!(answer.problems.len(), 1, "{:?}", answer.problems);
        assert_eq!(answer.problems[0].path, path);
        assert!(!answer.problems[0].message.is_empty());
    }
    let request = v1::CreateModelRequest { format: 77, ..Default::default() };
    assert_bad_field(client.create_model_as(request).await, "format");
}

#[tokio::test]
async fn unknown_models_are_not_found_by_any_call() {
    let (_server, client) = server().await;
    let model = || "perpetuum-mobile".to_owned();
    let reason = "MODEL_NOT_FOUND";
    assert_not_found(client.get_model(model()).await, reason);
    assert_not_found(client.get_model("chain-01").await, reason);
    assert_not_found(client.get_model("chain-99999").await, reason);
    assert_not_found(client.delete_model(model()).await, reason);
    let request = v1::CreatePlantRequest { model: model(), ..Default::default() };
    assert_not_found(client.create_plant(request).await, reason);
    let request = v1::LinearizeRequest { model: model(), ..Default::default() };
    assert_not_found(client.linearize(request).await, reason);
    let request = v1::SolveLqrRequest { model: model(), ..Default::default() };
    assert_not_found(client.solve_lqr(request).await, reason);
    let request = v1::LinearizeTrajectoryRequest { model: model(), ..Default::default() };
    assert_not_found(opened(client.linearize_trajectory(request).await).await, reason);
    let request = v1::SolveTrajectoryLqrRequest { model: model(), ..Default::default() };
    assert_not_found(opened(client.solve_trajectory_lqr(request).await).await, reason);
    let request = v1::RolloutRequest { model: model(), ..Default::default() };
    assert_not_found(opened(client.rollout(request).await).await, reason);
}

/// The first message of a stream; a refusal may come as the call's status or as the stream's end.
async fn opened<T>(
    stream: plantd_client::Result<plantd_client::Answers<T>>,
) -> plantd_client::Result<Option<T>> {
    soon(stream?.next()).await
}

#[tokio::test]
async fn unknown_plants_are_not_found_by_any_call() {
    let (_server, client) = server().await;
    let id = || "nobody".to_owned();
    let reason = "PLANT_NOT_FOUND";
    assert_not_found(client.get_plant(id()).await, reason);
    assert_not_found(client.delete_plant(id()).await, reason);
    let request = v1::StepRequest { id: id(), hold: 1, ..Default::default() };
    assert_not_found(client.step(request).await, reason);
    assert_not_found(client.drive(id()).await, reason);
    let fields = vec![v1::WatchField::State.into()];
    let request = v1::WatchRequest { id: id(), fields, ..Default::default() };
    assert_not_found(opened(client.watch(request).await).await, reason);
    assert_not_found(client.reset(id()).await, reason);
    assert_not_found(client.snapshot(id()).await, reason);
    assert_not_found(client.restore(id(), vec![1, 2, 3]).await, reason);
    assert_not_found(client.open_link(id()).await, reason);
}

#[tokio::test]
async fn names_that_are_malformed_or_taken_are_refused() {
    let (_server, client) = server().await;
    let model = |name: &str| v1::CreateModelRequest {
        name: name.to_owned(),
        scene: TWO_PENDULUMS.to_owned(),
        ..Default::default()
    };
    let plant = |id: &str| v1::CreatePlantRequest {
        id: id.to_owned(),
        model: "pendulum".to_owned(),
        ..Default::default()
    };
    for bad in ["Upper", "with space", "../etc", &"x".repeat(64), "ä"] {
        assert_bad_field(client.create_model_as(model(bad)).await, "name");
        assert_bad_field(client.create_plant(plant(bad)).await, "id");
    }
    client.create_model_as(model("mine")).await.unwrap();
    client.create_plant(plant("mine")).await.unwrap();
    for taken in ["mine", "pendulum", "chain-7"] {
        let again = client.create_model_as(model(taken)).await;
        assert_refused(again, Code::AlreadyExists, "MODEL_EXISTS", "");
    }
    let again = client.create_plant(plant("mine")).await;
    assert_refused(again, Code::AlreadyExists, "PLANT_EXISTS", "");
    let builtin = client.delete_model("pendulum").await;
    assert_refused(builtin, Code::FailedPrecondition, "BUILTIN_MODEL", "");
}

#[tokio::test]
async fn initial_states_are_checked() {
    use v1::initial_state::{Form, Momentum, Projection, TwoConfigurations};
    let (_server, client) = server().await;
    let create = async |model: &str, form: Form| {
        let request = v1::CreatePlantRequest {
            model: model.to_owned(),
            initial: Some(v1::InitialState { form: Some(form) }),
            ..Default::default()
        };
        client.create_plant(request).await
    };
    let momentum = |q: &[f64], p: &[f64]| {
        Form::Momentum(Momentum { q: q.to_vec(), p: p.to_vec(), v: Vec::new() })
    };
    assert_bad_field(create("pendulum", momentum(&[], &[0.0])).await, "initial.q");
    assert_bad_field(create("pendulum", momentum(&[0.0], &[0.0, 0.0])).await, "initial.p");
    assert_bad_field(create("pendulum", momentum(&[f64::NAN], &[0.0])).await, "initial.q[0]");
    let infinite = momentum(&[0.0], &[f64::NEG_INFINITY]);
    assert_bad_field(create("pendulum", infinite).await, "initial.p[0]");
    let pair = TwoConfigurations { q0: vec![0.0], q1: vec![0.0, 1.0] };
    assert_bad_field(create("pendulum", Form::TwoConfigurations(pair)).await, "initial.q1");
    let point = Form::OperatingPoint("sideways".to_owned());
    assert_bad_field(create("pendulum", point).await, "initial");
    let hold = Projection { q: vec![0.0; 3], hold: vec!["piston".to_owned()] };
    assert_bad_field(create("four-bar", Form::Projection(hold)).await, "initial");
    let off = create("four-bar", momentum(&[0.0; 3], &[0.0; 3])).await;
    assert_refused(off, Code::InvalidArgument, "OFF_CONSTRAINT", "initial");
    let garbage = create("pendulum", Form::Snapshot(vec![1, 2, 3])).await;
    assert_refused(garbage, Code::InvalidArgument, "INVALID_SNAPSHOT", "snapshot");
    assert!(client.list_plants().await.unwrap().is_empty(), "a refused plant is not kept");
}

#[tokio::test]
async fn settings_are_checked() {
    let (_server, client) = server().await;
    let create = async |settings: v1::PlantSettings| {
        let request = v1::CreatePlantRequest {
            model: "pendulum".to_owned(),
            settings: Some(settings),
            ..Default::default()
        };
        client.create_plant(request).await
    };
    for time_step_s in [-0.1, f64::NAN, f64::INFINITY] {
        let settings = v1::PlantSettings { time_step_s, ..Default::default() };
        assert_bad_field(create(settings).await, "settings.time_step_s");
    }
    let settings = v1::PlantSettings { force_split: 9, ..Default::default() };
    assert_bad_field(create(settings).await, "settings.force_split");
}

#[tokio::test]
async fn inputs_of_a_step_are_checked() {
    let (_server, client) = server().await;
    let plant = plant(&client, "pendulum").await;
    let step = async |u: Option<v1::Matrix>| {
        client.step(v1::StepRequest { id: plant.id.clone(), u, ..Default::default() }).await
    };
    assert_bad_field(step(None).await, "u");
    assert_bad_field(step(Some(v1::Matrix::from_rows(&[[0.0, 0.0]]))).await, "u.cols");
    let torn = v1::Matrix { rows: 2, cols: 1, data: vec![0.0] };
    assert_bad_field(step(Some(torn)).await, "u.data");
    let huge = v1::Matrix { rows: u32::MAX, cols: u32::MAX, data: vec![0.0] };
    assert_bad_field(step(Some(huge)).await, "u.data");
    for number in [f64::NAN, f64::INFINITY] {
        let late = v1::Matrix::from_rows(&[[0.0], [number]]);
        assert_bad_field(step(Some(late)).await, "u.data[1]");
    }
    let state = client.get_plant(&plant.id).await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(bits(&state), bits(plant.state.as_ref().unwrap()), "the plant is where it was");
}

#[tokio::test]
async fn points_and_weights_are_checked() {
    let (_server, client) = server().await;
    let solve = async |point: Option<v1::Point>, q: Option<v1::Weight>, r: Option<v1::Weight>| {
        let request = v1::SolveLqrRequest {
            model: "pendulum".to_owned(),
            point,
            weights: Some(v1::LqrWeights { q, r, ..Default::default() }),
            ..Default::default()
        };
        client.solve_lqr(request).await
    };
    let upright = || Some(operating_point("upright"));
    let q = || Some(diagonal([1.0, 1.0]));
    let r = || Some(diagonal([1.0]));
    let full = |rows: &[[f64; 2]]| {
        let matrix = v1::Matrix::from_rows(rows);
        Some(v1::Weight { form: Some(v1::weight::Form::Full(matrix)) })
    };

    assert_bad_field(solve(None, q(), r()).await, "point");
    let nowhere = Some(operating_point("sideways"));
    assert_bad_field(solve(nowhere, q(), r()).await, "point.operating_point");
    assert_bad_field(solve(upright(), None, r()).await, "weights.q");
    let long = Some(diagonal([1.0; 3]));
    assert_bad_field(solve(upright(), long, r()).await, "weights.q.diagonal");
    assert_bad_field(solve(upright(), full(&[[1.0, 0.0]]), r()).await, "weights.q.full");
    let nan = Some(diagonal([f64::NAN]));
    assert_bad_field(solve(upright(), q(), nan).await, "weights.r.diagonal[0]");

    let invalid = (Code::InvalidArgument, "INVALID_WEIGHT");
    for (bad_q, bad_r, field) in [
        (full(&[[1.0, 2.0], [0.0, 1.0]]), r(), "weights.q"),
        (Some(diagonal([1.0, -1.0])), r(), "weights.q"),
        (q(), Some(diagonal([0.0])), "weights.r"),
        (q(), Some(diagonal([-1.0])), "weights.r"),
    ] {
        assert_refused(solve(upright(), bad_q, bad_r).await, invalid.0, invalid.1, field);
    }

    let request = v1::SolveLqrRequest {
        model: "pendulum".to_owned(),
        point: upright(),
        weights: Some(unit_weights(2, 1)),
        constraints: 42,
        ..Default::default()
    };
    assert_bad_field(client.solve_lqr(request).await, "constraints");
}

#[tokio::test]
async fn regulators_that_do_not_exist_say_why() {
    let (_server, client) = server().await;
    client.create_model(TWO_PENDULUMS).await.unwrap();
    let solve = async |model: &str, nx: usize, nu: usize| {
        let request = v1::SolveLqrRequest {
            model: model.to_owned(),
            point: Some(operating_point("initial")),
            weights: Some(unit_weights(nx, nu)),
            ..Default::default()
        };
        client.solve_lqr(request).await
    };
    let moving = solve("pendulum", 2, 1).await;
    assert_refused(moving, Code::FailedPrecondition, "NOT_AN_EQUILIBRIUM", "");
    let loose = solve("two-pendulums", 4, 1).await;
    assert_refused(loose, Code::FailedPrecondition, "NOT_STABILISABLE", "");
}

#[tokio::test]
async fn trajectories_are_checked_and_failures_say_how_far_they_came() {
    let (_server, client) = server().await;
    let linearize = async |initial: Option<v1::State>, u: v1::Matrix| {
        let request = v1::LinearizeTrajectoryRequest {
            model: "pendulum".to_owned(),
            trajectory: Some(v1::Trajectory { initial, u: Some(u) }),
            ..Default::default()
        };
        match client.linearize_trajectory(request).await {
            Ok(stream) => soon(stream.collect()).await,
            Err(error) => Err(error),
        }
    };
    let wide = v1::Matrix::from_rows(&[[0.0, 0.0]]);
    assert_bad_field(linearize(None, wide).await, "trajectory.u.cols");
    let short = v1::State { q: vec![0.0], ..Default::default() };
    let u = || v1::Matrix::from_rows(&[[0.0]]);
    assert_bad_field(linearize(Some(short), u()).await, "trajectory.initial.p");
    let nan = v1::Matrix::from_rows(&[[f64::NAN]]);
    assert_bad_field(linearize(None, nan).await, "trajectory.u.data[0]");
}

#[tokio::test]
async fn a_trajectory_without_steps_is_no_trajectory() {
    let (_server, client) = server().await;
    for u in [None, Some(v1::Matrix { rows: 0, cols: 1, data: Vec::new() })] {
        let model = || "pendulum".to_owned();
        let trajectory = || Some(v1::Trajectory { initial: None, u: u.clone() });
        let request = v1::LinearizeTrajectoryRequest {
            model: model(),
            trajectory: trajectory(),
            ..Default::default()
        };
        let linearized = opened(client.linearize_trajectory(request).await).await;
        assert_bad_field(linearized, "trajectory.u");
        let request = v1::SolveTrajectoryLqrRequest {
            model: model(),
            trajectory: trajectory(),
            weights: Some(unit_weights(2, 1)),
            ..Default::default()
        };
        let solved = opened(client.solve_trajectory_lqr(request).await).await;
        assert_bad_field(solved, "trajectory.u");
    }
}

#[tokio::test]
async fn snapshots_of_other_models_and_settings_are_refused() {
    let (_server, client) = server().await;
    let pendulum = plant(&client, "pendulum").await;
    let cart = plant(&client, "cart-pole").await;
    let snapshot = client.snapshot(&cart.id).await.unwrap();
    let mismatch = (Code::InvalidArgument, "SNAPSHOT_MISMATCH");
    let restored = client.restore(&pendulum.id, snapshot.clone()).await;
    assert_refused(restored, mismatch.0, mismatch.1, "snapshot");
    let mut damaged = snapshot.clone();
    damaged.truncate(snapshot.len() - 1);
    let restored = client.restore(&cart.id, damaged).await;
    assert_refused(restored, Code::InvalidArgument, "INVALID_SNAPSHOT", "snapshot");
    client.restore(&cart.id, snapshot).await.unwrap();
}

#[tokio::test]
async fn bad_pages_are_refused() {
    let (_server, client) = server().await;
    let request = || v1::ListPlantsRequest { page_size: 0, page_token: "No such!".to_owned() };
    let answer = client.plants().list_plants(request()).await.map_err(Into::into);
    assert_bad_field(answer, "page_token");
    let request = v1::ListModelsRequest { page_size: -1, page_token: String::new() };
    let answer = client.models().list_models(request).await.map_err(Into::into);
    assert_bad_field(answer, "page_size");
}
