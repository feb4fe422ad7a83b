//! Holds a pendulum where it hangs, as the examples in other languages do:
//! `cargo run -p plantd-client --example pendulum -- [ADDRESS [STEPS]]`.

use plantd_client::{Client, DEFAULT_ADDRESS, v1};

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let address = arguments.next().unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let steps = arguments.next().and_then(|text| text.parse().ok()).unwrap_or(100);
    let client = Client::connect(address).await?;

    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let plant = client.create_plant(request).await?;
    let mut state = plant.state.unwrap_or_default();
    let mut driver = client.drive(&plant.id).await?;
    for _ in 0..steps {
        let torque = -3.0 * state.q[0] - state.p[0];
        state = driver.step(&[torque]).await?.state.unwrap_or_default();
        println!("{:?} {:?} {:?}", state.q[0], state.p[0], state.velocity[0]);
    }
    driver.close().await?;
    client.delete_plant(&plant.id).await
}
