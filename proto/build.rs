//! Generates the message and service types from `plantd/v1/*.proto`, without protoc.

use std::path::Path;

use prost::Message as _;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=plantd");
    let names = [
        "model_service",
        "plant_service",
        "control_service",
        "channel_service",
        "recording",
        "recording_service",
    ];
    let files = names.map(|name| format!("plantd/v1/{name}.proto"));
    let descriptors = protox::compile(files, ["."])?;
    let out = std::env::var("OUT_DIR")?;
    std::fs::write(Path::new(&out).join("descriptors.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure().compile_fds(descriptors)?;
    Ok(())
}
