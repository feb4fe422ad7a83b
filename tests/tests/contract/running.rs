//! What running plants tell: the end of a run, states in order, leases, watchdogs.

use std::time::Duration;

use plantd_client::{Answers, Client, Code, v1};
use plantd_tests::server::ServerProcess;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::realtime::{broken_driver, protect, run_request, state, watchdog};
use crate::support::*;

async fn watch(client: &Client, id: &str) -> Answers<v1::WatchResponse> {
    let fields = vec![v1::WatchField::State.into()];
    let request = v1::WatchRequest { id: id.to_owned(), fields, queue: 512, ..Default::default() };
    client.watch(request).await.unwrap()
}

async fn next(states: &mut Answers<v1::WatchResponse>) -> v1::WatchResponse {
    soon(states.next()).await.unwrap().expect("the stream goes on")
}

async fn metrics(server: &ServerProcess) -> String {
    let address = server.addresses().metrics.clone().unwrap();
    let authority = address.trim_start_matches("http://").split('/').next().unwrap().to_owned();
    let mut stream = TcpStream::connect(authority).await.unwrap();
    stream.write_all(b"GET /metrics HTTP/1.0\r\n\r\n").await.unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).await.unwrap();
    text
}

/// Kinds of the events so far; the last one is that of a pause which is made here.
async fn events(client: &Client, id: &str) -> Vec<v1::EventKind> {
    let mut events = client.watch_events(id, Some(0)).await.unwrap();
    client.pause(id).await.unwrap();
    let mut kinds = Vec::new();
    while kinds.last() != Some(&v1::EventKind::Paused) {
        kinds.push(soon(events.next()).await.unwrap().unwrap().event.unwrap().kind());
    }
    kinds
}

#[tokio::test]
async fn a_run_of_some_steps_can_be_waited_for() {
    let (_server, client) = server().await;
    let waiting = |request: v1::RunRequest| v1::RunRequest { wait: true, ..request };
    for (pace, speed) in [(v1::Pace::Paced, 10.0), (v1::Pace::Free, 0.0)] {
        let id = plant(&client, "pendulum").await.id;
        let run = client.run(waiting(run_request(&id, pace, speed, 30))).await.unwrap();
        assert_eq!((run.running, run.steps_left, run.stopped_by), (false, 0, None));
        assert_eq!(state(&client, &id).await.step, 30);
        // Something else may end it.
        let run = client.run(waiting(run_request(&id, v1::Pace::Paced, 1.0, 0)));
        let stop = async {
            while !client.get_plant(&id).await.unwrap().plant.unwrap().run.unwrap().running {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            client.pause(&id).await.unwrap();
        };
        let (run, ()) = soon(async { tokio::join!(run, stop) }).await;
        assert!(!run.unwrap().running);
    }
    // In lockstep the driver takes them; a step that fails is none.
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let steps = async {
        while client.get_plant(&id).await.unwrap().plant.unwrap().run.unwrap().steps_left != 2 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        driver.step(&[f64::NAN]).await.unwrap_err();
        driver.step(&[0.1]).await.unwrap();
        driver.step(&[0.1]).await.unwrap()
    };
    let run = client.run(waiting(run_request(&id, v1::Pace::Lockstep, 0.0, 2)));
    let (run, last) = soon(async { tokio::join!(run, steps) }).await;
    assert_eq!(last.state.unwrap().step, 2);
    let run = run.unwrap();
    assert_eq!((run.running, run.steps_left), (false, 0));
    assert!(!client.get_plant(&id).await.unwrap().plant.unwrap().run.unwrap().running);
    assert!(events(&client, &id).await.contains(&v1::EventKind::StepsTaken));
    client.delete_plant(&id).await.unwrap();
    let gone = client.run(waiting(run_request(&id, v1::Pace::Free, 0.0, 1))).await;
    assert_refused(gone, Code::NotFound, "PLANT_NOT_FOUND", "");
}

/// Watchers of a plant that runs learn of a reset after the steps before it, and see each step once.
#[tokio::test]
async fn states_are_told_in_the_order_in_which_they_came() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut states = watch(&client, &id).await;
    let mut last = next(&mut states).await;
    client.run(run_request(&id, v1::Pace::Paced, 10.0, 0)).await.unwrap();
    for _ in 0..60 {
        client.reset(&id).await.unwrap();
        loop {
            let message = next(&mut states).await;
            let has_lost = message.dropped > last.dropped;
            let (before, step) = (last.step, message.step);
            assert!(step == 0 || has_lost || step == before + 1, "step {step} after {before}");
            last = message;
            if step == 0 || has_lost {
                break;
            }
        }
    }
}

/// Steps of a run that is over come before those that a driver takes after it.
#[tokio::test]
async fn steps_of_a_run_that_is_over_are_told_before_the_next_ones() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut states = watch(&client, &id).await;
    let mut last = next(&mut states).await.step;
    for round in 0..20 {
        let pace = if round % 2 == 0 { (v1::Pace::Free, 0.0) } else { (v1::Pace::Paced, 100.0) };
        let run = v1::RunRequest { wait: true, ..run_request(&id, pace.0, pace.1, 7) };
        client.run(run).await.unwrap();
        let step = v1::StepRequest { id: id.clone(), hold: 3, ..Default::default() };
        client.step(step).await.unwrap();
        for _ in 0..10 {
            let step = next(&mut states).await.step;
            assert_eq!(step, last + 1);
            last = step;
        }
    }
}

/// A recording that ends takes nothing away from watchers.
#[tokio::test]
async fn watchers_see_every_step_after_a_recording_has_ended() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_str().unwrap();
    let (_server, client) = server_with(&["--recordings", path]).await;
    let id = plant(&client, "pendulum").await.id;
    let run = run_request(&id, v1::Pace::Paced, 10.0, 300);
    client.run(v1::RunRequest { wait: true, ..run }).await.unwrap();
    client.run(run_request(&id, v1::Pace::Paced, 10.0, 0)).await.unwrap();
    let (id, name) = (id.clone(), "short".to_owned());
    let recording = v1::StartRecordingRequest { id: id.clone(), name, checkpoint_interval_s: 1.0 };
    client.start_recording(recording).await.unwrap();
    client.stop_recording("short").await.unwrap();
    let mut states = watch(&client, &id).await;
    let first = next(&mut states).await;
    let second = next(&mut states).await;
    assert_eq!(second.step, first.step + 1 + second.dropped);
}

/// The time step of the plant is that of the driver's pace too.
#[tokio::test]
async fn in_lockstep_at_a_speed_the_period_follows_the_time_step() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    client.run(run_request(&id, v1::Pace::Lockstep, 1.0, 0)).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[0.0]).await.unwrap();
    // A step an hour.
    let slow = run_request(&id, v1::Pace::Lockstep, 1e-3, 0);
    client.run(slow).await.unwrap();
    let request =
        v1::SetParametersRequest { id: id.clone(), parameters: Vec::new(), time_step_s: 3.6 };
    client.set_parameters(request).await.unwrap();
    driver.step(&[0.0]).await.unwrap();
    let early = tokio::time::timeout(Duration::from_millis(200), driver.step(&[0.0])).await;
    assert!(early.is_err(), "{early:?}");
}

/// Each driver that comes goes, in the events too, and nothing is left of a lease that was taken over.
#[tokio::test]
async fn leases_that_are_taken_over_are_told_and_leave_nothing() {
    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let open = |grace_s| v1::DriveOpen { id: id.clone(), grace_s, ..Default::default() };
    let token = broken_driver(&server, open(3600.0)).await;
    let resumed = v1::DriveOpen { resume: token.clone(), ..open(0.0) };
    let driver = client.drive_as(resumed.clone()).await.unwrap();
    driver.close().await.unwrap();
    let token = broken_driver(&server, open(0.01)).await;
    let again = async {
        loop {
            match client.drive(&id).await {
                Ok(driver) => break driver.close().await.unwrap(),
                Err(_) => tokio::time::sleep(Duration::from_millis(2)).await,
            }
        }
    };
    soon(again).await;
    let late = client.drive_as(v1::DriveOpen { resume: token, ..open(0.0) }).await;
    assert_refused(late, Code::FailedPrecondition, "LEASE_LOST", "");
    let kinds = events(&client, &id).await;
    let count = |kind| kinds.iter().filter(|other| **other == kind).count();
    assert_eq!(count(v1::EventKind::DriverAttached), 4, "{kinds:?}");
    assert_eq!(count(v1::EventKind::DriverLeft), 4, "{kinds:?}");
    // The task that kept the first lease has ended with it.
    let none = async {
        while !metrics(&server).await.contains("plantd_drivers{driver=\"drive\"} 0") {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    soon(none).await;
}

#[tokio::test]
async fn watchdogs_are_shown() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let safety = async || client.get_plant(&id).await.unwrap().plant.unwrap().safety;
    assert_eq!(safety().await, None);
    let dog = watchdog("v(x)", 0.5, v1::WatchdogAction::Freeze);
    protect(&client, &id, dog.clone()).await;
    let shown = safety().await.unwrap();
    assert_eq!((shown.watchdogs, shown.frozen), (vec![dog], None));
    let mut driver = client.drive(&id).await.unwrap();
    while driver.step(&[20.0]).await.is_ok() {}
    let frozen = safety().await.unwrap().frozen.unwrap();
    assert_eq!((frozen.watchdog, frozen.step), (0, state(&client, &id).await.step));
    assert!(frozen.value > 0.5);
    client.run(v1::RunRequest { id: id.clone(), ..Default::default() }).await.unwrap();
    assert_eq!(safety().await.unwrap().frozen, None);
    let request = v1::SetSafetyRequest { id: id.clone(), ..Default::default() };
    client.set_safety(request).await.unwrap();
    assert_eq!(safety().await, None);
}

/// A Run that is refused changes nothing, and one of a plant that runs needs no room besides its own.
#[tokio::test]
async fn a_plant_whose_run_is_refused_runs_as_before() {
    let (server, client) = server_with(&["--limit", "running_plants=1"]).await;
    let (first, second) =
        (plant(&client, "pendulum").await.id, plant(&client, "pendulum").await.id);
    let slow = run_request(&second, v1::Pace::Lockstep, 2.0, 3);
    let before = client.run(slow).await.unwrap();
    client.run(run_request(&first, v1::Pace::Paced, 1.0, 0)).await.unwrap();
    let refused = client.run(run_request(&second, v1::Pace::Free, 0.0, 0)).await;
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    let run = client.get_plant(&second).await.unwrap().plant.unwrap().run.unwrap();
    assert_eq!(run, before);
    for speed in [2.0, 3.0] {
        client.run(run_request(&first, v1::Pace::Paced, speed, 0)).await.unwrap();
    }
    assert!(metrics(&server).await.contains("plantd_running_plants 1"));
    client.run(run_request(&first, v1::Pace::Lockstep, 0.0, 0)).await.unwrap();
    assert!(metrics(&server).await.contains("plantd_running_plants 0"));
}
