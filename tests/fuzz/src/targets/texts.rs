//! Texts: scenes, robots, configurations, scenarios.

use std::str::from_utf8;

use anyhow::Result;
use plantd_models::{Model, Scene};
use plantd_server::config::Config;
use plantd_server::core::limits::Limits;
use plantd_server::wire::message::settings;

use crate::scenario::file::Scenario;
use crate::targets::{Mutated, Target, seeds};

/// Reads a scene within the limits of a server, and compiles it.
fn compile(text: &str) {
    let limits = Limits { coordinates: 64, scene_items: 256, ..Limits::default() };
    let read = settings::scene(text, 0, &std::collections::HashMap::new(), &limits);
    if let Ok(Ok((scene, _))) = read {
        // What was read can be written, and read again.
        let again = Scene::from_toml(&scene.to_toml());
        assert!(again.is_ok(), "{}", again.unwrap_err());
        let _ = Model::compile(&scene);
    }
}

fn robot(name: &str, end: &str) -> Result<Box<dyn Target>> {
    let seeds = seeds(name, &["tests/robots"], end)?;
    let take = |input: &[u8]| {
        if let Ok(text) = from_utf8(input) {
            compile(text);
        }
    };
    Ok(Box::new(Mutated { seeds, take }))
}

pub(super) fn scene() -> Result<Box<dyn Target>> {
    let seeds = seeds("scene", &["models/scenes", "models/scenes/elements"], "toml")?;
    let take = |input: &[u8]| {
        if let Ok(text) = from_utf8(input) {
            compile(text);
        }
    };
    Ok(Box::new(Mutated { seeds, take }))
}

pub(super) fn urdf() -> Result<Box<dyn Target>> {
    robot("urdf", "urdf")
}

pub(super) fn mjcf() -> Result<Box<dyn Target>> {
    robot("mjcf", "xml")
}

pub(super) fn configuration() -> Result<Box<dyn Target>> {
    let seeds = seeds("configuration", &["deploy"], "toml")?;
    let folder = tempfile::tempdir()?;
    let take = move |input: &[u8]| {
        let path = folder.path().join("plantd.toml");
        std::fs::write(&path, input).expect("it is written");
        if let Ok(config) = Config::from_file(&path)
            && config.check().is_ok()
        {
            let _ = config.check_exposure();
            let again = config.to_toml();
            assert!(again.is_ok(), "{}", again.unwrap_err());
        }
    };
    Ok(Box::new(Mutated { seeds, take }))
}

pub(super) fn scenario() -> Result<Box<dyn Target>> {
    let folders = ["client/scenarios", "tests/scenarios/met", "tests/scenarios/broken"];
    let seeds = seeds("scenario", &folders, "toml")?;
    let take = |input: &[u8]| {
        if let Ok(text) = from_utf8(input)
            && let Ok(scenario) = Scenario::parse(text)
        {
            let _ = scenario.steps(1e-2);
            let _ = scenario.cases();
        }
    };
    Ok(Box::new(Mutated { seeds, take }))
}
