//! What the calls answer.

use std::f64::consts::PI;

use plantd_client::{
    Client, GainExt as _, MatrixExt as _, StateExt as _, diagonal, operating_point, v1,
};

use crate::support::*;

#[tokio::test]
async fn models_are_listed_described_uploaded_and_forgotten() {
    let (_server, client) = server().await;
    let listed = client.list_models().await.unwrap();
    let names: Vec<_> = listed.iter().map(|model| model.name.as_str()).collect();
    for name in plantd_models::builtin::NAMES {
        assert!(names.contains(name), "no `{name}` among {names:?}");
    }
    assert!(listed.iter().all(|m| m.builtin && m.plan.is_empty() && m.scene_toml.is_empty()));

    let marionette = client.get_model("marionette").await.unwrap();
    let prescribed = marionette.coordinates.iter().filter(|c| c.prescribed).count();
    assert_eq!((marionette.coordinates.len(), prescribed), (40, 18));
    assert_eq!(marionette.constraints.len(), 6);
    assert!(!marionette.plan.is_empty());
    assert_eq!(client.get_model("chain-12").await.unwrap().coordinates.len(), 12);

    let created = client.create_model(TWO_PENDULUMS).await.unwrap();
    assert_eq!((created.name.as_str(), created.builtin), ("two-pendulums", false));
    let again = client.validate_scene(&created.scene_toml).await.unwrap();
    assert!(again.problems.is_empty(), "{:?}", again.problems);
    assert_eq!(again.model.unwrap().plan, created.plan);
    let json = r#"{"format": 1, "gravity": [0, 0, 0], "name": "slider", "frames": [{"name": "block",
        "joint": {"type": "prismatic", "axis": [1, 0, 0]}, "body": {"mass": 2}}]}"#;
    let slider = client.create_model(json).await.unwrap();
    assert_eq!(slider.coordinates[0].unit(), v1::Unit::Metre);

    let plant = plant(&client, "slider").await;
    client.delete_model("slider").await.unwrap();
    assert_not_found(client.get_model("slider").await, "MODEL_NOT_FOUND");
    let step = v1::StepRequest { id: plant.id, hold: 1, ..Default::default() };
    client.step(step).await.expect("plants outlive their model's name");
}

#[tokio::test]
async fn plants_are_created_listed_by_pages_and_deleted() {
    let (_server, client) = server().await;
    for id in ["c", "a", "b"] {
        let request = v1::CreatePlantRequest {
            id: id.to_owned(),
            model: "cart-pole".to_owned(),
            settings: Some(v1::PlantSettings { time_step_s: 0.002, ..Default::default() }),
            ..Default::default()
        };
        let plant = client.create_plant(request).await.unwrap();
        assert_eq!(plant.settings.unwrap().time_step_s, 0.002);
        assert_eq!(plant.state.unwrap().q, [0.0, 0.7]);
    }
    let request = v1::ListPlantsRequest { page_size: 2, page_token: String::new() };
    let page = client.plants().list_plants(request).await.unwrap().into_inner();
    let ids = |plants: &[v1::PlantInfo]| plants.iter().map(|p| p.id.clone()).collect::<Vec<_>>();
    assert_eq!(ids(&page.plants), ["a", "b"]);
    let request = v1::ListPlantsRequest { page_size: 2, page_token: page.next_page_token };
    let page = client.plants().list_plants(request).await.unwrap().into_inner();
    assert_eq!(ids(&page.plants), ["c"]);
    assert!(page.next_page_token.is_empty());

    client.delete_plant("b").await.unwrap();
    assert_eq!(ids(&client.list_plants().await.unwrap()), ["a", "c"]);
}

/// The same inputs through every way to step.
#[tokio::test]
async fn the_same_inputs_give_the_same_bits_whichever_way_they_come() {
    let (_server, client) = server().await;
    // The server steps large models in another way than small ones.
    for (model, amplitude, steps) in [("cart-pole", 1.0, 100), ("chain-72", 1e-5, 10)] {
        let input = |k: usize| [amplitude * (0.1 * k as f64).sin()];
        same_bits_whichever_way(&client, model, &(0..steps).map(input).collect::<Vec<_>>()).await;
    }
}

async fn same_bits_whichever_way(client: &Client, model: &str, inputs: &[[f64; 1]]) {
    let driven = plant(client, model).await.id;
    let mut driver = client.drive(&driven).await.unwrap();
    let mut states = Vec::new();
    for u in inputs {
        states.push(bits(&driver.step(u).await.unwrap().state.unwrap()));
    }

    let stepped = plant(client, model).await.id;
    let request = v1::StepRequest {
        id: stepped.clone(),
        u: Some(v1::Matrix::from_rows(inputs)),
        hold: 0,
        all_states: true,
        ..Default::default()
    };
    let answer = client.step(request).await.unwrap();
    assert_eq!(answer.states.iter().map(bits).collect::<Vec<_>>(), states);

    let case = v1::RolloutCase { u: Some(v1::Matrix::from_rows(inputs)), ..Default::default() };
    let request = v1::RolloutRequest {
        model: model.to_owned(),
        cases: vec![case; 3],
        every: 1,
        ..Default::default()
    };
    let mut cases = client.rollout(request).await.unwrap().collect().await.unwrap();
    cases.sort_by_key(|case| case.case_index);
    assert_eq!(cases.iter().map(|c| c.case_index).collect::<Vec<_>>(), [0, 1, 2]);
    for case in cases {
        assert!(case.failure.is_none(), "{:?}", case.failure);
        let after_start: Vec<_> = case.states.iter().filter(|s| s.step > 0).map(bits).collect();
        assert_eq!(after_start, states);
    }
}

#[tokio::test]
async fn snapshot_restore_and_reset_continue_bit_for_bit() {
    let (_server, client) = server().await;
    let id = plant(&client, "double-pendulum").await.id;
    let inputs = client.get_model("double-pendulum").await.unwrap().inputs.len();
    let run = async |id: &str| {
        let request = v1::StepRequest {
            id: id.to_owned(),
            u: Some(v1::Matrix::from_rows(&vec![vec![0.3; inputs]; 50])),
            all_states: true,
            ..Default::default()
        };
        client.step(request).await.unwrap().states.iter().map(bits).collect::<Vec<_>>()
    };
    let first = run(&id).await;
    let snapshot = client.snapshot(&id).await.unwrap();
    let second = run(&id).await;

    let restored = client.restore(&id, snapshot.clone()).await.unwrap();
    assert_eq!(Some(&bits(&restored)), first.last());
    assert_eq!(run(&id).await, second);

    let form = v1::initial_state::Form::Snapshot(snapshot);
    let request = v1::CreatePlantRequest {
        model: "double-pendulum".to_owned(),
        initial: Some(v1::InitialState { form: Some(form) }),
        ..Default::default()
    };
    let fork = client.create_plant(request).await.unwrap();
    assert_eq!(run(&fork.id).await, second);

    assert_eq!(client.reset(&id).await.unwrap().step, 0);
    assert_eq!(run(&id).await, first);
    let request =
        v1::ResetRequest { id: id.clone(), initial: Some(at_velocity(&[0.1, 0.2], &[0.0, 0.0])) };
    assert_eq!(client.reset_to(request).await.unwrap().q, [0.1, 0.2]);
}

fn linearize(model: &str, point: v1::Point) -> v1::LinearizeRequest {
    v1::LinearizeRequest { model: model.to_owned(), settings: None, point: Some(point) }
}

#[tokio::test]
async fn every_way_to_linearize_gives_the_same_matrices() {
    let (_server, client) = server().await;
    let plant = plant(&client, "cart-pole").await;
    let u = [0.4];
    let here = v1::StateAndInput { state: plant.state.clone(), u: u.to_vec() };
    let point = v1::Point { source: Some(v1::point::Source::StateAndInput(here)) };
    let at_point = client.linearize(linearize("cart-pole", point)).await.unwrap();
    assert_eq!(at_point.controllability_rank, 4);

    let request = v1::LinearizeTrajectoryRequest {
        model: "cart-pole".to_owned(),
        trajectory: Some(v1::Trajectory {
            initial: plant.state.clone(),
            u: Some(v1::Matrix::from_rows(&[u; 3])),
        }),
        ..Default::default()
    };
    let along = client.linearize_trajectory(request).await.unwrap().collect().await.unwrap();
    assert_eq!(along.len(), 3);

    let mut driver = client.drive_linearized(&plant.id).await.unwrap();
    for (k, expected) in along.iter().enumerate() {
        let step = driver.step(&u).await.unwrap();
        let driven = step.linearization.unwrap();
        assert_eq!(expected.linearization.as_ref(), Some(&driven));
        if k == 0 {
            assert_eq!(at_point.linearization.as_ref(), Some(&driven));
            assert_eq!(at_point.next.as_ref().unwrap().q, step.state.unwrap().q);
        }
    }
}

#[tokio::test]
async fn an_lqr_gain_balances_the_pendulum() {
    let (_server, client) = server().await;
    let request = v1::SolveLqrRequest {
        model: "pendulum".to_owned(),
        point: Some(operating_point("upright")),
        weights: Some(v1::LqrWeights {
            q: Some(diagonal([100.0, 1.0])),
            r: Some(diagonal([1.0])),
            ..Default::default()
        }),
        ..Default::default()
    };
    let answer = client.solve_lqr(request).await.unwrap();
    assert!(answer.spectral_radius < 1.0 && answer.residual < 1e-9);
    let gain = answer.gain.unwrap();
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        initial: Some(at_velocity(&[PI + 0.3], &[0.0])),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let mut state = plant.state.unwrap();
    let mut driver = client.drive(&plant.id).await.unwrap();
    for _ in 0..100 {
        state = driver.step_by(&gain, &state).await.unwrap().state.unwrap();
    }
    assert!((state.q[0] - PI).abs() < 1e-9, "{}", state.q[0]);
}

#[tokio::test]
async fn gains_along_a_trajectory_bring_a_perturbed_plant_back() {
    const STEPS: usize = 200;
    let (_server, client) = server().await;
    let reference = plant(&client, "marionette").await;
    let initial = reference.state.clone().unwrap();
    let held = &initial.q[22..];
    let inputs: Vec<Vec<f64>> = (0..STEPS)
        .map(|k| {
            let lift = 0.05 * (0.05 * k as f64).sin();
            held.iter().enumerate().map(|(i, x)| if i == 0 { x + lift } else { *x }).collect()
        })
        .collect();
    let request = v1::SolveTrajectoryLqrRequest {
        model: "marionette".to_owned(),
        trajectory: Some(v1::Trajectory {
            initial: Some(initial.clone()),
            u: Some(v1::Matrix::from_rows(&inputs)),
        }),
        weights: Some(v1::LqrWeights {
            q: Some(diagonal([[100.0; 40], [1.0; 40]].concat())),
            ..unit_weights(80, 18)
        }),
        ..Default::default()
    };
    let stream = client.solve_trajectory_lqr(request).await.unwrap();
    let gains: Vec<_> =
        stream.collect().await.unwrap().into_iter().map(|m| m.gain.unwrap()).collect();
    assert_eq!(gains.len(), STEPS + 1);
    assert_eq!(gains[0].x_reference, initial.x());
    assert!(gains[STEPS].k.is_none() && gains[STEPS].u_reference.is_empty());

    let open = tracking_error(&client, &initial, &gains, false).await;
    let closed = tracking_error(&client, &initial, &gains, true).await;
    assert!(closed < 0.6 * open, "closed loop {closed}, open loop {open}");
}

/// Sum of the configuration's error norms over a run that starts with a push.
async fn tracking_error(
    client: &Client,
    initial: &v1::State,
    gains: &[v1::Gain],
    feedback: bool,
) -> f64 {
    let momentum = v1::initial_state::Momentum {
        q: initial.q.clone(),
        p: initial.p.iter().map(|p| p + 0.01).collect(),
        v: initial.v.clone(),
    };
    let form = v1::initial_state::Form::Momentum(momentum);
    let request = v1::CreatePlantRequest {
        model: "marionette".to_owned(),
        initial: Some(v1::InitialState { form: Some(form) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let mut driver = client.drive(&plant.id).await.unwrap();
    let mut state = plant.state.unwrap();
    let mut sum = 0.0;
    for (gain, next) in gains.iter().zip(&gains[1..]) {
        let u = if feedback { gain.control(&state).unwrap() } else { gain.u_reference.clone() };
        state = driver.step(&u).await.unwrap().state.unwrap();
        let squares = state.q.iter().zip(&next.x_reference).map(|(q, r)| (q - r).powi(2));
        sum += squares.sum::<f64>().sqrt();
    }
    sum
}

#[tokio::test]
async fn a_failed_case_of_a_rollout_does_not_spoil_the_others() {
    let (_server, client) = server().await;
    let case = |velocity: f64| v1::RolloutCase {
        initial: Some(at_velocity(&[0.2], &[velocity])),
        u: None,
        hold: 20,
        ..Default::default()
    };
    let request = v1::RolloutRequest {
        model: "pendulum".to_owned(),
        cases: vec![case(0.0), case(1e6), case(1.0)],
        ..Default::default()
    };
    let mut answers = client.rollout(request).await.unwrap().collect().await.unwrap();
    answers.sort_by_key(|answer| answer.case_index);
    let failed: Vec<_> = answers.iter().map(|answer| answer.failure.is_some()).collect();
    assert_eq!(failed, [false, true, false]);
    assert!(!answers[1].failure.as_ref().unwrap().reason.is_empty());
    for answer in [&answers[0], &answers[2]] {
        assert_eq!(answer.states.iter().map(|s| s.step).collect::<Vec<_>>(), [20]);
    }
}

#[tokio::test]
async fn the_shared_memory_link_opens_once_and_says_where_it_is() {
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let link = client.open_link(&id).await.unwrap();
    assert!(!link.service.is_empty() && !link.root_path.is_empty() && link.layout_version > 0);
    assert_eq!(client.open_link(&id).await.unwrap(), link);
    assert!(client.get_plant(&id).await.unwrap().plant.unwrap().link_open);

    let (_server, client) = server_with(&["--link", "off"]).await;
    let id = plant(&client, "pendulum").await.id;
    let code = plantd_client::Code::FailedPrecondition;
    assert_refused(client.open_link(&id).await, code, "LINK_DISABLED", "");
}
