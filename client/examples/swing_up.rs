//! Swings the paper's pendulum up by trajectory optimisation and regulates it along the way:
//! `cargo run -p plantd-client --example swing_up -- [ADDRESS]`.

use std::f64::consts::PI;

use plantd_client::{
    Client, DEFAULT_ADDRESS, MatrixExt as _, StateExt as _, diagonal, v1, weights,
};

const STEPS: usize = 100;

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let settings = v1::PlantSettings {
        time_step_s: 0.1,
        force_split: v1::ForceSplit::Paper.into(),
        ..Default::default()
    };

    // Down for five seconds, then up: no motion of the pendulum, but what it should come close to.
    let desired: Vec<_> = (0..=STEPS).map(|k| [if k < 50 { 0.0 } else { PI }, 0.0]).collect();
    let still = v1::Trajectory {
        initial: Some(v1::State { q: vec![0.0], p: vec![0.0], ..Default::default() }),
        u: Some(v1::Matrix::from_rows(&[[0.0]; STEPS])),
    };
    let request = v1::OptimizeTrajectoryRequest {
        model: "pendulum".to_owned(),
        settings: Some(settings),
        cost: Some(v1::TrajectoryCost {
            x: Some(v1::Matrix::from_rows(&desired)),
            weights: Some(weights(diagonal([1000.0, 1.0]), diagonal([50.0]))),
            ..Default::default()
        }),
        guess: Some(still),
        options: Some(v1::OptimizationOptions {
            first_method: v1::DescentMethod::QuasiNewton.into(),
            first_iterations: 4,
            tolerance: 1e-6,
            ..Default::default()
        }),
        ..Default::default()
    };
    let print =
        |step: &v1::OptimizationProgress| println!("{:3}  cost {}", step.iteration, step.cost);
    let best = client.find_trajectory(request, print).await?;
    let target = best.x.as_ref().and_then(|x| x.rows_iter().last()).expect("states").to_vec();

    // From elsewhere the regulator leads back to the trajectory.
    let start = v1::initial_state::Momentum { q: vec![1.0], p: vec![1.0], v: vec![] };
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        settings: Some(settings),
        initial: Some(v1::InitialState { form: Some(v1::initial_state::Form::Momentum(start)) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await?;
    let trajectory = best.checkpoint.and_then(|c| c.trajectory).unwrap_or_default();
    let request = v1::SetFeedbackRequest {
        id: plant.id.clone(),
        reference: Some(v1::set_feedback_request::Reference::Trajectory(trajectory)),
        weights: Some(weights(diagonal([1.0, 1.0]), diagonal([1.0]))),
        ..Default::default()
    };
    client.set_feedback(request).await?;
    let law = client.follow_gains(&plant.id).await?;
    let mut driver = client.drive(&plant.id).await?;
    let mut state = plant.state.unwrap_or_default();
    for _ in 0..STEPS {
        state = driver.step(&law.input(&state).await?).await?.state.unwrap_or_default();
    }
    driver.close().await?;
    client.delete_plant(plant.id).await?;

    let error = state.x().iter().zip(&target).map(|(x, r)| (x - r).powi(2)).sum::<f64>().sqrt();
    println!("cost {}; from (1, 1) the error is {error:.1e} after 10 s", best.cost);
    assert!(best.converged && (best.cost / 13297.378894617856 - 1.0).abs() < 1e-9);
    assert!(error < 1e-6);
    Ok(())
}
