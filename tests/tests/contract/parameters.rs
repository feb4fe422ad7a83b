//! Numbers of a plant's scene, changed while it runs.

use plantd_client::{Client, Code, v1};
use plantd_models::{Initial, Model, Plant, Scene, Settings, builtin};

use crate::support::*;

fn set(id: &str, parameters: &[(&str, f64)], time_step_s: f64) -> v1::SetParametersRequest {
    let parameter =
        |(path, value): &(&str, f64)| v1::Parameter { path: (*path).to_owned(), value: *value };
    v1::SetParametersRequest {
        id: id.to_owned(),
        parameters: parameters.iter().map(parameter).collect(),
        time_step_s,
    }
}

async fn info(client: &Client, id: &str) -> v1::PlantInfo {
    client.get_plant(id).await.unwrap().plant.unwrap()
}

/// The cart-pole with these changes of its text, as a plant of the mechanics alone.
fn in_process(changes: &[(&str, &str)], time_step_s: f64) -> Plant {
    let text = builtin::scene("cart-pole").unwrap().to_toml();
    let text = changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "{from}\n{text}");
        text.replace(from, to)
    });
    let model = Model::compile(&Scene::from_toml(&text).unwrap()).unwrap();
    let settings = Settings { time_step_s, ..Settings::new(&model) };
    Plant::new(std::sync::Arc::new(model), settings).unwrap()
}

/// A plant of the changed scene goes on from the state at the change; so does the server's.
#[tokio::test]
async fn the_state_stays_and_the_motion_is_that_of_the_changed_scene() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let mut before = driver.plant().state.clone().unwrap();
    for k in 0..50 {
        before = driver.step(&[f64::from(k)]).await.unwrap().state.unwrap();
    }
    // The lease is held by the driver: nobody's is touched.
    let changes = [("frames[pole].body.mass", 3.5), ("gravity[1]", -1.6)];
    let plant = client.set_parameters(set(&id, &changes, 0.004)).await.unwrap();
    let state = plant.state.as_ref().unwrap();
    assert_eq!((&state.q, &state.p, state.step), (&before.q, &before.p, 50));
    assert_eq!(state.time_s, before.time_s);
    assert_eq!(plant.settings.unwrap().time_step_s, 0.004);
    let shown: Vec<_> = plant.parameters.iter().map(|p| (p.path.as_str(), p.value)).collect();
    assert_eq!(shown, changes);
    assert_eq!(info(&client, &id).await.parameters, plant.parameters);
    assert_eq!(plant.driver, "drive");

    let texts = [("mass = 1.0", "mass = 3.5"), ("-9.8", "-1.6")];
    let mut expected = in_process(&texts, 0.004);
    let (q, p, v) = (before.q.clone(), before.p.clone(), before.v.clone());
    expected.initialize(&Initial::Momentum { q, p, v }).unwrap();
    for k in 0..50 {
        let state = driver.step(&[f64::from(k)]).await.unwrap().state.unwrap();
        expected.step(&[f64::from(k)]).unwrap();
        assert_eq!((state.q.as_slice(), state.p.as_slice()), (expected.q(), expected.p()));
        let time_s = before.time_s + 0.004 * f64::from(k + 1);
        assert!((state.time_s - time_s).abs() < 1e-12, "{} {time_s}", state.time_s);
    }
    // Other plants of the model have the model's numbers.
    let other = client.get_model("cart-pole").await.unwrap();
    assert!(other.scene_toml.contains("-9.8"));
}

#[tokio::test]
async fn resets_keep_parameters_and_snapshots_belong_to_theirs() {
    let (_server, client) = server().await;
    let created = plant(&client, "cart-pole").await;
    let id = created.id;
    let start = created.state.unwrap();
    let step = |hold| v1::StepRequest { id: id.clone(), hold, ..Default::default() };
    client.step(step(20)).await.unwrap();
    let snapshot = client.snapshot(&id).await.unwrap();
    client.set_parameters(set(&id, &[("frames[pole].body.mass", 2.0)], 0.0)).await.unwrap();

    let refused = client.restore(&id, snapshot.clone()).await;
    assert_eq!(refused.unwrap_err().reason(), "SNAPSHOT_MISMATCH");
    assert_eq!(info(&client, &id).await.state.unwrap().step, 20);
    let changed = client.snapshot(&id).await.unwrap();
    let ahead = client.step(step(30)).await.unwrap().states.remove(0);
    client.restore(&id, changed).await.unwrap();
    let again = client.step(step(30)).await.unwrap().states.remove(0);
    assert_eq!(bits(&again), bits(&ahead), "a snapshot of the changed plant goes on bit for bit");

    let state = client.reset(&id).await.unwrap();
    assert_eq!((state.step, state.time_s), (0, 0.0));
    assert_eq!((&state.q, &state.p), (&start.q, &start.p));
    assert_eq!(info(&client, &id).await.parameters.len(), 1, "the change holds");

    // Back to the model's number, and the old snapshot fits again.
    client.set_parameters(set(&id, &[("frames[1].body.mass", 1.0)], 0.0)).await.unwrap();
    client.restore(&id, snapshot).await.unwrap();
}

#[tokio::test]
async fn a_refused_change_changes_nothing() {
    let (_server, client) = server_with(&["--limit", "parameters=2"]).await;
    let id = plant(&client, "cart-pole").await.id;
    client.step(v1::StepRequest { id: id.clone(), hold: 7, ..Default::default() }).await.unwrap();
    let before = info(&client, &id).await;
    let gravity = ("gravity[1]", -1.0);
    for (changes, field) in [
        (&[gravity, ("gravity[7]", 1.0)][..], "parameters[1].path"),
        (&[gravity, ("gravity[1]", 1.0)], "parameters[1].path"),
        (&[gravity, ("frames[arm].body.mass", 1.0)], "parameters[1].path"),
        (&[gravity, ("name", 1.0)], "parameters[1].path"),
        (&[gravity, ("time_step_s", 1.0)], "parameters[1].path"),
        (&[("gravity[1]", f64::NAN)], "parameters[0].path"),
        (&[], "parameters"),
    ] {
        assert_bad_field(client.set_parameters(set(&id, changes, 0.0)).await, field);
    }
    let bad = [gravity, ("frames[pole].body.mass", -1.0)];
    let refused = client.set_parameters(set(&id, &bad, 0.0)).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_SCENE", "frames[1].body.mass");
    let bad = [gravity, ("frames[pole].body.colour", 1.0)];
    let refused = client.set_parameters(set(&id, &bad, 0.0)).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_SCENE", "frames[1].body.colour");
    for time_step_s in [-0.01, f64::NAN, f64::INFINITY] {
        let refused = client.set_parameters(set(&id, &[gravity], time_step_s)).await;
        assert_bad_field(refused, "time_step_s");
    }
    assert_not_found(
        client.set_parameters(set("nobody", &[gravity], 0.0)).await,
        "PLANT_NOT_FOUND",
    );
    let three = [gravity, ("gravity[0]", 0.1), ("gravity[2]", 0.1)];
    let error = client.set_parameters(set(&id, &three, 0.0)).await.unwrap_err();
    assert_eq!(error.reason(), "LIMIT_EXCEEDED");
    client.set_parameters(set(&id, &three[1..2], 0.0)).await.unwrap();
    client.set_parameters(set(&id, &three[2..], 0.0)).await.unwrap();
    let error = client.set_parameters(set(&id, &three[..1], 0.0)).await.unwrap_err();
    assert_eq!(error.reason(), "LIMIT_EXCEEDED", "changes of several calls count together");
    let mut after = info(&client, &id).await;
    after.parameters.clear();
    assert_eq!(after, before);
}

/// A rod that is too short for where its ends are.
#[tokio::test]
async fn constraints_must_hold_at_the_state() {
    let (_server, client) = server().await;
    let id = plant(&client, "four-bar").await.id;
    let model = client.get_model("four-bar").await.unwrap();
    let scene: toml::Table = model.scene_toml.parse().unwrap();
    let frame = scene["frames"]
        .as_array()
        .unwrap()
        .iter()
        .position(|frame| frame.get("translation").is_some());
    let path = format!("frames[{}].translation[0]", frame.expect("a frame that is moved away"));
    let refused = client.set_parameters(set(&id, &[(&path, 17.0)], 0.0)).await;
    let error = refused.unwrap_err();
    assert_eq!((error.code(), error.reason()), (Some(Code::InvalidArgument), "OFF_CONSTRAINT"));
    assert!(info(&client, &id).await.parameters.is_empty());
}

/// What is computed about a plant is computed with its parameters.
#[tokio::test]
async fn linearizations_and_watchers_see_the_changed_plant() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let request = v1::WatchRequest {
        id: id.clone(),
        fields: vec![v1::WatchField::Linearization.into(), v1::WatchField::Energy.into()],
        ..Default::default()
    };
    let mut watch = client.watch(request).await.unwrap();
    let first = soon(watch.next()).await.unwrap().unwrap();
    client.set_parameters(set(&id, &[("frames[cart].body.mass", 2.0)], 0.0)).await.unwrap();
    let at = v1::LinearizeRequest {
        point: Some(plantd_client::present_state(&id)),
        ..Default::default()
    };
    let changed = client.linearize(at).await.unwrap().linearization.unwrap();
    assert_ne!(changed.b, first.linearization.unwrap().b);
    client.step(v1::StepRequest { id: id.clone(), hold: 1, ..Default::default() }).await.unwrap();
    let watched = soon(watch.next()).await.unwrap().unwrap();
    assert!(watched.failure.is_none(), "{:?}", watched.failure);
    assert_eq!(watched.step, 1);
    let mut expected = in_process(&[("mass = 10.0", "mass = 2.0")], 0.01);
    expected.step(&[0.0]).unwrap();
    let energy = expected.energy();
    let watched = watched.energy.unwrap();
    assert_eq!((watched.kinetic_j, watched.potential_j), (energy.kinetic_j, energy.potential_j));
}
