//! Finds strings that make the marionette dance as desired:
//! `cargo run -p plantd-client --example optimize_marionette -- [ADDRESS]`.

use std::f64::consts::PI;

use plantd_client::{Client, DEFAULT_ADDRESS, MatrixExt as _, diagonal, v1, weights};

const STEPS: usize = 1001;

/// How far a string's length swings, m: opposite limbs go opposite ways.
fn swing(string: &str) -> f64 {
    match string {
        "left_leg_string_length" | "right_arm_string_length" => -0.1,
        "right_leg_string_length" | "left_arm_string_length" => 0.1,
        _ => 0.0,
    }
}

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let settings =
        v1::PlantSettings { force_split: v1::ForceSplit::Paper.into(), ..Default::default() };
    let request = v1::CreatePlantRequest {
        model: "marionette".to_owned(),
        settings: Some(settings),
        ..Default::default()
    };
    let plant = client.create_plant(request).await?;
    let start = plant.state.unwrap_or_default();

    // Desired are the configurations of a motion of the strings, at rest at every step.
    let model = client.get_model("marionette").await?;
    let strings: Vec<_> = model.coordinates.iter().filter(|c| c.prescribed).collect();
    let held: Vec<f64> = strings.iter().map(|s| s.initial).collect();
    let moved = |k: usize| {
        let phase = (0.006 * PI * k as f64).sin();
        strings.iter().map(|s| s.initial + swing(&s.name) * phase).collect::<Vec<f64>>()
    };
    let request = v1::StepRequest {
        id: plant.id.clone(),
        u: Some(v1::Matrix::from_rows(&(0..STEPS).map(moved).collect::<Vec<_>>())),
        all_states: true,
        ..Default::default()
    };
    let motion = client.step(request).await?.states;
    client.delete_plant(plant.id).await?;
    let (coordinates, dynamic) = (start.q.len(), start.p.len());
    let desired: Vec<Vec<f64>> = std::iter::once(&start)
        .chain(&motion)
        .map(|state| [state.q.as_slice(), &vec![0.0; coordinates]].concat())
        .collect();

    let mut q = vec![100.0; dynamic];
    q.resize(2 * coordinates, 1.0);
    let request = v1::OptimizeTrajectoryRequest {
        model: "marionette".to_owned(),
        settings: Some(settings),
        cost: Some(v1::TrajectoryCost {
            x: Some(v1::Matrix::from_rows(&desired)),
            weights: Some(weights(diagonal(q), diagonal(vec![0.1; held.len()]))),
            ..Default::default()
        }),
        guess: Some(v1::Trajectory {
            initial: Some(start),
            u: Some(v1::Matrix::from_rows(&vec![held; STEPS])),
        }),
        options: Some(v1::OptimizationOptions {
            first_method: v1::DescentMethod::QuasiNewton.into(),
            first_iterations: 10,
            tolerance: 1e-2,
            ..Default::default()
        }),
        ..Default::default()
    };
    let print =
        |step: &v1::OptimizationProgress| println!("{:3}  cost {}", step.iteration, step.cost);
    let best = client.find_trajectory(request, print).await?;
    assert!(best.converged && best.cost < 1472.6934, "cost {}", best.cost);
    Ok(())
}
