//! Swings a cart-pole up with a bounded force, then keeps it upright, with gains that the server
//! streams: `cargo run -p plantd-client --example cart_pole_swing_up -- [ADDRESS]`.

use std::f64::consts::PI;

use plantd_client::{
    Client, DEFAULT_ADDRESS, MatrixExt as _, StateExt as _, WeightsExt as _, diagonal,
    operating_point, v1, weights,
};
use v1::set_feedback_request::Reference;

const STEPS: usize = 400;
const LIMIT_N: f64 = 60.0;
const UPRIGHT: [f64; 4] = [0.0, PI, 0.0, 0.0];

fn regulator() -> v1::LqrWeights {
    weights(diagonal([100.0, 100.0, 1.0, 1.0]), diagonal([0.1]))
}

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let hanging = v1::initial_state::Form::OperatingPoint("hanging".to_owned());
    let request = v1::CreatePlantRequest {
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState { form: Some(hanging) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await?;

    // A push back and forth with the period in which the pole swings.
    let push = |k: usize| [20.0 * (2.0 * PI / 192.0 * k as f64).sin()];
    let guess = v1::Trajectory {
        initial: plant.state.clone(),
        u: Some(v1::Matrix::from_rows(&(0..STEPS).map(push).collect::<Vec<_>>())),
    };
    let cost = v1::TrajectoryCost {
        x: Some(v1::Matrix::from_rows(&[UPRIGHT; STEPS + 1])),
        weights: Some(
            weights(diagonal([0.1, 0.1, 0.01, 0.01]), diagonal([0.001]))
                .with_final(diagonal([1e4, 1e4, 1e3, 1e3])),
        ),
        ..Default::default()
    };
    let force = v1::Bound { entry: "force".to_owned(), min: Some(-LIMIT_N), max: Some(LIMIT_N) };
    let request = v1::OptimizeTrajectoryRequest {
        model: "cart-pole".to_owned(),
        cost: Some(cost),
        guess: Some(guess),
        bounds: Some(v1::TrajectoryBounds { input: vec![force], ..Default::default() }),
        options: Some(v1::OptimizationOptions {
            bound_tolerance: 0.01,
            projection: Some(regulator()),
            ..Default::default()
        }),
        ..Default::default()
    };
    let print =
        |step: &v1::OptimizationProgress| println!("{:3}  cost {}", step.iteration, step.cost);
    let best = client.find_trajectory(request, print).await?;
    let trajectory = best.checkpoint.and_then(|c| c.trajectory).unwrap_or_default();
    let inputs = trajectory.u.clone().unwrap_or_default().data;
    let largest = inputs.iter().fold(0.0_f64, |largest, u| largest.max(u.abs()));

    let feedback = |reference| v1::SetFeedbackRequest {
        id: plant.id.clone(),
        reference: Some(reference),
        weights: Some(regulator()),
        ..Default::default()
    };
    client.set_feedback(feedback(Reference::Trajectory(trajectory))).await?;
    let mut law = client.follow_gains(&plant.id).await?;
    let mut driver = client.drive(&plant.id).await?;
    let mut state = plant.state.clone().unwrap_or_default();
    for k in 0..STEPS + 500 {
        if k == STEPS {
            client.set_feedback(feedback(Reference::Point(operating_point("upright")))).await?;
            law = client.follow_gains(&plant.id).await?;
        }
        state = driver.step(&law.input(&state).await?).await?.state.unwrap_or_default();
    }
    driver.close().await?;
    client.delete_plant(&plant.id).await?;

    let off = state.x().iter().zip(UPRIGHT).map(|(x, r)| (x - r).abs()).fold(0.0, f64::max);
    println!("largest force {largest:.3} N; off upright by {off:.1e} after 9 s");
    assert!(best.converged && largest < LIMIT_N + 0.01 && off < 1e-2);
    Ok(())
}
