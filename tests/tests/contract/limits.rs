//! The server's limits.

use plantd_client::{Code, MatrixExt as _, v1};

use crate::support::*;

/// RESOURCE_EXHAUSTED with the limit's name in the message.
#[track_caller]
fn assert_limited<T: std::fmt::Debug>(result: plantd_client::Result<T>, limit: &str) {
    let message = result.as_ref().err().map(ToString::to_string).unwrap_or_default();
    assert_refused(result, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    assert!(message.contains(limit), "{message}");
}

#[tokio::test]
async fn oversized_messages_and_scenes_are_refused() {
    let limits = ["--limit", "message_bytes=20000", "--limit", "scene_bytes=5000"];
    let (_server, client) = server_with(&limits).await;
    assert_limited(client.create_model("#".repeat(6_000)).await, "scene_bytes");
    assert_limited(client.validate_scene("#".repeat(6_000)).await, "scene_bytes");
    assert_limited(client.create_model("#".repeat(30_000)).await, "message_bytes");

    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    assert_limited(driver.step(&[0.0; 5_000]).await, "message_bytes");
    let state = client.get_plant(&id).await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(state.step, 0);
}

#[tokio::test]
async fn no_more_plants_models_and_watchers_than_allowed() {
    let limits = "plants=2,models=1,watchers_per_plant=1";
    let (_server, client) = server_with(&["--limit", limits]).await;
    let id = plant(&client, "pendulum").await.id;
    plant(&client, "pendulum").await;
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    assert_limited(client.create_plant(request).await, "plants");

    client.create_model(TWO_PENDULUMS).await.unwrap();
    let other = TWO_PENDULUMS.replace("two-pendulums", "others");
    assert_limited(client.create_model(other.as_str()).await, "models");
    client.delete_model("two-pendulums").await.unwrap();
    client.create_model(other).await.unwrap();

    let watch =
        v1::WatchRequest { id, fields: vec![v1::WatchField::State.into()], ..Default::default() };
    let _first = client.watch(watch.clone()).await.unwrap();
    let id = watch.id.clone();
    assert_limited(client.watch(watch).await, "watchers_per_plant");
    let first = client.watch_events(&id, None).await.unwrap();
    assert_limited(client.watch_events(&id, None).await, "watchers_per_plant");
    drop(first);
    soon(async { while client.watch_events(&id, None).await.is_err() {} }).await;
}

#[tokio::test]
async fn no_more_work_in_one_call_than_allowed() {
    let limits = "steps_per_call=10,horizon=10,rollout_cases=2,max_iterations=50,max_substeps=4,\
                  stage_coordinates=9";
    let (_server, client) = server_with(&["--limit", limits]).await;
    let id = plant(&client, "pendulum").await.id;
    let step = |hold| v1::StepRequest { id: id.clone(), hold, ..Default::default() };
    client.step(step(10)).await.unwrap();
    assert_limited(client.step(step(11)).await, "steps_per_call");
    assert_limited(client.step(step(u32::MAX)).await, "steps_per_call");

    let request = v1::LinearizeTrajectoryRequest {
        model: "pendulum".to_owned(),
        trajectory: Some(v1::Trajectory {
            initial: None,
            u: Some(v1::Matrix::from_rows(&[[0.0]; 11])),
        }),
        ..Default::default()
    };
    let answer = match client.linearize_trajectory(request).await {
        Ok(stream) => stream.collect().await,
        Err(error) => Err(error),
    };
    assert_limited(answer, "horizon");

    let cases = |count: usize, hold| v1::RolloutRequest {
        model: "pendulum".to_owned(),
        cases: vec![v1::RolloutCase { hold, ..Default::default() }; count],
        ..Default::default()
    };
    for (request, limit) in [(cases(3, 1), "rollout_cases"), (cases(1, 11), "horizon")] {
        let answer = match client.rollout(request).await {
            Ok(stream) => stream.collect().await,
            Err(error) => Err(error),
        };
        assert_limited(answer, limit);
    }

    let create = async |settings| {
        let request = v1::CreatePlantRequest {
            model: "double-pendulum".to_owned(),
            settings: Some(settings),
            ..Default::default()
        };
        client.create_plant(request).await
    };
    let settings = v1::PlantSettings { max_iterations: 51, ..Default::default() };
    assert_limited(create(settings).await, "max_iterations");
    let settings = |order, substeps| v1::PlantSettings { order, substeps, ..Default::default() };
    create(settings(8, 4)).await.unwrap();
    assert_limited(create(settings(8, 5)).await, "max_substeps");
    assert_limited(create(settings(12, 4)).await, "stage_coordinates");
}
