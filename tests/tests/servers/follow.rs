//! Streamed gains applied in one call, over gRPC and over shared memory.

use std::f64::consts::PI;
use std::time::Duration;

use plantd_client::link::{LinkDriver, LinkOptions};
use plantd_client::{
    Client, Error, GainExt as _, GainSchedule, MatrixExt as _, diagonal, operating_point, v1,
    weights,
};
use plantd_tests::server::ServerProcess;
use v1::set_feedback_request::Reference;

/// More steps than a follower keeps gains ahead.
const STEPS: usize = 2500;

fn unit_weights() -> v1::LqrWeights {
    weights(diagonal([1.0, 1.0]), diagonal([1.0]))
}

/// A pendulum that swings, and is pushed a little.
fn swinging(initial: v1::State) -> v1::Trajectory {
    let push = |k: usize| [0.2 * (0.05 * k as f64).sin()];
    let rows: Vec<_> = (0..STEPS).map(push).collect();
    v1::Trajectory { initial: Some(initial), u: Some(v1::Matrix::from_rows(&rows)) }
}

fn at(q: f64) -> Option<v1::InitialState> {
    let velocity = v1::initial_state::Velocity { q: vec![q], v: vec![0.0] };
    Some(v1::InitialState { form: Some(v1::initial_state::Form::Velocity(velocity)) })
}

async fn pendulum(client: &Client, q: f64, open_link: bool) -> v1::PlantInfo {
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        initial: at(q),
        open_link,
        ..Default::default()
    };
    client.create_plant(request).await.unwrap()
}

async fn set(client: &Client, id: &str, reference: Reference) -> v1::FeedbackInfo {
    let request = v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(reference),
        weights: Some(unit_weights()),
        ..Default::default()
    };
    client.set_feedback(request).await.unwrap()
}

#[tokio::test]
async fn along_a_trajectory_the_streamed_law_is_the_collected_one() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    let plant = pendulum(&client, 0.5, false).await;
    let trajectory = swinging(plant.state.unwrap());
    let request = v1::SolveTrajectoryLqrRequest {
        model: "pendulum".to_owned(),
        trajectory: Some(trajectory.clone()),
        weights: Some(unit_weights()),
        ..Default::default()
    };
    let answers = client.solve_trajectory_lqr(request).await.unwrap().collect().await.unwrap();
    let gains = answers.into_iter().filter_map(|answer| answer.gain);
    let schedule = GainSchedule::from_gains(gains).unwrap();

    let feedback = set(&client, &plant.id, Reference::Trajectory(trajectory)).await;
    assert_eq!(feedback.horizon as usize, STEPS);
    let law = client.follow_gains(&plant.id).await.unwrap();
    assert_eq!((law.horizon(), law.revision()), (STEPS as u64, feedback.revision));
    for _ in 0..2 {
        // The second time over, the plant has gone back to its first step.
        let request = v1::ResetRequest { id: plant.id.clone(), initial: at(0.6) };
        let mut state = client.reset_to(request).await.unwrap();
        let mut driver = client.drive(&plant.id).await.unwrap();
        for k in 0..STEPS + 10 {
            let u = law.input(&state).await.unwrap();
            assert_eq!(u, schedule.input(&state).unwrap(), "step {k}");
            state = driver.step(&u).await.unwrap().state.unwrap();
        }
        driver.close().await.unwrap();
    }
    assert!(law.end().is_none() && law.failure().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_over_shared_memory_follows_as_well() {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    let server = ServerProcess::start_with(|command| {
        command.arg("--link-root").arg(&root);
    })
    .unwrap();
    let client = server.client().await;
    let plant = pendulum(&client, PI - 0.2, true).await;
    set(&client, &plant.id, Reference::Point(operating_point("upright"))).await;
    let law = client.follow_gains(&plant.id).await.unwrap();
    let patience = Duration::from_secs(30);
    let options =
        LinkOptions { root, timeout: patience, connect_timeout: patience, ..Default::default() };
    let id = plant.id.clone();
    let (law, error) = tokio::task::spawn_blocking(move || {
        let mut driver = LinkDriver::connect(&id, options).unwrap();
        for _ in 0..400 {
            let u = law.blocking_input(&driver.state()).unwrap();
            driver.step(&u).unwrap();
        }
        let error = driver.state().q[0] - PI;
        (law, error)
    })
    .await
    .unwrap();
    assert!(error.abs() < 1e-9, "{error}");

    let state = client.get_plant(&plant.id).await.unwrap().plant.unwrap().state.unwrap();
    client.delete_plant(plant.id).await.unwrap();
    let end = loop {
        match law.input(&state).await {
            Ok(_) => tokio::task::yield_now().await,
            Err(error) => break error,
        }
    };
    assert_eq!(end.reason(), "PLANT_DELETED");
    assert!(law.end().is_some());
}

#[tokio::test]
async fn a_new_computation_replaces_the_gain_in_force() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    let plant = pendulum(&client, PI - 0.2, false).await;
    let state = plant.state.unwrap();
    let refused = client.follow_gains(&plant.id).await.unwrap_err();
    assert_eq!(refused.reason(), "NO_FEEDBACK");
    set(&client, &plant.id, Reference::Point(operating_point("upright"))).await;
    let law = client.follow_gains(&plant.id).await.unwrap();
    let before = law.input(&state).await.unwrap();
    let request = v1::SetParametersRequest {
        id: plant.id.clone(),
        parameters: vec![v1::Parameter { path: "gravity[1]".to_owned(), value: -1.6 }],
        ..Default::default()
    };
    client.set_parameters(request).await.unwrap();
    let soon = async {
        while law.revision() == 1 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), soon).await.expect("a new revision");
    let after = law.input(&state).await.unwrap();
    assert!(after[0].abs() < 0.5 * before[0].abs(), "{before:?}, then {after:?}");
}

/// A law of another time step, model or length is refused before it moves anything, whoever applies it.
#[tokio::test(flavor = "multi_thread")]
async fn a_law_for_another_plant_is_refused() {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    let server = ServerProcess::start_with(|command| {
        command.arg("--link-root").arg(&root);
    })
    .unwrap();
    let client = server.client().await;
    let solve = |model: &str, states: usize| {
        let request = v1::SolveLqrRequest {
            model: model.to_owned(),
            point: Some(operating_point("upright")),
            weights: Some(weights(diagonal(vec![1.0; states]), diagonal([1.0]))),
            ..Default::default()
        };
        let client = client.clone();
        async move { client.solve_lqr(request).await.unwrap().gain.unwrap() }
    };
    let (gain, other) = (solve("pendulum", 2).await, solve("cart-pole", 4).await);
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        settings: Some(v1::PlantSettings {
            time_step_s: 0.5 * gain.time_step_s,
            ..Default::default()
        }),
        initial: at(PI - 0.2),
        open_link: true,
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let state = plant.state.clone().unwrap();
    let nameless = v1::Gain { model: String::new(), time_step_s: 0.0, ..other.clone() };
    let schedule = GainSchedule::from_gains([gain.clone()]).unwrap();

    let mut driver = client.drive(&plant.id).await.unwrap();
    let refused = driver.step_by(&gain, &state).await.unwrap_err();
    assert!(matches!(refused, Error::GainTimeStep { .. }), "{refused}");
    let refused = driver.step_by(&schedule, &state).await.unwrap_err();
    assert!(matches!(refused, Error::GainTimeStep { .. }), "{refused}");
    let refused = driver.step_by(&other, &state).await.unwrap_err();
    assert!(matches!(refused, Error::GainModel { .. }), "{refused}");
    let refused = driver.step_by(&nameless, &state).await.unwrap_err();
    assert!(matches!(refused, Error::StateLength { expected: 4, actual: 2 }), "{refused}");
    let own = v1::Gain { time_step_s: 0.5 * gain.time_step_s, ..gain.clone() };
    let step = driver.step_by(&own, &state).await.unwrap();
    assert_eq!(step.state.unwrap().step, 1, "none of those before has moved it");
    driver.close().await.unwrap();

    // A follower and the plant's own loop.
    set(&client, &plant.id, Reference::Point(operating_point("upright"))).await;
    let law = client.follow_gains(&plant.id).await.unwrap();
    let refused = law.input(&v1::State::default()).await.unwrap_err();
    assert!(matches!(refused, Error::StateLength { expected: 2, actual: 0 }), "{refused}");
    for (field, gain) in
        [("gain.time_step_s", gain.clone()), ("gain.model", other), ("gain.k", nameless)]
    {
        let request = v1::SetFeedbackRequest {
            id: plant.id.clone(),
            reference: Some(Reference::Gain(gain)),
            ..Default::default()
        };
        let refused = client.set_feedback(request).await.unwrap_err();
        assert!(refused.violations()[0].field.starts_with(field), "{refused}");
    }

    // States of the link know their time step.
    let patience = Duration::from_secs(30);
    let options =
        LinkOptions { root, timeout: patience, connect_timeout: patience, ..Default::default() };
    tokio::task::spawn_blocking(move || {
        let driver = LinkDriver::connect(&plant.id, options).unwrap();
        for refused in [gain.control(&driver.state()), schedule.input(&driver.state())] {
            assert!(matches!(refused, Err(Error::GainTimeStep { .. })), "{refused:?}");
        }
        assert_eq!(own.control(&driver.state()).unwrap().len(), 1);
    })
    .await
    .unwrap();
}
