//! Rollouts with everything that a plant can have: each case moves as a plant does that is driven step by step.

use futures::TryStreamExt as _;
use plantd_client::{Client, Code, MatrixExt as _, diagonal, operating_point, v1, weights};
use v1::fault_spec::{Kind, Target};
use v1::output_channel::Source;

use crate::support::*;

const STEPS: u32 = 60;

/// A sensor that is late and noisy, and an actuator that is late and coarse.
fn channels() -> v1::Channels {
    let sensor = v1::OutputChannel {
        name: "angle".to_owned(),
        source: Some(Source::Coordinate("theta".to_owned())),
        latency_s: 0.02,
        noise: 1e-3,
        ..Default::default()
    };
    let actuator = v1::InputChannel {
        input: "force".to_owned(),
        delay_s: 0.01,
        quantum: 0.05,
        ..Default::default()
    };
    v1::Channels { outputs: vec![sensor], inputs: vec![actuator], seed: 1 }
}

fn noise_of_the_input() -> v1::FaultSpec {
    let noise = v1::ExtraNoise { deviation: 0.3 };
    v1::FaultSpec {
        target: Some(Target::Input("force".to_owned())),
        kind: Some(Kind::Noise(noise)),
        ..Default::default()
    }
}

async fn feedback(client: &Client) -> v1::SetFeedbackRequest {
    let request = v1::SolveLqrRequest {
        model: "cart-pole".to_owned(),
        point: Some(operating_point("upright")),
        weights: Some(weights(diagonal([100.0, 100.0, 1.0, 1.0]), diagonal([0.1]))),
        ..Default::default()
    };
    let regulator = client.solve_lqr(request).await.unwrap();
    v1::SetFeedbackRequest {
        reference: Some(v1::set_feedback_request::Reference::Gain(regulator.gain.unwrap())),
        mode: v1::FeedbackMode::Replace.into(),
        ..Default::default()
    }
}

fn mass(k: usize) -> f64 {
    0.9 + 0.01 * k as f64
}

fn start() -> v1::InitialState {
    at_velocity(&[0.0, std::f64::consts::PI - 0.05], &[0.1, 0.0])
}

#[tokio::test]
async fn a_case_with_everything_is_a_plant_with_everything_bit_for_bit() {
    let (_server, client) = server().await;
    let feedback = feedback(&client).await;
    let path = "frames[cart].body.mass";
    let case = |k: usize| v1::RolloutCase {
        parameters: vec![v1::Parameter { path: path.to_owned(), value: mass(k) }],
        seed: Some(k as u64),
        ..Default::default()
    };
    let common = v1::RolloutCase {
        initial: Some(start()),
        hold: STEPS,
        channels: Some(channels()),
        feedback: Some(feedback.clone()),
        faults: vec![noise_of_the_input()],
        ..Default::default()
    };
    let request = v1::RolloutRequest {
        model: "cart-pole".to_owned(),
        cases: (0..20).map(case).collect(),
        every: 1,
        common: Some(common),
        ..Default::default()
    };
    let mut cases = client.rollout(request).await.unwrap().collect().await.unwrap();
    cases.sort_by_key(|case| case.case_index);
    assert_eq!(cases.len(), 20);

    for case in cases {
        assert!(case.failure.is_none(), "{:?}", case.failure);
        let k = case.case_index as usize;
        let (id, model) = (format!("p{k}"), "cart-pole".to_owned());
        let create = v1::CreatePlantRequest { id: id.clone(), model, ..Default::default() };
        client.create_plant(create).await.unwrap();
        let parameters = vec![v1::Parameter { path: path.to_owned(), value: mass(k) }];
        let change = v1::SetParametersRequest { id: id.clone(), parameters, ..Default::default() };
        client.set_parameters(change).await.unwrap();
        let reset = v1::ResetRequest { id: id.clone(), initial: Some(start()) };
        client.reset_to(reset).await.unwrap();
        let channels = v1::Channels { seed: k as u64, ..channels() };
        client.set_channels(&*id, channels).await.unwrap();
        let feedback = v1::SetFeedbackRequest { id: id.clone(), ..feedback.clone() };
        client.set_feedback(feedback).await.unwrap();
        client.inject_fault(&*id, noise_of_the_input()).await.unwrap();
        let mut driver = client.drive(&*id).await.unwrap();
        for (state, outputs) in case.states.iter().zip(&case.outputs) {
            let step = driver.step(&[0.0]).await.unwrap();
            assert_eq!(bits(step.state.as_ref().unwrap()), bits(state), "case {k}");
            assert_eq!(step.outputs.as_ref(), Some(outputs), "case {k}");
        }
        assert_eq!(case.states.len() as u32, STEPS);
        driver.close().await.unwrap();
    }
}

#[tokio::test]
async fn cases_end_early_and_are_told_as_rows() {
    let (_server, client) = server().await;
    let until = v1::Watchdog {
        quantity: "theta".to_owned(),
        min: Some(-0.5),
        max: Some(0.5),
        ..Default::default()
    };
    let case = |velocity: f64| v1::RolloutCase {
        initial: Some(at_velocity(&[0.2], &[velocity])),
        ..Default::default()
    };
    let cost = v1::RolloutCost {
        q: Some(diagonal([2.0, 0.5])),
        r: Some(diagonal([3.0])),
        end: Some(diagonal([0.0, 7.0])),
        x_reference: vec![0.1, 0.0],
        u_reference: vec![0.25],
    };
    let common = v1::RolloutCase {
        u: Some(v1::Matrix::from_rows(&[[0.5]])),
        hold: 49,
        until: vec![until],
        ..Default::default()
    };
    let request = v1::RolloutRequest {
        model: "pendulum".to_owned(),
        // The last one cannot begin: it has no such velocity.
        cases: vec![case(0.0), case(3.0), case(f64::NAN)],
        every: 1,
        common: Some(common),
        extremes: true,
        cost: Some(cost),
        ..Default::default()
    };
    let mut states = client.rollout(request.clone()).await.unwrap().collect().await.unwrap();
    states.sort_by_key(|case| case.case_index);
    let table = v1::RolloutRequest { table: true, ..request };
    let mut rows = client.rollout(table).await.unwrap().collect().await.unwrap();
    assert_eq!(rows.len(), 1);
    let build = client.server_info().await.unwrap().build;
    let table = rows.remove(0).table.unwrap();
    assert_eq!(table.build, build);
    assert_eq!(
        table.columns,
        [
            "steps",
            "end",
            "theta",
            "p(theta)",
            "min theta",
            "min p(theta)",
            "max theta",
            "max p(theta)",
            "cost"
        ]
    );
    let of = |case: u32| {
        let row = table.case_indices.iter().position(|index| *index == case).unwrap();
        let matrix = table.rows.as_ref().unwrap();
        (0..matrix.cols).map(|col| matrix.at(row, col as usize)).collect::<Vec<_>>()
    };
    assert_eq!((of(0)[0], of(0)[1]), (50.0, 0.0));
    assert!(of(1)[0] < 50.0 && of(1)[1] == 1.0, "{:?}", of(1));
    assert!(of(2)[0] == 0.0 && of(2)[1] == 2.0 && of(2)[2..].iter().all(|x| x.is_nan()));
    assert_eq!(table.failures.len(), 1);
    assert_eq!(table.failures[0].case_index, 2);
    for (case, first) in states.iter().take(2).zip([0.0, 3.0]) {
        assert_eq!(case.steps as usize, case.states.len());
        let ended = case.ended_by.as_ref();
        assert_eq!(ended.map(|trip| trip.step), (first == 3.0).then_some(case.steps));
        let start = client.create_plant(v1::CreatePlantRequest {
            model: "pendulum".to_owned(),
            initial: Some(at_velocity(&[0.2], &[first])),
            ..Default::default()
        });
        let start = start.await.unwrap().state.unwrap();
        let all: Vec<&v1::State> = std::iter::once(&start).chain(&case.states).collect();
        let of_state = |state: &v1::State| (state.q[0], state.p[0]);
        let least = all.iter().map(|s| s.q[0]).fold(f64::INFINITY, f64::min);
        let most = all.iter().map(|s| s.p[0]).fold(f64::NEG_INFINITY, f64::max);
        let row = of(case.case_index);
        assert_eq!((row[4], row[7]), (least, most));
        assert_eq!((case.min[0], case.max[1]), (least, most));
        let (last, before) = all.split_last().unwrap();
        assert_eq!((row[2], row[3]), of_state(last));
        let stage = |state: &&v1::State| {
            let (q, p) = of_state(state);
            2.0 * (q - 0.1).powi(2) + 0.5 * p.powi(2) + 3.0 * 0.25_f64.powi(2)
        };
        let cost = before.iter().map(stage).sum::<f64>() + 7.0 * last.p[0].powi(2);
        assert!((row[8] / cost - 1.0).abs() < 1e-12, "{} {cost}", row[8]);
        assert_eq!(row[8], case.cost);
    }
}

#[tokio::test]
async fn a_scene_of_the_request_is_the_model_of_its_cases() {
    let (_server, client) = server().await;
    let scene = client.get_model("pendulum").await.unwrap().scene_toml;
    let case = v1::RolloutCase {
        initial: Some(at_velocity(&[0.2], &[1.0])),
        hold: 10,
        ..Default::default()
    };
    let by_scene = v1::RolloutRequest { scene, cases: vec![case], ..Default::default() };
    let by_name = v1::RolloutRequest {
        scene: String::new(),
        model: "pendulum".to_owned(),
        ..by_scene.clone()
    };
    let run = async |request| client.rollout(request).await.unwrap().collect().await.unwrap();
    let (scene, name) = (run(by_scene.clone()).await, run(by_name).await);
    assert_eq!(scene, name);
    let both = v1::RolloutRequest { model: "pendulum".to_owned(), ..by_scene.clone() };
    assert_bad_field(client.rollout(both).await, "model");
    let mut of_a_plant = by_scene;
    of_a_plant.cases[0].feedback =
        Some(v1::SetFeedbackRequest { id: "p1".to_owned(), ..Default::default() });
    let refused = client.rollout(of_a_plant).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_FIELD", "cases[0].feedback.id");
}

/// One case stays upright and the other falls; verdicts say so, with the time and the value of the sensor.
#[tokio::test]
async fn expectations_are_judged_case_by_case() {
    let (_server, client) = server().await;
    let expect = "[[expect]]\nnever_exceeds = { signal = \"|angle - pi|\", limit = 0.5 }\n\
                  [[expect]]\nsettles = { signal = \"velocity(theta)\", to = 0, within = 0.2, by_s = 1 }\n\
                  [[expect]]\neventually = { signal = \"energy\", low = -1e9 }\n\
                  [[expect]]\nno_failures = true\n";
    let held = v1::RolloutCase { feedback: Some(feedback(&client).await), ..Default::default() };
    let request = |table| v1::RolloutRequest {
        model: "cart-pole".to_owned(),
        cases: vec![held.clone(), v1::RolloutCase::default()],
        common: Some(v1::RolloutCase {
            initial: Some(start()),
            hold: 300,
            channels: Some(channels()),
            ..Default::default()
        }),
        every: 1,
        expect: expect.to_owned(),
        table,
        ..Default::default()
    };
    let cases = client.rollout(request(false)).await.unwrap();
    let mut cases: Vec<_> = cases.try_collect().await.unwrap();
    cases.sort_by_key(|case| case.case_index);
    let came_true = |case: &v1::RolloutResponse| {
        case.verdicts.iter().map(|verdict| verdict.came_true).collect::<Vec<_>>()
    };
    assert_eq!(came_true(&cases[0]), [true; 4], "{:?}", cases[0].verdicts);
    assert_eq!(came_true(&cases[1]), [false, false, true, true], "{:?}", cases[1].verdicts);
    // It broke when the sensor first said so.
    let fallen = &cases[1].verdicts[0];
    let angle = |outputs: &v1::Outputs| (outputs.y[0] - std::f64::consts::PI).abs();
    let first = cases[1].outputs.iter().position(|outputs| angle(outputs) > 0.5).unwrap();
    assert_eq!(fallen.time_s, Some(cases[1].states[first].time_s));
    assert_eq!(fallen.value, Some(angle(&cases[1].outputs[first])));

    let answers = client.rollout(request(true)).await.unwrap();
    let answers: Vec<_> = answers.try_collect().await.unwrap();
    let table = answers[0].table.as_ref().unwrap();
    let named = table.columns.iter().position(|name| name == "expect: no failures").unwrap();
    assert_eq!(named + 1, table.columns.len());
    for (row, index) in table.case_indices.iter().enumerate() {
        let rows = table.rows.as_ref().unwrap();
        let numbers =
            (named - 3..=named).map(|column| rows.data[row * table.columns.len() + column] == 1.0);
        assert_eq!(numbers.collect::<Vec<_>>(), came_true(&cases[*index as usize]));
    }

    // What there is not is named.
    let refused = v1::RolloutRequest {
        expect: "[[expect]]\nnever_exceeds = { signal = \"phi\", limit = 1 }".to_owned(),
        common: Some(v1::RolloutCase { hold: 3, ..Default::default() }),
        ..request(false)
    };
    let refused = client.rollout(refused).await.map(drop).unwrap_err();
    let violation = &refused.violations()[0];
    assert_eq!(violation.field, "expect");
    assert!(violation.description.contains("`phi`"), "{refused}");
}

/// Cases with nothing but inputs go side by side where their states are not asked for one by one, and are the same.
#[tokio::test]
async fn cases_side_by_side_are_the_cases_by_themselves() {
    let (_server, client) = server().await;
    for model in ["pendulum", "chain-8", "tree-8"] {
        let described = client.get_model(model).await.unwrap();
        let (size, width) = (described.coordinates.len(), described.inputs.len());
        let case = |k: usize| {
            let force =
                |step: usize| if k == 7 && step == 9 { 1e12 } else { (k + step) as f64 * 0.01 };
            let rows: Vec<_> = (0..10 + k).map(|step| vec![force(step); width]).collect();
            let q = vec![0.1 * (k + 1) as f64; if k == 5 { size + 1 } else { size }];
            v1::RolloutCase {
                initial: Some(at_velocity(&q, &vec![0.0; q.len()])),
                u: Some(v1::Matrix::from_rows(&rows)),
                hold: 20,
                ..Default::default()
            }
        };
        let request = |every| v1::RolloutRequest {
            model: model.to_owned(),
            cases: (0..19).map(case).collect(),
            every,
            extremes: true,
            cost: Some(v1::RolloutCost {
                q: Some(diagonal(vec![1.0; 2 * size])),
                r: Some(diagonal(vec![0.1; width])),
                ..Default::default()
            }),
            ..Default::default()
        };
        let answers = async |request| {
            let answers = client.rollout(request).await.unwrap();
            let mut answers: Vec<_> = answers.try_collect().await.unwrap();
            answers.sort_by_key(|answer: &v1::RolloutResponse| answer.case_index);
            answers
        };
        let together = answers(request(0)).await;
        let alone = answers(request(1)).await;
        assert_eq!(together.len(), 19);
        for (one, other) in together.iter().zip(&alone) {
            let case = one.case_index;
            assert_eq!(one.failure, other.failure, "{model}, case {case}");
            assert_eq!(one.states.last(), other.states.last(), "{model}, case {case}");
            assert_eq!((&one.min, &one.max), (&other.min, &other.max), "{model}, case {case}");
            assert_eq!((one.cost, one.steps), (other.cost, other.steps), "{model}, case {case}");
        }
        let failed: Vec<_> = together.iter().filter(|case| case.failure.is_some()).collect();
        assert_eq!(
            failed.iter().map(|case| case.case_index).collect::<Vec<_>>(),
            [5, 7],
            "{model}"
        );
    }
}
