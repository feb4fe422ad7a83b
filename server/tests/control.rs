//! `ControlService` and `ModelService` of a real server over TCP.

use futures::TryStreamExt as _;
use plantd_proto::v1;
use plantd_server::config::{Config, Listen};
use plantd_server::serve::RunningServer;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;
use v1::control_service_client::ControlServiceClient;
use v1::model_service_client::ModelServiceClient;
use v1::plant_service_client::PlantServiceClient;

async fn start() -> (RunningServer, Channel) {
    let mut config = Config { grpc: Listen::At(([127, 0, 0, 1], 0).into()), ..Config::default() };
    config.link.enabled = false;
    let server = RunningServer::start(config).await.unwrap();
    let address = server.addresses().grpc.clone().unwrap();
    let channel = Channel::from_shared(address).unwrap().connect().await.unwrap();
    (server, channel)
}

fn reason(status: &Status) -> String {
    status.get_error_details().error_info().map(|info| info.reason.clone()).unwrap_or_default()
}

/// Torques 0, 0.01, 0.02, ...
fn torques(count: u32) -> v1::Matrix {
    v1::Matrix { rows: count, cols: 1, data: (0..count).map(|k| 0.01 * f64::from(k)).collect() }
}

fn trajectory(count: u32) -> v1::Trajectory {
    v1::Trajectory { initial: None, u: Some(torques(count)) }
}

fn weights(q: &[f64], r: &[f64]) -> v1::LqrWeights {
    let diagonal = |values: &[f64]| v1::Weight {
        form: Some(v1::weight::Form::Diagonal(v1::Diagonal { values: values.to_vec() })),
    };
    v1::LqrWeights { q: Some(diagonal(q)), r: Some(diagonal(r)), ..Default::default() }
}

fn at(operating_point: &str) -> v1::Point {
    v1::Point { source: Some(v1::point::Source::OperatingPoint(operating_point.to_owned())) }
}

fn lqr(point: &str, q: &[f64]) -> v1::SolveLqrRequest {
    v1::SolveLqrRequest {
        model: "pendulum".to_owned(),
        point: Some(at(point)),
        weights: Some(weights(q, &[1.0])),
        ..Default::default()
    }
}

#[tokio::test]
async fn rollouts_take_the_very_steps_of_a_plant() {
    const STEPS: u32 = 200;
    let (server, channel) = start().await;
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let mut plants = PlantServiceClient::new(channel.clone());
    let id = plants.create_plant(request).await.unwrap().into_inner().plant.unwrap().id;
    let request = v1::StepRequest {
        id,
        u: Some(torques(STEPS)),
        hold: 10,
        all_states: true,
        ..Default::default()
    };
    let stepped = plants.step(request).await.unwrap().into_inner().states;

    let case =
        v1::RolloutCase { initial: None, u: Some(torques(STEPS)), hold: 10, ..Default::default() };
    let cases = vec![case; 5];
    let request =
        v1::RolloutRequest { model: "pendulum".to_owned(), cases, every: 7, ..Default::default() };
    let answers = ControlServiceClient::new(channel).rollout(request).await.unwrap().into_inner();
    let mut answers: Vec<_> = answers.try_collect().await.unwrap();
    answers.sort_by_key(|answer| answer.case_index);
    let expected: Vec<_> = stepped.into_iter().skip(6).step_by(7).collect();
    assert_eq!(answers.len(), 5);
    for (index, answer) in (0..).zip(answers) {
        assert_eq!((answer.case_index, answer.failure), (index, None));
        assert_eq!(answer.states, expected);
    }
    server.stop().await;
}

#[tokio::test]
async fn one_bad_case_does_not_spoil_the_others() {
    let (server, channel) = start().await;
    let bad = v1::InitialState {
        form: Some(v1::initial_state::Form::OperatingPoint("nowhere".to_owned())),
    };
    let cases = vec![
        v1::RolloutCase { initial: Some(bad), u: None, hold: 3, ..Default::default() },
        v1::RolloutCase { initial: None, u: None, hold: 3, ..Default::default() },
    ];
    let request = v1::RolloutRequest { model: "pendulum".to_owned(), cases, ..Default::default() };
    let answers = ControlServiceClient::new(channel).rollout(request).await.unwrap().into_inner();
    let mut answers: Vec<_> = answers.try_collect().await.unwrap();
    answers.sort_by_key(|answer| answer.case_index);
    let failure = answers[0].failure.as_ref().unwrap();
    assert_eq!((failure.code, failure.reason.as_str()), (3, "INVALID_FIELD"));
    assert_eq!(answers[1].states[0].step, 3);
    server.stop().await;
}

#[tokio::test]
async fn linearizations_stream_in_order_over_several_portions() {
    // The server computes about 30 linearizations of the marionette at a time.
    const STEPS: u32 = 70;
    let (server, channel) = start().await;
    let request = v1::GetModelRequest { name: "marionette".to_owned() };
    let model = ModelServiceClient::new(channel.clone()).get_model(request).await.unwrap();
    let coordinates = model.into_inner().model.unwrap().coordinates;
    let held: Vec<f64> = coordinates.iter().filter(|c| c.prescribed).map(|c| c.initial).collect();
    let u = v1::Matrix { rows: STEPS, cols: held.len() as u32, data: held.repeat(STEPS as usize) };
    let request = v1::LinearizeTrajectoryRequest {
        model: "marionette".to_owned(),
        trajectory: Some(v1::Trajectory { initial: None, u: Some(u) }),
        ..Default::default()
    };
    let mut control = ControlServiceClient::new(channel);
    let points = control.linearize_trajectory(request).await.unwrap().into_inner();
    let points: Vec<_> = points.try_collect().await.unwrap();
    let steps: Vec<u64> =
        points.iter().map(|point| point.linearization.as_ref().unwrap().step).collect();
    assert_eq!(steps, (0..u64::from(STEPS)).collect::<Vec<_>>());
    server.stop().await;
}

#[tokio::test]
async fn gains_come_with_their_reference_first_step_first() {
    const STEPS: u32 = 50;
    let (server, channel) = start().await;
    let request = v1::SolveTrajectoryLqrRequest {
        model: "pendulum".to_owned(),
        trajectory: Some(trajectory(STEPS)),
        weights: Some(weights(&[1.0, 1.0], &[1.0])),
        ..Default::default()
    };
    let mut control = ControlServiceClient::new(channel);
    let gains = control.solve_trajectory_lqr(request).await.unwrap().into_inner();
    let gains: Vec<_> = gains.try_collect().await.unwrap();
    assert_eq!(gains.len(), STEPS as usize + 1);
    let torques = torques(STEPS).data;
    for (k, message) in gains.iter().enumerate() {
        let gain = message.gain.as_ref().unwrap();
        assert_eq!(gain.step, k as u64);
        assert_eq!(gain.x_reference.len(), 2);
        assert_eq!(gain.k.is_some(), k < STEPS as usize);
        assert_eq!(gain.u_reference.first(), torques.get(k));
    }
    server.stop().await;
}

#[tokio::test]
async fn regulators_are_refused_with_their_reasons() {
    let (server, channel) = start().await;
    let mut control = ControlServiceClient::new(channel);
    let good = control.solve_lqr(lqr("upright", &[1.0, 1.0])).await.unwrap().into_inner();
    assert!(good.spectral_radius < 1.0);
    let moving = control.solve_lqr(lqr("initial", &[1.0, 1.0])).await.unwrap_err();
    assert_eq!(
        (moving.code(), reason(&moving).as_str()),
        (Code::FailedPrecondition, "NOT_AN_EQUILIBRIUM")
    );
    let negative = control.solve_lqr(lqr("upright", &[1.0, -1.0])).await.unwrap_err();
    assert_eq!(
        (negative.code(), reason(&negative).as_str()),
        (Code::InvalidArgument, "INVALID_WEIGHT")
    );
    for (request, field) in [
        (lqr("upright", &[1.0]), "weights.q.diagonal"),
        (lqr("upright", &[1.0, f64::NAN]), "weights.q.diagonal[1]"),
        (lqr("nowhere", &[1.0, 1.0]), "point.operating_point"),
    ] {
        let status = control.solve_lqr(request).await.unwrap_err();
        let details = status.get_error_details();
        assert_eq!(details.bad_request().unwrap().field_violations[0].field, field);
    }
    server.stop().await;
}

#[tokio::test]
async fn models_are_listed_page_by_page() {
    let (server, channel) = start().await;
    let mut models = ModelServiceClient::new(channel);
    let scene = models.get_model(v1::GetModelRequest { name: "pendulum".to_owned() }).await;
    let scene = scene.unwrap().into_inner().model.unwrap().scene_toml;
    for name in ["zz", "aa"] {
        let request = v1::CreateModelRequest {
            name: name.to_owned(),
            scene: scene.clone(),
            ..Default::default()
        };
        models.create_model(request).await.unwrap();
    }
    let mut names = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = v1::ListModelsRequest { page_size: 4, page_token };
        let page = models.list_models(request).await.unwrap().into_inner();
        assert!(page.models.len() <= 4);
        names.extend(page.models.into_iter().map(|model| model.name));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    let mut expected: Vec<_> =
        plantd_models::builtin::NAMES.iter().map(|name| (*name).to_owned()).collect();
    expected.sort();
    expected.extend(["aa".to_owned(), "zz".to_owned()]);
    assert_eq!(names, expected);
    server.stop().await;
}
