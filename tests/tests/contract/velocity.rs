//! The velocity of states: of all coordinates, and in every state that a plant shows.

use plantd_client::v1;

use crate::realtime::{run_request, state};
use crate::support::*;

/// The cart-pole has no constraints: its momenta are M(q) times its velocities.
#[track_caller]
fn assert_of_momentum(state: &v1::State) {
    let (cos, [p_x, p_theta]) = (state.q[1].cos(), [state.p[0], state.p[1]]);
    // M = [[11, cos], [cos, 1]], in kg, kg m and kg m².
    let determinant = 11.0 - cos * cos;
    let expected =
        [(p_x - cos * p_theta) / determinant, (11.0 * p_theta - cos * p_x) / determinant];
    assert_eq!(state.velocity.len(), 2);
    for (found, expected) in state.velocity.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-13, "{found} {expected}");
    }
}

#[tokio::test]
async fn every_state_of_a_plant_has_the_velocity_of_its_momentum() {
    let (_server, client) = server().await;
    let (q, v) = ([0.1, 0.7], [0.3, -2.0]);
    let request = v1::CreatePlantRequest {
        model: "cart-pole".to_owned(),
        initial: Some(at_velocity(&q, &v)),
        ..Default::default()
    };
    let start = client.create_plant(request).await.unwrap();
    let (id, start) = (start.id, start.state.unwrap());
    for (found, given) in start.velocity.iter().zip(v) {
        assert!((found - given).abs() < 1e-14, "{found} {given}");
    }
    assert_of_momentum(&start);
    assert_eq!(client.list_plants().await.unwrap()[0].state.as_ref(), Some(&start));

    let fields = vec![v1::WatchField::State.into()];
    let watch = v1::WatchRequest { id: id.clone(), fields, queue: 64, ..Default::default() };
    let mut watch = client.watch(watch).await.unwrap();
    let steps = v1::StepRequest { id: id.clone(), hold: 3, all_states: true, ..Default::default() };
    let mut states = vec![start.clone()];
    states.extend(client.step(steps).await.unwrap().states);
    let mut driver = client.drive(&id).await.unwrap();
    for _ in 0..3 {
        states.push(driver.step(&[5.0]).await.unwrap().state.unwrap());
    }
    for state in &states {
        assert_of_momentum(state);
        assert_eq!(soon(watch.next()).await.unwrap().unwrap().state.as_ref(), Some(state));
    }
    assert_eq!(state(&client, &id).await, states[6]);
    driver.close().await.unwrap();

    let snapshot = client.snapshot(&id).await.unwrap();
    assert_eq!(client.reset(&id).await.unwrap(), start);
    let restored = client.restore(&id, snapshot).await.unwrap();
    assert_eq!(restored.velocity, states[6].velocity);
    // Those of the reset and of the restored state.
    for _ in 0..2 {
        soon(watch.next()).await.unwrap().unwrap();
    }

    // In a loop of its own it leaves by other ways.
    client.run(run_request(&id, v1::Pace::Free, 0.0, 20)).await.unwrap();
    for k in 7..=26 {
        let state = soon(watch.next()).await.unwrap().unwrap().state.unwrap();
        assert_eq!(state.step, k);
        assert_of_momentum(&state);
    }
    assert_of_momentum(&state(&client, &id).await);
    let mut driver = client.drive(&id).await.unwrap();
    client.run(run_request(&id, v1::Pace::Paced, 1.0, 0)).await.unwrap();
    assert_of_momentum(&driver.step(&[1.0]).await.unwrap().state.unwrap());
}

/// With constraints and prescribed coordinates it is the slope of the configuration.
#[tokio::test]
async fn the_velocity_is_the_slope_of_the_configuration() {
    const H: f64 = 1e-4;
    const RATE: f64 = 0.05;
    let (_server, client) = server().await;
    let start = plant(&client, "marionette").await.state.unwrap();
    let (n, nd) = (start.q.len(), start.p.len());
    let v: Vec<_> = (0..n).map(|i| if i < nd { (1.0 + i as f64).sin() } else { RATE }).collect();
    let request = v1::CreatePlantRequest {
        model: "marionette".to_owned(),
        initial: Some(at_velocity(&start.q, &v)),
        settings: Some(v1::PlantSettings { time_step_s: H, ..Default::default() }),
        ..Default::default()
    };
    let id = client.create_plant(request).await.unwrap().id;
    let at = |k: usize| start.q[nd..].iter().map(move |q| q + RATE * H * k as f64);
    let (rows, cols) = (20, (n - nd) as u32);
    let u = v1::Matrix { rows, cols, data: (1..=rows as usize).flat_map(at).collect() };
    let steps = v1::StepRequest { id, u: Some(u), all_states: true, ..Default::default() };
    let states = client.step(steps).await.unwrap().states;
    let [.., before, state, after] = &states[..] else { panic!("{} states", states.len()) };
    assert_eq!(state.velocity.len(), n);
    assert_eq!(state.velocity[nd..], state.v);
    let size = state.velocity.iter().fold(1.0, |size: f64, v| size.max(v.abs()));
    for (i, v) in state.velocity.iter().enumerate() {
        let slope = (after.q[i] - before.q[i]) / (2.0 * H);
        assert!((v - slope).abs() < 1e-5 * size, "{i}: {v} {slope}");
    }
}
