//! Creates a plant and steps it: `cargo run -p plantd-client --example step -- [ADDRESS]`.

use plantd_client::{Client, DEFAULT_ADDRESS, MatrixExt as _, v1};

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let request = v1::CreatePlantRequest { model: "cart-pole".to_owned(), ..Default::default() };
    let plant = client.create_plant(request).await?;

    // Two steps with a force of 5 N, then eight more with the last one's.
    let request = v1::StepRequest {
        id: plant.id.clone(),
        u: Some(v1::Matrix::from_rows(&[[5.0], [-5.0]])),
        hold: 8,
        all_states: true,
        ..Default::default()
    };
    for state in client.step(request).await?.states {
        println!("{:.2} s  q = {:?}", state.time_s, state.q);
    }
    client.delete_plant(plant.id).await
}
