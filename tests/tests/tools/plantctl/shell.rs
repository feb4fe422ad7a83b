//! What shells, manuals and people who look on are given.

use std::fs;

use plantd_tests::server::ServerProcess;

use super::{json_lines, plantctl, text};

#[test]
fn a_shell_completes_names_of_the_server() {
    let server = ServerProcess::start().unwrap();
    text(&server, &["create", "pendulum", "--id", "left-arm"]);
    text(&server, &["create", "cart-pole", "--id", "right-arm"]);
    let complete = |address: &str, words: &[&str]| {
        let mut shell = plantctl(address, &[&["--", "plantctl"], words].concat());
        shell.env("PLANTCTL_COMPLETE", "bash").env("_CLAP_COMPLETE_INDEX", words.len().to_string());
        shell.env("_CLAP_IFS", "\n");
        let output = shell.output().unwrap();
        assert!(output.status.success());
        String::from_utf8(output.stdout).unwrap()
    };
    let plants = complete(server.address(), &["step", "l"]);
    assert_eq!(plants.trim(), "left-arm");
    let plants = complete(server.address(), &["fault", "list", ""]);
    assert!(plants.contains("left-arm") && plants.contains("right-arm"), "{plants}");
    assert_eq!(complete(server.address(), &["lqr", "double-pend"]).trim(), "double-pendulum");
    assert!(complete(server.address(), &["rec"]).contains("record"));
    // Without a server there are no names, and no complaint into the line that is being typed.
    let unknown = complete("http://127.0.0.1:1", &["step", "l"]);
    assert!(!unknown.contains("left-arm"), "{unknown}");
}

#[test]
fn completions_are_printed_for_each_shell() {
    let server = ServerProcess::start().unwrap();
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = text(&server, &["completions", shell]);
        assert!(script.contains("plantctl") && script.contains("PLANTCTL_COMPLETE"), "{shell}");
    }
}

#[test]
fn each_command_has_a_manual_page() {
    let server = ServerProcess::start().unwrap();
    let folder = server.directory().join("man");
    text(&server, &["man", folder.to_str().unwrap()]);
    let page = |name: &str| fs::read_to_string(folder.join("man1").join(name)).unwrap();
    assert!(page("plantctl.1").contains("plantctl\\-step(1)"));
    assert!(page("plantctl-step.1").starts_with(".ie"), "{}", page("plantctl-step.1"));
    assert!(page("plantctl-fault-inject.1").contains("inject"));
}

#[test]
fn top_shows_rates_of_plants_that_run() {
    let server = ServerProcess::start().unwrap();
    text(&server, &["create", "pendulum", "--id", "runs"]);
    text(&server, &["create", "pendulum", "--id", "waits"]);
    text(&server, &["run", "runs", "--pace", "paced"]);
    let looks = json_lines(&server, &["top", "--interval", "0.3", "-n", "2"]);
    assert_eq!(looks.len(), 2);
    let plant = |id: &str| {
        let plants = looks[1]["plants"].as_array().unwrap();
        plants.iter().find(|plant| plant["id"] == id).unwrap().clone()
    };
    assert_eq!(looks[0]["plants"][0]["steps_per_s"], serde_json::Value::Null);
    assert!(plant("runs")["steps_per_s"].as_f64().unwrap() > 0.0);
    assert_eq!(
        (&plant("runs")["run"], &plant("waits")["run"]),
        (&"paced".into(), &"lockstep".into())
    );
    assert_eq!(plant("waits")["steps_per_s"], 0.0);
    let table = text(&server, &["top", "--interval", "0.1", "-n", "1"]);
    assert!(table.starts_with("plant ") && table.contains("overruns"), "{table}");
    assert!(!table.contains('\u{1b}'), "control characters where nobody looks at a screen");
}
