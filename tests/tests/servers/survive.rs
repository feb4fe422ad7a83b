//! Plants survive their server, ended or killed, and go on bit for bit.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use plantd_client::{Client, MatrixExt as _, diagonal, operating_point, v1, weights};
use plantd_tests::server::ServerProcess;
use prost::Message as _;

const SCENE: &str = r#"
format = 1
name = "arm"
gravity = [0.0, -9.81, 0.0]

[[frames]]
name = "upper"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 2.0, center_of_mass = [0.5, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }

[[inputs]]
name = "torque"
coordinate = "upper"
"#;

fn serve(state: &Path) -> ServerProcess {
    ServerProcess::start_with(|command| {
        command.arg("--state-directory").arg(state).args(["--state-interval-s", "0.05"]);
    })
    .unwrap()
}

async fn step(client: &Client, id: &str, from: u64, count: u64) -> Vec<v1::State> {
    let rows: Vec<_> = (from..from + count).map(|k| vec![(k as f64 * 0.1).sin()]).collect();
    let u = Some(v1::Matrix::from_rows(&rows));
    let request =
        v1::StepRequest { id: id.to_owned(), u, all_states: true, hold: 0, ..Default::default() };
    client.step(request).await.unwrap().states
}

async fn create(client: &Client, id: &str, model: &str) -> v1::PlantInfo {
    let (id, model) = (id.to_owned(), model.to_owned());
    let request = v1::CreatePlantRequest { id, model, ..Default::default() };
    client.create_plant(request).await.unwrap()
}

/// A cart-pole in its own loop, of other gravity and another time step than it began with.
async fn create_changed(client: &Client, id: &str) {
    let upright = v1::initial_state::Form::OperatingPoint("upright".to_owned());
    let request = v1::CreatePlantRequest {
        id: id.to_owned(),
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState { form: Some(upright) }),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
    let gravity = v1::Parameter { path: "gravity[1]".to_owned(), value: -3.25 };
    let change = v1::SetParametersRequest {
        id: id.to_owned(),
        parameters: vec![gravity],
        time_step_s: 0.004,
    };
    client.set_parameters(change).await.unwrap();
    let feedback = v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(v1::set_feedback_request::Reference::Point(operating_point("upright"))),
        weights: Some(weights(diagonal([10.0, 100.0, 1.0, 1.0]), diagonal([0.1]))),
        mode: v1::FeedbackMode::Add.into(),
        ..Default::default()
    };
    client.set_feedback(feedback).await.unwrap();
}

#[tokio::test]
async fn a_server_that_was_ended_has_its_plants_again() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    client.create_model(SCENE).await.unwrap();
    create(&client, "arm", "arm").await;
    let start = client.snapshot("arm").await.unwrap();
    create_changed(&client, "changed").await;
    create(&client, "gone", "pendulum").await;
    for id in ["arm", "changed", "gone"] {
        step(&client, id, 0, 150).await;
    }
    client.delete_plant("gone").await.unwrap();
    let ids = ["arm", "changed"];
    let mut snapshots = Vec::new();
    let mut plants = Vec::new();
    for id in ids {
        snapshots.push(client.snapshot(id).await.unwrap());
        plants.push(client.get_plant(id).await.unwrap().plant.unwrap());
    }
    assert!(server.stop().unwrap().success());

    // What the first server would have gone on with.
    let mut expected = Vec::new();
    for round in 0..2 {
        let mut server = serve(state.path());
        let client = server.client().await;
        assert_eq!(client.list_plants().await.unwrap().len(), 2, "{}", server.log());
        for (i, id) in ids.into_iter().enumerate() {
            if round == 0 {
                assert_eq!(client.snapshot(id).await.unwrap(), snapshots[i], "{id}");
                let plant = client.get_plant(id).await.unwrap().plant.unwrap();
                assert_eq!(plant.parameters, plants[i].parameters);
                assert_eq!(plant.settings, plants[i].settings);
                assert_eq!(plant.state, plants[i].state);
                let mode = |plant: &v1::PlantInfo| plant.feedback.as_ref().map(|f| f.mode());
                assert_eq!(mode(&plant), mode(&plants[i]));
                expected.push(step(&client, id, 150, 50).await);
            } else {
                // The same from the state that the second server has saved.
                client.restore(id, snapshots[i].clone()).await.unwrap();
                assert_eq!(step(&client, id, 150, 50).await, expected[i], "{id}");
            }
        }
        if round == 1 {
            // The model that was uploaded is there, and the state to which a reset returns.
            assert_eq!(client.get_model("arm").await.unwrap().inputs, ["torque"]);
            client.reset("arm").await.unwrap();
            assert_eq!(client.snapshot("arm").await.unwrap(), start);
            client.reset("changed").await.unwrap();
        }
        assert!(server.stop().unwrap().success());
    }
}

/// In a store for many, what is as it was is not written again by each server that starts.
#[tokio::test]
async fn what_nobody_has_changed_is_not_written_again() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    for id in ["still", "stepped"] {
        create_changed(&client, id).await;
        step(&client, id, 0, 10).await;
    }
    assert!(server.stop().unwrap().success());
    let written = |id: &str| {
        let path = state.path().join(id).with_extension("plant");
        std::fs::metadata(path).unwrap().modified().unwrap()
    };
    let before = ["still", "stepped"].map(written);
    let mut server = serve(state.path());
    step(&server.client().await, "stepped", 10, 1).await;
    let deadline = Instant::now() + Duration::from_secs(20);
    while written("stepped") == before[1] {
        assert!(Instant::now() < deadline, "a plant that was stepped is written");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(server.stop().unwrap().success());
    assert_eq!(written("still"), before[0]);
}

#[tokio::test]
async fn the_trajectory_over_a_restart_is_the_uninterrupted_one() {
    let mut whole = Vec::new();
    for is_killed in [None, Some(false), Some(true)] {
        let state = tempfile::tempdir().unwrap();
        let mut server = serve(state.path());
        let mut client = server.client().await;
        create(&client, "free", "cart-pole").await;
        create_changed(&client, "changed").await;
        let ids = ["free", "changed"];
        let mut states = [Vec::new(), Vec::new()];
        for (i, id) in ids.into_iter().enumerate() {
            states[i] = step(&client, id, 0, 100).await;
        }
        if let Some(is_killed) = is_killed {
            for id in ids {
                wait_until_saved(state.path(), id).await;
            }
            if is_killed {
                server.kill().unwrap();
            } else {
                assert!(server.stop().unwrap().success());
            }
            server = serve(state.path());
            client = server.client().await;
        }
        for (i, id) in ids.into_iter().enumerate() {
            // A server that was killed had saved some state, not always the last one.
            let plant = client.get_plant(id).await.unwrap().plant.unwrap();
            let saved = plant.state.unwrap();
            assert!(is_killed == Some(true) || saved.step == 100);
            if let Some(before) = (saved.step as usize).checked_sub(1) {
                assert_eq!(saved, states[i][before]);
            }
            states[i].truncate(saved.step as usize);
            states[i].extend(step(&client, id, saved.step, 200 - saved.step).await);
        }
        match whole.is_empty() {
            true => whole = states.to_vec(),
            false => assert_eq!(states.to_vec(), whole, "killed: {is_killed:?}"),
        }
        drop(server);
    }
}

/// A cart-pole along a trajectory with channels in which much is under way, faults of all kinds, of which
/// some change its parameters, and a watchdog that puts it back.
async fn create_disturbed(client: &Client, id: &str) {
    use v1::fault_spec::{Kind, Pattern, Start, Target};
    let plant = create(client, id, "cart-pole").await;
    let h = plant.settings.unwrap().time_step_s;
    let name = |name: &str| name.to_owned();
    let theta = v1::output_channel::Source::Coordinate(name("theta"));
    let sensor = v1::OutputChannel {
        name: name("angle"),
        source: Some(theta),
        latency_s: 30.0 * h,
        sample_period_s: 4.0 * h,
        noise: 0.1,
        ..Default::default()
    };
    let actuator =
        v1::InputChannel { input: name("force"), delay_s: 40.0 * h, ..Default::default() };
    let channels = v1::Channels { outputs: vec![sensor], inputs: vec![actuator], seed: 9 };
    client.set_channels(id, channels).await.unwrap();
    let blink = |period: f64, kind, target| v1::FaultSpec {
        target,
        kind: Some(kind),
        start: Some(Start::StartS(5.0 * h)),
        pattern: Some(Pattern::Intermittent(v1::Intermittent { period_s: period * h, duty: 0.5 })),
        ..Default::default()
    };
    let point = v1::FramePoint { frame: name("pole"), at: vec![0.0, -1.0, 0.0] };
    let push = v1::Push { point: Some(point), force: vec![1.0, 0.0, 0.0], torque: vec![] };
    let number = |path: &str, value| v1::Parameter { path: path.to_owned(), value };
    let change = |path, value| {
        Kind::Parameters(v1::ParameterChange { parameters: vec![number(path, value)] })
    };
    let delay = Kind::Delay(v1::ExtraDelay { delay_s: 25.0 * h });
    // The first one is gone by the time, and its number is not used again.
    let first = blink(9.0, Kind::Off(true), Some(Target::Input(name("force"))));
    let first = client.inject_fault(id, first).await.unwrap().id;
    for fault in [
        v1::FaultSpec { start: None, ..blink(8.0, delay, Some(Target::Output(name("angle")))) },
        blink(60.0, Kind::Stuck(true), Some(Target::Input(name("force")))),
        blink(14.0, Kind::Push(push), None),
        blink(80.0, change("gravity[1]", -3.0), None),
        blink(56.0, change("frames[pole].translation[1]", 0.2), None),
    ] {
        client.inject_fault(id, fault).await.unwrap();
    }
    client.clear_fault(id, first).await.unwrap();
    let rows: Vec<_> = (0..400).map(|k| vec![2.0 * (0.05 * f64::from(k)).sin()]).collect();
    let trajectory = v1::Trajectory { initial: None, u: Some(v1::Matrix::from_rows(&rows)) };
    let feedback = v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(v1::set_feedback_request::Reference::Trajectory(trajectory)),
        weights: Some(weights(diagonal([1.0; 4]), diagonal([1.0]))),
        mode: v1::FeedbackMode::Add.into(),
        first_step: Some(3),
        ..Default::default()
    };
    client.set_feedback(feedback).await.unwrap();
    let watchdog = v1::Watchdog {
        quantity: name("v(theta)"),
        min: None,
        max: Some(2.0),
        action: v1::WatchdogAction::Reset.into(),
    };
    let watchdogs = vec![watchdog];
    let request = v1::SetSafetyRequest { id: id.to_owned(), watchdogs, ..Default::default() };
    client.set_safety(request).await.unwrap();
}

#[tokio::test]
async fn channels_faults_feedback_and_watchdogs_survive() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    for id in ["whole", "cut"] {
        create_disturbed(&client, id).await;
    }
    let whole = step(&client, "whole", 0, 460).await;
    let resets = whole.iter().filter(|state| state.step == 0).count();
    assert!((1..20).contains(&resets), "{resets} resets");
    let mut cut = Vec::new();
    let mut sets = BTreeSet::new();
    // Within changes of parameters, and between them.
    for (from, count) in [(0, 50), (50, 60), (110, 51), (161, 39), (200, 260)] {
        let client = server.client().await;
        cut.extend(step(&client, "cut", from, count).await);
        let before = everything(&client, "cut").await;
        sets.insert(before.parameters.len());
        assert!(server.stop().unwrap().success());
        server = serve(state.path());
        let client = server.client().await;
        assert_eq!(everything(&client, "cut").await, before, "{}", server.log());
    }
    assert_eq!(cut, whole);
    assert!(sets.len() > 1, "{sets:?}");
    // It is as free as ever.
    let client = server.client().await;
    let plant = async || client.get_plant("cut").await.unwrap().plant.unwrap();
    client.clear_fault("cut", 0).await.unwrap();
    assert!(plant().await.parameters.is_empty());
    let stuck = v1::FaultSpec {
        target: Some(v1::fault_spec::Target::Input("force".to_owned())),
        kind: Some(v1::fault_spec::Kind::Stuck(true)),
        ..Default::default()
    };
    assert_eq!(client.inject_fault("cut", stuck).await.unwrap().id, 7);
    assert_eq!(plant().await.feedback.unwrap().horizon, 400);
}

/// What can be seen of a plant.
#[derive(Debug, PartialEq)]
struct Everything {
    snapshot: Vec<u8>,
    state: Option<v1::State>,
    parameters: Vec<v1::Parameter>,
    faults: Vec<v1::FaultInfo>,
    channels: v1::GetChannelsResponse,
    first_step: u64,
}

async fn everything(client: &Client, id: &str) -> Everything {
    let plant = client.get_plant(id).await.unwrap().plant.unwrap();
    Everything {
        snapshot: client.snapshot(id).await.unwrap(),
        state: plant.state,
        parameters: plant.parameters,
        faults: client.list_faults(id).await.unwrap(),
        channels: client.get_channels(id).await.unwrap(),
        first_step: plant.feedback.unwrap().first_step,
    }
}

/// Watchdogs protect the plant with the next server too, and one that held it still does.
#[tokio::test]
async fn watchdogs_survive() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    let dog = |max, action: v1::WatchdogAction| v1::Watchdog {
        quantity: "x".to_owned(),
        min: None,
        max: Some(max),
        action: action.into(),
    };
    let (freeze, reset) = (v1::WatchdogAction::Freeze, v1::WatchdogAction::Reset);
    for (id, action) in [("frozen", freeze), ("fresh", reset)] {
        create(&client, id, "cart-pole").await;
        let request = v1::SetSafetyRequest {
            id: id.to_owned(),
            watchdogs: vec![dog(0.2, action)],
            on_step_failure: reset.into(),
        };
        client.set_safety(request).await.unwrap();
    }
    let mut driver = client.drive("frozen").await.unwrap();
    while driver.step(&[20.0]).await.is_ok() {}
    driver.close().await.unwrap();
    let mut before = Vec::new();
    for id in ["frozen", "fresh"] {
        before.push(client.get_plant(id).await.unwrap().plant.unwrap());
    }
    assert!(before[0].safety.as_ref().unwrap().frozen.is_some());
    assert!(server.stop().unwrap().success());

    let server = serve(state.path());
    let client = server.client().await;
    for plant in before {
        let now = client.get_plant(&plant.id).await.unwrap().plant.unwrap();
        assert_eq!((now.safety, now.state), (plant.safety, plant.state), "{}", server.log());
    }
    let mut driver = client.drive("frozen").await.unwrap();
    assert_eq!(driver.step(&[0.0]).await.unwrap_err().reason(), "WATCHDOG");
    let mut driver = client.drive("fresh").await.unwrap();
    let mut step = driver.step(&[20.0]).await.unwrap().state.unwrap().step;
    while step != 0 {
        step = driver.step(&[20.0]).await.unwrap().state.unwrap().step;
        assert!(step < 1000, "nothing puts it back");
    }
}

/// Waits until there is a file of a plant that has taken steps: everything before them is in it.
async fn wait_until_saved(state: &Path, id: &str) {
    let path = state.join(id).with_extension("plant");
    let started = Instant::now();
    let has_steps = || {
        let bytes = std::fs::read(&path).ok()?;
        let record = v1::PlantRecord::decode(&bytes[..bytes.len() - 8]).ok()?;
        Some(record.plant?.state?.step > 0)
    };
    while has_steps() != Some(true) {
        assert!(started.elapsed() < Duration::from_secs(30), "{} is not there", path.display());
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn broken_files_are_named_and_left_alone() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    for id in ["a", "b", "c", "d"] {
        create(&client, id, "pendulum").await;
        step(&client, id, 0, 10).await;
    }
    assert!(server.stop().unwrap().success());
    let path = |id: &str| state.path().join(id).with_extension("plant");
    let good = std::fs::read(path("b")).unwrap();
    let mut flipped = good.clone();
    flipped[good.len() / 2] ^= 4;
    std::fs::write(path("b"), &flipped).unwrap();
    std::fs::write(path("c"), &good[..good.len() / 3]).unwrap();
    // Another plant's file.
    std::fs::copy(path("a"), path("d")).unwrap();
    std::fs::write(state.path().join("e.plant"), "").unwrap();
    std::fs::write(state.path().join("f.partial"), "cut").unwrap();

    let mut server = serve(state.path());
    let client = server.client().await;
    let plants = client.list_plants().await.unwrap();
    assert_eq!(plants.iter().map(|plant| plant.id.as_str()).collect::<Vec<_>>(), ["a"]);
    for id in ["b", "c", "d", "e"] {
        let name = format!("{id}.plant");
        let log = server.log();
        assert!(log.lines().any(|l| l.contains("not restored") && l.contains(&name)), "{log}");
    }
    // A new plant of that name lives, but does not take the place of the file.
    create(&client, "b", "pendulum").await;
    step(&client, "b", 0, 3).await;
    assert!(server.stop().unwrap().success());
    assert_eq!(std::fs::read(path("b")).unwrap(), flipped);
    assert_eq!(std::fs::read(path("c")).unwrap(), &good[..good.len() / 3]);
    assert!(server.log().contains("plant not saved"), "{}", server.log());
}

#[tokio::test]
async fn a_plant_that_ran_runs_again_and_one_that_was_paused_does_not() {
    let state = tempfile::tempdir().unwrap();
    let mut server = serve(state.path());
    let client = server.client().await;
    for id in ["runs", "stands", "waits"] {
        create(&client, id, "pendulum").await;
    }
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), speed: 2.0, input: None };
    let request = v1::RunRequest {
        id: "runs".to_owned(),
        settings: Some(settings.clone()),
        steps: 0,
        wait: false,
    };
    client.run(request).await.unwrap();
    step(&client, "stands", 0, 5).await;
    client.pause("stands").await.unwrap();
    assert!(server.stop().unwrap().success());

    let server = serve(state.path());
    let client = server.client().await;
    let plant = async |id: &str| client.get_plant(id).await.unwrap().plant.unwrap();
    let stands = plant("stands").await;
    assert!(!stands.run.unwrap().running);
    assert_eq!(stands.state.unwrap().step, 5);
    // One that waits for its driver does so again.
    assert!(plant("waits").await.run.unwrap().running);
    let mut driver = client.drive("waits").await.unwrap();
    assert_eq!(driver.step(&[0.0]).await.unwrap().state.unwrap().step, 1);
    let first = plant("runs").await;
    let run = first.run.unwrap();
    assert!(run.running);
    let again = run.settings.unwrap();
    assert_eq!((again.pace, again.speed), (settings.pace, settings.speed));
    let started = Instant::now();
    while plant("runs").await.state.unwrap().step <= first.state.as_ref().unwrap().step {
        assert!(started.elapsed() < Duration::from_secs(30), "it does not move");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Each of two servers would overwrite what the other has saved.
#[tokio::test]
async fn a_second_server_on_the_same_directory_is_refused() {
    let state = tempfile::tempdir().unwrap();
    let mut first = serve(state.path());
    let on_it = |command: &mut Command| {
        command.arg("--state-directory").arg(state.path());
    };
    let refused = ServerProcess::start_with(on_it).expect_err("a second server").to_string();
    for part in ["another server", &first.pid().to_string(), state.path().to_str().unwrap()] {
        assert!(refused.contains(part), "{refused}");
    }
    // One that was killed holds nothing.
    first.kill().unwrap();
    assert!(ServerProcess::start_with(on_it).unwrap().stop().unwrap().success());
}

/// As a disk that takes its time.
const SLOW_SYNC: &str = "\
#include <time.h>
int fdatasync(int file) {
    struct timespec a_while = { 0, 40000000 };
    nanosleep(&a_while, 0);
    return (void)file, 0;
}
";

/// One after the other the plants of this test would take 40 s to save.
#[tokio::test]
async fn a_slow_disk_loses_no_plant_at_the_end() {
    const PLANTS: usize = 1000;
    let folder = tempfile::tempdir().unwrap();
    let [state, source, library] =
        ["plants", "slow.c", "slow.so"].map(|name| folder.path().join(name));
    std::fs::write(&source, SLOW_SYNC).unwrap();
    let compiled =
        Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&library, &source]).status();
    assert!(compiled.unwrap().success());
    let serve = |interval: &str, preload: Option<&Path>| {
        ServerProcess::start_with(|command| {
            command.arg("--state-directory").arg(&state).args(["--state-interval-s", interval]);
            command.envs(preload.map(|library| ("LD_PRELOAD", library)));
        })
        .unwrap()
    };
    let mut server = serve("1000", Some(&library));
    let client = server.client().await;
    for i in 0..PLANTS {
        create(&client, &format!("p{i}"), "pendulum").await;
    }
    step(&client, "p0", 0, 10).await;
    assert!(server.stop().unwrap().success(), "{}", server.log());
    let mut server = serve("1000", None);
    let client = server.client().await;
    assert_eq!(client.list_plants().await.unwrap().len(), PLANTS, "{}", server.log());
    let first = client.get_plant("p0").await.unwrap().plant.unwrap();
    assert_eq!(first.state.unwrap().step, 10);
    assert!(server.stop().unwrap().success());
}
