//! Watching.

use plantd_client::{Answers, Client, v1};

use crate::support::*;

async fn watch(client: &Client, id: &str, fields: &[v1::WatchField]) -> v1::WatchRequest {
    // The plant must exist, so that a test fails here and not at a stream that ends at once.
    client.get_plant(id).await.unwrap();
    let fields = fields.iter().map(|&field| field.into()).collect();
    v1::WatchRequest { id: id.to_owned(), fields, ..Default::default() }
}

async fn next<T: std::fmt::Debug>(stream: &mut Answers<T>) -> T {
    soon(stream.next()).await.unwrap().expect("the stream goes on")
}

#[tokio::test]
async fn a_watcher_gets_what_it_asked_for_and_nothing_else() {
    use v1::WatchField::{Energy, Gain, Linearization, Report, State};
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let some = watch(&client, &id, &[State]).await;
    let mut all = watch(&client, &id, &[State, Report, Energy, Linearization, Gain]).await;
    all.weights = Some(unit_weights(4, 1));
    let mut some = client.watch(some).await.unwrap();
    let mut all = client.watch(all).await.unwrap();

    let mut driver = client.drive(&id).await.unwrap();
    // The step is watched by both, so that neither can miss it.
    let mut last = driver.step(&[0.5]).await.unwrap();
    let message = loop {
        let message = next(&mut some).await;
        if message.step > 0 {
            break message;
        }
    };
    assert!(message.report.is_none() && message.energy.is_none());
    assert!(message.linearization.is_none() && message.gain.is_none());
    assert_eq!(bits(&message.state.unwrap()), bits(last.state.as_ref().unwrap()));

    let message = loop {
        let message = next(&mut all).await;
        if message.step > 0 {
            break message;
        }
        last = driver.step(&[0.5]).await.unwrap();
    };
    assert!(message.failure.is_none(), "{:?}", message.failure);
    assert!(message.report.unwrap().iterations > 0);
    let energy = message.energy.unwrap();
    assert!(energy.kinetic_j > 0.0 && energy.potential_j.is_finite());
    let linearization = message.linearization.unwrap();
    assert_eq!(linearization.step, message.step);
    let shape = |m: Option<v1::Matrix>| m.map(|m| (m.rows, m.cols));
    assert_eq!(shape(linearization.a), Some((4, 4)));
    assert_eq!(shape(linearization.b), Some((4, 1)));
    assert_eq!(shape(message.gain.unwrap().k), Some((1, 4)));
    assert!(last.state.unwrap().step >= message.step);
}

#[tokio::test]
async fn steps_and_coordinates_can_be_thinned_out() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let request = v1::WatchRequest {
        every: 5,
        coordinates: vec!["theta".to_owned()],
        ..watch(&client, &id, &[v1::WatchField::State]).await
    };
    let mut stream = client.watch(request).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    let mut seen = 0;
    for k in 1..=20_u64 {
        let state = driver.step(&[0.1]).await.unwrap().state.unwrap();
        if k % 5 != 0 {
            continue;
        }
        let message = loop {
            let message = next(&mut stream).await;
            if message.step > 0 {
                break message;
            }
        };
        assert_eq!(message.step, k);
        let watched = message.state.unwrap();
        assert_eq!((watched.q.as_slice(), watched.p.as_slice()), (&state.q[1..], &state.p[1..]));
        assert_eq!(watched.velocity, state.velocity[1..]);
        seen += 1;
    }
    assert_eq!(seen, 4);
}

#[tokio::test]
async fn requests_of_watchers_are_checked() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let open = async |request: v1::WatchRequest| match client.watch(request).await {
        Ok(mut stream) => soon(stream.next()).await,
        Err(error) => Err(error),
    };
    let nothing = watch(&client, &id, &[]).await;
    assert_bad_field(open(nothing).await, "fields");
    let mut unknown = watch(&client, &id, &[v1::WatchField::State]).await;
    unknown.fields.push(99);
    assert_bad_field(open(unknown).await, "fields[1]");
    let mut masked = watch(&client, &id, &[v1::WatchField::State]).await;
    masked.coordinates = vec!["theta".to_owned(), "phi".to_owned()];
    assert_bad_field(open(masked).await, "coordinates[1]");
    let weightless = watch(&client, &id, &[v1::WatchField::Gain]).await;
    assert_bad_field(open(weightless).await, "weights");
}

#[tokio::test]
async fn a_stalled_watcher_loses_messages_and_stops_nobody() {
    const STEPS: u64 = 20_000;
    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let request = watch(&client, &id, &[v1::WatchField::State, v1::WatchField::Report]).await;
    // A connection of its own, as another process would have.
    let mut stalled = server.client().await.watch(request).await.unwrap();

    let mut driver = client.drive(&id).await.unwrap();
    for _ in 0..STEPS {
        driver.step(&[0.0]).await.unwrap();
    }
    let mut received = 0;
    let last = loop {
        let message = next(&mut stalled).await;
        received += u64::from(message.step > 0);
        if message.step == STEPS {
            break message;
        }
    };
    assert!(last.dropped > 0, "20 000 messages cannot have been kept");
    assert_eq!(received + last.dropped, STEPS, "what was lost is counted");
}

#[tokio::test]
async fn a_queue_keeps_what_the_latest_would_have_won_over() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let steps = 5000;
    let watched = async |queue: u32| {
        client.reset(&id).await.unwrap();
        let watch = watch(&client, &id, &[v1::WatchField::State]).await;
        let mut stream = client.watch(v1::WatchRequest { queue, ..watch }).await.unwrap();
        let request = v1::StepRequest { id: id.clone(), hold: steps, ..Default::default() };
        client.step(request).await.unwrap();
        let (mut seen, mut dropped) = (Vec::new(), 0);
        while seen.last() != Some(&u64::from(steps)) {
            let message = next(&mut stream).await;
            seen.push(message.step);
            dropped = message.dropped;
        }
        (seen, dropped)
    };
    let (all, dropped) = watched(steps + 1).await;
    assert_eq!((all, dropped), ((0..=u64::from(steps)).collect(), 0));
    let (some, dropped) = watched(4).await;
    assert!(some.is_sorted_by(|a, b| a < b));
    assert_eq!(some.len() as u64 + dropped, u64::from(steps) + 1);

    let watch = watch(&client, &id, &[v1::WatchField::State]).await;
    let refused = client.watch(v1::WatchRequest { queue: u32::MAX, ..watch }).await.unwrap_err();
    assert_eq!(refused.code(), Some(plantd_client::Code::ResourceExhausted));
    assert!(refused.to_string().contains("watch_numbers"), "{refused}");
}
