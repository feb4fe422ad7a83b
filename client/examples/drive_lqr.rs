//! Balances the pendulum with a gain that the server computed:
//! `cargo run -p plantd-client --example drive_lqr -- [ADDRESS]`.

use std::f64::consts::PI;

use plantd_client::{Client, DEFAULT_ADDRESS, diagonal, operating_point, v1, weights};

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;

    let request = v1::SolveLqrRequest {
        model: "pendulum".to_owned(),
        point: Some(operating_point("upright")),
        weights: Some(weights(diagonal([100.0, 1.0]), diagonal([1.0]))),
        ..Default::default()
    };
    let gain = client.solve_lqr(request).await?.gain.unwrap_or_default();

    let start = v1::initial_state::Velocity { q: vec![PI - 0.2], v: vec![0.0] };
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        initial: Some(v1::InitialState { form: Some(v1::initial_state::Form::Velocity(start)) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await?;
    let mut state = plant.state.unwrap_or_default();

    let mut driver = client.drive(&plant.id).await?;
    for _ in 0..50 {
        state = driver.step_by(&gain, &state).await?.state.unwrap_or_default();
        println!("{:.1} s  angle from upright {:+.6} rad", state.time_s, state.q[0] - PI);
    }
    driver.close().await?;
    client.delete_plant(plant.id).await
}
