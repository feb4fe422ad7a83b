//! Streams of a real server over TCP: leases, watchers, and how they end.

use std::time::Duration;

use futures::StreamExt as _;
use plantd_proto::v1;
use plantd_server::config::{Config, Listen};
use plantd_server::serve::RunningServer;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{sleep, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt as _;
use v1::drive_request::Request as DriveMessage;
use v1::drive_response::Response as DriveAnswer;
use v1::model_service_client::ModelServiceClient;
use v1::plant_service_client::PlantServiceClient;

/// Bound on every wait.
const PATIENCE: Duration = Duration::from_secs(60);

async fn start(change: impl FnOnce(&mut Config)) -> (RunningServer, Channel) {
    let mut config = Config { grpc: Listen::At(([127, 0, 0, 1], 0).into()), ..Config::default() };
    config.link.enabled = false;
    change(&mut config);
    let server = RunningServer::start(config).await.unwrap();
    let address = server.addresses().grpc.clone().unwrap();
    let channel = Channel::from_shared(address).unwrap().connect().await.unwrap();
    (server, channel)
}

async fn create_pendulum(plants: &mut PlantServiceClient<Channel>) -> String {
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    plants.create_plant(request).await.unwrap().into_inner().plant.unwrap().id
}

async fn step(
    plants: &mut PlantServiceClient<Channel>,
    id: &str,
    hold: u32,
) -> Result<v1::StepResponse, Status> {
    let request = v1::StepRequest { id: id.to_owned(), hold, ..Default::default() };
    plants.step(request).await.map(tonic::Response::into_inner)
}

async fn watch(
    plants: &mut PlantServiceClient<Channel>,
    id: &str,
    every: u32,
) -> Result<Streaming<v1::WatchResponse>, Status> {
    let fields = vec![v1::WatchField::State.into()];
    let request = v1::WatchRequest { id: id.to_owned(), fields, every, ..Default::default() };
    plants.watch(request).await.map(tonic::Response::into_inner)
}

/// A Drive stream with its sending half.
struct Drive {
    inputs: mpsc::Sender<v1::DriveRequest>,
    answers: Streaming<v1::DriveResponse>,
}

impl Drive {
    async fn open(plants: &mut PlantServiceClient<Channel>, id: &str) -> Self {
        let (inputs, requests) = mpsc::channel(4);
        let answers = plants.drive(ReceiverStream::new(requests)).await.unwrap().into_inner();
        let mut drive = Self { inputs, answers };
        let open = v1::DriveOpen { id: id.to_owned(), ..Default::default() };
        drive.send(DriveMessage::Open(open)).await;
        drive
    }

    async fn send(&mut self, message: DriveMessage) {
        self.inputs.send(v1::DriveRequest { request: Some(message) }).await.unwrap();
    }

    async fn answer(&mut self) -> Result<DriveAnswer, Status> {
        let answer = timeout(PATIENCE, self.answers.message()).await.expect("an answer in time");
        Ok(answer?.expect("the stream goes on").response.expect("an answer"))
    }

    async fn step(&mut self, sequence: u64, u: f64) -> DriveAnswer {
        self.send(DriveMessage::Input(v1::DriveInput { sequence, u: vec![u], answers_ns: 0 }))
            .await;
        self.answer().await.unwrap()
    }
}

fn reason(status: &Status) -> String {
    status.get_error_details().error_info().map(|info| info.reason.clone()).unwrap_or_default()
}

/// A step that takes long holds up those who wait for it; the threads on which all calls run do not. Here
/// there is one.
#[tokio::test]
async fn a_plant_that_takes_long_does_not_hold_the_server_up() {
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let mut former = Drive::open(&mut plants, &id).await;
    assert!(matches!(former.answer().await, Ok(DriveAnswer::Opened(_))));
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    let run = v1::RunRequest { id: id.clone(), settings: Some(settings), ..Default::default() };
    plants.run(run).await.unwrap();
    let (begin, has_begun) = oneshot::channel();
    let (end, ending) = std::sync::mpsc::channel();
    let session = server.hub().session(&id).unwrap();
    let long = move || {
        session.with_core(move |_| {
            begin.send(()).unwrap();
            ending.recv_timeout(PATIENCE).is_ok()
        })
    };
    let long = std::thread::spawn(long);
    has_begun.await.unwrap();

    // One driver goes, another one comes.
    drop(former.inputs);
    while timeout(PATIENCE, former.answers.message()).await.unwrap().unwrap().is_some() {}
    let mut drive = Drive::open(&mut plants, &id).await;
    let mut others = plants.clone();
    let clear = v1::ClearFeedbackRequest { id: id.clone() };
    let cleared = tokio::spawn(async move { others.clear_feedback(clear).await });
    for _ in 0..10 {
        plants.get_timing(v1::GetTimingRequest { id: id.clone(), clear: false }).await.unwrap();
    }
    end.send(()).unwrap();
    assert!(long.join().unwrap(), "the server stood still");
    assert!(matches!(drive.answer().await, Ok(DriveAnswer::Opened(_))));
    cleared.await.unwrap().unwrap();
    server.stop().await;
}

#[tokio::test]
async fn a_failed_step_is_answered_in_band_and_the_stream_goes_on() {
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let mut drive = Drive::open(&mut plants, &id).await;
    assert!(matches!(drive.answer().await, Ok(DriveAnswer::Opened(_))));
    let DriveAnswer::Failure(failure) = drive.step(7, f64::NAN).await else {
        panic!("NaN was taken")
    };
    assert_eq!(failure.sequence, 7);
    assert_eq!(failure.failure.unwrap().reason, "INPUT_NOT_FINITE");
    let DriveAnswer::Step(taken) = drive.step(8, 0.1).await else { panic!("no step") };
    assert_eq!((taken.sequence, taken.state.unwrap().step), (8, 1));
    server.stop().await;
}

#[tokio::test]
async fn the_lease_of_a_driver_that_disconnects_is_released() {
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let address = server.addresses().grpc.clone().unwrap();
    let other = Channel::from_shared(address).unwrap().connect().await.unwrap();
    let mut drive = Drive::open(&mut PlantServiceClient::new(other), &id).await;
    drive.answer().await.unwrap();
    let refused = step(&mut plants, &id, 1).await.unwrap_err();
    assert_eq!(
        (refused.code(), reason(&refused).as_str()),
        (Code::FailedPrecondition, "LEASE_HELD")
    );
    drop(drive);
    let released = async {
        while step(&mut plants, &id, 1).await.is_err() {
            sleep(Duration::from_millis(5)).await;
        }
    };
    timeout(PATIENCE, released).await.expect("the lease is released");
    server.stop().await;
}

#[tokio::test]
async fn a_watcher_that_does_not_read_never_blocks_and_its_losses_are_counted() {
    const STEPS: u64 = 50_000;
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel.clone());
    let id = create_pendulum(&mut plants).await;
    let mut stalled = watch(&mut plants, &id, 1).await.unwrap();
    let taken = timeout(PATIENCE, step(&mut plants, &id, STEPS as u32)).await;
    assert_eq!(taken.expect("the plant is not blocked").unwrap().states[0].step, STEPS);
    let mut received = 0;
    let mut before = None;
    let dropped = loop {
        let message = timeout(PATIENCE, stalled.message()).await.expect("in time");
        let message = message.unwrap().expect("the stream goes on");
        received += 1;
        assert!(before.is_none_or(|step| step < message.step), "steps only grow");
        before = Some(message.step);
        if message.step == STEPS {
            break message.dropped;
        }
    };
    // Every state, the first one included, was either delivered or counted as lost.
    assert_eq!(received + dropped, STEPS + 1);
    assert!(dropped > 0, "nothing was lost: the watcher was not too slow");
    server.stop().await;
}

#[tokio::test]
async fn decimation_delivers_the_steps_that_were_asked_for() {
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let mut watcher = watch(&mut plants, &id, 10).await.unwrap();
    for expected in 0..3 {
        let message = timeout(PATIENCE, watcher.message()).await.unwrap().unwrap().unwrap();
        assert_eq!(message.step, 10 * expected);
        step(&mut plants, &id, 10).await.unwrap();
    }
    server.stop().await;
}

#[tokio::test]
async fn streams_of_a_deleted_plant_end_with_not_found() {
    let (server, channel) = start(|_| {}).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let mut watcher = watch(&mut plants, &id, 1).await.unwrap();
    let mut drive = Drive::open(&mut plants, &id).await;
    drive.answer().await.unwrap();
    plants
        .delete_plant(v1::DeletePlantRequest { id: id.clone(), ..Default::default() })
        .await
        .unwrap();
    let driven = drive.answer().await.unwrap_err();
    assert_eq!((driven.code(), reason(&driven).as_str()), (Code::NotFound, "PLANT_DELETED"));
    let watched = timeout(PATIENCE, async {
        loop {
            if let Err(status) = watcher.message().await {
                break status;
            }
        }
    });
    assert_eq!(watched.await.unwrap().code(), Code::NotFound);
    assert_eq!(step(&mut plants, &id, 1).await.unwrap_err().code(), Code::NotFound);
    server.stop().await;
}

#[tokio::test]
async fn shutdown_ends_open_streams_with_unavailable() {
    // The grace is longer than the test's patience: streams must end by themselves.
    let (server, channel) = start(|config| config.shutdown_grace_s = 600.0).await;
    let mut plants = PlantServiceClient::new(channel);
    let id = create_pendulum(&mut plants).await;
    let watcher = watch(&mut plants, &id, 1).await.unwrap();
    let mut drive = Drive::open(&mut plants, &id).await;
    drive.answer().await.unwrap();
    timeout(PATIENCE, server.stop()).await.expect("the server stops");
    let ended = drive.answer().await.unwrap_err();
    assert_eq!((ended.code(), reason(&ended).as_str()), (Code::Unavailable, "SHUTTING_DOWN"));
    let rest: Vec<_> = timeout(PATIENCE, watcher.collect()).await.unwrap();
    assert_eq!(rest.last().unwrap().as_ref().unwrap_err().code(), Code::Unavailable);
}

#[tokio::test]
async fn limits_are_enforced_and_named() {
    let (server, channel) = start(|config| {
        config.limits.watchers_per_plant = 1;
        config.limits.message_bytes = 4096;
        config.limits.plants = 1;
    })
    .await;
    let mut plants = PlantServiceClient::new(channel.clone());
    let id = create_pendulum(&mut plants).await;
    let _first = watch(&mut plants, &id, 1).await.unwrap();
    let watchers = watch(&mut plants, &id, 1).await.unwrap_err();
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let too_many = plants.create_plant(request).await.unwrap_err();
    let request = v1::ValidateSceneRequest { scene: " ".repeat(8192), ..Default::default() };
    let oversized = ModelServiceClient::new(channel).validate_scene(request).await.unwrap_err();
    for (status, limit) in
        [(watchers, "watchers_per_plant"), (too_many, "plants"), (oversized, "message_bytes")]
    {
        assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
        let details = status.get_error_details();
        let info = details.error_info().unwrap();
        assert_eq!(
            (info.reason.as_str(), info.metadata["limit"].as_str()),
            ("LIMIT_EXCEEDED", limit)
        );
    }
    server.stop().await;
}
