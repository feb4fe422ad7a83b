//! Generates the types of messages and services from `plantd/v1/*.proto` and `foxglove/scene.proto`, without protoc.

use std::path::Path;

use prost::Message as _;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=plantd");
    println!("cargo:rerun-if-changed=foxglove");
    let names = [
        "model_service",
        "plant_service",
        "control_service",
        "channel_service",
        "recording",
        "recording_service",
        "server_service",
    ];
    let contract: Vec<_> = names.iter().map(|name| format!("plantd/v1/{name}.proto")).collect();
    let players = vec!["foxglove/scene.proto".to_owned()];
    let out = std::env::var("OUT_DIR")?;
    for (files, name) in [(contract, "descriptors.bin"), (players, "foxglove.bin")] {
        let descriptors = protox::compile(files, ["."])?;
        std::fs::write(Path::new(&out).join(name), descriptors.encode_to_vec())?;
        tonic_prost_build::configure().compile_fds(descriptors)?;
    }
    Ok(())
}
