//! Plants that run by themselves: pace, inputs, pauses, watchdogs, events. No test looks at how long
//! something took.

use std::time::Duration;

use plantd_client::link::LinkDriver;
use plantd_client::{Client, Code, Error, v1};
use plantd_tests::links::patient;
use plantd_tests::server::ServerProcess;

use crate::support::*;

pub(crate) fn run_request(id: &str, pace: v1::Pace, speed: f64, steps: u64) -> v1::RunRequest {
    let settings = v1::RunSettings { pace: pace.into(), speed, input: None };
    v1::RunRequest { id: id.to_owned(), settings: Some(settings), steps, wait: false }
}

fn with_policy(mut request: v1::RunRequest, policy: v1::InputPolicy) -> v1::RunRequest {
    if let Some(settings) = &mut request.settings {
        settings.input = Some(policy);
    }
    request
}

pub(crate) async fn state(client: &Client, id: &str) -> v1::State {
    client.get_plant(id).await.unwrap().plant.unwrap().state.unwrap()
}

/// Waits until the plant stands still; says how it is run.
async fn standing(client: &Client, id: &str) -> v1::RunInfo {
    for _ in 0..60_000 {
        let run = client.get_plant(id).await.unwrap().plant.unwrap().run.unwrap();
        if !run.running {
            return run;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    panic!("the plant runs on");
}

/// The state after so many steps without inputs, taken in lockstep.
async fn expected(client: &Client, model: &str, steps: u32) -> v1::State {
    let id = plant(client, model).await.id;
    let request = v1::StepRequest { id: id.clone(), hold: steps, ..Default::default() };
    let last = client.step(request).await.unwrap().states.remove(0);
    client.delete_plant(id).await.unwrap();
    last
}

#[tokio::test]
async fn pace_and_speed_do_not_change_a_bit_of_the_motion() {
    let (_server, client) = server().await;
    for model in ["double-pendulum", "marionette"] {
        let expected = bits(&expected(&client, model, 300).await);
        for (pace, speed) in
            [(v1::Pace::Free, 0.0), (v1::Pace::Paced, 10.0), (v1::Pace::Paced, 37.5)]
        {
            let id = plant(&client, model).await.id;
            client.run(run_request(&id, pace, speed, 300)).await.unwrap();
            let run = standing(&client, &id).await;
            assert_eq!((run.stopped_by, run.steps_left), (None, 0), "{model}, {pace:?}");
            assert_eq!(bits(&state(&client, &id).await), expected, "{model}, {pace:?}, {speed}");
        }
    }
}

#[tokio::test]
async fn in_lockstep_speed_and_pauses_do_not_change_a_bit_of_the_motion() {
    let (_server, client) = server().await;
    let mut expected = None;
    for speed in [0.0, 0.1, 1.0, 10.0] {
        let created = v1::CreatePlantRequest {
            model: "cart-pole".to_owned(),
            settings: Some(v1::PlantSettings { time_step_s: 0.001, ..Default::default() }),
            ..Default::default()
        };
        let id = client.create_plant(created).await.unwrap().id;
        client.run(run_request(&id, v1::Pace::Lockstep, speed, 0)).await.unwrap();
        let mut driver = client.drive(&id).await.unwrap();
        let mut last = None;
        for k in 0..50 {
            if k == 25 {
                client.pause(&id).await.unwrap();
                let before = state(&client, &id).await.step;
                // An input that waits: each step has to be let through.
                let force = [f64::from(k).sin()];
                let step = driver.step(&force);
                let one = v1::RunRequest { id: id.clone(), settings: None, steps: 1, wait: false };
                let (step, run) = tokio::join!(step, client.run(one));
                run.unwrap();
                assert_eq!(step.unwrap().state.unwrap().step, before + 1);
                let all = v1::RunRequest { id: id.clone(), settings: None, steps: 0, wait: false };
                client.run(all).await.unwrap();
                continue;
            }
            last = driver.step(&[f64::from(k).sin()]).await.unwrap().state;
        }
        let last = bits(&last.unwrap());
        assert_eq!(&last, expected.get_or_insert(last.clone()), "speed {speed}");
    }
}

#[tokio::test]
async fn a_driver_gives_inputs_to_a_paced_plant_with_the_same_loop() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let lockstep = driver.step(&[0.5]).await.unwrap();
    assert!(lockstep.timing.is_none());
    client.run(run_request(&id, v1::Pace::Paced, 10.0, 0)).await.unwrap();
    let mut before = lockstep.state.unwrap().step;
    for k in 0..50 {
        let force = f64::from(k) - 25.0;
        let step = driver.step(&[force]).await.unwrap();
        let (timing, clocks) = (step.timing.unwrap(), step.clocks.unwrap());
        let now = step.state.unwrap();
        assert!(now.step > before);
        assert_eq!((step.sequence, step.u.as_slice()), (k as u64 + 2, &[force][..]));
        assert_eq!(timing.input_sequence, step.sequence);
        assert!(timing.due_ns <= timing.began_ns && timing.began_ns < timing.ended_ns);
        assert_eq!((clocks.plant_s, clocks.monotonic_ns), (now.time_s, timing.ended_ns));
        assert!(clocks.utc_ns > 1_700_000_000_000_000_000);
        before = now.step;
    }
    // States come without being asked for.
    let (first, second) = (driver.next().await.unwrap(), driver.next().await.unwrap());
    assert!(first.state.unwrap().step < second.state.unwrap().step);
    // In the middle of a step some counts are ahead of others.
    client.pause(&id).await.unwrap();
    let timing = client.timing(&id, true).await.unwrap();
    assert!(timing.steps > 50 && timing.steps == timing.step.unwrap().count);
    assert_eq!(timing.lateness.unwrap().count, timing.steps);
    assert!(timing.round_trip.unwrap().count >= 50);
    assert!(timing.late_inputs + 50 <= timing.steps + 1);
    assert!(client.timing(&id, false).await.unwrap().steps < timing.steps);
    // Back in lockstep nothing moves without an input.
    client.run(run_request(&id, v1::Pace::Lockstep, 0.0, 0)).await.unwrap();
    let still = state(&client, &id).await.step;
    assert_eq!(driver.step(&[0.0]).await.unwrap().state.unwrap().step, still + 1);
}

#[tokio::test]
async fn bad_inputs_to_a_running_plant_are_refused_and_do_not_act() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    client.run(run_request(&id, v1::Pace::Paced, 1.0, 0)).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[1.0]).await.unwrap();
    for (u, reason) in [(vec![f64::NAN], "INPUT_NOT_FINITE"), (vec![], "INPUT_DIMENSION")] {
        let error = driver.step(&u).await.unwrap_err();
        assert!(matches!(error, Error::Step(_)), "{error}");
        assert_eq!(error.reason(), reason);
    }
    assert_eq!(driver.next().await.unwrap().u, [1.0]);
    assert_eq!(driver.step(&[2.0]).await.unwrap().u, [2.0]);
}

#[tokio::test]
async fn steps_of_others_are_refused_while_a_plant_runs() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    client.run(run_request(&id, v1::Pace::Paced, 1.0, 0)).await.unwrap();
    let step = v1::StepRequest { id: id.clone(), hold: 1, ..Default::default() };
    assert_refused(client.step(step.clone()).await, Code::FailedPrecondition, "RUNNING", "");
    let paused = client.pause(&id).await.unwrap();
    assert!(!paused.run.unwrap().running);
    let stands_at = paused.state.unwrap().step;
    assert_eq!(client.step(step).await.unwrap().states[0].step, stands_at + 1);
    // One step at a time, at its pace.
    client
        .run(v1::RunRequest { id: id.clone(), settings: None, steps: 1, wait: false })
        .await
        .unwrap();
    standing(&client, &id).await;
    assert_eq!(state(&client, &id).await.step, stands_at + 2);
}

#[tokio::test]
async fn everything_else_can_be_done_to_a_running_plant_between_its_steps() {
    let (_server, client) = server().await;
    let id = plant(&client, "double-pendulum").await.id;
    client.run(run_request(&id, v1::Pace::Paced, 10.0, 0)).await.unwrap();
    // A snapshot of a running plant is exact: from there the motion is that of the plant itself.
    let snapshot = client.snapshot(&id).await.unwrap();
    let before = state(&client, &id).await;
    let parameters = vec![v1::Parameter { path: "gravity[1]".to_owned(), value: -1.6 }];
    let request = v1::SetParametersRequest { id: id.clone(), parameters, time_step_s: 0.002 };
    let changed = client.set_parameters(request).await.unwrap();
    assert_eq!(changed.settings.unwrap().time_step_s, 0.002);
    assert!(changed.state.unwrap().step >= before.step && changed.run.unwrap().running);
    assert_eq!(client.reset(&id).await.unwrap().step, 0);
    client.pause(&id).await.unwrap();

    let other = client
        .create_plant(v1::CreatePlantRequest {
            model: "double-pendulum".to_owned(),
            initial: Some(v1::InitialState {
                form: Some(v1::initial_state::Form::Snapshot(snapshot.clone())),
            }),
            ..Default::default()
        })
        .await
        .unwrap();
    let from = other.state.unwrap().step;
    let all = expected(&client, "double-pendulum", from as u32 + 10).await;
    let step = v1::StepRequest { id: other.id, hold: 10, ..Default::default() };
    assert_eq!(bits(&client.step(step).await.unwrap().states[0]), bits(&all));
    // A plant that runs can be deleted.
    client
        .run(v1::RunRequest { id: id.clone(), settings: None, steps: 0, wait: false })
        .await
        .unwrap();
    client.delete_plant(&id).await.unwrap();
    assert_refused(client.get_plant(&id).await, Code::NotFound, "PLANT_NOT_FOUND", "");
}

#[tokio::test]
async fn without_a_valid_input_the_policy_acts_and_the_next_input_ends_it() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let policy = v1::InputPolicy {
        // On the plant's clock: 50 ms of the machine's, within which it has to run the plant, the server and the driver.
        timeout_s: 0.5,
        action: v1::InputAction::Safe.into(),
        safe: vec![-3.0],
        ..Default::default()
    };
    let request = with_policy(run_request(&id, v1::Pace::Paced, 10.0, 0), policy);
    client.run(request).await.unwrap();
    let mut events = client.watch_events(&id, Some(0)).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    assert_eq!(driver.step(&[1.0]).await.unwrap().u, [1.0]);
    loop {
        let step = driver.next().await.unwrap();
        let timing = step.timing.unwrap();
        if step.u == [-3.0] {
            assert!(timing.input_safe && timing.input_late);
            break;
        }
        assert_eq!((step.u, timing.input_safe), (vec![1.0], false));
    }
    assert_eq!(driver.step(&[2.0]).await.unwrap().u, [2.0]);
    driver.close().await.unwrap();
    let mut kinds = Vec::new();
    while kinds.last() != Some(&v1::EventKind::DriverLeft) {
        let event = events.next().await.unwrap().unwrap().event.unwrap();
        assert_eq!(event.number, kinds.len() as u64);
        kinds.push(event.kind());
    }
    use v1::EventKind::{
        DriverAttached, DriverLeft, InputBack, InputLost, Overran, Slipped, Started,
    };
    let among = [InputBack, InputLost, Started, DriverAttached, DriverLeft, Overran, Slipped];
    assert!(kinds.iter().all(|kind| among.contains(kind)), "{kinds:?}");
    let back = kinds.iter().filter(|kind| **kind == InputBack).count();
    assert!(back >= 2, "{kinds:?}");
    // Without its driver the plant has the safe input again.
    loop {
        let event = events.next().await.unwrap().unwrap().event.unwrap();
        if event.kind() == InputLost {
            break;
        }
    }
}

/// No machine takes a step in 100 ns: the plant is late all the time, and two events tell of it in two
/// seconds.
#[tokio::test]
async fn overruns_are_counted_and_told_once_a_second() {
    let (_server, client) = server().await;
    let created = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        settings: Some(v1::PlantSettings { time_step_s: 0.001, ..Default::default() }),
        ..Default::default()
    };
    let id = client.create_plant(created).await.unwrap().id;
    client.run(run_request(&id, v1::Pace::Paced, 1e4, 0)).await.unwrap();
    let mut events = client.watch_events(&id, Some(0)).await.unwrap();
    let mut told = Vec::new();
    while told.len() < 2 {
        let event = events.next().await.unwrap().unwrap().event.unwrap();
        if event.kind() == v1::EventKind::Overran {
            told.push((event.value, event.monotonic_ns));
        }
    }
    client.pause(&id).await.unwrap();
    let (first, second) = (told[0], told[1]);
    assert_eq!(first.0, 1.0);
    assert!(second.1 - first.1 >= 1_000_000_000);
    let counted = client.timing(&id, false).await.unwrap().overruns as f64;
    assert!(second.0 > 1.0 && first.0 + second.0 <= counted, "{told:?}, {counted}");
}

#[tokio::test]
async fn a_policy_may_stop_the_plant_and_run_goes_on() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let policy =
        v1::InputPolicy { action: v1::InputAction::Stop.into(), ..v1::InputPolicy::default() };
    let request = with_policy(run_request(&id, v1::Pace::Free, 0.0, 0), policy);
    client.run(request).await.unwrap();
    let run = standing(&client, &id).await;
    assert_eq!(run.stopped_by.unwrap().reason, "INPUT_LOST");
    assert_eq!(state(&client, &id).await.step, 0);
    let hold = run_request(&id, v1::Pace::Free, 0.0, 5);
    client.run(hold).await.unwrap();
    assert_eq!(standing(&client, &id).await.stopped_by, None);
    assert_eq!(state(&client, &id).await.step, 5);
}

pub(crate) fn watchdog(quantity: &str, max: f64, action: v1::WatchdogAction) -> v1::Watchdog {
    let (quantity, max) = (quantity.to_owned(), Some(max));
    v1::Watchdog { quantity, min: None, max, action: action.into() }
}

pub(crate) async fn protect(client: &Client, id: &str, dog: v1::Watchdog) {
    let (id, watchdogs) = (id.to_owned(), vec![dog]);
    let request = v1::SetSafetyRequest { id, watchdogs, on_step_failure: 0 };
    client.set_safety(request).await.unwrap();
}

/// The pole falls from 0.7 rad, or is pushed: each quantity leaves its bounds.
#[tokio::test]
async fn a_watchdog_freezes_the_plant_and_says_why() {
    let (_server, client) = server().await;
    for (quantity, max) in [("x", 0.2), ("v(x)", 0.5), ("energy", 0.5)] {
        let id = plant(&client, "cart-pole").await.id;
        protect(&client, &id, watchdog(quantity, max, v1::WatchdogAction::Freeze)).await;
        let mut driver = client.drive(&id).await.unwrap();
        let error = loop {
            match driver.step(&[20.0]).await {
                Ok(step) => assert!(step.state.unwrap().step < 1000, "{quantity}"),
                Err(error) => break error,
            }
        };
        assert_eq!((error.code(), error.reason()), (Some(Code::FailedPrecondition), "WATCHDOG"));
        let mut events = client.watch_events(&id, Some(0)).await.unwrap();
        let event = loop {
            let event = events.next().await.unwrap().unwrap().event.unwrap();
            if event.kind() == v1::EventKind::Watchdog {
                break event;
            }
        };
        assert_eq!(event.subject, quantity);
        assert!(event.value > max, "{quantity}: {}", event.value);
        let stands_at = state(&client, &id).await.step;
        assert_eq!(event.step, stands_at);
        // Run releases it, and the next step is beyond the bound again.
        client
            .run(v1::RunRequest { id: id.clone(), settings: None, steps: 0, wait: false })
            .await
            .unwrap();
        assert_eq!(driver.step(&[0.0]).await.unwrap().state.unwrap().step, stands_at + 1);
        assert_eq!(driver.step(&[0.0]).await.unwrap_err().reason(), "WATCHDOG");
    }
}

/// The same over shared memory, and in a loop of the plant's own.
#[tokio::test]
async fn a_watchdog_acts_whoever_takes_the_steps() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    protect(&client, &id, watchdog("x", 0.2, v1::WatchdogAction::Freeze)).await;
    let opened = client.open_link(&id).await.unwrap();
    let options = patient(opened.root_path);
    let mut driver = LinkDriver::connect(&id, options).unwrap();
    let error = loop {
        if let Err(error) = driver.step(&[20.0]) {
            break error;
        }
    };
    assert!(error.to_string().contains("watchdog 0"), "{error}");
    drop(driver);
    undriven(&client, &id).await;
    client.reset(&id).await.unwrap();
    client.run(run_request(&id, v1::Pace::Free, 0.0, 0)).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    let _ = driver.offer(&[20.0]).await;
    let run = standing(&client, &id).await;
    assert_eq!(run.stopped_by.unwrap().reason, "WATCHDOG");
    assert!(state(&client, &id).await.q[0] > 0.2);
}

#[tokio::test]
async fn a_watchdog_resets_the_plant_or_takes_the_lease() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let start = bits(&state(&client, &id).await);
    protect(&client, &id, watchdog("x", 0.2, v1::WatchdogAction::Reset)).await;
    let mut driver = client.drive(&id).await.unwrap();
    let mut steps = 0;
    while driver.step(&[20.0]).await.unwrap().state.unwrap().step != 0 {
        steps += 1;
        assert!(steps < 1000);
    }
    assert_eq!(bits(&state(&client, &id).await), start, "back at the start");

    protect(&client, &id, watchdog("x", 0.2, v1::WatchdogAction::Disconnect)).await;
    let error = loop {
        if let Err(error) = driver.step(&[20.0]).await {
            break error;
        }
    };
    assert_eq!((error.code(), error.reason()), (Some(Code::Aborted), "LEASE_REVOKED"));
    client.drive(&id).await.unwrap();
}

/// A plant with watchdogs on everything moves as one without, to the last bit.
#[tokio::test]
async fn watchdogs_do_not_change_a_bit_of_the_motion() {
    let (_server, client) = server().await;
    for model in ["double-pendulum", "four-bar", "marionette"] {
        let id = plant(&client, model).await.id;
        protect(&client, &id, watchdog("energy", 1e9, v1::WatchdogAction::Freeze)).await;
        let step = v1::StepRequest { id, hold: 200, ..Default::default() };
        let last = client.step(step).await.unwrap().states.remove(0);
        assert_eq!(bits(&last), bits(&expected(&client, model, 200).await), "{model}");
    }
}

#[tokio::test]
async fn what_cannot_be_run_is_refused_by_name() {
    let (_server, client) = server_with(&["--limit", "running_plants=1"]).await;
    let (first, second) =
        (plant(&client, "pendulum").await.id, plant(&client, "pendulum").await.id);
    let invalid = Code::InvalidArgument;
    for (pace, speed, field) in [
        (v1::Pace::Paced, -1.0, "settings.speed"),
        (v1::Pace::Paced, f64::NAN, "settings.speed"),
        (v1::Pace::Paced, 1e9, "settings.speed"),
        (v1::Pace::Free, 1.0, "settings.speed"),
    ] {
        let refused = client.run(run_request(&first, pace, speed, 0)).await;
        assert_refused(refused, invalid, "INVALID_FIELD", field);
    }
    let policy = |policy| with_policy(run_request(&first, v1::Pace::Paced, 1.0, 0), policy);
    let long = policy(v1::InputPolicy { timeout_s: -1.0, ..Default::default() });
    assert_refused(client.run(long).await, invalid, "INVALID_FIELD", "settings.input.timeout_s");
    let wide = policy(v1::InputPolicy { safe: vec![0.0; 7], ..Default::default() });
    assert_refused(client.run(wide).await, invalid, "INVALID_FIELD", "settings.input.safe");
    let lockstep = run_request(&first, v1::Pace::Lockstep, 0.0, 0);
    let lockstep = with_policy(lockstep, v1::InputPolicy::default());
    assert_refused(client.run(lockstep).await, invalid, "INVALID_FIELD", "settings.input");

    client.run(run_request(&first, v1::Pace::Paced, 1.0, 0)).await.unwrap();
    let refused = client.run(run_request(&second, v1::Pace::Paced, 1.0, 0)).await;
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    client.pause(&first).await.unwrap();
    client.run(run_request(&second, v1::Pace::Free, 0.0, 0)).await.unwrap();

    let safety = |quantity: &str, max| v1::SetSafetyRequest {
        id: first.clone(),
        watchdogs: vec![watchdog(quantity, max, v1::WatchdogAction::Freeze)],
        on_step_failure: 0,
    };
    for (request, field) in [
        (safety("nothing", 1.0), "watchdogs[0].quantity"),
        (safety("force(rod)", 1.0), "watchdogs[0].quantity"),
        (safety("theta", f64::NAN), "watchdogs[0].min"),
    ] {
        assert_refused(client.set_safety(request).await, invalid, "INVALID_FIELD", field);
    }
    assert_refused(client.timing("nobody", false).await, Code::NotFound, "PLANT_NOT_FOUND", "");
}

/// A driver that takes a step, and whose connection then breaks; the name of its lease.
pub(crate) async fn broken_driver(server: &ServerProcess, open: v1::DriveOpen) -> String {
    let address = server.address().to_owned();
    let drive = move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let token = runtime.block_on(async {
            let client = Client::connect(address).await.unwrap();
            let mut driver = client.drive_as(open).await.unwrap();
            driver.step(&[0.1]).await.unwrap();
            let token = driver.lease_token().to_owned();
            // It does not end its stream: its connection goes with the runtime.
            std::mem::forget(driver);
            token
        });
        runtime.shutdown_background();
        token
    };
    tokio::task::spawn_blocking(drive).await.unwrap()
}

/// A driver whose connection breaks keeps its lease for a while, and goes on with it; one that ends its
/// stream gives it back at once.
#[tokio::test]
async fn a_lease_outlives_a_broken_connection_for_its_grace() {
    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let with_grace = |grace_s| v1::DriveOpen { id: id.clone(), grace_s, ..Default::default() };
    let token = broken_driver(&server, with_grace(3600.0)).await;
    for _ in 0..20 {
        tokio::time::sleep(Duration::from_millis(5)).await;
        let held = client.drive(&id).await;
        assert_refused(held, Code::FailedPrecondition, "LEASE_HELD", "");
    }
    let resume = |token: &str| v1::DriveOpen { resume: token.to_owned(), ..with_grace(0.0) };
    let wrong = client.drive_as(resume("0123")).await;
    assert_refused(wrong, Code::FailedPrecondition, "LEASE_LOST", "");
    let mut driver = client.drive_as(resume(&token)).await.unwrap();
    assert_eq!(driver.step(&[0.1]).await.unwrap().state.unwrap().step, 2);
    assert_eq!(driver.lease_token(), "");
    driver.close().await.unwrap();
    assert_refused(
        client.drive_as(resume(&token)).await,
        Code::FailedPrecondition,
        "LEASE_LOST",
        "",
    );
    // A short grace ends by itself.
    broken_driver(&server, with_grace(0.01)).await;
    let again = async {
        while client.drive(&id).await.is_err() {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    soon(again).await;
    let refused = client.drive_as(with_grace(-1.0)).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_FIELD", "grace_s");
}
