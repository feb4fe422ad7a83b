//! What does not happen is said: faults that come too late, cases that are refused, watchdogs that hold.

use plantd_client::link::{Guarded, LinkDriver, LinkError, StepFailure};
use plantd_client::{Client, Code, RolloutExt as _, v1};
use plantd_tests::links::patient;
use v1::fault_spec::{Kind, Start, Target};

use crate::realtime::{protect, state, watchdog};
use crate::support::*;

const H: f64 = 0.01;

/// A fault of the force of the cart, or of what its sensor says.
fn fault(on_output: bool, start: Option<Start>, steps: f64) -> v1::FaultSpec {
    let target = match on_output {
        true => Target::Output("angle".to_owned()),
        false => Target::Input("force".to_owned()),
    };
    let (target, kind) = (Some(target), Some(Kind::Offset(v1::Offset { value: 1.0 })));
    v1::FaultSpec { target, kind, start, duration_s: steps * H, ..Default::default() }
}

/// A plant with a sensor, some steps after its beginning.
async fn moved_plant(client: &Client, steps: u32) -> String {
    let id = plant(client, "cart-pole").await.id;
    let angle = v1::OutputChannel {
        name: "angle".to_owned(),
        source: Some(v1::output_channel::Source::Coordinate("theta".to_owned())),
        ..Default::default()
    };
    let channels = v1::Channels { outputs: vec![angle], ..Default::default() };
    client.set_channels(&id, channels).await.unwrap();
    let request = v1::StepRequest { id: id.clone(), hold: steps, ..Default::default() };
    client.step(request).await.unwrap();
    id
}

#[tokio::test]
async fn a_fault_that_comes_too_late_is_refused_and_says_so() {
    let (_server, client) = server().await;
    let id = moved_plant(&client, 20).await;
    for late in [
        fault(false, Some(Start::StartStep(19)), 0.0),
        fault(false, Some(Start::StartS(0.1)), 3.0),
        fault(false, Some(Start::StartStep(0)), 1000.0),
        fault(true, Some(Start::StartStep(19)), 0.0),
        // The present measurement has been delivered.
        fault(true, Some(Start::StartStep(20)), 1.0),
    ] {
        let error = client.inject_fault(&id, late).await.unwrap_err();
        let (code, reason) = (error.code(), error.reason());
        assert_eq!((code, reason), (Some(Code::FailedPrecondition), "START_PASSED"), "{error}");
        assert!(error.to_string().contains("the plant is at step 20"), "{error}");
    }
    assert_eq!(client.list_faults(&id).await.unwrap(), [], "nothing is there of what was refused");
    for good in [
        fault(false, None, 0.0),
        fault(false, Some(Start::StartStep(20)), 0.0),
        fault(false, Some(Start::StartS(0.2)), 1.0),
        fault(true, None, 1.0),
        fault(true, Some(Start::StartStep(20)), 2.0),
        fault(true, Some(Start::StartStep(21)), 1.0),
    ] {
        client.inject_fault(&id, good).await.unwrap();
    }
    let ids: Vec<u64> = client.list_faults(&id).await.unwrap().iter().map(|f| f.id).collect();
    assert_eq!(ids, [1, 2, 3, 4, 5, 6]);
    // All of them began: none had been left behind.
    let request = v1::StepRequest { id: id.clone(), hold: 3, ..Default::default() };
    client.step(request).await.unwrap();
    let faults = client.list_faults(&id).await.unwrap();
    assert!(faults.iter().all(|fault| fault.beginnings == 1), "{faults:#?}");
}

/// A plant that runs goes on between the question where it is and the fault.
#[tokio::test]
async fn a_plant_that_runs_has_no_fault_in_its_past() {
    let (_server, client) = server().await;
    let id = moved_plant(&client, 1).await;
    let settings = v1::RunSettings { pace: v1::Pace::Free.into(), ..Default::default() };
    let request = v1::RunRequest { id: id.clone(), settings: Some(settings), ..Default::default() };
    client.run(request).await.unwrap();
    for _ in 0..50 {
        let step = state(&client, &id).await.step;
        let given = fault(false, Some(Start::StartStep(step)), 1.0);
        match client.inject_fault(&id, given).await {
            Ok(injected) => client.clear_fault(&id, injected.id).await.map(drop).unwrap(),
            Err(error) => assert_eq!(error.reason(), "START_PASSED"),
        }
        let next = client.inject_fault(&id, fault(false, None, 0.0)).await.unwrap();
        client.clear_fault(&id, next.id).await.unwrap();
    }
}

#[tokio::test]
async fn a_case_of_a_rollout_whose_initial_state_is_refused_says_so() {
    let (_server, client) = server().await;
    let case = |initial| v1::RolloutCase {
        initial: Some(initial),
        u: None,
        hold: 5,
        ..Default::default()
    };
    let nowhere = v1::InitialState {
        form: Some(v1::initial_state::Form::OperatingPoint("nowhere".to_owned())),
    };
    let request = v1::RolloutRequest {
        model: "pendulum".to_owned(),
        cases: vec![
            case(at_velocity(&[0.2], &[0.0])),
            case(at_velocity(&[0.2, 0.3], &[0.0])),
            case(nowhere),
            case(at_velocity(&[f64::NAN], &[0.0])),
        ],
        ..Default::default()
    };
    let mut answers = client.rollout(request).await.unwrap().collect().await.unwrap();
    answers.sort_by_key(|answer| answer.case_index);
    for (index, answer) in answers.into_iter().enumerate() {
        if index == 0 {
            assert_eq!(answer.into_states().unwrap().last().unwrap().step, 5);
            continue;
        }
        assert!(answer.states.is_empty());
        let error = answer.into_states().unwrap_err();
        assert_eq!(error.code(), Some(Code::InvalidArgument), "{error}");
        let field = format!("cases[{index}].initial");
        assert!(error.to_string().contains(&field), "no `{field}` in {error}");
    }
}

/// Over gRPC with its name, over shared memory with its index: the quantity, its bound, and the way on.
#[tokio::test]
async fn a_watchdog_names_its_quantity_its_bound_and_the_way_on() {
    let (_server, client) = server().await;
    for (quantity, max, guarded) in [
        ("x", 0.2, Guarded::Coordinate(0)),
        ("v(x)", 0.5, Guarded::Velocity(0)),
        ("energy", 0.5, Guarded::Energy),
    ] {
        let id = plant(&client, "cart-pole").await.id;
        protect(&client, &id, watchdog(quantity, max, v1::WatchdogAction::Freeze)).await;
        let opened = client.open_link(&id).await.unwrap();
        let options = patient(opened.root_path);
        let mut driver = LinkDriver::connect(&id, options).unwrap();
        let error = loop {
            if let Err(error) = driver.step(&[20.0]) {
                break error;
            }
        };
        let sentence = error.to_string();
        let LinkError::Step(StepFailure::Watchdog { watchdog: 0, quantity: told, value, bound }) =
            error
        else {
            panic!("{error}");
        };
        assert_eq!((told, bound), (guarded, max));
        assert!(value > max && sentence.contains("Reset"), "{sentence}");
        drop(driver);
        undriven(&client, &id).await;
        let mut driver = client.drive(&id).await.unwrap();
        let error = driver.step(&[20.0]).await.unwrap_err().to_string();
        let parts =
            [&format!("{quantity} is {value}"), &format!("bound {max}"), "Run", "SetSafety"];
        for part in parts {
            assert!(error.contains(part), "no `{part}` in {error}");
        }
    }
}
