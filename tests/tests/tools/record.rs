//! Recordings of real servers: what is in the files, and that it can be done again bit for bit.

mod players;
mod seen;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use mcap::records::MessageHeader;
use plantd_client::{
    Client, Code, MatrixExt as _, RecordingEntry, RecordingReader, diagonal, operating_point, v1,
    weights,
};
use plantd_tests::server::{ServerProcess, binary};
use prost::Message as _;
use serde_json::Value;

struct Setup {
    server: ServerProcess,
    client: Client,
    recordings: tempfile::TempDir,
}

async fn setup(flags: &[&str]) -> Setup {
    let recordings = tempfile::tempdir().unwrap();
    let server = ServerProcess::start_with(|command| {
        command.arg("--recordings").arg(recordings.path()).args(flags);
    })
    .unwrap();
    let client = server.client().await;
    Setup { server, client, recordings }
}

impl Setup {
    async fn plant(&self, model: &str) -> v1::PlantInfo {
        let request = v1::CreatePlantRequest { model: model.to_owned(), ..Default::default() };
        self.client.create_plant(request).await.unwrap()
    }

    async fn record(&self, id: &str, name: &str) -> v1::Recording {
        let request = v1::StartRecordingRequest {
            id: id.to_owned(),
            name: name.to_owned(),
            checkpoint_interval_s: 0.1,
        };
        self.client.start_recording(request).await.unwrap()
    }

    /// Takes steps with inputs that jump about; the states after them.
    async fn step(&self, id: &str, count: u32, seed: u64) -> Vec<v1::State> {
        let plant = self.client.get_plant(id).await.unwrap().plant.unwrap();
        let model = self.client.get_model(plant.model).await.unwrap();
        let held: Vec<_> = model.coordinates.iter().filter(|c| c.prescribed).collect();
        let row = |k: u64| {
            let forces = (0..model.inputs.len() as u64).map(|i| noise(seed, k, i));
            let near = |(i, c): (u64, &&v1::Coordinate)| c.initial + 1e-3 * noise(seed + 1, k, i);
            forces.chain((0..).zip(&held).map(near)).collect::<Vec<f64>>()
        };
        let rows: Vec<_> = (0..u64::from(count)).map(row).collect();
        let (u, hold) = match rows[0].len() {
            0 => (None, count),
            _ => (Some(v1::Matrix::from_rows(&rows)), 0),
        };
        let request =
            v1::StepRequest { id: id.to_owned(), u, hold, all_states: true, ..Default::default() };
        self.client.step(request).await.unwrap().states
    }

    fn file(&self, name: &str) -> PathBuf {
        self.recordings.path().join(name).with_extension("mcap")
    }
}

/// A number between -1 and 1 from the bits of products.
fn noise(seed: u64, k: u64, i: u64) -> f64 {
    let bits = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (k << 8 | i);
    let bits = (bits ^ (bits >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (bits >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

fn plantctl(command: &str, file: &Path, more: &[&str]) -> Output {
    let mut plantctl = Command::new(binary("plantctl").unwrap());
    plantctl.env_remove("PLANTD_ADDRESS").arg(command).arg(file).args(more);
    plantctl.stdin(Stdio::null()).output().unwrap()
}

/// Replays on a server that plantctl starts; its exit code and what it prints.
fn replay(file: &Path) -> (Option<i32>, Value) {
    let output = plantctl("replay", file, &["--json"]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    let value = serde_json::from_slice(&output.stdout);
    (output.status.code(), value.unwrap_or_else(|error| panic!("{error}: {stderr}")))
}

#[track_caller]
fn assert_identical(file: &Path, steps: u64) {
    let (code, outcome) = replay(file);
    assert_eq!((code, &outcome["identical"]), (Some(0), &true.into()), "{outcome}");
    assert_eq!(outcome["steps"], steps, "{outcome}");
    assert_eq!((&outcome["not_compared"], &outcome["lost"]), (&0.into(), &0.into()), "{outcome}");
}

#[tokio::test]
async fn whatever_happens_to_a_plant_is_replayed_bit_for_bit() {
    let setup = setup(&[]).await;
    for model in ["pendulum", "cart-pole", "marionette", "four-bar"] {
        let id = setup.plant(model).await.id;
        setup.step(&id, 7, 0).await;
        setup.record(&id, model).await;
        setup.step(&id, 40, 1).await;
        let change = |parameters: &[(&str, f64)], time_step_s| v1::SetParametersRequest {
            id: id.clone(),
            parameters: parameters
                .iter()
                .map(|(path, value)| v1::Parameter { path: (*path).to_owned(), value: *value })
                .collect(),
            time_step_s,
        };
        setup.client.set_parameters(change(&[("gravity[1]", -3.25)], 0.0)).await.unwrap();
        setup.step(&id, 20, 2).await;
        setup.client.set_parameters(change(&[], 0.004)).await.unwrap();
        setup.step(&id, 20, 3).await;
        // Long enough for a checkpoint between two calls.
        tokio::time::sleep(Duration::from_millis(150)).await;
        setup.step(&id, 1, 4).await;
        setup.client.reset(&id).await.unwrap();
        setup.step(&id, 5, 5).await;
        let ended = setup.client.stop_recording(model).await.unwrap();
        assert_eq!((ended.status(), ended.steps, ended.lost), (v1::RecordingStatus::Done, 86, 0));
        let file = setup.file(model);
        assert_eq!(ended.bytes, std::fs::metadata(&file).unwrap().len());
        assert_identical(&file, 86);
    }
}

#[tokio::test]
async fn a_feedback_in_the_loop_and_a_driver_are_replayed_by_what_acted() {
    let setup = setup(&[]).await;
    let upright = v1::initial_state::Form::OperatingPoint("upright".to_owned());
    let request = v1::CreatePlantRequest {
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState { form: Some(upright) }),
        ..Default::default()
    };
    let id = setup.client.create_plant(request).await.unwrap().id;
    setup.record(&id, "fed").await;
    let feedback = v1::SetFeedbackRequest {
        id: id.clone(),
        reference: Some(v1::set_feedback_request::Reference::Point(operating_point("upright"))),
        weights: Some(weights(diagonal([10.0, 100.0, 1.0, 1.0]), diagonal([0.1]))),
        mode: v1::FeedbackMode::Add.into(),
        ..Default::default()
    };
    setup.client.set_feedback(feedback).await.unwrap();
    let mut driver = setup.client.drive(&id).await.unwrap();
    let mut applied = Vec::new();
    for k in 0..300 {
        applied.push(driver.step(&[noise(9, k, 0)]).await.unwrap().u[0]);
    }
    driver.close().await.unwrap();
    setup.client.stop_recording("fed").await.unwrap();
    assert_identical(&setup.file("fed"), 300);
    // What the driver sent is there beside what acted.
    let mut recording = RecordingReader::open(setup.file("fed")).unwrap();
    let mut k = 0;
    while let Some(entry) = recording.next_entry().unwrap() {
        let RecordingEntry::Step(step) = entry else { continue };
        assert_eq!((step.driver[0], step.u[0]), (noise(9, k, 0), applied[k as usize]));
        k += 1;
    }
    assert_eq!(k, 300);
}

#[tokio::test]
async fn faults_are_replayed_whatever_they_do() {
    use v1::fault_spec::{Kind, Pattern, Start, Target};
    let setup = setup(&[]).await;
    let plant = setup.plant("cart-pole").await;
    let (id, h) = (plant.id, plant.settings.unwrap().time_step_s);
    let angle = v1::OutputChannel {
        name: "angle".to_owned(),
        source: Some(v1::output_channel::Source::Coordinate("theta".to_owned())),
        noise: 0.01,
        ..Default::default()
    };
    let channels = v1::Channels { seed: 3, outputs: vec![angle], ..Default::default() };
    setup.client.set_channels(&id, channels).await.unwrap();
    setup.record(&id, "pushed").await;
    let input = setup.client.get_model("cart-pole").await.unwrap().inputs.remove(0);
    let noise = v1::FaultSpec {
        target: Some(Target::Input(input)),
        kind: Some(Kind::Noise(v1::ExtraNoise { deviation: 1.0 })),
        ..Default::default()
    };
    setup.client.inject_fault(&id, noise).await.unwrap();
    let point = v1::FramePoint { frame: "pole".to_owned(), ..Default::default() };
    let push = v1::Push { point: Some(point), force: vec![1.0, 0.0, 0.0], torque: Vec::new() };
    let push = v1::FaultSpec {
        kind: Some(Kind::Push(push)),
        start: Some(Start::StartStep(20)),
        duration_s: 5.0 * h,
        ..Default::default()
    };
    setup.client.inject_fault(&id, push).await.unwrap();
    setup.step(&id, 50, 1).await;
    // Long enough for a checkpoint.
    tokio::time::sleep(Duration::from_millis(150)).await;
    setup.step(&id, 30, 2).await;
    setup.client.stop_recording("pushed").await.unwrap();
    assert_identical(&setup.file("pushed"), 80);
    // Numbers of the scene, too: alone and together, of which one stands there and the other does not.
    let change = |path: &str, value, start, steps: u32, period: u32| {
        let parameters = vec![v1::Parameter { path: path.to_owned(), value }];
        let (period_s, duty) = (f64::from(period) * h, 0.5);
        v1::FaultSpec {
            kind: Some(Kind::Parameters(v1::ParameterChange { parameters })),
            start: Some(Start::StartStep(start)),
            duration_s: f64::from(steps) * h,
            pattern: Some(Pattern::Intermittent(v1::Intermittent { period_s, duty })),
            ..Default::default()
        }
    };
    let gravity = change("gravity[1]", -1.0, 90, 60, 20);
    setup.client.inject_fault(&id, gravity).await.unwrap();
    setup.step(&id, 15, 3).await;
    // It begins in the middle of a change, and ends in another one.
    setup.record(&id, "changed").await;
    setup.step(&id, 3, 4).await;
    let longer = change("frames[pole].translation[1]", 0.1, 100, 100, 6);
    let longer = setup.client.inject_fault(&id, longer).await.unwrap().id;
    setup.step(&id, 30, 5).await;
    tokio::time::sleep(Duration::from_millis(150)).await;
    setup.step(&id, 10, 6).await;
    let snapshot = setup.client.snapshot(&id).await.unwrap();
    setup.step(&id, 3, 7).await;
    setup.client.clear_fault(&id, longer).await.unwrap();
    setup.step(&id, 10, 8).await;
    setup.client.clear_fault(&id, 0).await.unwrap();
    setup.step(&id, 10, 9).await;
    let mass = v1::Parameter { path: "frames[pole].body.mass".to_owned(), value: 0.3 };
    let parameters = vec![mass];
    let request = v1::SetParametersRequest { id: id.clone(), parameters, ..Default::default() };
    setup.client.set_parameters(request).await.unwrap();
    setup.step(&id, 10, 10).await;
    let longer = change("frames[pole].translation[1]", 0.2, 0, 1000, 4);
    setup.client.reset(&id).await.unwrap();
    setup.client.inject_fault(&id, longer).await.unwrap();
    setup.step(&id, 10, 11).await;
    setup.client.reset(&id).await.unwrap();
    setup.step(&id, 10, 12).await;
    assert!(setup.client.restore(&id, snapshot).await.is_err(), "of another mass");
    setup.client.stop_recording("changed").await.unwrap();
    assert_identical(&setup.file("changed"), 96);
    // What the sensor said is in the file, and in the table.
    let output = plantctl("export", &setup.file("pushed"), &["--csv", "-"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.lines().next().unwrap().contains(",y(angle),"), "{text}");
    for line in text.lines().skip(2) {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let (theta, measured) = (cells[3], cells[7]);
        assert!(measured != theta && (measured - theta).abs() < 0.1, "{line}");
    }
}

#[tokio::test]
async fn nothing_is_lost_however_fast_somebody_steps() {
    let setup = setup(&[]).await;
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, "fast").await;
    // Many times the ring.
    let request = v1::StepRequest { id: id.clone(), hold: 60_000, ..Default::default() };
    setup.client.step(request).await.unwrap();
    let ended = setup.client.stop_recording("fast").await.unwrap();
    assert_eq!((ended.steps, ended.lost), (60_000, 0));
    assert_identical(&setup.file("fast"), 60_000);
}

/// Runs a plant for so many steps and waits for them.
async fn run(client: &Client, id: &str, pace: v1::Pace, speed: f64, steps: u64) {
    let settings = v1::RunSettings { pace: pace.into(), speed, input: None };
    let id = id.to_owned();
    let before = client.get_plant(&id).await.unwrap().plant.unwrap().state.unwrap().step;
    let request = v1::RunRequest { id: id.clone(), settings: Some(settings), steps, wait: false };
    client.run(request).await.unwrap();
    let end = async {
        while client.get_plant(&id).await.unwrap().plant.unwrap().state.unwrap().step
            < before + steps
        {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), end).await.expect("the steps are taken");
}

#[tokio::test]
async fn plants_that_run_by_themselves_are_recorded_with_times_and_events() {
    let setup = setup(&[]).await;
    let id = setup.plant("cart-pole").await.id;
    setup.record(&id, "paced").await;
    run(&setup.client, &id, v1::Pace::Paced, 10.0, 500).await;
    // A reset while it runs.
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), speed: 10.0, input: None };
    let request =
        v1::RunRequest { id: id.clone(), settings: Some(settings), steps: 0, wait: false };
    setup.client.run(request).await.unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await;
    setup.client.pause(&id).await.unwrap();
    setup.client.reset(&id).await.unwrap();
    run(&setup.client, &id, v1::Pace::Paced, 10.0, 100).await;
    let ended = setup.client.stop_recording("paced").await.unwrap();
    assert_eq!((ended.status(), ended.lost), (v1::RecordingStatus::Done, 0));
    assert!(ended.steps > 600, "{}", ended.steps);
    assert_identical(&setup.file("paced"), ended.steps);
    let mut recording = RecordingReader::open(setup.file("paced")).unwrap();
    let (mut last_ns, mut kinds) = (0, Vec::new());
    while let Some(entry) = recording.next_entry().unwrap() {
        match entry {
            RecordingEntry::Step(step) => {
                let timing = step.timing.expect("times of a paced step");
                assert!(last_ns <= timing.began_ns && timing.began_ns <= timing.ended_ns);
                assert!(0 < timing.due_ns && timing.due_ns <= timing.began_ns);
                last_ns = timing.ended_ns;
            }
            RecordingEntry::Event(event) => kinds.push(event.kind()),
            RecordingEntry::Mark(_) | RecordingEntry::Energy { .. } => {}
        }
    }
    for kind in [v1::EventKind::Started, v1::EventKind::Paused, v1::EventKind::StateSet] {
        assert!(kinds.contains(&kind), "{kinds:?}");
    }
}

#[tokio::test]
async fn a_free_running_plant_is_not_held_up_and_every_step_is_accounted_for() {
    const STEPS: u64 = 60_000;
    let setup = setup(&[]).await;
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, "free").await;
    run(&setup.client, &id, v1::Pace::Free, 0.0, STEPS).await;
    let ended = setup.client.stop_recording("free").await.unwrap();
    assert_eq!((ended.status(), ended.steps + ended.lost), (v1::RecordingStatus::Done, STEPS));
    let (code, outcome) = replay(&setup.file("free"));
    let count = |name: &str| outcome[name].as_u64().unwrap();
    assert_eq!((code, &outcome["identical"]), (Some(0), &true.into()), "{outcome}");
    assert_eq!((count("steps") + count("not_compared"), count("lost")), (ended.steps, ended.lost));
}

#[tokio::test]
async fn a_plant_that_its_watchdog_resets_is_replayed() {
    let setup = setup(&[]).await;
    let request = v1::CreatePlantRequest {
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState {
            form: Some(v1::initial_state::Form::OperatingPoint("upright".to_owned())),
        }),
        ..Default::default()
    };
    let id = setup.client.create_plant(request).await.unwrap().id;
    let watchdog = v1::Watchdog {
        quantity: "x".to_owned(),
        min: Some(-0.1),
        max: Some(0.1),
        action: v1::WatchdogAction::Reset.into(),
    };
    let request =
        v1::SetSafetyRequest { id: id.clone(), watchdogs: vec![watchdog], ..Default::default() };
    setup.client.set_safety(request).await.unwrap();
    setup.record(&id, "reset").await;
    // One push after the other to the same side.
    let u = Some(v1::Matrix::from_rows(&vec![vec![5.0]; 400]));
    let request =
        v1::StepRequest { id: id.clone(), u, hold: 0, all_states: true, ..Default::default() };
    let states = setup.client.step(request).await.unwrap().states;
    let resets = states.iter().filter(|state| state.step == 0).count() as u64;
    assert!(resets > 1, "{resets}");
    setup.client.stop_recording("reset").await.unwrap();
    // The step after which it was reset is not among them.
    assert_identical(&setup.file("reset"), 400 - resets);
}

/// Where eight bytes are in a file.
fn places(bytes: &[u8], number: f64) -> Vec<usize> {
    let pattern = number.to_le_bytes();
    let is_there = |(i, window): (usize, &[u8])| (window == pattern).then_some(i);
    bytes.windows(8).enumerate().filter_map(is_there).collect()
}

#[tokio::test]
async fn a_flipped_bit_is_named() {
    let setup = setup(&[]).await;
    let id = setup.plant("cart-pole").await.id;
    setup.record(&id, "good").await;
    let states = setup.step(&id, 100, 6).await;
    setup.client.stop_recording("good").await.unwrap();
    let bytes = std::fs::read(setup.file("good")).unwrap();
    let flipped = setup.recordings.path().join("flipped.mcap");
    let flip = |place: usize, mask: u8| {
        let mut bytes = bytes.clone();
        bytes[place] ^= mask;
        std::fs::write(&flipped, bytes).unwrap();
        replay(&flipped)
    };
    for (entry, number) in
        [("x", states[41].q[0]), ("theta", states[41].q[1]), ("p(x)", states[41].p[0])]
    {
        // The step itself comes first; then what players show of it.
        let places = places(&bytes, number);
        assert!(!places.is_empty(), "{number} is in the file");
        // The last bit of the mantissa.
        let (code, outcome) = flip(places[0], 1);
        let difference = &outcome["difference"];
        assert_eq!((code, &outcome["steps"]), (Some(1), &41.into()), "{outcome}");
        assert_eq!((&difference["step"], &difference["entry"]), (&42.into(), &entry.into()));
        assert_eq!(difference["replayed"], number);
        assert_eq!(difference["replayed_bits"], format!("{:016x}", number.to_bits()));
        assert_eq!(difference["recorded_bits"], format!("{:016x}", number.to_bits() ^ 1));
    }
    // An input: as it acted, and as the driver sent it.
    let places = places(&bytes, noise(6, 41, 0));
    assert!(places.len() >= 2);
    // The sign.
    let (code, outcome) = flip(places[0] + 7, 0x80);
    assert_eq!((code, &outcome["difference"]["step"]), (Some(1), &42.into()), "{outcome}");
    let text = String::from_utf8(plantctl("replay", &flipped, &[]).stdout).unwrap();
    assert!(text.starts_with("step 42 differs in x, after 41 identical steps\n"), "{text}");
    // What the driver sent is not replayed, but the file is known to be damaged.
    std::fs::write(&flipped, {
        let mut bytes = bytes.clone();
        bytes[places[1]] ^= 1;
        bytes
    })
    .unwrap();
    let output = plantctl("replay", &flipped, &[]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr.contains("CRC"), "{stderr}");
}

#[tokio::test]
async fn a_recording_outlives_a_killed_server() {
    let mut setup = setup(&[]).await;
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, "cut").await;
    setup.step(&id, 500, 7).await;
    // Within half a second what was recorded is handed to the system.
    let is_flushed = async {
        let bytes = async || setup.client.list_recordings().await.unwrap()[0].bytes;
        let (mut before, mut now) = (0, bytes().await);
        while now == 0 || now != before {
            tokio::time::sleep(Duration::from_millis(1500)).await;
            (before, now) = (now, bytes().await);
        }
    };
    tokio::time::timeout(Duration::from_secs(30), is_flushed).await.unwrap();
    setup.server.kill().unwrap();
    let (code, outcome) = replay(&setup.file("cut"));
    assert_eq!((code, &outcome["cut_short"]), (Some(0), &true.into()), "{outcome}");
    assert_eq!(outcome["steps"], 500, "{outcome}");
    // Cut anywhere, a file gives what is before the cut, and nothing but that.
    let bytes = std::fs::read(setup.file("cut")).unwrap();
    let mut steps_before = 0;
    for length in (0..bytes.len()).step_by(997) {
        let path = setup.recordings.path().join("shorter");
        std::fs::write(&path, &bytes[..length]).unwrap();
        let Ok(mut recording) = RecordingReader::open(&path) else { continue };
        let mut steps = 0;
        while let Some(entry) = recording.next_entry().unwrap() {
            steps += u64::from(matches!(entry, RecordingEntry::Step(_)));
        }
        assert!(recording.is_cut() && steps >= steps_before, "{length} bytes, {steps} steps");
        steps_before = steps;
    }
    assert!(steps_before > 400, "{steps_before}");
    // The next server lists it, and refuses a new one under its name.
    let server = ServerProcess::start_with(|command| {
        command.arg("--recordings").arg(setup.recordings.path());
    })
    .unwrap();
    let client = server.client().await;
    let listed = client.list_recordings().await.unwrap();
    assert_eq!((listed[0].name.as_str(), listed[0].status()), ("cut", v1::RecordingStatus::Done));
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let id = client.create_plant(request).await.unwrap().id;
    let request = v1::StartRecordingRequest { id, name: "cut".to_owned(), ..Default::default() };
    let error = client.start_recording(request).await.unwrap_err();
    assert_eq!((error.code(), error.reason()), (Some(Code::AlreadyExists), "RECORDING_EXISTS"));
}

#[tokio::test]
async fn a_recording_ends_at_its_limit_and_the_plant_goes_on() {
    let setup = setup(&["--limit", "recording_bytes=1048576"]).await;
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, "large").await;
    let request = v1::StepRequest { id: id.clone(), hold: 20_000, ..Default::default() };
    let last = setup.client.step(request).await.unwrap().states[0].clone();
    assert_eq!(last.step, 20_000);
    let ended = setup.client.stop_recording("large").await.unwrap();
    assert_eq!(ended.status(), v1::RecordingStatus::Failed);
    assert!(ended.failure.contains("recording_bytes"), "{}", ended.failure);
    assert!((1 << 20..4 << 20).contains(&ended.bytes), "{}", ended.bytes);
    assert!(ended.steps < 20_000, "{}", ended.steps);
    assert_identical(&setup.file("large"), ended.steps);
    // The plant can be recorded again.
    setup.record(&id, "again").await;
}

/// Copies a recording; `change` says what each message becomes. An empty topic is that of the message.
fn copy(
    from: &Path,
    to: &Path,
    mut change: impl FnMut(&str, &[u8]) -> Vec<(&'static str, Vec<u8>)>,
) {
    let bytes = std::fs::read(from).unwrap();
    let mut out = mcap::Writer::new(std::fs::File::create(to).unwrap()).unwrap();
    let mut channels = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let channel = &message.channel;
        let schema = channel.schema.as_ref().unwrap();
        let schema = out.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
        let id = out.add_channel(schema, &channel.topic, "protobuf", &BTreeMap::new()).unwrap();
        channels.insert(channel.topic.clone(), id);
        for (topic, data) in change(&channel.topic, &message.data) {
            let topic = if topic.is_empty() { channel.topic.as_str() } else { topic };
            let header = MessageHeader {
                channel_id: channels[topic],
                sequence: 0,
                log_time: message.log_time,
                publish_time: message.publish_time,
            };
            out.write_to_known_channel(&header, &data).unwrap();
        }
    }
    out.finish().unwrap();
}

fn step_of(data: &[u8]) -> u64 {
    v1::StepRecord::decode(data).unwrap().state.unwrap().step
}

#[tokio::test]
async fn a_replay_goes_on_after_a_gap_and_says_what_it_left_out() {
    let setup = setup(&[]).await;
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, "whole").await;
    for seed in 0..4 {
        setup.step(&id, 25, seed).await;
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    setup.client.stop_recording("whole").await.unwrap();
    let whole = setup.file("whole");
    let mut recording = RecordingReader::open(&whole).unwrap();
    let mut checkpoints = Vec::new();
    while let Some(entry) = recording.next_entry().unwrap() {
        if let RecordingEntry::Mark(mark) = entry {
            assert_eq!(mark.reason(), v1::MarkReason::Checkpoint);
            checkpoints.push(mark.step);
        }
    }
    let first = *checkpoints.first().expect("a checkpoint");
    let after = *checkpoints.iter().find(|step| **step > first).expect("another one");
    assert!(first >= 25 && after < 100, "{checkpoints:?}");
    // As a recorder writes it that has lost five steps.
    let gap = setup.file("gap");
    let (from, to) = (first + 3, first + 8);
    copy(&whole, &gap, |topic, data| {
        let kept = ("", data.to_vec());
        if topic != "/step" {
            return vec![kept];
        }
        match step_of(data) {
            step if (from..to).contains(&step) => Vec::new(),
            step if step == to => {
                let reason = v1::MarkReason::Gap.into();
                let step = to - 1;
                let mark = v1::MarkRecord { reason, step, lost: to - from, ..Default::default() };
                vec![("/mark", mark.encode_to_vec()), kept]
            }
            _ => vec![kept],
        }
    });
    let (code, outcome) = replay(&gap);
    assert_eq!((code, &outcome["identical"]), (Some(0), &true.into()), "{outcome}");
    assert_eq!(outcome["steps"], from - 1 + (100 - after), "{outcome}");
    assert_eq!(outcome["lost"], to - from, "{outcome}");
    assert_eq!(outcome["not_compared"], after - (to - 1), "{outcome}");
    // A step that is missing without a word is a difference.
    let silent = setup.file("silent");
    copy(&whole, &silent, |topic, data| {
        let is_missing = topic == "/step" && step_of(data) == 11;
        if is_missing { Vec::new() } else { vec![("", data.to_vec())] }
    });
    let (code, outcome) = replay(&silent);
    assert_eq!((code, &outcome["difference"]["step"]), (Some(1), &12.into()), "{outcome}");
}

#[tokio::test]
async fn a_table_has_the_numbers_of_the_steps() {
    let setup = setup(&[]).await;
    let id = setup.plant("cart-pole").await.id;
    setup.record(&id, "table").await;
    let states = setup.step(&id, 50, 8).await;
    setup.client.stop_recording("table").await.unwrap();
    let output = plantctl("export", &setup.file("table"), &["--csv", "-"]);
    let text = String::from_utf8(output.stdout).unwrap();
    let mut lines = text.lines();
    let inputs = setup.client.get_model("cart-pole").await.unwrap().inputs;
    let head =
        format!("step,time_s,x,theta,p(x),p(theta),u({}),velocity(x),velocity(theta)", inputs[0]);
    assert_eq!(lines.next(), Some(head.as_str()));
    assert!(lines.next().unwrap().starts_with("0,0.0,"));
    for (k, (line, state)) in (0..).zip(lines.by_ref().zip(&states)) {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let input = [noise(8, k, 0)];
        let expected =
            [&[state.step as f64, state.time_s][..], &state.q, &state.p, &input, &state.velocity];
        assert_eq!(cells, expected.concat());
    }
    assert_eq!(text.lines().count(), 52);
}

#[tokio::test]
async fn recordings_without_velocities_are_read_and_replayed() {
    let setup = setup(&[]).await;
    let id = setup.plant("cart-pole").await.id;
    setup.record(&id, "whole").await;
    setup.step(&id, 20, 8).await;
    setup.client.stop_recording("whole").await.unwrap();
    let older = setup.file("older");
    copy(&setup.file("whole"), &older, |topic, data| {
        let mut data = data.to_vec();
        if topic == "/step" {
            let mut record = v1::StepRecord::decode(&*data).unwrap();
            record.state.as_mut().unwrap().velocity.clear();
            data = record.encode_to_vec();
        }
        vec![("", data)]
    });
    assert_identical(&older, 20);
    let table = plantctl("export", &older, &["--csv", "-"]).stdout;
    let last = String::from_utf8(table).unwrap().lines().last().unwrap().to_owned();
    assert!(last.starts_with("20,") && last.ends_with(",,"), "{last}");
    assert_eq!(last.split(',').count(), 9);
}

#[tokio::test]
async fn recordings_are_fetched_listed_and_deleted_and_wrong_requests_refused() {
    let setup = setup(&["--limit", "recordings=2"]).await;
    let client = &setup.client;
    let id = setup.plant("pendulum").await.id;
    let started = setup.record(&id, "one").await;
    assert_eq!((started.status(), started.plant.as_str()), (v1::RecordingStatus::Active, &*id));
    let start = async |id: &str, name: &str, checkpoint_interval_s: f64| {
        let (id, name) = (id.to_owned(), name.to_owned());
        let request = v1::StartRecordingRequest { id, name, checkpoint_interval_s };
        client.start_recording(request).await
    };
    let reason = |result: Result<v1::Recording, plantd_client::Error>| {
        let error = result.expect_err("a refusal");
        (error.code().unwrap(), error.reason().to_owned())
    };
    let active = (Code::FailedPrecondition, "RECORDING_ACTIVE".to_owned());
    assert_eq!(reason(start(&id, "two", 0.0).await), active);
    let error = client.delete_recording("one").await.unwrap_err();
    assert_eq!(error.reason(), "RECORDING_ACTIVE");
    let field = (Code::InvalidArgument, "INVALID_FIELD".to_owned());
    for name in ["../one", "a/b", "One", ".", "one.mcap"] {
        assert_eq!(reason(start(&id, name, 0.0).await), field);
        assert_eq!(reason(client.stop_recording(name).await), field);
    }
    for interval in [-1.0, 0.01, f64::NAN, f64::INFINITY] {
        assert_eq!(reason(start(&id, "two", interval).await), field);
    }
    let missing = (Code::NotFound, "RECORDING_NOT_FOUND".to_owned());
    assert_eq!(reason(client.stop_recording("two").await), missing);
    assert_eq!(reason(start("nobody", "two", 0.0).await).1, "PLANT_NOT_FOUND");

    setup.step(&id, 30, 0).await;
    client.stop_recording("one").await.unwrap();
    let again = client.stop_recording("one").await.unwrap();
    assert_eq!((again.status(), again.steps), (v1::RecordingStatus::Done, 30));
    let other = setup.plant("pendulum").await.id;
    let unnamed = start(&other, "", 0.0).await.unwrap();
    assert!(unnamed.name.starts_with(&other), "{}", unnamed.name);
    let full = (Code::ResourceExhausted, "LIMIT_EXCEEDED".to_owned());
    assert_eq!(reason(start(&id, "two", 0.0).await), full);
    // A recording ends with its plant.
    client.delete_plant(&other).await.unwrap();
    let ended = client.stop_recording(&unnamed.name).await.unwrap();
    assert_eq!(ended.status(), v1::RecordingStatus::Done);
    let listed = client.list_recordings().await.unwrap();
    let names: Vec<_> = listed.iter().map(|recording| recording.name.as_str()).collect();
    assert_eq!(names, ["one", &unnamed.name]);

    let copy = setup.recordings.path().join("fetched");
    let output = Command::new(binary("plantctl").unwrap())
        .args(["--address", setup.server.address(), "record", "get", "one"])
        .arg(&copy)
        .output()
        .unwrap();
    assert!(output.status.success());
    assert_eq!(std::fs::read(copy).unwrap(), std::fs::read(setup.file("one")).unwrap());
    client.delete_recording("one").await.unwrap();
    assert!(!setup.file("one").exists());
    start(&id, "one", 0.0).await.unwrap();

    let server = ServerProcess::start().unwrap();
    let error = server.client().await.list_recordings().await.unwrap_err();
    assert_eq!(error.reason(), "RECORDINGS_DISABLED");
}
