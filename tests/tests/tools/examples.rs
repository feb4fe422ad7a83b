//! The Rust client's examples run and check themselves; Python's are run by its own tests.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use plantd_tests::example;
use plantd_tests::server::{ServerProcess, binary};

#[track_caller]
fn run(name: &str) -> String {
    // Other tests share the processors; workers that take what others leave would starve.
    let server = ServerProcess::start_with(|command| {
        command.args(["--worker-priority", "normal"]);
    })
    .unwrap();
    let mut command = Command::new(example(name));
    let output = command.arg(server.address()).stdin(Stdio::null()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{name}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn drive_lqr() {
    assert_eq!(run("drive_lqr").lines().count(), 50);
}

#[test]
fn swing_up() {
    assert!(run("swing_up").contains("from (1, 1)"));
}

#[test]
fn cart_pole_swing_up() {
    assert!(run("cart_pole_swing_up").contains("off upright"));
}

#[test]
fn optimize_marionette() {
    assert!(run("optimize_marionette").contains("cost"));
}

#[test]
fn cart_pole_lqg() {
    assert!(run("cart_pole_lqg").contains("estimated to"));
}

/// Those with controllers in Python are run by its own tests.
#[test]
fn starter_scenarios() {
    let examples = example("balance_link");
    let path = std::env::var("PATH").unwrap();
    let path = format!("{}:{path}", examples.parent().unwrap().display());
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../client/scenarios");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let scenarios: Vec<PathBuf> = files
        .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
        .filter(|path| !std::fs::read_to_string(path).unwrap().contains("\"python3\""))
        .collect();
    assert!(scenarios.len() >= 4);
    let mut command = Command::new(binary("plantctl").unwrap());
    command.arg("test").args(scenarios).env("PATH", path).env_remove("PLANTD_ADDRESS");
    let output = command.stdin(Stdio::null()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
}
