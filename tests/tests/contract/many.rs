//! Many plants in one call, and plants that go when nobody uses them.

use std::time::Duration;

use plantd_client::{Client, Code, v1};

use crate::support::*;

async fn many(client: &Client, model: &str, count: usize) -> Vec<String> {
    let mut ids = Vec::new();
    for _ in 0..count {
        ids.push(plant(client, model).await.id);
    }
    ids
}

fn request(ids: &[String], u: Vec<f64>, steps: u32) -> v1::StepManyRequest {
    v1::StepManyRequest { ids: ids.to_vec(), u, steps }
}

#[tokio::test]
async fn many_plants_step_to_the_bits_of_each_alone() {
    let (_server, client) = server().await;
    // Small plants are stepped at once, large ones by several workers.
    for (model, count) in [("cart-pole", 5), ("chain-64", 9)] {
        let (ids, alone) = (many(&client, model, count).await, many(&client, model, count).await);
        let inputs = client.get_model(model).await.unwrap().inputs.len();
        for steps in [1, 4] {
            let u: Vec<f64> = (0..count * inputs).map(|i| 0.1 * i as f64).collect();
            let answer = client.step_many(request(&ids, u.clone(), steps)).await.unwrap();
            assert_eq!(answer.plants.len(), count);
            for (i, stepped) in answer.plants.iter().enumerate() {
                let data = u[i * inputs..][..inputs].to_vec();
                let row = v1::Matrix { rows: 1, cols: inputs as u32, data };
                let (u, hold) = (Some(row), steps - 1);
                let id = alone[i].clone();
                let expected = client.step(v1::StepRequest { id, u, hold, ..Default::default() });
                let expected = expected.await.unwrap();
                let state = stepped.state.as_ref().unwrap();
                assert_eq!(bits(state), bits(&expected.states[0]), "{model} {i}");
                assert_eq!((stepped.steps, &stepped.failure), (steps, &None));
            }
        }
    }
}

#[tokio::test]
async fn what_cannot_be_stepped_says_why_and_disturbs_nobody() {
    let (_server, client) = server().await;
    let ids = many(&client, "pendulum", 4).await;
    let _driver = client.drive(&ids[1]).await.unwrap();
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    let run = v1::RunRequest { id: ids[2].clone(), settings: Some(settings), ..Default::default() };
    client.run(run).await.unwrap();
    let answer = client.step_many(request(&ids, Vec::new(), 2)).await.unwrap();
    let reasons: Vec<_> =
        answer.plants.iter().map(|p| p.failure.as_ref().map_or("", |f| &f.reason)).collect();
    assert_eq!(reasons, ["", "LEASE_HELD", "RUNNING", ""]);
    let steps: Vec<_> = answer.plants.iter().map(|plant| plant.steps).collect();
    assert_eq!(steps, [2, 0, 0, 2]);
    assert_eq!(answer.plants[1].state.as_ref().unwrap().step, 0);

    // Far too fast: the first plant of them fails in its step and stays where it was.
    let ids = many(&client, "pendulum", 2).await;
    let answer = client.step_many(request(&ids, vec![1e12, 0.0], 3)).await.unwrap();
    let failure = answer.plants[0].failure.as_ref().unwrap();
    assert_eq!(failure.code, Code::FailedPrecondition as i32, "{failure:?}");
    let taken = answer.plants[0].steps;
    assert_eq!(answer.plants[0].state.as_ref().unwrap().step, u64::from(taken));
    assert_eq!((answer.plants[1].steps, &answer.plants[1].failure), (3, &None));
}

#[tokio::test]
async fn a_call_that_makes_no_sense_steps_nobody() {
    let (_server, client) = server_with(&["--limit", "steps_per_call=6"]).await;
    let ids = many(&client, "pendulum", 2).await;
    let step = async |ids: &[String], u, steps| client.step_many(request(ids, u, steps)).await;
    assert_bad_field(step(&[], Vec::new(), 1).await, "ids");
    let twice = [ids[0].clone(), ids[1].clone(), ids[0].clone()];
    assert_bad_field(step(&twice, Vec::new(), 1).await, "ids[2]");
    assert_bad_field(step(&ids, vec![1.0; 3], 1).await, "u");
    let strange = [ids[0].clone(), "nobody".to_owned()];
    assert_not_found(step(&strange, Vec::new(), 1).await, "PLANT_NOT_FOUND");
    let refused = step(&ids, Vec::new(), 4).await;
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    // An input that is no number is the plant's own failure.
    let answer = step(&ids, vec![f64::NAN, 0.0], 1).await.unwrap();
    assert_eq!(answer.plants[0].failure.as_ref().unwrap().reason, "INPUT_NOT_FINITE");
    assert_eq!((answer.plants[0].steps, answer.plants[1].steps), (0, 1));
}

#[tokio::test]
async fn a_plant_goes_that_nobody_has_used_for_as_long_as_it_is_kept() {
    let (_server, client) = server().await;
    let create = async |expires_s| {
        let model = "pendulum".to_owned();
        client.create_plant(v1::CreatePlantRequest { model, expires_s, ..Default::default() }).await
    };
    for wrong in [0.5, -1.0, f64::NAN, 1e9] {
        assert_bad_field(create(wrong).await, "expires_s");
    }
    let (unused, stays) = (create(1.0).await.unwrap(), create(0.0).await.unwrap());
    assert_eq!((unused.expires_s, stays.expires_s), (1.0, 0.0));
    let (driven, watched) = (create(1.0).await.unwrap().id, create(1.0).await.unwrap().id);
    let driver = client.drive(&driven).await.unwrap();
    let watch = client.watch(v1::WatchRequest {
        id: watched.clone(),
        fields: vec![v1::WatchField::State.into()],
        ..Default::default()
    });
    let watch = watch.await.unwrap();
    let left = async || {
        let plants = client.list_plants().await.unwrap();
        plants.into_iter().map(|plant| plant.id).collect::<Vec<_>>()
    };
    let until = async |count| {
        soon(async {
            while left().await.len() > count {
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        })
        .await;
    };
    until(3).await;
    assert!(!left().await.contains(&unused.id));
    drop((driver, watch));
    until(1).await;
    assert_eq!(left().await, [stays.id]);
}

#[tokio::test]
async fn a_model_takes_the_place_of_an_uploaded_one() {
    let (_server, client) = server_with(&["--limit", "models=1"]).await;
    let upload = async |scene: &str, replace| {
        let scene = scene.to_owned();
        client
            .create_model_as(v1::CreateModelRequest { scene, replace, ..Default::default() })
            .await
    };
    upload(TWO_PENDULUMS, false).await.unwrap();
    let before = plant(&client, "two-pendulums").await.id;
    let refused = upload(TWO_PENDULUMS, false).await;
    assert_refused(refused, Code::AlreadyExists, "MODEL_EXISTS", "");
    upload(TWO_PENDULUMS, true).await.unwrap();
    client.get_plant(&before).await.unwrap();
    let builtin = TWO_PENDULUMS.replace("two-pendulums", "pendulum");
    assert_refused(upload(&builtin, true).await, Code::AlreadyExists, "MODEL_EXISTS", "");
    client.delete_model("two-pendulums").await.unwrap();
    upload(TWO_PENDULUMS, true).await.unwrap();
}

#[tokio::test]
async fn an_unknown_name_is_told_what_was_probably_meant() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let said = async |result: Result<(), plantd_client::Error>, words: &str| {
        let error = result.unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    let model = client.get_model("cart-pol").await.map(|_| ());
    said(model, "there is no model `cart-pol`; did you mean `cart-pole`?").await;
    let near = format!("{}x", &id[..id.len() - 1]);
    let plant = client.get_plant(&near).await.map(|_| ());
    said(plant, &format!("there is no plant `{near}`; did you mean `{id}`?")).await;
    let request = v1::KinematicsRequest {
        state: Some(v1::MechanicalState { plant: id, ..Default::default() }),
        frames: vec!["poll".to_owned()],
        ..Default::default()
    };
    let kinematics = client.kinematics(request).await.map(|_| ());
    said(kinematics, "there is no frame `poll`; did you mean `pole`?").await;
}
