//! Weights on the projected momentum.

use plantd_client::{Client, MatrixExt as _, StateExt as _, WeightsExt as _, operating_point, v1};
use v1::optimize_trajectory_response::Response as Message;

use crate::support::*;

const MODEL: &str = "four-bar";
const STEPS: usize = 20;

fn projected() -> v1::LqrWeights {
    unit_weights(6, 1).on_projected_momentum()
}

fn released() -> v1::Trajectory {
    v1::Trajectory { initial: None, u: Some(zeros(STEPS, 1)) }
}

fn zeros(rows: usize, cols: usize) -> v1::Matrix {
    v1::Matrix { rows: rows as u32, cols: cols as u32, data: vec![0.0; rows * cols] }
}

/// Largest minor of two rows and columns of a value function's momenta, relative to the largest product.
fn minor(value: &v1::Matrix) -> f64 {
    let at = |i: usize, j: usize| value.at(3 + i, 3 + j);
    let (mut minor, mut product) = (0.0_f64, 0.0_f64);
    for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
        let (below, beside) = ((i + 1) % 3, (j + 1) % 3);
        minor = minor.max((at(i, j) * at(below, beside) - at(i, beside) * at(below, j)).abs());
        product = product.max(at(i, j).powi(2));
    }
    minor / product
}

async fn solve(client: &Client, weights: v1::LqrWeights, full: bool) -> v1::SolveLqrResponse {
    let space = if full { v1::ConstraintHandling::Full } else { v1::ConstraintHandling::Manifold };
    let request = v1::SolveLqrRequest {
        model: MODEL.to_owned(),
        point: Some(operating_point("rest")),
        weights: Some(weights),
        constraints: space.into(),
        ..Default::default()
    };
    client.solve_lqr(request).await.unwrap()
}

#[track_caller]
fn assert_near(found: Option<v1::Matrix>, expected: &v1::Matrix) {
    let found = found.unwrap();
    assert_eq!((found.rows, found.cols), (expected.rows, expected.cols));
    let largest = expected.data.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    for (found, expected) in found.data.iter().zip(&expected.data) {
        assert!((found - expected).abs() < 1e-9 * largest, "{found} {expected}");
    }
}

/// The linkage has one freedom: the projected momenta have rank one, those of the state three.
#[tokio::test]
async fn every_regulator_weighs_the_projected_momentum_where_it_is_asked_to() {
    let (_server, client) = server().await;
    let value = async |weights| solve(&client, weights, true).await.value.unwrap();
    assert!(minor(&value(projected()).await) < 1e-9);
    assert!(minor(&value(unit_weights(6, 1)).await) > 1e-3);

    let request = v1::SolveTrajectoryLqrRequest {
        model: MODEL.to_owned(),
        trajectory: Some(released()),
        weights: Some(projected()),
        constraints: v1::ConstraintHandling::Full.into(),
        values: true,
        ..Default::default()
    };
    let answers = client.solve_trajectory_lqr(request).await.unwrap().collect().await.unwrap();
    assert_eq!(answers.len(), STEPS + 1);
    for answer in answers {
        assert!(minor(&answer.value.unwrap()) < 1e-9);
    }

    let gain = async |weights| solve(&client, weights, false).await.gain.unwrap().k.unwrap();
    let (k, own) = (gain(projected()).await, gain(unit_weights(6, 1)).await);
    assert!(k.data.iter().zip(&own.data).any(|(a, b)| (a - b).abs() > 1e-3), "{k:?} {own:?}");
    let point = v1::initial_state::Form::OperatingPoint("rest".to_owned());
    let request = v1::CreatePlantRequest {
        id: "resting".to_owned(),
        model: MODEL.to_owned(),
        initial: Some(v1::InitialState { form: Some(point) }),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
    let request = v1::SetFeedbackRequest {
        id: "resting".to_owned(),
        reference: Some(v1::set_feedback_request::Reference::Point(operating_point("rest"))),
        weights: Some(projected()),
        ..Default::default()
    };
    client.set_feedback(request).await.unwrap();
    let mut gains = client.watch_gains("resting").await.unwrap();
    assert_near(soon(gains.next()).await.unwrap().unwrap().gain.unwrap().k, &k);
    let request = v1::WatchRequest {
        id: "resting".to_owned(),
        fields: vec![v1::WatchField::Gain.into()],
        weights: Some(projected()),
        ..Default::default()
    };
    let mut states = client.watch(request).await.unwrap();
    assert_near(soon(states.next()).await.unwrap().unwrap().gain.unwrap().k, &k);
}

fn search(x: v1::Matrix, weights: v1::LqrWeights) -> v1::OptimizeTrajectoryRequest {
    v1::OptimizeTrajectoryRequest {
        model: MODEL.to_owned(),
        cost: Some(v1::TrajectoryCost { x: Some(x), weights: Some(weights), ..Default::default() }),
        guess: Some(released()),
        ..Default::default()
    }
}

async fn run(client: &Client, request: v1::OptimizeTrajectoryRequest) -> v1::OptimizationResult {
    let answers = client.optimize_trajectory(request).await.unwrap().collect().await.unwrap();
    match answers.into_iter().next_back().and_then(|answer| answer.response) {
        Some(Message::Result(result)) => result,
        other => panic!("no result: {other:?}"),
    }
}

#[tokio::test]
async fn a_search_weighs_the_projected_momentum_where_it_is_asked_to() {
    let (_server, client) = server().await;
    let request = v1::RolloutRequest {
        model: MODEL.to_owned(),
        cases: vec![v1::RolloutCase {
            initial: None,
            u: Some(zeros(STEPS, 1)),
            hold: 0,
            ..Default::default()
        }],
        every: 1,
        ..Default::default()
    };
    let rollout = client.rollout(request).await.unwrap().collect().await.unwrap().remove(0);
    let first = plant(&client, MODEL).await.state.unwrap().x();
    let states = rollout.states.iter().map(|state| state.x());
    let motion: Vec<_> = std::iter::once(first).chain(states).collect();
    let motion = v1::Matrix::from_rows(&motion);
    let still = run(&client, search(motion, projected())).await;
    assert!(still.converged && still.cost == 0.0, "{still:?}");

    let mut costs = Vec::new();
    for weights in [projected(), unit_weights(6, 1)] {
        let result = run(&client, search(zeros(STEPS + 1, 6), weights)).await;
        assert!(result.converged, "{:?}", result.failure);
        costs.push(result.cost);
    }
    assert!((costs[0] - costs[1]).abs() > 1e-3 * costs[1], "{costs:?}");
}

#[tokio::test]
async fn a_momentum_is_checked() {
    let (_server, client) = server().await;
    let refused = async |request: v1::OptimizeTrajectoryRequest| match client
        .optimize_trajectory(request)
        .await
    {
        Ok(mut answers) => soon(answers.next()).await.map(drop),
        Err(error) => Err(error),
    };
    let unknown = v1::LqrWeights { momentum: 7, ..projected() };
    let request = search(zeros(STEPS + 1, 6), unknown);
    assert_bad_field(refused(request).await, "cost.weights.momentum");
    let mut request = search(zeros(STEPS + 1, 6), projected());
    let options = v1::OptimizationOptions { projection: Some(projected()), ..Default::default() };
    request.options = Some(options);
    assert_bad_field(refused(request).await, "options.projection.momentum");
}
