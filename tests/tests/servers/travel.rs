//! Servers among others: plants go from one to the other, and drivers find them; a server ends without losing a step.

use std::net::TcpListener;
use std::path::Path;
use std::time::Duration;

use plantd_client::{
    Client, Code, ConnectOptions, Credentials, Error, Reconnecting, diagonal, operating_point, v1,
    weights,
};
use plantd_tests::server::ServerProcess;
use v1::fault_spec::{Kind, Start, Target};
use v1::output_channel::Source;

const PATIENCE: Duration = Duration::from_secs(20);

fn named(name: &str, more: &[&str]) -> ServerProcess {
    ServerProcess::start_with(|command| {
        command.args(["--name", name]).args(more);
    })
    .unwrap()
}

/// The input of a step: of nothing but its index.
fn force(k: u64) -> f64 {
    3.0 * (0.17 * k as f64).sin()
}

async fn create(client: &Client, id: &str, model: &str) {
    let (id, model) = (id.to_owned(), model.to_owned());
    let upright = v1::initial_state::Form::OperatingPoint("upright".to_owned());
    let initial = Some(v1::InitialState { form: Some(upright) });
    let request = v1::CreatePlantRequest { id, model, initial, ..Default::default() };
    client.create_plant(request).await.unwrap();
}

/// A cart-pole with a model of its own, another mass, a late and noisy sensor, a late actuator, a fault under way, a
/// feedback and a watchdog.
async fn create_with_everything(client: &Client, id: &str) {
    create(client, id, "cart").await;
    let parameters = vec![v1::Parameter { path: "frames[cart].body.mass".to_owned(), value: 1.3 }];
    let change = v1::SetParametersRequest { id: id.to_owned(), parameters, ..Default::default() };
    client.set_parameters(change).await.unwrap();
    let sensor = v1::OutputChannel {
        name: "angle".to_owned(),
        source: Some(Source::Coordinate("theta".to_owned())),
        latency_s: 0.03,
        noise: 1e-3,
        ..Default::default()
    };
    let actuator =
        v1::InputChannel { input: "force".to_owned(), delay_s: 0.02, ..Default::default() };
    let channels = v1::Channels { outputs: vec![sensor], inputs: vec![actuator], seed: 7 };
    client.set_channels(id, channels).await.unwrap();
    let feedback = v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(v1::set_feedback_request::Reference::Point(operating_point("upright"))),
        weights: Some(weights(diagonal([10.0, 100.0, 1.0, 1.0]), diagonal([0.1]))),
        mode: v1::FeedbackMode::Add.into(),
        ..Default::default()
    };
    client.set_feedback(feedback).await.unwrap();
    let fault = v1::FaultSpec {
        target: Some(Target::Input("force".to_owned())),
        kind: Some(Kind::Noise(v1::ExtraNoise { deviation: 0.2 })),
        start: Some(Start::StartStep(20)),
        duration_s: 2.0,
        ..Default::default()
    };
    client.inject_fault(id, fault).await.unwrap();
    let watchdog =
        v1::Watchdog { quantity: "x".to_owned(), max: Some(100.0), ..Default::default() };
    let safety =
        v1::SetSafetyRequest { id: id.to_owned(), watchdogs: vec![watchdog], ..Default::default() };
    client.set_safety(safety).await.unwrap();
}

fn open(id: &str, grace_s: f64) -> v1::DriveOpen {
    v1::DriveOpen { id: id.to_owned(), grace_s, ..Default::default() }
}

#[tokio::test]
async fn a_plant_with_everything_moves_under_its_driver_bit_for_bit() {
    let (first, second) = (named("lab-1", &[]), named("lab-2", &[]));
    let (here, there) = (first.client().await, second.client().await);
    let scene = here.get_model("cart-pole").await.unwrap().scene_toml;
    let name = "cart".to_owned();
    let upload = v1::CreateModelRequest { scene, name, ..Default::default() };
    here.create_model_as(upload).await.unwrap();
    create_with_everything(&here, "p1").await;
    create_with_everything(&here, "twin").await;
    let before = here.get_plant("p1").await.unwrap().plant.unwrap();
    assert_eq!((&before.server[..], &before.address[..]), ("lab-1", first.address()));

    let mut twin = here.drive("twin").await.unwrap();
    let mut driver = Reconnecting::open(here.clone(), open("p1", 0.0), PATIENCE).await.unwrap();
    for k in 0..300 {
        if k == 60 {
            let moved = here.move_plant("p1", &there, false).await.unwrap();
            assert_eq!((&moved.server[..], &moved.address[..]), ("lab-2", second.address()));
            assert_eq!(moved.state.as_ref().unwrap().step, 60);
        }
        let (a, b) = (driver.step(&[force(k)]).await, twin.step(&[force(k)]).await);
        let (a, b) = (a.unwrap(), b.unwrap());
        assert_eq!(a.state, b.state, "step {k}");
        assert_eq!((&a.u, &a.outputs), (&b.u, &b.outputs), "step {k}");
    }
    assert_eq!(driver.reconnections(), 1);
    driver.close().await.unwrap();

    let refused = here.get_plant("p1").await.unwrap_err();
    assert_eq!(
        (refused.code(), refused.reason()),
        (Some(Code::FailedPrecondition), "PLANT_ELSEWHERE")
    );
    assert_eq!(refused.elsewhere(), Some(second.address()));
    // Whoever knows the old address alone ends at the new one.
    let mut late = Reconnecting::open(here.clone(), open("p1", 0.0), PATIENCE).await.unwrap();
    assert_eq!(late.step(&[0.0]).await.unwrap().state.unwrap().step, 301);
    // A new plant of that id is one of this server.
    create(&here, "p1", "cart-pole").await;
    assert_eq!(here.get_plant("p1").await.unwrap().plant.unwrap().server, "lab-1");
}

#[tokio::test]
async fn a_plant_that_cannot_move_stays_as_it_is() {
    let (first, second) = (named("a", &[]), named("b", &["--limit", "plants=1"]));
    let (here, there) = (first.client().await, second.client().await);
    create(&here, "p1", "cart-pole").await;
    create(&there, "full", "cart-pole").await;
    let refused = here.move_plant("p1", &there, false).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::ResourceExhausted));
    // It was in lockstep, and is.
    assert!(here.step(one_step("p1")).await.is_ok());
    let export = v1::ExportPlantRequest { id: "p1".to_owned(), pause: false };
    let exported = here.export_plant(export).await.unwrap();
    assert_eq!(exported.step, 1);

    // A damaged record makes nothing; nor does one of another build, unless that is asked for.
    there.delete_plant("full").await.unwrap();
    let make = async |record: Vec<u8>, any_build| {
        let request = v1::CreatePlantRequest { record, any_build, ..Default::default() };
        there.create_plant(request).await
    };
    let mut damaged = exported.record.clone();
    damaged[40] ^= 1;
    let refused = make(damaged, false).await.unwrap_err();
    assert_eq!((refused.reason(), &refused.violations()[0].field[..]), ("INVALID_FIELD", "record"));
    let other = resealed(&exported.record, |record| record.build = "0.0 other".to_owned());
    assert_eq!(make(other.clone(), false).await.unwrap_err().reason(), "OTHER_BUILD");
    // Half a plant is none: its watchdog is of nothing that it has.
    let broken = resealed(&exported.record, |record| {
        let dog = v1::Watchdog { quantity: "nonsense".to_owned(), ..Default::default() };
        let safety = v1::SafetyInfo { watchdogs: vec![dog], ..Default::default() };
        record.plant.as_mut().unwrap().safety = Some(safety);
    });
    assert!(make(broken, false).await.is_err());
    assert!(there.list_plants().await.unwrap().is_empty());
    assert_eq!(make(other, true).await.unwrap().state.unwrap().step, 1);

    // Deleted only where it was seen.
    let stale = v1::DeletePlantRequest { id: "p1".to_owned(), step: Some(0), ..Default::default() };
    assert_eq!(here.delete_plant_as(stale).await.unwrap_err().reason(), "MOVED_ON");
    let nowhere = v1::DeletePlantRequest {
        id: "p1".to_owned(),
        moved_to: "somewhere else".to_owned(),
        ..Default::default()
    };
    assert_eq!(here.delete_plant_as(nowhere).await.unwrap_err().violations()[0].field, "moved_to");
    assert!(here.step(one_step("p1")).await.is_ok());
}

fn one_step(id: &str) -> v1::StepRequest {
    v1::StepRequest { id: id.to_owned(), hold: 1, ..Default::default() }
}

/// A record that was changed, with its hash.
fn resealed(record: &[u8], change: impl FnOnce(&mut v1::PlantRecord)) -> Vec<u8> {
    use prost::Message as _;
    let (body, _) = record.split_last_chunk::<8>().unwrap();
    let mut changed = v1::PlantRecord::decode(body).unwrap();
    change(&mut changed);
    let mut bytes = changed.encode_to_vec();
    let fnv1a = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
    let hash = bytes.iter().fold(0xcbf2_9ce4_8422_2325, fnv1a);
    bytes.extend(hash.to_le_bytes());
    bytes
}

#[tokio::test]
async fn a_server_that_drains_loses_no_step_and_takes_nothing_new() {
    let mut server = named("ending", &["--drain-s", "20"]);
    let client = server.client().await;
    create(&client, "p1", "cart-pole").await;
    let mut driver = client.drive("p1").await.unwrap();
    let mut k = 0;
    let mut go_on = async |steps: u64| {
        for _ in 0..steps {
            let step = driver.step(&[force(k)]).await.unwrap();
            k += 1;
            assert_eq!(step.state.unwrap().step, k);
        }
    };
    go_on(10).await;
    let refused = client.drain(Some(-1.0)).await.unwrap_err();
    assert_eq!(refused.violations()[0].field, "drain_s");
    assert!(!client.server_info().await.unwrap().draining);
    assert_eq!(client.drain(None).await.unwrap(), 1);
    go_on(10).await;
    let info = client.server_info().await.unwrap();
    assert!(info.draining && info.name == "ending" && info.plants == 1);
    // Connections are still taken, plants and batches are not.
    let another = server.client().await;
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let refused = another.create_plant(request).await.unwrap_err();
    assert_eq!((refused.code(), refused.reason()), (Some(Code::Unavailable), "DRAINING"));
    let batch = v1::RolloutRequest { model: "pendulum".to_owned(), ..Default::default() };
    assert_eq!(another.rollout(batch).await.unwrap_err().reason(), "DRAINING");
    go_on(10).await;
    driver.close().await.unwrap();
    // Nobody drives any more: the end, long before the time is over.
    assert!(server.end().unwrap().success(), "{}", server.log());
}

fn keeping(port: u16, state: &Path) -> ServerProcess {
    ServerProcess::start_with(|command| {
        command.args(["--grpc", &format!("127.0.0.1:{port}"), "--state-interval-s", "0.05"]);
        command.arg("--state-directory").arg(state);
    })
    .unwrap()
}

#[tokio::test]
async fn a_driver_whose_server_is_killed_is_told_what_was_lost() {
    // Bound and dropped: a port that nobody listens on.
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let state = tempfile::tempdir().unwrap();
    let mut server = keeping(port, state.path());
    let client = server.client().await;
    create(&client, "p1", "cart-pole").await;
    let mut driver = Reconnecting::open(client, open("p1", 5.0), PATIENCE).await.unwrap();
    let mut k = 0;
    let mut seen = Vec::new();
    let mut rolled_back = None;
    while k < 400 {
        if seen.len() == 200 && rolled_back.is_none() {
            // Time for a plant to be saved, and steps after it that are not.
            tokio::time::sleep(Duration::from_millis(200)).await;
            for _ in 0..3 {
                seen.push(driver.step(&[force(k)]).await.unwrap().state.unwrap());
                k += 1;
            }
            server.kill().unwrap();
            drop(server);
            server = keeping(port, state.path());
        }
        match driver.step(&[force(k)]).await {
            Ok(step) => {
                seen.push(step.state.unwrap());
                k += 1;
            }
            Err(Error::RolledBack { from, to }) => {
                assert_eq!(from, seen.len() as u64);
                assert!(to >= 150 && rolled_back.is_none(), "{from} {to}");
                rolled_back = Some((from, to));
                seen.truncate(to as usize);
                k = to;
            }
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!(driver.reconnections(), 1);
    driver.close().await.unwrap();

    // What the undisturbed plant does.
    let other = named("other", &[]);
    let client = other.client().await;
    create(&client, "p1", "cart-pole").await;
    let mut undisturbed = client.drive("p1").await.unwrap();
    for (k, state) in seen.iter().enumerate() {
        let step = undisturbed.step(&[force(k as u64)]).await.unwrap();
        assert_eq!(step.state.as_ref(), Some(state), "step {k}");
    }
}

#[tokio::test]
async fn a_restarted_server_has_the_plant_at_the_very_step() {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let state = tempfile::tempdir().unwrap();
    let mut server = ServerProcess::start_with(|command| {
        command.args(["--grpc", &format!("127.0.0.1:{port}"), "--drain-s", "0"]);
        command.arg("--state-directory").arg(state.path());
    })
    .unwrap();
    let client = server.client().await;
    create(&client, "p1", "cart-pole").await;
    let mut driver = Reconnecting::open(client, open("p1", 5.0), PATIENCE).await.unwrap();
    for k in 0..100 {
        if k == 50 {
            assert!(server.stop().unwrap().success());
            server = keeping(port, state.path());
        }
        let step = driver.step(&[force(k)]).await.unwrap();
        assert_eq!(step.state.unwrap().step, k + 1);
    }
    assert_eq!(driver.reconnections(), 1);
}

#[tokio::test]
async fn a_token_is_not_carried_into_the_open() {
    let server = named("here", &[]);
    let credentials = Credentials { token: Some("secret".to_owned()), ..Default::default() };
    let options = ConnectOptions { credentials, ..Default::default() };
    let socket = Client::connect_with(server.unix_address(), options.clone()).await.unwrap();
    // Nobody has to listen there: it is not tried.
    let refused = socket.at("http://192.0.2.1:50051").await.unwrap_err();
    assert!(matches!(refused, Error::Address { .. }), "{refused}");
    assert!(socket.at(server.unix_address()).await.is_ok());
    // What went in clear may go on in clear.
    let open = Client::connect_with(server.address(), options).await.unwrap();
    assert!(open.at(server.address()).await.is_ok());
}
