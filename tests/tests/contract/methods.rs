//! Orders, substeps, halving and precision: what plants are given, what they say, and what they do.

use plantd_client::{Client, Code, MatrixExt as _, StateExt as _, v1};
use plantd_models::HALVINGS_MAX;

use crate::support::*;

fn with(model: &str, settings: v1::PlantSettings) -> v1::CreatePlantRequest {
    v1::CreatePlantRequest {
        model: model.to_owned(),
        settings: Some(settings),
        ..Default::default()
    }
}

fn from_snapshot(
    model: &str,
    settings: v1::PlantSettings,
    bytes: Vec<u8>,
) -> v1::CreatePlantRequest {
    let form = v1::initial_state::Form::Snapshot(bytes);
    let initial = Some(v1::InitialState { form: Some(form) });
    v1::CreatePlantRequest { initial, ..with(model, settings) }
}

fn order(order: u32) -> v1::PlantSettings {
    v1::PlantSettings { order, ..Default::default() }
}

/// Steps under a force, as bits.
async fn run(client: &Client, id: &str) -> Vec<(u64, Vec<u64>)> {
    let request = v1::StepRequest {
        id: id.to_owned(),
        u: Some(v1::Matrix::from_rows(&[[0.3]; 20])),
        all_states: true,
        ..Default::default()
    };
    client.step(request).await.unwrap().states.iter().map(bits).collect()
}

#[tokio::test]
async fn settings_come_back_and_go_with_snapshots() {
    let (_server, client) = server().await;
    let plain = plant(&client, "cart-pole").await.settings.unwrap();
    assert_eq!((plain.order, plain.substeps, plain.halvings), (2, 1, Some(HALVINGS_MAX)));
    assert_eq!(plain.precision(), v1::Precision::Exact);

    let given = v1::PlantSettings {
        substeps: 3,
        halvings: Some(0),
        precision: v1::Precision::Fast.into(),
        ..order(6)
    };
    let created = client.create_plant(with("cart-pole", given)).await.unwrap();
    let shown = client.get_plant(&created.id).await.unwrap().plant.unwrap().settings.unwrap();
    let filled = v1::PlantSettings {
        order: 6,
        substeps: 3,
        halvings: Some(0),
        precision: v1::Precision::Fast.into(),
        ..plain
    };
    assert_eq!((shown, created.settings), (filled, Some(filled)));

    run(&client, &created.id).await;
    let snapshot = client.snapshot(&created.id).await.unwrap();
    let ahead = run(&client, &created.id).await;
    client.restore(&created.id, snapshot.clone()).await.unwrap();
    assert_eq!(run(&client, &created.id).await, ahead);
    let fork = from_snapshot("cart-pole", given, snapshot.clone());
    let fork = client.create_plant(fork).await.unwrap();
    assert_eq!(run(&client, &fork.id).await, ahead);
    for other in [order(6), v1::PlantSettings { halvings: None, ..given }] {
        let refused =
            client.create_plant(from_snapshot("cart-pole", other, snapshot.clone())).await;
        assert_refused(refused, Code::InvalidArgument, "SNAPSHOT_MISMATCH", "snapshot");
    }
}

#[tokio::test]
async fn methods_that_are_not_there_are_refused() {
    let (_server, client) = server().await;
    let create = async |model: &str, settings| client.create_plant(with(model, settings)).await;
    for number in [1, 3, 10, u32::MAX] {
        assert_bad_field(create("pendulum", order(number)).await, "settings.order");
    }
    create("four-bar", order(12)).await.unwrap();
    let paper = v1::PlantSettings { force_split: v1::ForceSplit::Paper.into(), ..order(4) };
    assert_bad_field(create("pendulum", paper).await, "settings.order");
    let often = v1::PlantSettings { halvings: Some(HALVINGS_MAX + 1), ..Default::default() };
    assert_bad_field(create("pendulum", often).await, "settings.halvings");
    let vague = v1::PlantSettings { precision: 9, ..Default::default() };
    assert_bad_field(create("pendulum", vague).await, "settings.precision");

    let reference = v1::ProjectReferenceRequest {
        model: "pendulum".to_owned(),
        settings: Some(order(4)),
        q: Some(v1::Matrix::from_rows(&[[0.1]; 3])),
        ..Default::default()
    };
    assert_bad_field(client.project_reference(reference).await, "settings.order");
}

/// A chain that turns by more than half a turn in a period.
#[tokio::test]
async fn a_halved_period_says_so_and_is_linearized_as_it_was_taken() {
    let (_server, client) = server().await;
    let settings = v1::PlantSettings { time_step_s: 0.1, ..Default::default() };
    let turning = v1::CreatePlantRequest {
        initial: Some(at_velocity(&[0.3, 0.1, 0.0, -0.1], &[40.0, 0.0, 0.0, 0.0])),
        ..with("chain-4", settings)
    };
    let plant = client.create_plant(turning).await.unwrap();
    let start = plant.state.unwrap();
    let hold = v1::PlantSettings { halvings: Some(0), ..settings };
    let step = async |x: &[f64], u: &[f64], settings: v1::PlantSettings| {
        let momentum =
            v1::initial_state::Momentum { q: x[..4].to_vec(), p: x[4..].to_vec(), v: Vec::new() };
        let form = v1::initial_state::Form::Momentum(momentum);
        let initial = Some(v1::InitialState { form: Some(form) });
        let request = v1::CreatePlantRequest { initial, ..with("chain-4", settings) };
        let id = client.create_plant(request).await.unwrap().id;
        let u = Some(v1::Matrix { rows: 1, cols: u.len() as u32, data: u.to_vec() });
        let request = v1::StepRequest { id: id.clone(), u, ..Default::default() };
        let answer = client.step(request).await;
        client.delete_plant(id).await.unwrap();
        answer
    };

    let mut driver = client.drive_linearized(&plant.id).await.unwrap();
    let (x, u) = (start.x(), vec![0.0; client.get_model("chain-4").await.unwrap().inputs.len()]);
    let refused = step(&x, &u, hold).await.unwrap_err();
    assert_eq!(refused.reason(), "TOO_FAST", "{refused}");
    let taken = driver.step(&u).await.unwrap();
    driver.close().await.unwrap();
    let report = taken.report.unwrap();
    assert!(report.halvings > 0 && report.steps == 1 << report.halvings, "{report:?}");

    let linearization = taken.linearization.unwrap();
    let (a, b) = (linearization.a.unwrap(), linearization.b.unwrap());
    let point = [x.as_slice(), &u].concat();
    let width = 1e-4;
    for column in 0..point.len() {
        let mut ends = Vec::new();
        for side in [-2.0, -1.0, 1.0, 2.0] {
            let mut point = point.clone();
            point[column] += side * width;
            let answer = step(&point[..8], &point[8..], settings).await.unwrap();
            assert_eq!(answer.report.unwrap().halvings, report.halvings);
            ends.push(answer.states[0].x());
        }
        let slope = |row: usize| {
            let [far_left, left, right, far_right] = [0, 1, 2, 3].map(|k: usize| ends[k][row]);
            (8.0 * (right - left) - (far_right - far_left)) / (12.0 * width)
        };
        for row in 0..8 {
            let exact = if column < 8 {
                a.data[row * 8 + column]
            } else {
                b.data[row * u.len() + column - 8]
            };
            let error = (slope(row) - exact).abs();
            assert!(error < 1e-6 * (1.0 + exact.abs()), "{row}, {column}: {error:e} of {exact}");
        }
    }
}

/// Against order 12 in many substeps.
#[tokio::test]
async fn a_tolerance_chooses_the_method() {
    let (_server, client) = server().await;
    let tolerance = |tolerance| v1::PlantSettings { tolerance, ..Default::default() };
    let path = async |settings| {
        let request = v1::CreatePlantRequest {
            initial: Some(at_velocity(&[2.0, 1.0], &[1.0, -2.0])),
            ..with("double-pendulum", settings)
        };
        let plant = client.create_plant(request).await.unwrap();
        let id = plant.id.clone();
        let request = v1::StepRequest { id, hold: 50, all_states: true, ..Default::default() };
        let states = client.step(request).await.unwrap().states;
        (plant, states.into_iter().flat_map(|state| state.q).collect::<Vec<_>>())
    };
    let (_, exact) = path(v1::PlantSettings { substeps: 16, ..order(12) }).await;
    let error =
        |path: &[f64]| path.iter().zip(&exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let wanted = 1e-8;
    let (chosen, found) = path(tolerance(wanted)).await;
    let accuracy = chosen.accuracy.unwrap();
    assert_eq!((accuracy.tolerance, accuracy.periods), (wanted, 50));
    assert!(accuracy.error <= wanted && error(&found) <= 1.2 * wanted, "{accuracy:?}");
    let settings = chosen.settings.unwrap();
    assert!(settings.order > 2 && settings.substeps > 0 && settings.tolerance == 0.0);
    let (plain, found) = path(v1::PlantSettings::default()).await;
    assert!(plain.accuracy.is_none() && error(&found) > 100.0 * wanted);
    let shown = client.get_plant(&chosen.id).await.unwrap().plant.unwrap();
    assert_eq!((shown.accuracy, shown.settings), (chosen.accuracy, Some(settings)));

    let create = async |model: &str, settings| client.create_plant(with(model, settings)).await;
    for bad in [-1.0, f64::NAN, f64::INFINITY, 1e-20] {
        assert_bad_field(create("pendulum", tolerance(bad)).await, "settings.tolerance");
    }
    let both = v1::PlantSettings { order: 4, ..tolerance(wanted) };
    assert_bad_field(create("pendulum", both).await, "settings.order");
    let both = v1::PlantSettings { substeps: 1, ..tolerance(wanted) };
    assert_bad_field(create("pendulum", both).await, "settings.substeps");
    let snapshot = client.snapshot(&chosen.id).await.unwrap();
    let fork = from_snapshot("double-pendulum", tolerance(wanted), snapshot);
    assert_bad_field(client.create_plant(fork).await, "initial.snapshot");
    let large = create("chain-129", tolerance(wanted)).await;
    assert_refused(large, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    let request = v1::LinearizeRequest {
        model: "pendulum".to_owned(),
        settings: Some(tolerance(wanted)),
        point: Some(plantd_client::operating_point("upright")),
    };
    assert_bad_field(client.linearize(request).await, "settings.tolerance");
    let fast = v1::PlantSettings { time_step_s: 1e3, ..tolerance(1e-12) };
    let refused = create("double-pendulum", fast).await;
    assert!(refused.is_err(), "{refused:?}");
}

/// A fast plant remembers nothing that its snapshot does not have.
#[tokio::test]
async fn fast_plants_are_restored_bit_for_bit() {
    let (_server, client) = server().await;
    let fast = v1::PlantSettings { precision: v1::Precision::Fast.into(), ..Default::default() };
    let step = async |id: &str, hold| {
        let request =
            v1::StepRequest { id: id.to_owned(), hold, all_states: true, ..Default::default() };
        client.step(request).await.unwrap().states.iter().map(bits).collect::<Vec<_>>()
    };
    let first = client.create_plant(with("cart-pole", fast)).await.unwrap().id;
    let other = client.create_plant(with("cart-pole", fast)).await.unwrap().id;
    step(&first, 2).await;
    let snapshot = client.snapshot(&first).await.unwrap();
    client.restore(&other, snapshot).await.unwrap();
    assert_eq!(step(&first, 20).await, step(&other, 20).await);
}
