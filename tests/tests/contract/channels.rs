//! Sensors, actuators and faults.

use std::sync::Arc;

use plantd_client::{Client, Code, Error, v1};
use plantd_models::{Initial, Model, Plant, Scene, Settings, builtin};
use v1::fault_spec::{Kind, Pattern, Start, Target};
use v1::output_channel::Source;

use crate::support::*;

const H: f64 = 0.01;

fn output(name: &str, source: Source) -> v1::OutputChannel {
    v1::OutputChannel { name: name.to_owned(), source: Some(source), ..Default::default() }
}

fn theta(name: &str) -> v1::OutputChannel {
    output(name, Source::Coordinate("theta".to_owned()))
}

fn outputs(outputs: Vec<v1::OutputChannel>) -> v1::Channels {
    v1::Channels { outputs, ..Default::default() }
}

fn actuator(channel: v1::InputChannel) -> v1::Channels {
    let input = v1::InputChannel { input: "force".to_owned(), ..channel };
    v1::Channels { inputs: vec![input], ..Default::default() }
}

fn on_input(kind: Kind) -> v1::FaultSpec {
    let target = Some(Target::Input("force".to_owned()));
    v1::FaultSpec { target, kind: Some(kind), ..Default::default() }
}

fn on_output(name: &str, kind: Kind) -> v1::FaultSpec {
    let target = Some(Target::Output(name.to_owned()));
    v1::FaultSpec { target, kind: Some(kind), ..Default::default() }
}

fn push(frame: &str, force: [f64; 3], torque: [f64; 3]) -> Kind {
    Kind::Push(v1::Push {
        point: Some(v1::FramePoint { frame: frame.to_owned(), at: vec![0.0, -0.5, 0.0] }),
        force: force.to_vec(),
        torque: torque.to_vec(),
    })
}

fn from_step(step: u64, steps: f64, fault: v1::FaultSpec) -> v1::FaultSpec {
    v1::FaultSpec { start: Some(Start::StartStep(step)), duration_s: steps * H, ..fault }
}

/// The force of step `k`.
fn force(k: u64) -> f64 {
    20.0 * (0.3 * k as f64).sin()
}

fn cart_pole() -> Plant {
    let model = Arc::new(Model::compile(&builtin::scene("cart-pole").unwrap()).unwrap());
    let settings = Settings::new(&model);
    Plant::new(model, settings).unwrap()
}

/// Drives by [`force`] from the present step on.
async fn drive(client: &Client, id: &str, steps: u64) -> Vec<v1::DriveStep> {
    let mut driver = client.drive(id).await.unwrap();
    let first = driver.plant().state.as_ref().unwrap().step;
    let mut answers = Vec::new();
    for k in first..first + steps {
        answers.push(driver.step(&[force(k)]).await.unwrap());
    }
    driver.close().await.unwrap();
    answers
}

fn y(step: &v1::DriveStep) -> &[f64] {
    &step.outputs.as_ref().unwrap().y
}

/// Step, bits of the state and of `y`, and lost channels.
type Seen = (u64, Vec<u64>, Vec<u64>, Vec<u32>);

/// What a drive has seen.
fn seen(steps: &[v1::DriveStep]) -> Vec<Seen> {
    let bits_of = |step: &v1::DriveStep| {
        let (k, state) = bits(step.state.as_ref().unwrap());
        let outputs = step.outputs.clone().unwrap_or_default();
        (k, state, outputs.y.iter().map(|y| y.to_bits()).collect(), outputs.lost)
    };
    steps.iter().map(bits_of).collect()
}

#[tokio::test]
async fn sensors_measure_what_they_say() {
    let (_server, client) = server().await;
    let created = plant(&client, "cart-pole").await;
    let id = created.id;
    let name = |name: &str| name.to_owned();
    let tip = v1::FramePoint { frame: name("pole"), at: vec![0.0, -1.0, 0.0] };
    let channels = outputs(vec![
        theta("angle"),
        output("rate", Source::Velocity(name("theta"))),
        output("acceleration", Source::Acceleration(name("theta"))),
        output("tip", Source::Position(tip)),
        output("attitude", Source::Orientation(name("pole"))),
        output("motor", Source::Input(name("force"))),
        output("energy", Source::Energy(true)),
        v1::OutputChannel { latency_s: 3.0 * H, ..theta("late") },
        v1::OutputChannel { sample_period_s: 4.0 * H, ..theta("slow") },
        v1::OutputChannel { quantum: 0.125, bias: 0.5, ..theta("coarse") },
        v1::OutputChannel { min: Some(0.2), max: Some(0.5), ..theta("narrow") },
    ]);
    let answer = client.set_channels(&id, channels.clone()).await.unwrap();
    let info = answer.info.unwrap();
    let names = [
        "angle",
        "rate",
        "acceleration",
        "tip.x",
        "tip.y",
        "tip.z",
        "attitude.rx",
        "attitude.ry",
        "attitude.rz",
        "motor",
        "energy",
        "late",
        "slow",
        "coarse",
        "narrow",
    ];
    assert_eq!(info.names, names);
    // At rest; all has its value there.
    let start = &created.state.unwrap();
    let angle = start.q[1];
    let tip = [angle.sin(), -angle.cos()];
    let at_start = [
        angle,
        0.0,
        0.0,
        tip[0],
        tip[1],
        0.0,
        0.0,
        0.0,
        angle,
        0.0,
        -9.8 * angle.cos(),
        angle,
        angle,
        1.25,
        0.5,
    ];
    let close = |a: f64, b: f64, tolerance: f64, what: &str| {
        assert!((a - b).abs() <= tolerance, "{what}: {a}, not {b}");
    };
    for ((found, expected), name) in answer.y.iter().zip(at_start).zip(names) {
        close(*found, expected, 1e-14, name);
    }
    let steps = drive(&client, &id, 60).await;
    let states: Vec<&v1::State> =
        std::iter::once(start).chain(steps.iter().map(|s| s.state.as_ref().unwrap())).collect();
    let mut plain = cart_pole();
    for (i, step) in steps.iter().enumerate() {
        let k = i + 1;
        plain.step(&[force(i as u64)]).unwrap();
        assert_eq!((states[k].q.as_slice(), states[k].p.as_slice()), (plain.q(), plain.p()));
        let y = y(step);
        let (x, angle) = (states[k].q[0], states[k].q[1]);
        let rate = |k: usize| (states[k].q[1] - states[k - 1].q[1]) / H;
        assert_eq!((y[0], y[1]), (angle, rate(k)));
        let acceleration = if k == 1 { rate(1) / (0.5 * H) } else { (rate(k) - rate(k - 1)) / H };
        close(y[2], acceleration, 1e-9, "acceleration");
        close(y[3], x + angle.sin(), 1e-14, "tip.x");
        close(y[4], -angle.cos(), 1e-14, "tip.y");
        assert_eq!((y[5], y[6], y[7]), (0.0, 0.0, 0.0));
        close(y[8], angle, 1e-14, "attitude");
        assert_eq!(y[9], force(i as u64));
        let energy = plain.clone().energy();
        assert_eq!(y[10], energy.kinetic_j + energy.potential_j);
        assert_eq!(y[11], states[k.saturating_sub(3)].q[1]);
        assert_eq!(y[12], states[k - k % 4].q[1]);
        assert_eq!(y[13], ((angle + 0.5) / 0.125).round() * 0.125);
        assert_eq!(y[14], angle.clamp(0.2, 0.5));
        assert!(step.u.is_empty(), "sensors have no say in the input");
    }
    // In other answers, too.
    let last = y(&steps[59]).to_vec();
    assert_eq!(client.get_channels(&id).await.unwrap().y, last);
    let request = v1::WatchRequest {
        id: id.clone(),
        fields: vec![v1::WatchField::Outputs.into()],
        ..Default::default()
    };
    let mut watch = client.watch(request).await.unwrap();
    let watched = soon(watch.next()).await.unwrap().unwrap();
    assert_eq!((watched.step, watched.outputs.unwrap().y), (60, last));
    let request = v1::StepRequest { id: id.clone(), hold: 1, ..Default::default() };
    let stepped = client.step(request).await.unwrap();
    assert_eq!(stepped.outputs.unwrap().y[0], stepped.states[0].q[1]);
    // Times become whole steps.
    let odd = v1::OutputChannel { latency_s: 0.0249, sample_period_s: 0.004, ..theta("odd") };
    let info = client.set_channels(&id, outputs(vec![odd])).await.unwrap().info.unwrap();
    let odd = info.channels.unwrap().outputs.remove(0);
    assert_eq!((odd.latency_s, odd.sample_period_s), (0.02, 0.01));
    let none = client.set_channels(&id, v1::Channels::default()).await.unwrap();
    assert!(none.y.is_empty());
    assert!(drive(&client, &id, 1).await[0].outputs.is_none());
}

/// Noise, lost samples and chance of all kinds, on a plant whose input is disturbed, too.
async fn disturb(client: &Client, id: &str, seed: u64) {
    let noisy = v1::OutputChannel { noise: 0.1, drop_out: 0.2, latency_s: H, ..theta("noisy") };
    let declared = v1::Channels { seed, ..outputs(vec![noisy, theta("angle")]) };
    client.set_channels(id, declared).await.unwrap();
    client.reset(id).await.unwrap();
    let noise = |deviation| Kind::Noise(v1::ExtraNoise { deviation });
    let chance = v1::Chance { window_s: 5.0 * H, probability: 0.5 };
    let at_times = |fault| v1::FaultSpec { pattern: Some(Pattern::Chance(chance)), ..fault };
    for fault in [
        from_step(0, 0.0, on_input(noise(3.0))),
        from_step(0, 0.0, at_times(on_input(Kind::Loss(v1::PacketLoss { probability: 0.5 })))),
        from_step(0, 0.0, at_times(on_output("angle", noise(0.01)))),
    ] {
        client.inject_fault(id, fault).await.unwrap();
    }
}

/// The same seed gives the same bits: in another plant, after a reset and after a restore; another seed
/// gives others.
#[tokio::test]
async fn chance_is_reproducible() {
    let (_server, client) = server().await;
    let (a, b) = (plant(&client, "cart-pole").await.id, plant(&client, "cart-pole").await.id);
    for id in [&a, &b] {
        disturb(&client, id, 7).await;
    }
    let first = seen(&drive(&client, &a, 100).await);
    assert_eq!(seen(&drive(&client, &b, 100).await), first, "another plant");
    client.reset(&a).await.unwrap();
    assert_eq!(seen(&drive(&client, &a, 100).await), first, "after a reset");
    let lost = first.iter().filter(|(.., lost)| lost.contains(&0)).count();
    // 100 samples of probability 0.2: mean 20, deviation 4.
    assert!((8..=32).contains(&lost), "{lost}");

    let snapshot = client.snapshot(&a).await.unwrap();
    client.restore(&a, snapshot.clone()).await.unwrap();
    let ahead = seen(&drive(&client, &a, 50).await);
    client.restore(&a, snapshot).await.unwrap();
    assert_eq!(seen(&drive(&client, &a, 50).await), ahead, "after a restore");
    assert_eq!(seen(&drive(&client, &b, 50).await), ahead, "without a restore");

    disturb(&client, &b, 8).await;
    client.clear_fault(&b, 0).await.unwrap();
    disturb(&client, &b, 8).await;
    client.reset(&b).await.unwrap();
    let other = seen(&drive(&client, &b, 100).await);
    assert!(first.iter().zip(&other).all(|(first, other)| first.2 != other.2));
}

/// Channels and faults of which nothing acts where it begins, in all parts of a plant.
async fn delay(client: &Client, id: &str) {
    let name = |name: &str| name.to_owned();
    let tip = v1::FramePoint { frame: name("pole"), at: vec![0.0, -1.0, 0.0] };
    let (latency_s, sample_period_s) = (7.0 * H, 3.0 * H);
    let late =
        |name, source| v1::OutputChannel { latency_s, sample_period_s, ..output(name, source) };
    let delayed = v1::InputChannel {
        input: name("force"),
        delay_s: 5.0 * H,
        sample_period_s,
        hold: v1::Hold::FirstOrder.into(),
        max_rate: Some(500.0),
        ..Default::default()
    };
    let declared = v1::Channels {
        outputs: vec![
            v1::OutputChannel {
                drop_out: 0.4,
                noise: 0.1,
                ..late("rate", Source::Velocity(name("theta")))
            },
            output("acceleration", Source::Acceleration(name("x"))),
            late("tip", Source::Position(tip)),
            late("motor", Source::Input(name("force"))),
        ],
        inputs: vec![delayed],
        seed: 5,
    };
    client.set_channels(id, declared).await.unwrap();
    let delay = |steps: f64| Kind::Delay(v1::ExtraDelay { delay_s: steps * H });
    let half = |period: f64, fault| v1::FaultSpec {
        pattern: Some(Pattern::Intermittent(v1::Intermittent { period_s: period * H, duty: 0.5 })),
        ..fault
    };
    let pushed =
        v1::FaultSpec { kind: Some(push("pole", [3.0, 0.0, 0.0], [0.0; 3])), ..Default::default() };
    for fault in [
        from_step(4, 0.0, on_output("tip.y", delay(6.0))),
        half(6.0, from_step(3, 0.0, on_input(Kind::Stuck(true)))),
        half(10.0, from_step(2, 0.0, on_output("acceleration", delay(4.0)))),
        half(8.0, from_step(6, 0.0, pushed)),
        half(14.0, from_step(10, 0.0, change("frames[pole].translation[1]", 0.5))),
        from_step(12, 0.0, on_output("motor", Kind::Loss(v1::PacketLoss { probability: 0.5 }))),
    ] {
        client.inject_fault(id, fault).await.unwrap();
    }
}

/// What is under way in channels and faults is part of a snapshot, whatever has happened since.
#[tokio::test]
async fn a_restored_plant_goes_on_with_what_was_under_way() {
    let (_server, client) = server().await;
    let (a, b) = (plant(&client, "cart-pole").await.id, plant(&client, "cart-pole").await.id);
    for id in [&a, &b] {
        delay(&client, id).await;
    }
    // In the middle of the changed parameters, and without them.
    for steps in [13, 21] {
        client.reset(&a).await.unwrap();
        drive(&client, &a, steps).await;
        let snapshot = client.snapshot(&a).await.unwrap();
        let (outputs, faults) =
            (client.get_channels(&a).await.unwrap(), client.list_faults(&a).await.unwrap());
        let ahead = seen(&drive(&client, &a, 60).await);
        for id in [&a, &b] {
            client.restore(id, snapshot.clone()).await.unwrap();
            assert_eq!(client.snapshot(id).await.unwrap(), snapshot);
            assert_eq!(client.get_channels(id).await.unwrap(), outputs);
            assert_eq!(client.list_faults(id).await.unwrap(), faults);
            assert_eq!(seen(&drive(&client, id, 60).await), ahead, "{id} from {steps}");
        }
        // Another plant can begin there, which has no channels.
        let form = v1::initial_state::Form::Snapshot(snapshot.clone());
        let request = v1::CreatePlantRequest {
            model: "cart-pole".to_owned(),
            initial: Some(v1::InitialState { form: Some(form.clone()) }),
            ..Default::default()
        };
        match client.create_plant(request).await {
            Ok(other) => assert_eq!(other.state.unwrap().step, steps),
            // It stands among changed parameters.
            Err(error) => assert_eq!((steps, error.reason()), (13, "SNAPSHOT_MISMATCH")),
        }
        // A reset to a snapshot is a restore.
        let initial = Some(v1::InitialState { form: Some(form) });
        client.reset_to(v1::ResetRequest { id: a.clone(), initial }).await.unwrap();
        assert_eq!(seen(&drive(&client, &a, 60).await), ahead);
    }
    // With other channels, or without its faults, the motion would be another one: the state alone can be had.
    drive(&client, &a, 8).await;
    let snapshot = client.snapshot(&a).await.unwrap();
    let late = v1::OutputChannel { latency_s: 7.0 * H, ..theta("late") };
    client.clear_fault(&a, 0).await.unwrap();
    let refused = client.restore(&a, snapshot.clone()).await.unwrap_err();
    assert_eq!(refused.reason(), "SNAPSHOT_MISMATCH");
    assert!(refused.to_string().contains("another set of faults"), "{refused}");
    client.set_channels(&a, outputs(vec![late])).await.unwrap();
    let refused = client.restore(&a, snapshot.clone()).await.unwrap_err();
    assert!(refused.to_string().contains("another set of channels"), "{refused}");
    let bare = plant(&client, "cart-pole").await.id;
    let refused = client.restore(&bare, snapshot.clone()).await.unwrap_err();
    assert_eq!(refused.reason(), "SNAPSHOT_MISMATCH");
    assert_eq!(client.get_plant(&bare).await.unwrap().plant.unwrap().state.unwrap().step, 0);
    let fault = on_output("late", Kind::Delay(v1::ExtraDelay { delay_s: H }));
    client.inject_fault(&a, fault).await.unwrap();
    drive(&client, &a, 20).await;
    let request = v1::RestoreRequest { id: a.clone(), snapshot, state_alone: true };
    client.restore_by(request).await.unwrap();
    let theta = client.get_plant(&a).await.unwrap().plant.unwrap().state.unwrap().q[1];
    let steps = drive(&client, &a, 8).await;
    assert!(steps.iter().all(|step| y(step) == [theta]), "{theta}");
    assert_eq!(y(&drive(&client, &a, 1).await[0]), [steps[0].state.as_ref().unwrap().q[1]]);
}

/// A plant that moves by itself meets the same noise, delays and faults as one in lockstep.
#[tokio::test]
async fn channels_do_the_same_at_every_pace() {
    const STEPS: u32 = 250;
    let (_server, client) = server().await;
    let watched = async |paces: &[v1::Pace]| {
        let id = plant(&client, "cart-pole").await.id;
        delay(&client, &id).await;
        let noise = Kind::Noise(v1::ExtraNoise { deviation: 3.0 });
        client.inject_fault(&id, from_step(0, 0.0, on_input(noise))).await.unwrap();
        let fields = [v1::WatchField::State, v1::WatchField::Outputs, v1::WatchField::Input];
        let request = v1::WatchRequest {
            id: id.clone(),
            fields: fields.map(Into::into).to_vec(),
            queue: STEPS + 1,
            ..Default::default()
        };
        let mut stream = client.watch(request).await.unwrap();
        let mut all = Vec::new();
        for (phase, pace) in (1..).zip(paces) {
            let steps = STEPS / paces.len() as u32;
            let is_lockstep = *pace == v1::Pace::Lockstep;
            let speed = if *pace == v1::Pace::Paced { 20.0 } else { 0.0 };
            let settings = v1::RunSettings { pace: (*pace).into(), speed, input: None };
            let request = v1::RunRequest {
                id: id.clone(),
                settings: Some(settings),
                steps: if is_lockstep { 0 } else { steps.into() },
                wait: !is_lockstep,
            };
            client.run(request).await.unwrap();
            if is_lockstep {
                let request = v1::StepRequest { id: id.clone(), hold: steps, ..Default::default() };
                client.step(request).await.unwrap();
            }
            while all.len() <= (phase * steps) as usize {
                let message = soon(stream.next()).await.unwrap().expect("a state");
                assert_eq!(message.dropped, 0);
                let outputs = message.outputs.unwrap();
                let y: Vec<u64> = outputs.y.iter().map(|y| y.to_bits()).collect();
                let u: Vec<u64> = message.u.iter().map(|u| u.to_bits()).collect();
                all.push((bits(&message.state.unwrap()), y, outputs.lost, u));
            }
        }
        all
    };
    use v1::Pace::{Free, Lockstep, Paced};
    let lockstep = watched(&[Lockstep]).await;
    for paces in [&[Paced][..], &[Free], &[Paced, Lockstep, Free, Lockstep, Paced]] {
        let other = watched(paces).await;
        for (k, (expected, found)) in lockstep.iter().zip(&other).enumerate() {
            assert_eq!(expected, found, "step {k}, {paces:?}");
        }
    }
}

/// Drives a plant, and one of the mechanics alone by `acting(k, force)`; both must move alike.
async fn assert_moves_as(client: &Client, id: &str, acting: impl Fn(u64) -> f64) {
    client.reset(id).await.unwrap();
    let mut plain = cart_pole();
    for (k, step) in (0..).zip(drive(client, id, 60).await) {
        plain.step(&[acting(k)]).unwrap();
        let state = step.state.unwrap();
        assert_eq!((state.q.as_slice(), state.p.as_slice()), (plain.q(), plain.p()), "step {k}");
        assert_eq!(step.u, [acting(k)]);
    }
}

#[tokio::test]
async fn actuators_and_faults_of_inputs_are_exact() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let late = v1::InputChannel { delay_s: 5.0 * H, ..Default::default() };
    client.set_channels(&id, actuator(late)).await.unwrap();
    assert_moves_as(&client, &id, |k| if k < 5 { 0.0 } else { force(k - 5) }).await;
    let slow = v1::InputChannel {
        sample_period_s: 4.0 * H,
        max: Some(12.0),
        quantum: 0.5,
        dead_band: 1.0,
        ..Default::default()
    };
    client.set_channels(&id, actuator(slow)).await.unwrap();
    let slow = |k: u64| {
        let u = force(k - k % 4);
        ((u.abs() - 1.0).max(0.0).copysign(u).min(12.0) / 0.5).round() * 0.5
    };
    assert_moves_as(&client, &id, slow).await;
    client.set_channels(&id, v1::Channels::default()).await.unwrap();

    let in_middle = |k: u64| (20..30).contains(&k);
    type Expected = fn(u64) -> f64;
    let cases: [(Kind, Expected); 5] = [
        (Kind::Stuck(true), |_| force(19)),
        (Kind::Off(true), |_| 0.0),
        (Kind::WrongSign(true), |k| -force(k)),
        (Kind::Offset(v1::Offset { value: 2.5 }), |k| force(k) + 2.5),
        (Kind::Delay(v1::ExtraDelay { delay_s: 7.0 * H }), |k| force(k - 7)),
    ];
    for (kind, expected) in cases {
        let fault = from_step(20, 10.0, on_input(kind));
        client.reset(&id).await.unwrap();
        let injected = client.inject_fault(&id, fault.clone()).await.unwrap();
        let expected = |k| if in_middle(k) { expected(k) } else { force(k) };
        assert_moves_as(&client, &id, expected).await;
        // At a time, and only now and then.
        client.clear_fault(&id, injected.id).await.unwrap();
    }
    let blink = v1::Intermittent { period_s: 4.0 * H, duty: 0.25 };
    let fault = v1::FaultSpec {
        start: Some(Start::StartS(20.0 * H)),
        duration_s: 10.0 * H,
        pattern: Some(Pattern::Intermittent(blink)),
        ..on_input(Kind::Off(true))
    };
    client.reset(&id).await.unwrap();
    client.inject_fault(&id, fault).await.unwrap();
    let off = |k| [20, 24, 28].contains(&k);
    assert_moves_as(&client, &id, |k| if off(k) { 0.0 } else { force(k) }).await;
}

#[tokio::test]
async fn faults_of_outputs_begin_and_end_at_their_steps() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let declared = outputs(vec![output("rate", Source::Velocity("x".to_owned())), theta("angle")]);
    client.set_channels(&id, declared.clone()).await.unwrap();
    let fault = from_step(10, 5.0, on_output("angle", Kind::Stuck(true)));
    let info = client.inject_fault(&id, fault).await.unwrap();
    assert_eq!((info.id, info.phase()), (1, v1::FaultPhase::Waiting));
    let phase = async || client.list_faults(&id).await.unwrap()[0].phase();
    let mut steps = drive(&client, &id, 12).await;
    assert_eq!(phase().await, v1::FaultPhase::Active);
    steps.extend(drive(&client, &id, 8).await);
    assert_eq!(phase().await, v1::FaultPhase::Over);
    let angle = |k: usize| steps[k - 1].state.as_ref().unwrap().q[1];
    for (k, step) in (1..).zip(&steps) {
        let expected = if (10..15).contains(&k) { angle(9) } else { angle(k) };
        assert_eq!(y(step)[1], expected, "step {k}");
    }
    // It is told, too.
    let mut events = client.watch_events(&id, Some(0)).await.unwrap();
    let mut told = Vec::new();
    while told.len() < 2 {
        let event = soon(events.next()).await.unwrap().unwrap().event.unwrap();
        if let v1::EventKind::FaultBegan | v1::EventKind::FaultEnded = event.kind() {
            told.push((event.kind(), event.step, event.value));
        }
    }
    let began = (v1::EventKind::FaultBegan, 10, 1.0);
    assert_eq!(told, [began, (v1::EventKind::FaultEnded, 15, 1.0)]);
    // From now on: the next measurement is the first.
    let fault = v1::FaultSpec { duration_s: 2.0 * H, ..on_output("angle", Kind::Off(true)) };
    let info = client.inject_fault(&id, fault).await.unwrap();
    assert_eq!(info.fault.unwrap().start, Some(Start::StartStep(21)));
    let steps = drive(&client, &id, 3).await;
    assert_eq!([y(&steps[0])[1], y(&steps[1])[1]], [0.0, 0.0]);
    assert_ne!(y(&steps[2])[1], 0.0);
    // Faults follow their output, and end with it.
    let swapped = outputs(declared.outputs.iter().rev().cloned().collect());
    client.set_channels(&id, swapped).await.unwrap();
    assert_eq!(client.list_faults(&id).await.unwrap().len(), 2);
    client.reset(&id).await.unwrap();
    let steps = drive(&client, &id, 12).await;
    assert_eq!(y(&steps[9])[0], y(&steps[8])[0]);
    client.set_channels(&id, outputs(vec![declared.outputs[0].clone()])).await.unwrap();
    assert!(client.list_faults(&id).await.unwrap().is_empty());
}

/// A push is the impulse of its wrench, step by step.
#[tokio::test]
async fn pushes_are_impulses() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let (force_of, torque) = ([30.0, 5.0, 1.0], [0.0, 0.0, -4.0]);
    let kind = Some(push("pole", force_of, torque));
    let fault = v1::FaultSpec { kind, ..Default::default() };
    client.inject_fault(&id, from_step(7, 3.0, fault)).await.unwrap();
    let mut plain = cart_pole();
    let site = plain.model().site("pole", [0.0, -0.5, 0.0]).unwrap();
    for (k, step) in (0..).zip(drive(&client, &id, 20).await) {
        let mut impulse = [0.0; 2];
        if (7..10).contains(&k) {
            let over_step = |wrench: [f64; 3]| wrench.map(|component| H * component);
            plain.add_wrench(&site, over_step(force_of), over_step(torque), &mut impulse);
        }
        plain.with_impulse(&impulse, |plant| plant.step(&[force(k)])).unwrap();
        let state = step.state.unwrap();
        assert_eq!((state.q.as_slice(), state.p.as_slice()), (plain.q(), plain.p()), "step {k}");
    }
    assert_eq!(client.list_faults(&id).await.unwrap()[0].beginnings, 1);
}

fn change(path: &str, value: f64) -> v1::FaultSpec {
    let parameters = vec![v1::Parameter { path: path.to_owned(), value }];
    let kind = Some(Kind::Parameters(v1::ParameterChange { parameters }));
    v1::FaultSpec { kind, ..Default::default() }
}

/// Changes of parameters come and go at their steps, alone and together, and a push knows the lengths.
#[tokio::test]
async fn parameters_change_on_schedule() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    client.inject_fault(&id, from_step(10, 10.0, change("gravity[1]", -1.0))).await.unwrap();
    let kind = Some(push("pole", [5.0, 0.0, 0.0], [0.0; 3]));
    let push = v1::FaultSpec { kind, ..Default::default() };
    client.inject_fault(&id, from_step(12, 5.0, push)).await.unwrap();
    // From there on until it is cleared.
    let higher = change("frames[pole].translation[1]", 0.5);
    client.inject_fault(&id, from_step(15, 0.0, higher)).await.unwrap();

    let text = builtin::scene("cart-pole").unwrap().to_toml();
    let of = |light: bool, high: bool| {
        let mut table: toml::Table = text.parse().unwrap();
        if light {
            table["gravity"].as_array_mut().unwrap()[1] = (-1.0).into();
        }
        if high {
            let pole = table["frames"].as_array_mut().unwrap()[1].as_table_mut().unwrap();
            pole.insert("translation".to_owned(), vec![0.0, 0.5, 0.0].into());
        }
        let model = Model::compile(&Scene::from_toml(&table.to_string()).unwrap()).unwrap();
        let settings = Settings::new(&model);
        Plant::new(Arc::new(model), settings).unwrap()
    };
    let expected = |steps: u64| -> Vec<(Vec<f64>, Vec<f64>)> {
        let mut plain = of(false, false);
        let step = |k: u64| {
            let mut plant = of((10..20).contains(&k), k >= 15);
            plant.go_on_from(&plain).unwrap();
            let mut impulse = [0.0; 2];
            if (12..17).contains(&k) {
                let site = plant.model().site("pole", [0.0, -0.5, 0.0]).unwrap();
                plant.add_wrench(&site, [H * 5.0, 0.0, 0.0], [0.0; 3], &mut impulse);
            }
            plant.with_impulse(&impulse, |plant| plant.step(&[force(k)])).unwrap();
            plain = plant;
            (plain.q().to_vec(), plain.p().to_vec())
        };
        (0..steps).map(step).collect()
    };
    let expected = expected(30);
    let found = |steps: Vec<v1::DriveStep>| -> Vec<(Vec<f64>, Vec<f64>)> {
        steps.into_iter().map(|step| step.state.unwrap()).map(|s| (s.q, s.p)).collect()
    };
    let mut steps = drive(&client, &id, 18).await;
    let snapshot = client.snapshot(&id).await.unwrap();
    let parameters = async || client.get_plant(&id).await.unwrap().plant.unwrap().parameters.len();
    assert_eq!(parameters().await, 2);
    let refused = client.set_parameters(v1::SetParametersRequest {
        id: id.clone(),
        time_step_s: 0.5 * H,
        ..Default::default()
    });
    let precondition = Code::FailedPrecondition;
    assert_refused(refused.await, precondition, "PARAMETERS_SCHEDULED", "");
    steps.extend(drive(&client, &id, 12).await);
    assert_eq!(found(steps), expected);
    assert_eq!(parameters().await, 1);
    client.restore(&id, snapshot).await.unwrap();
    assert_eq!(found(drive(&client, &id, 12).await), expected[18..], "after a restore");
    client.reset(&id).await.unwrap();
    assert_eq!(found(drive(&client, &id, 30).await), expected, "after a reset");
    let faults = client.list_faults(&id).await.unwrap();
    assert!(faults.iter().all(|fault| fault.beginnings == 1 && !fault.refused));

    client.clear_fault(&id, 0).await.unwrap();
    assert_eq!(parameters().await, 0);
    let last = drive(&client, &id, 1).await.remove(0).state.unwrap();
    let mut plain = of(false, false);
    let mut before = of(false, true);
    let (q, p) = expected[29].clone();
    before.initialize(&Initial::Momentum { q, p, v: vec![] }).unwrap();
    before.set_step_index(30);
    plain.go_on_from(&before).unwrap();
    plain.step(&[force(30)]).unwrap();
    assert!(last.q.iter().zip(plain.q()).all(|(a, b)| (a - b).abs() < 1e-13));
    assert!(last.p.iter().zip(plain.p()).all(|(a, b)| (a - b).abs() < 1e-13));
}

/// Where the state does not satisfy the changed constraints, nothing changes, and it is said.
#[tokio::test]
async fn a_change_that_cannot_be_is_told() {
    let (_server, client) = server().await;
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/scenes/elements/distance.toml");
    client.create_model(std::fs::read_to_string(path).unwrap()).await.unwrap();
    let id = plant(&client, "distance").await.id;
    // The rod's ends move up: it fits where the scene begins, and not where the plant will be.
    let number =
        |end: &str, value| v1::Parameter { path: format!("constraints[rod].{end}.at[2]"), value };
    let parameters = vec![number("a", -0.9), number("b", -0.3)];
    let kind = Some(Kind::Parameters(v1::ParameterChange { parameters }));
    let fault = v1::FaultSpec { kind, ..Default::default() };
    client.inject_fault(&id, from_step(30, 10.0, fault)).await.unwrap();
    let refused = client.inject_fault(&id, change("frames[nobody].body.mass", 1.0)).await;
    assert_bad_field(refused, "fault.parameters.parameters[0].path");
    let step = v1::StepRequest { id: id.clone(), hold: 35, ..Default::default() };
    let state = client.step(step.clone()).await.unwrap().states.remove(0);
    let fault = client.list_faults(&id).await.unwrap().remove(0);
    assert!(fault.refused && fault.phase() == v1::FaultPhase::Active);
    let plain = plant(&client, "distance").await.id;
    let expected = client.step(v1::StepRequest { id: plain, ..step }).await.unwrap();
    assert_eq!(bits(&state), bits(&expected.states[0]));
}

#[tokio::test]
async fn a_failed_step_leaves_channels_as_they_were() {
    let (_server, client) = server().await;
    let (a, b) = (plant(&client, "cart-pole").await.id, plant(&client, "cart-pole").await.id);
    for id in [&a, &b] {
        disturb(&client, id, 3).await;
        let kind = Some(push("cart", [1.0; 3], [1.0; 3]));
        client.inject_fault(id, v1::FaultSpec { kind, ..Default::default() }).await.unwrap();
        // A lost input would not fail.
        client.clear_fault(id, 2).await.unwrap();
    }
    let mut driver = client.drive(&a).await.unwrap();
    let mut steps = Vec::new();
    for k in 0..30 {
        for bad in [vec![f64::NAN], vec![], vec![1e308]] {
            let error = driver.step(&bad).await.unwrap_err();
            assert!(matches!(error, Error::Step(_)), "{error}");
        }
        steps.push(driver.step(&[force(k)]).await.unwrap());
    }
    assert_eq!(seen(&steps), seen(&drive(&client, &b, 30).await));
}

/// Times follow the time step, and sites the lengths.
#[tokio::test]
async fn channels_follow_changed_parameters() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let at = v1::FramePoint { frame: "pole".to_owned(), at: vec![] };
    let late = v1::OutputChannel { latency_s: 2.0 * H, ..theta("late") };
    let declared = outputs(vec![late, output("hinge", Source::Position(at))]);
    client.set_channels(&id, declared).await.unwrap();
    let fault = from_step(30, 1.0, on_output("late", Kind::Offset(v1::Offset { value: 100.0 })));
    client.inject_fault(&id, fault).await.unwrap();
    drive(&client, &id, 5).await;
    let set = |path: &str, value, time_step_s| v1::SetParametersRequest {
        id: id.clone(),
        parameters: vec![v1::Parameter { path: path.to_owned(), value }],
        time_step_s,
    };
    client.set_parameters(set("gravity[1]", -1.0, 0.5 * H)).await.unwrap();
    let steps = drive(&client, &id, 30).await;
    let angle = |k: usize| steps[k - 6].state.as_ref().unwrap().q[1];
    for k in 10..=35 {
        // The fault lasts twice as many steps.
        let offset = if (30..32).contains(&k) { 100.0 } else { 0.0 };
        assert_eq!(y(&steps[k - 6])[0], angle(k - 4) + offset, "step {k}");
    }
    client.set_parameters(set("gravity[1]", -2.0, 0.0)).await.unwrap();
    assert_eq!(y(&drive(&client, &id, 1).await[0])[2], 0.0);
}

#[tokio::test]
async fn what_cannot_be_is_refused_and_changes_nothing() {
    let flags = "channels=3,outputs=8,channel_numbers=1000,faults=2";
    let (_server, client) = server_with(&["--limit", flags]).await;
    let id = plant(&client, "cart-pole").await.id;
    let good = outputs(vec![v1::OutputChannel { latency_s: H, ..theta("angle") }]);
    client.set_channels(&id, good).await.unwrap();
    drive(&client, &id, 3).await;
    let before = client.get_channels(&id).await.unwrap();

    let field = "channels.outputs[0]";
    let bad = f64::NAN;
    for (channel, part) in [
        (v1::OutputChannel { name: String::new(), ..theta("a") }, "name"),
        (output("a", Source::Coordinate("phi".to_owned())), "coordinate"),
        (output("a", Source::Velocity("phi".to_owned())), "velocity"),
        (output("a", Source::ConstraintForce("phi".to_owned())), "constraint_force"),
        (output("a", Source::Input("phi".to_owned())), "input"),
        (output("a", Source::Orientation("arm".to_owned())), "orientation"),
        (output("a", Source::Energy(false)), "energy"),
        (v1::OutputChannel { latency_s: -1.0, ..theta("a") }, "latency_s"),
        (v1::OutputChannel { latency_s: 1e300, ..theta("a") }, "latency_s"),
        (v1::OutputChannel { sample_period_s: bad, ..theta("a") }, "sample_period_s"),
        (v1::OutputChannel { bias: bad, ..theta("a") }, "bias"),
        (v1::OutputChannel { noise: -1.0, ..theta("a") }, "noise"),
        (v1::OutputChannel { quantum: -1.0, ..theta("a") }, "quantum"),
        (v1::OutputChannel { drop_out: 1.1, ..theta("a") }, "drop_out"),
        (v1::OutputChannel { min: Some(2.0), max: Some(1.0), ..theta("a") }, "min"),
        (v1::OutputChannel { max: Some(f64::INFINITY), ..theta("a") }, "max"),
    ] {
        let refused = client.set_channels(&id, outputs(vec![channel])).await;
        assert_bad_field(refused, &format!("{field}.{part}"));
    }
    let empty = v1::OutputChannel { name: "a".to_owned(), ..Default::default() };
    assert_bad_field(client.set_channels(&id, outputs(vec![empty])).await, field);
    let twice = outputs(vec![theta("a"), theta("a")]);
    assert_bad_field(client.set_channels(&id, twice).await, "channels.outputs[1].name");
    for (channel, part) in [
        (v1::InputChannel { delay_s: -1.0, ..Default::default() }, "delay_s"),
        (v1::InputChannel { max_rate: Some(-1.0), ..Default::default() }, "max_rate"),
        (v1::InputChannel { dead_band: bad, ..Default::default() }, "dead_band"),
        (v1::InputChannel { hold: 9, ..Default::default() }, "hold"),
    ] {
        let refused = client.set_channels(&id, actuator(channel)).await;
        assert_bad_field(refused, &format!("channels.inputs[0].{part}"));
    }
    let limit = async |channels: v1::Channels, name: &str| {
        let error = client.set_channels(&id, channels).await.unwrap_err();
        assert_eq!(error.reason(), "LIMIT_EXCEEDED");
        assert!(error.to_string().contains(&format!("limit `{name}`")), "{error}");
    };
    limit(outputs(["a", "b", "c", "d"].map(theta).to_vec()), "channels").await;
    let point = v1::FramePoint { frame: "world".to_owned(), at: vec![] };
    let position = |name| output(name, Source::Position(point.clone()));
    limit(outputs(vec![position("a"), position("b"), theta("c")]), "outputs").await;
    let latency_s = 999.0 * H;
    limit(outputs(vec![v1::OutputChannel { latency_s, ..theta("a") }]), "channel_numbers").await;

    let fault = on_input(Kind::Stuck(true));
    for (fault, field) in [
        (v1::FaultSpec::default(), "fault"),
        (v1::FaultSpec { target: None, ..fault.clone() }, "fault.input"),
        (on_output("rate", Kind::Stuck(true)), "fault.output"),
        (on_input(Kind::Stuck(false)), "fault.stuck"),
        (on_input(Kind::Noise(v1::ExtraNoise { deviation: bad })), "fault.noise.deviation"),
        (on_input(Kind::Loss(v1::PacketLoss { probability: 2.0 })), "fault.loss.probability"),
        (on_input(Kind::Delay(v1::ExtraDelay { delay_s: -1.0 })), "fault.delay.delay_s"),
        (on_input(push("cart", [0.0; 3], [0.0; 3])), "fault.input"),
        (
            v1::FaultSpec { kind: Some(push("arm", [0.0; 3], [0.0; 3])), ..Default::default() },
            "fault.push.point.frame",
        ),
        (v1::FaultSpec { duration_s: -1.0, ..fault.clone() }, "fault.duration_s"),
        (v1::FaultSpec { start: Some(Start::StartS(bad)), ..fault.clone() }, "fault.start_s"),
        (
            v1::FaultSpec {
                pattern: Some(Pattern::Intermittent(v1::Intermittent { period_s: 1.0, duty: 1.0 })),
                ..fault.clone()
            },
            "fault.intermittent.duty",
        ),
    ] {
        assert_bad_field(client.inject_fault(&id, fault).await, field);
    }
    assert!(client.list_faults(&id).await.unwrap().is_empty());
    assert_refused(client.clear_fault(&id, 1).await, Code::NotFound, "FAULT_NOT_FOUND", "");
    assert_not_found(client.get_channels("nobody").await, "PLANT_NOT_FOUND");
    assert_not_found(client.inject_fault("nobody", fault.clone()).await, "PLANT_NOT_FOUND");
    assert_eq!(client.get_channels(&id).await.unwrap(), before);

    // Those that are over make room.
    let short = v1::FaultSpec { duration_s: H, ..fault.clone() };
    client.inject_fault(&id, short).await.unwrap();
    drive(&client, &id, 1).await;
    client.inject_fault(&id, fault.clone()).await.unwrap();
    client.inject_fault(&id, fault.clone()).await.unwrap();
    let error = client.inject_fault(&id, fault).await.unwrap_err();
    assert_eq!(error.reason(), "LIMIT_EXCEEDED");
    let ids: Vec<u64> = client.list_faults(&id).await.unwrap().iter().map(|f| f.id).collect();
    assert_eq!(ids, [2, 3]);
    assert_eq!(client.clear_fault(&id, 0).await.unwrap(), 2);
}
