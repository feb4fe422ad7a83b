//! Lists the models of a server: `cargo run -p plantd-client --example list_models -- [ADDRESS]`.

use plantd_client::{Client, DEFAULT_ADDRESS};

#[tokio::main]
async fn main() -> plantd_client::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    for model in client.list_models().await? {
        println!("{:20} {}", model.name, model.description);
    }
    Ok(())
}
