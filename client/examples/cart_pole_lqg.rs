//! Balances a cart-pole from noisy measurements of its two positions:
//! `cargo run -p plantd-client --example cart_pole_lqg -- [ADDRESS]`.

use std::f64::consts::PI;

use plantd_client::{
    Client, DEFAULT_ADDRESS, Estimator, GainExt as _, StateExt as _, diagonal, operating_point, v1,
    weights,
};

/// Standard deviation of both measurements, m and rad.
const SIGMA: f64 = 0.005;

/// Numbers with the standard normal distribution, the same in every run: sums of twelve from a linear
/// congruential generator.
fn normal(seed: &mut u64) -> f64 {
    let mut uniform = || {
        *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (*seed >> 11) as f64 / (1_u64 << 53) as f64
    };
    (0..12).map(|_| uniform()).sum::<f64>() - 6.0
}

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let model = "cart-pole".to_owned();
    let request = v1::SolveLqrRequest {
        model: model.clone(),
        point: Some(operating_point("upright")),
        weights: Some(weights(diagonal([10.0, 100.0, 1.0, 1.0]), diagonal([0.01]))),
        ..Default::default()
    };
    let gain = client.solve_lqr(request).await?.gain.unwrap_or_default();
    let request = v1::SolveKalmanRequest {
        model: model.clone(),
        point: Some(operating_point("upright")),
        measurement: Some(v1::Measurement {
            outputs: vec!["x".to_owned(), "theta".to_owned()],
            ..Default::default()
        }),
        noise: Some(v1::NoiseCovariances {
            process: Some(diagonal([1e-8, 1e-8, 1e-6, 1e-6])),
            measurement: Some(diagonal([SIGMA * SIGMA; 2])),
            ..Default::default()
        }),
        ..Default::default()
    };
    let mut estimator = Estimator::new(client.solve_kalman(request).await?)?;

    let start = v1::initial_state::Velocity { q: vec![0.1, PI - 0.05], v: vec![0.0; 2] };
    let request = v1::CreatePlantRequest {
        model,
        initial: Some(v1::InitialState { form: Some(v1::initial_state::Form::Velocity(start)) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await?;
    let mut driver = client.drive(&plant.id).await?;
    let mut state = plant.state.unwrap_or_default();
    let (mut seed, mut squares, mut farthest) = (1, [0.0; 2], 0.0_f64);
    for k in 0..2000 {
        let measured: Vec<f64> = state.q.iter().map(|q| q + SIGMA * normal(&mut seed)).collect();
        estimator.correct(&measured, None);
        let (estimate, truth) = (estimator.x(), state.x());
        if k >= 1000 {
            for i in 0..2 {
                squares[i] += (estimate[i] - truth[i]).powi(2) / 1000.0;
                farthest = farthest.max((truth[i] - gain.x_reference[i]).abs());
            }
        }
        let u = gain.control_at(&estimate)?;
        estimator.predict(&u);
        state = driver.step(&u).await?.state.unwrap_or_default();
    }
    driver.close().await?;
    client.delete_plant(plant.id).await?;

    let errors = squares.map(f64::sqrt);
    println!("measured to {SIGMA}, estimated to {errors:.5?}, held to {farthest:.3}");
    assert!(errors.iter().all(|error| *error < 0.5 * SIGMA) && farthest < 0.2);
    Ok(())
}
