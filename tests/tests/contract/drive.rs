//! Driving: the lease, failures in band, and the end of a stream.

use std::time::{Duration, Instant};

use plantd_client::{Client, Code, Error, v1};

use crate::support::*;

#[tokio::test]
async fn a_second_driver_waits_outside_until_the_first_has_left() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[0.1]).await.unwrap();

    let held = (Code::FailedPrecondition, "LEASE_HELD");
    assert_refused(client.drive(&id).await, held.0, held.1, "");
    let step = v1::StepRequest { id: id.clone(), hold: 1, ..Default::default() };
    assert_refused(client.step(step.clone()).await, held.0, held.1, "");
    assert_refused(client.reset(&id).await, held.0, held.1, "");
    let snapshot = client.snapshot(&id).await.unwrap();
    assert_refused(client.restore(&id, snapshot).await, held.0, held.1, "");
    assert_eq!(client.get_plant(&id).await.unwrap().plant.unwrap().driver, "drive");

    driver.step(&[0.1]).await.unwrap();
    driver.close().await.unwrap();
    let state = client.step(step).await.unwrap().states.remove(0);
    assert_eq!(state.step, 3);
    client.drive(&id).await.unwrap();
}

#[tokio::test]
async fn a_driver_that_dies_gives_up_the_lease() {
    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let other = Client::connect(server.address()).await.unwrap();
    let driver = other.drive(&id).await.unwrap();
    drop((driver, other));
    let deadline = Instant::now() + Duration::from_secs(30);
    while let Err(error) = client.drive(&id).await {
        assert_eq!(error.reason(), "LEASE_HELD");
        assert!(Instant::now() < deadline, "the lease is never given up");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn a_lease_is_held_without_a_stream_of_inputs() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let mut lease = client.hold(&id).await.unwrap();
    let held = soon(lease.next()).await.unwrap().unwrap();
    assert_eq!(held.plant.unwrap().id, id);
    assert_eq!(client.get_plant(&id).await.unwrap().plant.unwrap().driver, "drive");
    assert_refused(client.drive(&id).await, Code::FailedPrecondition, "LEASE_HELD", "");

    let input = |token: &str, u: &[f64]| v1::SetInputRequest {
        id: id.clone(),
        lease_token: token.to_owned(),
        u: u.to_vec(),
        sequence: 7,
    };
    let token = &held.lease_token;
    let set = client.set_input(input(token, &[2.0])).await;
    assert_refused(set, Code::FailedPrecondition, "LOCKSTEP", "");
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    let run = v1::RunRequest { id: id.clone(), settings: Some(settings), ..Default::default() };
    client.run(run).await.unwrap();
    let set = client.set_input(input("0", &[2.0])).await;
    assert_refused(set, Code::FailedPrecondition, "LEASE_LOST", "");
    let set = client.set_input(input(token, &[2.0, 0.0])).await;
    assert_refused(set, Code::InvalidArgument, "INPUT_DIMENSION", "u");
    client.set_input(input(token, &[2.0])).await.unwrap();
    let fields = vec![v1::WatchField::Input.into(), v1::WatchField::Timing.into()];
    let request = v1::WatchRequest { id: id.clone(), fields, ..Default::default() };
    let mut states = client.watch(request).await.unwrap();
    loop {
        let state = soon(states.next()).await.unwrap().unwrap();
        if state.u == [2.0] {
            assert_eq!(state.timing.unwrap().input_sequence, 7);
            break;
        }
    }

    drop(lease);
    undriven(&client, &id).await;
    let set = client.set_input(input(token, &[1.0])).await;
    assert_refused(set, Code::FailedPrecondition, "LEASE_LOST", "");
}

#[tokio::test]
async fn a_bad_input_is_answered_in_band_and_the_stream_goes_on() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let before = driver.step(&[1.0]).await.unwrap().state.unwrap();
    for (u, reason) in [
        (vec![], "INPUT_DIMENSION"),
        (vec![0.0; 2], "INPUT_DIMENSION"),
        (vec![0.0; 10_000], "INPUT_DIMENSION"),
        (vec![f64::NAN], "INPUT_NOT_FINITE"),
        (vec![f64::INFINITY], "INPUT_NOT_FINITE"),
    ] {
        let error = driver.step(&u).await.unwrap_err();
        assert!(matches!(error, Error::Step(_)), "{error}");
        assert_eq!((error.code(), error.reason()), (Some(Code::InvalidArgument), reason));
    }
    let now = client.get_plant(&id).await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(bits(&now), bits(&before), "the plant is where it was");
    assert_eq!(driver.step(&[1.0]).await.unwrap().state.unwrap().step, before.step + 1);
}

#[tokio::test]
async fn a_step_without_solution_leaves_the_plant_where_it_was() {
    let (_server, client) = server().await;
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        initial: Some(at_velocity(&[0.2], &[1e6])),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let start = bits(plant.state.as_ref().unwrap());
    let step = v1::StepRequest { id: plant.id.clone(), hold: 1, ..Default::default() };
    let unary = client.step(step).await.unwrap_err();
    let mut driver = client.drive(&plant.id).await.unwrap();
    let driven = driver.step(&[0.0]).await.unwrap_err();
    for error in [&unary, &driven] {
        assert_eq!(error.code(), Some(Code::FailedPrecondition), "{error}");
        assert!(!error.reason().is_empty());
    }
    assert_eq!(unary.reason(), driven.reason());
    let now = client.get_plant(&plant.id).await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(bits(&now), start);
}

#[tokio::test]
async fn messages_out_of_order_end_the_stream() {
    use v1::drive_request::Request;
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let open = || Request::Open(v1::DriveOpen { id: id.clone(), ..Default::default() });
    let input = Request::Input(v1::DriveInput { sequence: 1, u: vec![0.0], answers_ns: 0 });
    for (requests, answers) in [
        (vec![Some(input)], 0),
        (vec![None], 0),
        (vec![Some(open()), Some(open())], 1),
        (vec![Some(open()), None], 1),
    ] {
        let requests: Vec<_> =
            requests.into_iter().map(|request| v1::DriveRequest { request }).collect();
        let stream = client.plants().drive(tokio_stream::iter(requests)).await;
        let mut stream = stream.unwrap().into_inner();
        for _ in 0..answers {
            soon(stream.message()).await.unwrap().unwrap();
        }
        let end = soon(stream.message()).await.map_err(Into::into);
        assert_refused(end, Code::InvalidArgument, "PROTOCOL", "");
    }
}

#[tokio::test]
async fn deleting_a_plant_ends_its_driver_and_its_watchers() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let request = v1::WatchRequest {
        id: id.clone(),
        fields: vec![v1::WatchField::State.into()],
        ..Default::default()
    };
    let mut watch = client.watch(request).await.unwrap();
    driver.step(&[0.0]).await.unwrap();

    client.delete_plant(&id).await.unwrap();
    assert_not_found(driver.step(&[0.0]).await, "PLANT_DELETED");
    let end = loop {
        match soon(watch.next()).await {
            Ok(Some(_)) => {}
            end => break end,
        }
    };
    assert_not_found(end, "PLANT_DELETED");
    assert_not_found(client.get_plant(&id).await, "PLANT_NOT_FOUND");
    assert_not_found(client.delete_plant(&id).await, "PLANT_NOT_FOUND");
}

#[tokio::test]
async fn a_step_whose_caller_lost_patience_does_not_confuse_the_next() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    {
        // Polled once, so that the input is on its way, then dropped.
        let step = std::pin::pin!(driver.step(&[0.5]));
        assert!(futures_poll_once(step).await.is_none());
    }
    let step = driver.step(&[0.5]).await.unwrap();
    assert_eq!(step.sequence, 2);
    assert_eq!(step.state.unwrap().step, 2, "both inputs were applied");
}

/// Polls a future once and gives its output if it was ready.
async fn futures_poll_once<F: Future>(mut future: std::pin::Pin<&mut F>) -> Option<F::Output> {
    std::future::poll_fn(|context| {
        std::task::Poll::Ready(match future.as_mut().poll(context) {
            std::task::Poll::Ready(output) => Some(output),
            std::task::Poll::Pending => None,
        })
    })
    .await
}
