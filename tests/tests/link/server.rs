//! The shared-memory link of a real server beside gRPC: the same motion over both, one lease, and
//! recovery from a server that is killed.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use plantd_client::link::{LeaseHolder, LinkDriver, LinkError, StateView};
use plantd_client::{Client, Code, v1};
use plantd_models::{Plant, Snapshot};
use plantd_tests::links::{
    PATIENCE, files_of_links, new_plant_of_order, patient, wait_until, wiggle,
};
use plantd_tests::server::ServerProcess;

/// Models with and without inputs, prescribed coordinates and constraints, and orders.
const PLANTS: &[(&str, u32)] = &[
    ("pendulum", 2),
    ("spherical-pendulum", 2),
    ("four-bar", 2),
    ("marionette", 2),
    ("cart-pole", 6),
    ("marionette", 6),
];

/// A root path that outlives servers.
fn new_root() -> (tempfile::TempDir, PathBuf) {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    (directory, root)
}

fn start_server(root: &Path) -> ServerProcess {
    ServerProcess::start_with(|command| {
        command.arg("--link-root").arg(root);
    })
    .unwrap()
}

async fn create_plant(client: &Client, id: &str, model: &str, open_link: bool) {
    create_plant_of_order(client, id, (model, 2), open_link).await;
}

async fn create_plant_of_order(
    client: &Client,
    id: &str,
    (model, order): (&str, u32),
    open_link: bool,
) {
    let request = v1::CreatePlantRequest {
        id: id.to_owned(),
        model: model.to_owned(),
        settings: Some(v1::PlantSettings { order, ..Default::default() }),
        open_link,
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    assert_eq!(plant.link_open, open_link);
}

/// Calls of the synchronous driver leave the runtime alone.
fn connect(plant: &str, root: &Path) -> Result<LinkDriver, LinkError> {
    tokio::task::block_in_place(|| LinkDriver::connect(plant, patient(root)))
}

type Bits = (u64, Vec<u64>);

fn bits<'a>(step: u64, parts: [&'a [f64]; 5]) -> Bits {
    (step, parts.into_iter().flatten().map(|value: &'a f64| value.to_bits()).collect())
}

fn bits_of_plant(plant: &mut Plant) -> Bits {
    let velocity = plant.velocity();
    bits(plant.step_index(), [plant.q(), plant.p(), plant.v(), plant.multipliers(), &velocity])
}

fn bits_of_view(view: StateView<'_>) -> Bits {
    bits(view.step, [view.q, view.p, view.v, view.multipliers, view.velocity])
}

fn bits_of_message(state: &v1::State) -> Bits {
    bits(state.step, [&state.q, &state.p, &state.v, &state.multipliers, &state.velocity])
}

#[tokio::test(flavor = "multi_thread")]
async fn in_process_over_shared_memory_and_over_grpc_the_motion_is_the_same_bit_for_bit() {
    let (_directory, root) = new_root();
    let mut server = start_server(&root);
    let client = server.client().await;
    for &(model, order) in PLANTS {
        let ids = ["link", "drive", "step"].map(|way| format!("{model}-{order}-{way}"));
        for (id, open_link) in ids.iter().zip([true, false, false]) {
            create_plant_of_order(&client, id, (model, order), open_link).await;
        }
        let mut plant = new_plant_of_order(model, order).unwrap();
        let mut link = connect(&ids[0], &root).unwrap();
        let mut stream = client.drive(&ids[1]).await.unwrap();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        for k in 0..60 {
            wiggle(&plant, k, &mut u);
            plant.step(&u).unwrap();
            let expected = bits_of_plant(&mut plant);
            assert_eq!(
                bits_of_view(link.step(&u).unwrap()),
                expected,
                "{model} of order {order}, {k}, link"
            );
            let step = stream.step(&u).await.unwrap();
            assert_eq!(
                bits_of_message(&step.state.unwrap()),
                expected,
                "{model} of order {order}, {k}, stream"
            );
            let row = v1::Matrix { rows: 1, cols: u.len() as u32, data: u.clone() };
            let request =
                v1::StepRequest { id: ids[2].clone(), u: Some(row), ..Default::default() };
            let stepped = client.step(request).await.unwrap();
            assert_eq!(
                bits_of_message(&stepped.states[0]),
                expected,
                "{model} of order {order}, {k}, call"
            );
        }

        // A snapshot of the plant on the link goes on in process, over the link and over gRPC.
        let snapshot = client.snapshot(&ids[0]).await.unwrap();
        drop(link);
        stream.close().await.unwrap();
        let mut plant = new_plant_of_order(model, order).unwrap();
        plant.restore(&Snapshot::from_bytes(&snapshot).unwrap()).unwrap();
        let restored = format!("{model}-{order}-restored");
        create_plant_of_order(&client, &restored, (model, order), true).await;
        let state = client.restore(&restored, snapshot.clone()).await.unwrap();
        assert_eq!(bits_of_message(&state), bits_of_plant(&mut plant));
        when_free(|| client.restore(&ids[1], snapshot.clone())).await;
        let mut link = connect(&restored, &root).unwrap();
        assert_eq!(bits_of_view(link.state()), bits_of_plant(&mut plant));
        let mut stream = client.drive(&ids[1]).await.unwrap();
        for k in 60..90 {
            wiggle(&plant, k, &mut u);
            plant.step(&u).unwrap();
            let expected = bits_of_plant(&mut plant);
            assert_eq!(
                bits_of_view(link.step(&u).unwrap()),
                expected,
                "{model} of order {order}, {k}, link"
            );
            let step = stream.step(&u).await.unwrap();
            assert_eq!(
                bits_of_message(&step.state.unwrap()),
                expected,
                "{model} of order {order}, {k}, stream"
            );
        }
    }
    assert!(server.stop().unwrap().success());
    assert_eq!(files_of_links(&root).unwrap(), Vec::<PathBuf>::new());
}

/// The same seed gives the same outputs over shared memory and over gRPC.
#[tokio::test(flavor = "multi_thread")]
async fn channels_deliver_the_same_over_both_links() {
    let (_directory, root) = new_root();
    let server = start_server(&root);
    let client = server.client().await;
    let source = |name: &str| v1::output_channel::Source::Coordinate(name.to_owned());
    let output = |name: &str, latency_s: f64| v1::OutputChannel {
        name: name.to_owned(),
        source: Some(source("theta")),
        latency_s,
        noise: 0.1,
        drop_out: 0.3,
        ..Default::default()
    };
    let input = v1::InputChannel { input: "tau".to_owned(), delay_s: 0.3, ..Default::default() };
    let channels = v1::Channels {
        outputs: vec![output("now", 0.0), output("late", 0.5)],
        inputs: vec![input],
        seed: 7,
    };
    for id in ["grpc", "link"] {
        create_plant(&client, id, "pendulum", true).await;
    }
    // A link that is in use takes channels, too.
    let mut link = connect("link", &root).unwrap();
    assert!(link.step(&[0.0]).unwrap().outputs.is_empty());
    let mut driver = client.drive("grpc").await.unwrap();
    driver.step(&[0.0]).await.unwrap();
    for id in ["grpc", "link"] {
        client.set_channels(id, channels.clone()).await.unwrap();
    }
    let mut lost = 0;
    for k in 0..100 {
        let u = [(0.1 * f64::from(k)).sin()];
        let answer = driver.step(&u).await.unwrap();
        let view = link.step(&u).unwrap();
        let outputs = answer.outputs.unwrap();
        let bits = |y: &[f64]| y.iter().map(|y| y.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(view.outputs), bits(&outputs.y), "step {k}");
        let flags = [0, 1].map(|channel| f64::from(u8::from(outputs.lost.contains(&channel))));
        assert_eq!(view.lost, flags, "step {k}");
        assert_eq!(bits_of_view(view), bits_of_message(&answer.state.unwrap()));
        lost += outputs.lost.len();
    }
    // 200 samples of probability 0.3: mean 60, deviation 6.5.
    assert!((30..90).contains(&lost), "{lost}");
}

/// Repeats a request until the lease is free: that of a driver which has just left takes a moment to
/// come back.
async fn when_free<T, F>(mut request: impl FnMut() -> F) -> T
where
    F: Future<Output = plantd_client::Result<T>>,
{
    let deadline = Instant::now() + PATIENCE;
    loop {
        match request().await {
            Ok(answer) => return answer,
            Err(error) => assert_eq!(error.reason(), "LEASE_HELD", "{error}"),
        }
        assert!(Instant::now() < deadline, "the lease stays held");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn shared_memory_and_grpc_compete_for_one_lease() {
    let (_directory, root) = new_root();
    let mut server = start_server(&root);
    let client = server.client().await;
    create_plant(&client, "one", "pendulum", false).await;
    let opened = client.open_link("one").await.unwrap();
    assert_eq!((opened.service.as_str(), opened.layout_version), ("plantd/5/one", 5));
    assert_eq!(Path::new(&opened.root_path), root);
    assert_eq!(client.open_link("one").await.unwrap(), opened);

    let mut link = connect("one", &root).unwrap();
    let info = client.get_plant("one").await.unwrap().plant.unwrap();
    assert_eq!((info.driver.as_str(), info.link_open), ("link", true));
    let refused = client.drive("one").await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::FailedPrecondition));
    assert_eq!(refused.reason(), "LEASE_HELD");
    assert_eq!(link.step(&[0.1]).unwrap().step, 1);
    drop(link);

    let mut stream = when_free(|| client.drive("one")).await;
    assert_eq!(stream.step(&[0.1]).await.unwrap().state.unwrap().step, 2);
    let refused = connect("one", &root).unwrap_err();
    assert!(matches!(refused, LinkError::LeaseHeld { by: LeaseHolder::Drive }), "{refused}");
    assert!(server.stop().unwrap().success());
}

#[tokio::test(flavor = "multi_thread")]
async fn deleting_a_plant_ends_its_link() {
    let (_directory, root) = new_root();
    let mut server = start_server(&root);
    let client = server.client().await;
    create_plant(&client, "one", "pendulum", true).await;
    create_plant(&client, "other", "pendulum", true).await;
    let mut doomed = connect("one", &root).unwrap();
    let mut other = connect("other", &root).unwrap();
    client.delete_plant("one").await.unwrap();
    let error = doomed.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::Closed { is_deleted: true }), "{error}");
    assert_eq!(other.step(&[0.0]).unwrap().step, 1);
    assert!(server.stop().unwrap().success());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_recovers_from_a_killed_server() {
    let (_directory, root) = new_root();
    let mut server = start_server(&root);
    create_plant(&server.client().await, "one", "pendulum", true).await;
    let mut driver = connect("one", &root).unwrap();
    assert_eq!(driver.step(&[0.1]).unwrap().step, 1);
    let pid = server.pid();
    server.kill().unwrap();
    let error = driver.step(&[0.1]).unwrap_err();
    assert!(matches!(error, LinkError::ServerGone { pid: told } if told == pid), "{error}");

    // The next server comes up over the remains of the first.
    let mut server = start_server(&root);
    create_plant(&server.client().await, "one", "pendulum", true).await;
    let error = driver.step(&[0.1]).unwrap_err();
    assert!(matches!(error, LinkError::ServerRestarted), "{error}");
    tokio::task::block_in_place(|| driver.reconnect()).unwrap();
    assert_eq!(driver.step(&[0.1]).unwrap().step, 1);
    assert!(server.stop().unwrap().success());
    let error = driver.step(&[0.1]).unwrap_err();
    assert!(matches!(error, LinkError::Closed { .. }), "{error}");
    drop(driver);
    wait_until("clean shared memory", || files_of_links(&root).unwrap().is_empty()).unwrap();
}
