//! The `plantctl` command against a real server: output, exit codes, and where messages go.

mod output;
mod shell;

use std::io::Write as _;
use std::process::{Command, Output, Stdio};

use plantd_tests::server::{ServerProcess, binary};
use serde_json::Value;

const SCENE: &str = r#"
format = 1
gravity = [0.0, 0.0, 0.0]
name = "slider"

[[frames]]
name = "block"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
body = { mass = 2.0 }

[[inputs]]
name = "push"
coordinate = "block"
"#;

fn plantctl(address: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(binary("plantctl").unwrap());
    command.env("PLANTD_ADDRESS", address).args(arguments).stdin(Stdio::null());
    command
}

fn run(server: &ServerProcess, arguments: &[&str]) -> Output {
    plantctl(server.address(), arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// The output of a command that must succeed in silence on standard error.
#[track_caller]
fn text(server: &ServerProcess, arguments: &[&str]) -> String {
    let output = run(server, &[arguments, &["--quiet"]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    assert_eq!(stderr(&output), "");
    String::from_utf8(output.stdout).unwrap()
}

/// The same with `--json`, parsed.
#[track_caller]
fn json(server: &ServerProcess, arguments: &[&str]) -> Value {
    let arguments = [arguments, &["--json"]].concat();
    serde_json::from_str(&text(server, &arguments)).unwrap()
}

#[test]
fn a_plant_from_its_creation_to_its_end() {
    let server = ServerProcess::start().unwrap();
    let created = json(&server, &["create", "pendulum", "--id", "p1", "--q", "-0.5", "--v", "1"]);
    assert_eq!((&created["id"], &created["state"]["q"][0]), (&"p1".into(), &(-0.5).into()));

    let one = json(&server, &["step", "p1", "--u", "-0.1", "--u", "0.2", "--count", "5", "--all"]);
    let steps: Vec<_> = one["states"].as_array().unwrap().iter().map(|s| &s["step"]).collect();
    assert_eq!(steps, [1, 2, 3, 4, 5]);
    assert!(one["report"]["iterations"].as_u64().unwrap() > 0);

    let snapshot = server.directory().join("snapshot");
    let snapshot = snapshot.to_str().unwrap();
    json(&server, &["snapshot", "p1", snapshot]);
    let ahead = json(&server, &["step", "p1", "--count", "3"]);
    assert_eq!(json(&server, &["restore", "p1", snapshot])["step"], 5);
    assert_eq!(json(&server, &["step", "p1", "--count", "3"])["states"], ahead["states"]);

    let shown = json(&server, &["show", "plant", "p1"]);
    assert_eq!(shown["plant"]["state"], ahead["states"][0]);
    assert!(shown["energy"]["kinetic_j"].as_f64().unwrap() > 0.0);
    assert_eq!(json(&server, &["reset", "p1"])["step"], 0);
    let upright = json(&server, &["reset", "p1", "--at", "upright"]);
    assert_eq!(upright["q"][0], std::f64::consts::PI);

    let listed = json(&server, &["list"]);
    assert_eq!(listed["plants"][0]["id"], "p1");
    assert!(listed["models"].as_array().unwrap().len() >= plantd_models::builtin::NAMES.len());
    json(&server, &["delete", "plant", "p1"]);
    assert_eq!(json(&server, &["list", "plants"])["plants"], Value::Array(Vec::new()));
}

#[test]
fn a_plant_is_stepped_by_the_method_asked_for() {
    let server = ServerProcess::start().unwrap();
    let method = ["--order", "6", "--substeps", "3", "--halvings", "0", "--fast"];
    let created = json(&server, &[&["create", "four-bar", "--id", "p1"], &method[..]].concat());
    let settings = &created["settings"];
    assert_eq!((&settings["order"], &settings["substeps"]), (&6.into(), &3.into()));
    assert_eq!(
        (&settings["halvings"], &settings["precision"]),
        (&0.into(), &"PRECISION_FAST".into())
    );
    let shown = text(&server, &["show", "plant", "p1"]);
    assert!(shown.contains("order 6, substeps 3, halvings 0 at most, fast"), "{shown}");
    assert!(text(&server, &["step", "p1"]).contains("in 3 steps, residual"));
    assert_eq!(json(&server, &["step", "p1"])["report"]["steps"], 3);
    let coarse = json(&server, &["create", "pendulum", "--order", "8", "--coarse"]);
    assert_eq!(coarse["settings"]["precision"], "PRECISION_COARSE");
    let shown = text(&server, &["show", "plant", coarse["id"].as_str().unwrap()]);
    assert!(shown.contains("at most, coarse"), "{shown}");
    let both = run(&server, &["create", "pendulum", "--fast", "--coarse"]);
    assert!(stderr(&both).contains("cannot be used with"), "{}", stderr(&both));
    let chosen = json(&server, &["create", "pendulum", "--tolerance", "1e-6"]);
    assert!(chosen["accuracy"]["error"].as_f64().unwrap() <= 1e-6, "{chosen}");
    let id = chosen["id"].as_str().unwrap();
    assert!(text(&server, &["show", "plant", id]).contains(" over 50 steps"));
    let refused = run(&server, &["linearize", "--plant", "p1", "--order", "4"]);
    assert!(stderr(&refused).contains("cannot be used with"), "{}", stderr(&refused));
}

#[test]
fn linearizations_and_gains_are_printed_for_people_and_for_programs() {
    let server = ServerProcess::start().unwrap();
    let at = ["cart-pole", "--at", "upright"];
    let answer = json(&server, &[&["linearize"], at.as_slice()].concat());
    assert_eq!(answer["linearization"]["a"]["rows"], 4);
    assert_eq!(answer["linearization"]["b"]["data"].as_array().unwrap().len(), 4);
    assert_eq!(answer["controllability_rank"], 4);
    let shown = text(&server, &[&["linearize"], at.as_slice()].concat());
    for part in ["A = df/dx (4 × 4)", "B = df/du (4 × 1)", "p(theta)", "force", "rank: 4 of 4"] {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }

    let weights = ["--q", "100,1,1,1", "--r", "0.1"];
    let answer = json(&server, &[&["lqr"], at.as_slice(), &weights].concat());
    assert_eq!(answer["gain"]["k"]["cols"], 4);
    assert!(answer["spectral_radius"].as_f64().unwrap() < 1.0);
    let shown = text(&server, &[&["lqr"], at.as_slice(), &weights].concat());
    assert!(shown.contains("K (1 × 4)") && shown.contains("spectral radius"), "{shown}");

    json(&server, &["create", "cart-pole", "--id", "cart"]);
    let here = json(&server, &["linearize", "--plant", "cart"]);
    assert_eq!(here["state"]["q"][1], 0.7);
}

#[test]
fn second_derivatives_and_dynamics_are_printed() {
    let server = ServerProcess::start().unwrap();
    let at = ["pendulum", "--at", "hanging", "--paper"];
    let answer = json(&server, &[&["second-order"], at.as_slice()].concat());
    assert_eq!(answer["tensors"]["xx"]["outputs"], 2);
    assert_eq!(answer["tensors"]["xu"]["data"].as_array().unwrap().len(), 4);
    let shown = text(&server, &[&["second-order"], at.as_slice()].concat());
    assert!(shown.contains("d²/dxdx of p(theta) (2 × 2)"), "{shown}");
    let shown = text(&server, &[&["second-order"], at.as_slice(), &["--weights", "1,-1"]].concat());
    assert!(shown.contains("d²/dxdu (2 × 1)") && !shown.contains(" of "), "{shown}");

    let arguments = ["dynamics", "pendulum", "--q", "0.4", "--inputs", "-0.5", "--order", "2"];
    let answer = json(&server, &arguments);
    let expected = -0.5 - 9.8 * f64::sin(0.4);
    assert!((answer["acceleration"][0].as_f64().unwrap() - expected).abs() < 1e-12);
    let shown = text(&server, &arguments);
    for part in ["d²(theta)/dt²", "derivatives (1 × 3)", "second derivatives of theta (3 × 3)"]
    {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }
}

#[test]
fn frames_and_forces_are_printed() {
    let server = ServerProcess::start().unwrap();
    let arguments = ["kinematics", "double-pendulum", "--q", "0,0.5", "--v", "1,-1"];
    let answer = json(&server, &arguments);
    assert_eq!(answer["frames"][1]["frame"], "forearm");
    assert_eq!(answer["frames"][1]["position"][2], -1.0);
    assert_eq!(answer["center_of_mass"]["mass_kg"], 2.0);
    let point = [&arguments[..], &["--point", "forearm=0,0,-1", "--jacobians"]].concat();
    let answer = json(&server, &point);
    assert_eq!(answer["points"][0]["jacobian"]["rows"], 3);
    let shown = text(&server, &point);
    for part in ["velocity/m/s", "forearm(0, 0, -1", "Jacobian of centre of 2", "shoulder"] {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }

    json(&server, &["create", "four-bar", "--id", "f"]);
    json(&server, &["step", "f", "--count", "3"]);
    let arguments = ["forces", "--plant", "f", "--forward", "--acceleration", "0,0,0"];
    let answer = json(&server, &arguments);
    assert_eq!(answer["mass_matrix"]["rows"], 3);
    assert_eq!(answer["forward"]["multipliers"].as_array().unwrap().len(), 2);
    assert_eq!(answer["inverse"]["force"].as_array().unwrap().len(), 3);
    let shown = text(&server, &arguments);
    for part in ["mass matrix (3 × 3)", "tau", "λ with tau = 0", "pin.x", "J kinetic"] {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }
    assert_eq!(json(&server, &["show", "plant", "f"])["plant"]["state"]["step"], 3);
    assert_eq!(
        run(&server, &["kinematics", "pendulum", "--point", "theta"]).status.code(),
        Some(2)
    );
}

#[test]
fn modes_and_responses_are_printed() {
    let server = ServerProcess::start().unwrap();
    let arguments = ["analyze", "cart-pole", "--at", "hanging", "--outputs", "theta,p(x)"];
    let arguments = [&arguments[..], &["--frequencies", "0.1,2"]].concat();
    let answer = json(&server, &arguments);
    assert_eq!((&answer["order"], &answer["controllability_rank"]), (&4.into(), &4.into()));
    assert_eq!(answer["responses"][1]["magnitude"]["rows"], 2);
    let shown = text(&server, &arguments);
    for part in ["observability rank: 3", "damping ratio", " ± ", "response at 2.000000 Hz: phase"]
    {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }
}

#[test]
fn a_settled_configuration_can_be_pasted_into_the_scene() {
    let server = ServerProcess::start().unwrap();
    let arguments = ["settle", "pendulum", "--guess", "theta=0.3", "--inputs", "tau=4.9"];
    let settled = json(&server, &arguments);
    assert_eq!(settled["equilibrium"]["stable"], true);
    let shown = text(&server, &arguments);
    assert!(shown.contains("stable equilibrium after"), "{shown}");
    let point = text(&server, &[&arguments[..], &["--toml"]].concat());
    let scene = json(&server, &["show", "model", "pendulum"])["scene_toml"].clone();
    let scene = scene.as_str().unwrap().replace("\"pendulum\"", "\"settled\"") + &point;
    let file = server.directory().join("settled.toml");
    std::fs::write(&file, scene).unwrap();
    json(&server, &["upload", file.to_str().unwrap()]);
    json(&server, &["create", "settled", "--id", "s", "--at", "settled"]);
    let after = json(&server, &["step", "s", "--u", "4.9", "--count", "50"]);
    let angle = |state: &Value| state["q"][0].as_f64().unwrap();
    assert!(
        (angle(&after["states"][0]) - angle(&settled)).abs() < 1e-8,
        "it stays where it settled"
    );

    let arguments =
        ["settle", "four-bar", "--hold", "crank", "--guess", "crank=-0.8", "--constraints"];
    let held = json(&server, &arguments);
    assert_eq!((&held["q"][0], held["equilibrium"].is_null()), (&(-0.8).into(), true));
    assert_eq!(run(&server, &["settle", "pendulum", "--guess", "theta"]).status.code(), Some(2));
}

/// The four-bar with an initial configuration that does not close the loop.
#[test]
fn a_scene_that_starts_at_a_guess_settles() {
    let server = ServerProcess::start().unwrap();
    let scene = json(&server, &["show", "model", "four-bar"])["scene_toml"].clone();
    let scene = scene.as_str().unwrap().replace("\"four-bar\"", "\"four-bar-guess\"");
    let file = server.directory().join("four-bar-guess.toml");
    std::fs::write(&file, scene.replace("0.27841001304404134", "0.0")).unwrap();
    let file = file.to_str().unwrap();

    let validated = json(&server, &["validate", file]);
    let violations = validated["model"]["initial_violations"].as_array().unwrap();
    assert_eq!(violations.len(), 2, "{violations:?}");
    assert!(text(&server, &["validate", file]).contains("only a guess, which violates pin.x by"));
    json(&server, &["upload", file]);
    let settle = ["settle", "four-bar-guess", "--constraints", "--hold", "crank"];
    let held = json(&server, &settle);
    assert_eq!(held["q"][0], -1.2);
    assert!(json(&server, &["settle", "four-bar-guess"])["equilibrium"]["stable"] == true);

    json(&server, &["create", "four-bar-guess", "--id", "g", "--at", "rest"]);
    json(&server, &["step", "g", "--count", "5"]);
    let refused = run(&server, &["create", "four-bar-guess", "--id", "h"]);
    let message = String::from_utf8(refused.stderr).unwrap();
    assert!(message.contains("initial configuration is only a guess"), "{message}");
}

#[test]
fn a_state_is_diagnosed() {
    let server = ServerProcess::start().unwrap();
    let shown = text(&server, &["diagnose", "four-bar"]);
    for part in
        ["degrees of freedom: 1", "independent constraints: 2 of 2; redundant: none", "mass: 2.7"]
    {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }
    json(&server, &["create", "four-bar", "--id", "f"]);
    json(&server, &["step", "f", "--count", "3"]);
    let answer = json(&server, &["diagnose", "--plant", "f"]);
    assert_eq!((&answer["step"], &answer["constraint_rank"]), (&3.into(), &2.into()));
    assert_eq!(answer["constraint_forces"].as_array().unwrap().len(), 2);
    assert!(text(&server, &["diagnose", "--plant", "f"]).contains("pin.x"));
}

#[test]
fn scenes_are_checked_explained_and_uploaded() {
    let server = ServerProcess::start().unwrap();
    let good = server.directory().join("slider.toml");
    let bad = server.directory().join("bad.toml");
    std::fs::write(&good, SCENE).unwrap();
    std::fs::write(&bad, SCENE.replace("mass = 2.0", "mass = -2.0").replace("push", "")).unwrap();
    let (good, bad) = (good.to_str().unwrap(), bad.to_str().unwrap());

    assert_eq!(json(&server, &["validate", good])["model"]["name"], "slider");
    let shown = text(&server, &["validate", good]);
    assert!(shown.contains("valid, not uploaded"), "{shown}");
    assert!(!run(&server, &["show", "model", "slider"]).status.success());
    let output = run(&server, &["validate", bad]);
    assert_eq!(output.status.code(), Some(1));
    let problems = String::from_utf8(output.stdout).unwrap();
    for path in ["frames[0].body.mass: ", "inputs[0].name: "] {
        assert!(problems.contains(path), "no `{path}` in\n{problems}");
    }
    let plan = text(&server, &["explain", good]);
    json(&server, &["upload", good]);
    assert_eq!(text(&server, &["explain", "slider"]), plan);
    assert!(text(&server, &["show", "model", "slider"]).contains("block"));

    let mut child = plantctl(server.address(), &["validate", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(SCENE.as_bytes()).unwrap();
    assert!(child.wait_with_output().unwrap().status.success());
    assert_eq!(run(&server, &["upload", good]).status.code(), Some(1), "the name is taken");
    json(&server, &["upload", good, "--replace"]);
    json(&server, &["create", "slider", "--id", "a", "--expires", "60"]);
    json(&server, &["create", "pendulum", "--id", "b"]);
    let deleted = json(&server, &["delete", "model", "--all"]);
    assert_eq!(deleted["deleted"]["models"], serde_json::json!(["slider"]));
    let deleted = json(&server, &["delete", "plant", "--all"]);
    assert_eq!(deleted["deleted"]["plants"], serde_json::json!(["a", "b"]));
    assert_eq!(json(&server, &["list", "plants"])["plants"], Value::Array(Vec::new()));
    for wrong in [&["delete", "plant"][..], &["delete", "plant", "a", "--all"]] {
        assert_eq!(run(&server, wrong).status.code(), Some(2), "{wrong:?}");
    }
}

/// `import` needs no server; what it prints is a scene, and `upload` takes the robot itself.
#[test]
fn a_robot_becomes_a_scene() {
    const ROBOT: &str = r#"<robot name="Rod"><link name="base"><sensor/><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/></joint>
<link name="rod"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.01"/></inertial></link>
</robot>"#;
    let server = ServerProcess::start().unwrap();
    let file = |name: &str, text: &str| {
        let path = server.directory().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let robot = file("rod.urdf", ROBOT);
    let arguments = ["import", &robot, "--base", "free", "--name", "flying-rod"];
    let output = plantctl("http://127.0.0.1:1", &arguments).output().unwrap();
    let told = stderr(&output);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("1:37: no effect: `sensor` in `link`"), "{told}");
    assert!(told.contains("1 × continuous joint"), "{told}");
    let scene = file("rod.toml", std::str::from_utf8(&output.stdout).unwrap());
    let model = json(&server, &["upload", &scene]);
    let names: Vec<_> =
        model["coordinates"].as_array().unwrap().iter().map(|c| &c["name"]).collect();
    assert_eq!(names.len(), 7, "{names:?}");

    let output = run(&server, &["upload", &robot]);
    assert!(output.status.success());
    let told = stderr(&output);
    assert!(told.contains("1:37: no effect: `sensor` in `link`: it speaks"), "{told}");
    assert!(told.contains("scene `Rod` is named `rod`\n"), "{told}");
    let wrong =
        file("wrong.urdf", &ROBOT.replace("continuous", "helical").replace("\"2\"", "\"x\""));
    for arguments in [["import", &wrong], ["upload", &wrong]] {
        let output = run(&server, &arguments);
        assert_eq!(output.status.code(), Some(1));
        let told = stderr(&output);
        assert!(told.contains("2:1: joint `hinge` has type `helical`"), "{told}");
        assert!(told.contains("3:28: `value` of `mass` is `x`"), "{told}");
    }
    let weightless =
        file("weightless.urdf", &ROBOT.replace("<inertial>", "<!--").replace("</inertial>", "-->"));
    let output = run(&server, &["import", &weightless]);
    assert!(stderr(&output).contains("no mechanism that can be simulated"), "{}", stderr(&output));
}

#[test]
fn a_watch_prints_one_object_per_step() {
    let server = ServerProcess::start().unwrap();
    json(&server, &["create", "pendulum", "--id", "p"]);
    let arguments = ["watch", "p", "--fields", "state,energy", "--count", "1", "--json"];
    let watch = plantctl(server.address(), &arguments).stdout(Stdio::piped()).spawn().unwrap();
    // Steps until the watch, which takes its time to start, has seen one.
    let watch = std::thread::spawn(|| watch.wait_with_output().unwrap());
    for _ in 0..1000 {
        json(&server, &["step", "p"]);
        if watch.is_finished() {
            break;
        }
    }
    let output = watch.join().unwrap();
    let lines = String::from_utf8(output.stdout).unwrap();
    let message: Value = serde_json::from_str(lines.trim()).unwrap();
    assert_eq!(message["state"]["step"], message["step"]);
    assert!(message["energy"]["potential_j"].is_f64());
}

#[test]
fn refusals_go_to_standard_error_with_their_exit_code() {
    let server = ServerProcess::start().unwrap();
    let output = run(&server, &["show", "plant", "nobody"]);
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(1), [].as_slice()));
    assert!(stderr(&output).contains("NOT_FOUND (PLANT_NOT_FOUND)"), "{}", stderr(&output));

    let output = run(&server, &["create", "pendulum", "--q", "1,2", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let error: Value = serde_json::from_str(&stderr(&output)).unwrap();
    assert_eq!(error["error"]["code"], "INVALID_ARGUMENT");
    assert_eq!(error["error"]["violations"][0]["field"], "initial.q");

    assert_eq!(run(&server, &["dance"]).status.code(), Some(2));
    assert_eq!(run(&server, &["step", "p", "--u", "one"]).status.code(), Some(2));

    // Bound and dropped: a port that nobody listens on.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let nowhere = plantctl(&format!("http://127.0.0.1:{port}"), &["list"]).output().unwrap();
    assert_eq!(nowhere.status.code(), Some(3));
    assert!(stderr(&nowhere).contains("refused"), "{}", stderr(&nowhere));
}

/// What is wrong with an address is said in one sentence, each time another one, with the address.
#[test]
fn each_wrong_address_gets_a_sentence_of_its_own() {
    let server = ServerProcess::start().unwrap();
    let metrics = server.addresses().metrics.clone().unwrap().replace("/metrics", "");
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let path = |name: &str| format!("unix:{}", server.directory().join(name).display());
    std::fs::write(server.directory().join("file"), "").unwrap();
    let socket = std::os::unix::net::UnixListener::bind(server.directory().join("dead")).unwrap();
    drop(socket);
    let (refused, none, file, dead) =
        (format!("http://127.0.0.1:{port}"), path("none"), path("file"), path("dead"));
    let mut sentences = std::collections::BTreeSet::new();
    for (address, code, said) in [
        (refused.as_str(), 3, "no server listens there"),
        (&none, 3, "there is no such socket"),
        (&file, 3, "no socket"),
        (&dead, 3, "has ended"),
        (&metrics, 3, "does not speak gRPC"),
        ("ftp://127.0.0.1:1", 2, "scheme"),
        ("unix:relative", 2, "begins with `/`"),
    ] {
        let output = plantctl(address, &["list"]).output().unwrap();
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(code), "{address}: {error}");
        assert!(error.contains(address) && error.contains(said), "{address}: {error}");
        assert_eq!(error.lines().count(), 1, "{error}");
        for chain in ["transport error", "os error"] {
            assert!(!error.contains(chain), "{error}");
        }
        sentences.insert(error.replace(address, ""));
    }
    assert_eq!(sentences.len(), 7);
}

/// The output of a command that finds things as they were asked for: it succeeds, and says so.
#[track_caller]
fn nothing_to_do(server: &ServerProcess, arguments: &[&str], said: &str) {
    let output = run(server, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    let note = stderr(&output);
    assert!(note.contains("nothing to do") && note.contains(said), "{arguments:?}: {note}");
}

#[test]
fn a_command_that_does_nothing_says_so() {
    let server = ServerProcess::start().unwrap();
    json(&server, &["create", "pendulum", "--id", "p"]);
    nothing_to_do(&server, &["fault", "clear", "p", "--all"], "no faults");
    nothing_to_do(&server, &["channels", "clear", "p"], "no channels");
    nothing_to_do(&server, &["feedback", "clear", "p"], "no feedback");
    nothing_to_do(&server, &["guard", "p"], "nothing protects");
    nothing_to_do(&server, &["run", "p"], "--pace paced");
    assert_eq!(text(&server, &["fault", "list", "p"]), "no faults\n");
    let note = run(&server, &["guard", "p", "--json"]);
    let note: Value = serde_json::from_str(&stderr(&note)).unwrap();
    assert!(note["note"]["message"].is_string());

    text(&server, &["pause", "p"]);
    nothing_to_do(&server, &["pause", "p"], "paused already");
    text(&server, &["run", "p"]);
    json(&server, &["fault", "inject", "p", "input=tau", "stuck=true"]);
    text(&server, &["fault", "clear", "p", "--all"]);
    text(&server, &["guard", "p", "theta<1"]);
    text(&server, &["guard", "p"]);

    for missing in [
        ["fault", "clear", "p", "7"],
        ["delete", "plant", "nobody", "--json"],
        ["record", "stop", "nothing", "--json"],
    ] {
        assert_eq!(run(&server, &missing).status.code(), Some(1), "{missing:?}");
    }
    for zero in [
        &["step", "p", "--count", "0"][..],
        &["watch", "p", "--count", "0"],
        &["events", "p", "--count", "0"],
        &["gains", "p", "--count", "0"],
        &["run", "p", "--steps", "0"],
        &["optimize", "-", "--iterations", "0"],
    ] {
        assert_eq!(run(&server, zero).status.code(), Some(2), "{zero:?}");
    }
}

#[test]
fn what_comes_to_nothing_does_not_end_as_a_success() {
    let server = ServerProcess::start().unwrap();
    json(&server, &["create", "pendulum", "--id", "p", "--q", "1"]);
    json(&server, &["step", "p", "--count", "20"]);
    let late = ["fault", "inject", "p", "input=tau", "stuck=true", "start_step=5"];
    let late = run(&server, &late);
    assert_eq!(late.status.code(), Some(1));
    assert!(stderr(&late).contains("START_PASSED"), "{}", stderr(&late));

    // A run that a watchdog stops is not the one that was asked for.
    json(&server, &["guard", "p", "theta>0.5"]);
    let stopped = run(&server, &["run", "p", "--pace", "free", "-n", "100000", "--wait"]);
    assert_eq!(stopped.status.code(), Some(1));
    for part in ["WATCHDOG", "theta is", "bound 0.5"] {
        assert!(stderr(&stopped).contains(part), "no `{part}` in {}", stderr(&stopped));
    }
}

#[test]
fn the_version_is_that_of_plantctl() {
    let output = plantctl("unix:/nowhere", &["--version"]).output().unwrap();
    let version = String::from_utf8(output.stdout).unwrap();
    assert!(version.starts_with("plantctl "), "{version}");
}

/// Once, in a line of its own, with what is wrong; not a second time as its own cause.
#[test]
fn errors_of_the_configuration_are_printed_once() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("plantd.toml");
    std::fs::write(&file, "bogus = 3\n").unwrap();
    let file = file.to_str().unwrap();
    for (arguments, said) in [
        (["--config", file], "line 1: there is no key `bogus`"),
        (["--config", "/nowhere/plantd.toml"], "No such file"),
        (["--limit", "plant=3"], "there is no limit `plant`"),
    ] {
        let mut server = Command::new(binary("plantd").unwrap());
        let output = server.arg("serve").args(arguments).env_remove("RUST_BACKTRACE").output();
        let output = output.unwrap();
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert_eq!(error.matches(said).count(), 1, "{error}");
        assert!(error.starts_with("plantd: "), "{error}");
    }
}

/// Lines of JSON.
#[track_caller]
fn json_lines(server: &ServerProcess, arguments: &[&str]) -> Vec<Value> {
    let arguments = [arguments, &["--json"]].concat();
    text(server, &arguments).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The swing-up of the pendulum, as the help shows it.
const SWING_UP: &str = "
model = \"pendulum\"
steps = 100
time_step_s = 0.1
paper = true

[initial]
q = [0.0]

[cost]
q = [1000.0, 1.0]
r = [50.0]
x = [[0.0, 0.0]]
changes = [{ step = 50, x = [3.141592653589793, 0.0] }]

[options]
first_method = \"quasi-newton\"
first_iterations = 4
tolerance = 1e-6
";

#[test]
fn a_search_is_saved_resumed_and_used_as_a_guess() {
    let server = ServerProcess::start().unwrap();
    let file = |name: &str| server.directory().join(name).to_str().unwrap().to_owned();
    let (problem, best, part) = (file("swing-up.toml"), file("best.json"), file("part.json"));
    std::fs::write(&problem, SWING_UP).unwrap();

    let lines = json_lines(&server, &["optimize", &problem, "--save", &best]);
    let (result, iterations) = lines.split_last().unwrap();
    let result = &result["result"];
    assert_eq!(result["converged"], true);
    let cost = result["cost"].as_f64().unwrap();
    assert!((cost / 13297.378894617856 - 1.0).abs() < 1e-9, "{cost}");
    assert_eq!(iterations[0]["progress"]["cost_before"].as_f64().unwrap().round(), 251675.0);
    let saved: Value = serde_json::from_str(&std::fs::read_to_string(&best).unwrap()).unwrap();
    assert_eq!(&saved, result);

    // Six iterations, then the rest: the same bits, and the same number of them.
    let stopped = run(&server, &["optimize", &problem, "--iterations", "6", "--save", &part]);
    assert_eq!(stopped.status.code(), Some(4));
    let why = stderr(&stopped);
    for said in ["MAX_ITERATIONS", "--iterations", &format!("--resume {part}")] {
        assert!(why.contains(said), "no `{said}` in {why}");
    }
    let stopped = String::from_utf8(stopped.stdout).unwrap();
    assert!(stopped.contains("quasi-newton") && stopped.contains("MAX_ITERATIONS"), "{stopped}");
    let resumed = json_lines(&server, &["optimize", &problem, "--resume", &part]);
    assert_eq!(resumed.len(), lines.len() - 6);
    assert_eq!(&resumed.last().unwrap()["result"]["x"], &result["x"]);

    // From the best trajectory there is nothing left to do but to see that.
    let again = text(&server, &["optimize", &problem, "--guess", &best, "--method", "newton"]);
    assert!(again.contains("converged") && again.lines().count() <= 5, "{again}");

    std::fs::write(&problem, SWING_UP.replace("r = [50.0]", "r = [50.0, 1.0]")).unwrap();
    let refused = run(&server, &["optimize", &problem]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("cost.weights.r"), "{}", stderr(&refused));
    std::fs::write(&problem, SWING_UP.replace("steps", "strides")).unwrap();
    assert!(stderr(&run(&server, &["optimize", &problem])).contains("strides"));
}

#[test]
fn a_table_of_configurations_becomes_a_motion() {
    let server = ServerProcess::start().unwrap();
    json(&server, &["create", "cart-pole", "--id", "p", "--at", "hanging"]);
    let moved = json(&server, &["step", "p", "--u", "2", "--count", "20", "--all"]);
    let file = server.directory().join("reference.csv");
    let mut table = "x,theta\n0,0\n".to_owned();
    for state in moved["states"].as_array().unwrap() {
        table += &format!("{},{}\n", state["q"][0], state["q"][1]);
    }
    std::fs::write(&file, &table).unwrap();
    let file = file.to_str().unwrap();

    let arguments = ["project-reference", "cart-pole", file, "--strict"];
    let output = run(&server, &arguments);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("is a motion"), "{}", stderr(&output));
    let motion = String::from_utf8(output.stdout).unwrap();
    let mut lines = motion.lines();
    assert_eq!(lines.next(), Some("x,theta,p(x),p(theta),u(force)"));
    let rows: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 21);
    for (row, given) in rows.iter().zip(table.lines().skip(1)) {
        for (found, given) in row.iter().zip(given.split(',')) {
            let (found, given): (f64, f64) = (found.parse().unwrap(), given.parse().unwrap());
            assert!((found - given).abs() < 1e-7, "{found} instead of {given}");
        }
    }
    // The force that drove it is found again; the last state has none.
    assert!((rows[7][4].parse::<f64>().unwrap() - 2.0).abs() < 1e-3, "{:?}", rows[7]);
    assert_eq!(rows[20][4], "");
    let lines = json_lines(&server, &["project-reference", "cart-pole", file]);
    assert_eq!((lines.len(), &lines[0]["report"]["feasible"]), (22, &true.into()));

    // A jump is no motion.
    let jump = table.replacen("0,0", "0,0.5", 1);
    std::fs::write(file, jump).unwrap();
    let refused = run(&server, &arguments);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("INFEASIBLE_REFERENCE"), "{}", stderr(&refused));
}

#[test]
fn a_filter_is_printed() {
    let server = ServerProcess::start().unwrap();
    let arguments = ["kalman", "cart-pole", "--at", "upright", "--outputs", "x,theta"];
    let noise = ["--measurement", "1e-4", "--process", "1e-6"];
    let arguments = [&arguments[..], &noise].concat();
    let filter = json(&server, &arguments);
    assert_eq!((&filter["gain"]["rows"], &filter["gain"]["cols"]), (&4.into(), &2.into()));
    assert!(filter["error_modes"].as_array().unwrap().len() == 4);
    let printed = text(&server, &arguments);
    assert!(printed.contains("L (4 × 2)") && printed.contains("p(theta)"), "{printed}");
}

#[test]
fn feedback_is_set_streamed_and_cleared() {
    let server = ServerProcess::start().unwrap();
    json(&server, &["create", "pendulum", "--id", "p", "--q", "3.0"]);
    let none = run(&server, &["gains", "p", "--count", "1"]);
    assert!(stderr(&none).contains("NO_FEEDBACK"), "{}", stderr(&none));

    let set = ["feedback", "set", "p", "--at", "upright", "--q", "100,1", "--mode", "replace"];
    let feedback = json(&server, &set);
    assert_eq!((&feedback["revision"], &feedback["horizon"]), (&1.into(), &0.into()));
    let gain = json(&server, &["gains", "p", "--count", "1"]);
    assert_eq!(gain["gain"]["x_reference"][0], std::f64::consts::PI);
    let printed = text(&server, &["gains", "p", "--count", "1"]);
    assert!(printed.contains("K (1 × 2)"), "{printed}");
    // The law alone balances the pendulum.
    let state = json(&server, &["step", "p", "--count", "200"])["states"][0].clone();
    let error = state["q"][0].as_f64().unwrap() - std::f64::consts::PI;
    assert!(error.abs() < 1e-6, "{error}");

    let heavier = json(&server, &["set-parameter", "p", "gravity[1]=-1.6", "--dt", "0.05"]);
    assert_eq!(heavier["parameters"][0]["path"], "gravity[1]");
    assert_eq!(heavier["settings"]["time_step_s"], 0.05);
    assert!(text(&server, &["show", "plant", "p"]).contains("gravity[1] = -1.6"));
    let refused = run(&server, &["set-parameter", "p", "gravity[7]=1"]);
    assert_eq!(refused.status.code(), Some(1));

    let guard = ["--mode", "guard", "--guard", "theta=-0.5:0.5", "p(theta)=:2"];
    let guarded = json(&server, &[&set[..5], &guard].concat());
    assert_eq!(guarded["mode"], "FEEDBACK_MODE_GUARD");
    assert_eq!(text(&server, &["feedback", "clear", "p"]), "");
    assert!(!run(&server, &["gains", "p", "--count", "1"]).status.success());
}

#[test]
fn the_address_may_be_a_unix_socket_and_the_flag_wins() {
    let server = ServerProcess::start().unwrap();
    let arguments = ["list", "plants", "--json", "--address", server.unix_address()];
    let output = plantctl("http://127.0.0.1:1", &arguments).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn help_begins_with_examples() {
    let output = plantctl("unix:/nowhere", &["--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    let position = |part: &str| help.find(part).unwrap_or_else(|| panic!("no `{part}`"));
    assert!(position("Examples:") < position("Usage:"));
    assert!(position("Usage:") < position("Exit codes:"));
}
