//! Uploads a scene and prints what it compiles to, or all its errors:
//! `cargo run -p plantd-client --example upload_scene -- FILE [ADDRESS]`.

use plantd_client::{Client, DEFAULT_ADDRESS};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let file = arguments.next().expect("the file of a scene");
    let address = arguments.next().unwrap_or_else(|| DEFAULT_ADDRESS.to_owned());
    let client = Client::connect(address).await?;
    match client.create_model(std::fs::read_to_string(file)?).await {
        Ok(model) => println!("{}\n{}", model.name, model.plan),
        Err(error) if !error.violations().is_empty() => {
            for fault in error.violations() {
                println!("{}: {}", fault.field, fault.description);
            }
        }
        Err(error) => return Err(error.into()),
    }
    Ok(())
}
