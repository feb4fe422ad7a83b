//! Watches a plant while somebody drives it:
//! `cargo run -p plantd-client --example watch -- PLANT [ADDRESS]`.

use plantd_client::{Client, DEFAULT_ADDRESS, v1};

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let id = arguments.next().expect("the id of a plant");
    let address = arguments.next().unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    let request = v1::WatchRequest {
        id,
        fields: vec![v1::WatchField::State.into(), v1::WatchField::Energy.into()],
        every: 10,
        ..Default::default()
    };
    let mut messages = client.watch(request).await?;
    while let Some(message) = messages.next().await? {
        let energy = message.energy.unwrap_or_default();
        println!(
            "step {}  energy {:+.9} J  ({} messages lost)",
            message.step,
            energy.kinetic_j + energy.potential_j,
            message.dropped,
        );
    }
    Ok(())
}
