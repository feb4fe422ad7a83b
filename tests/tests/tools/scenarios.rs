//! `plantctl test` against scenarios whose motion is known in closed form: what must come true does,
//! and what must break breaks at the right time.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use plantd_tests::server::{ServerProcess, binary};
use serde_json::Value;

/// Longest wait for a process to come or go.
const PATIENCE: Duration = Duration::from_secs(60);

fn scenarios(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios").join(path)
}

/// With `plantctl` in PATH, for controllers and commands that are made of it.
fn with_path(command: &mut Command) -> &mut Command {
    let program = binary("plantctl").unwrap();
    let path = std::env::var("PATH").unwrap();
    let path = format!("{}:{path}", program.parent().unwrap().display());
    command.env("PATH", path).env_remove("PLANTD_ADDRESS").stdin(Stdio::null())
}

fn plantctl(arguments: &[&str]) -> Output {
    let mut command = Command::new(binary("plantctl").unwrap());
    with_path(command.args(arguments)).output().unwrap()
}

fn test(path: &str, arguments: &[&str]) -> Output {
    let path = scenarios(path);
    plantctl(&[&["test", path.to_str().unwrap()], arguments].concat())
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// The cases of a suite, and its exit code.
#[track_caller]
fn cases(path: &str, arguments: &[&str]) -> (Vec<Value>, i32) {
    let output = test(path, &[arguments, &["--json"]].concat());
    let text = stdout(&output);
    let lines = text.lines().map(|line| serde_json::from_str(line).unwrap());
    let mut all: Vec<Value> = lines.collect();
    let summary =
        all.pop().unwrap_or_else(|| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    assert!(summary["passed"].is_u64(), "{summary}");
    (all, output.status.code().unwrap())
}

#[test]
fn what_must_come_true_does() {
    let (cases, code) = cases("met", &[]);
    for case in &cases {
        assert_eq!(case["status"], "passed", "{case}");
    }
    assert_eq!((cases.len(), code), (9, 0));
}

#[test]
fn every_expectation_breaks_at_its_time() {
    let (cases, code) = cases("broken/slider.toml", &[]);
    assert_eq!((cases.len(), code), (1, 1));
    assert_eq!((&cases[0]["status"], &cases[0]["steps"]), (&"failed".into(), &200.into()));
    let step = |x: f64| (x.sqrt() / 0.01).ceil() * 0.01;
    let at = |time_s: f64| (Some(time_s), Some(time_s * time_s));
    let mean_square = (0..=200).map(|k| (4.0 * f64::from(k) * 0.01).powi(2)).sum::<f64>() / 201.0;
    let expected = [
        at(step(1.1)),
        at(step(1.2)),
        at(step(2.0)),
        (Some(0.01), Some(4.0)),
        at(2.0),
        at(2.0),
        (None, Some(mean_square.sqrt())),
        (None, None),
    ];
    let verdicts = cases[0]["expectations"].as_array().unwrap();
    assert_eq!(verdicts.len(), expected.len());
    for (verdict, (time_s, value)) in verdicts.iter().zip(expected) {
        assert_eq!(verdict["passed"], false, "{verdict}");
        for (actual, expected) in [(&verdict["time_s"], time_s), (&verdict["value"], value)] {
            match (actual.as_f64(), expected) {
                (Some(actual), Some(x)) => assert!((actual - x).abs() < 1e-9, "{verdict}: {x}"),
                (actual, expected) => assert_eq!(actual, expected, "{verdict}"),
            }
        }
    }
}

#[test]
fn a_step_that_is_refused_ends_the_run() {
    let (cases, code) = cases("broken/not-a-number.toml", &[]);
    assert_eq!((code, &cases[0]["steps"]), (1, &30.into()));
    let ended = cases[0]["ended"].as_str().unwrap();
    assert!(ended.contains("step 31") && ended.contains("INPUT_NOT_FINITE"), "{ended}");
    let verdicts = &cases[0]["expectations"];
    assert!((verdicts[0]["time_s"].as_f64().unwrap() - 0.3).abs() < 1e-9, "{verdicts}");
    // Of what was seen, the last is judged.
    assert_eq!(verdicts[1]["passed"], true);
}

#[test]
fn a_refused_input_of_any_driver_is_a_failure() {
    let (cases, code) = cases("broken/refused.toml", &[]);
    let [case] = &cases[..] else { panic!("{cases:?}") };
    assert_eq!((code, &case["steps"], &case["ended"]), (1, &50.into(), &Value::Null), "{case}");
    let failure = &case["expectations"][0];
    assert!((failure["time_s"].as_f64().unwrap() - 0.2).abs() < 1e-9, "{failure}");
    assert_eq!(case["expectations"][1]["passed"], true, "{case}");
}

/// The server that plantctl has started ends with it, however that ends.
#[test]
fn no_server_is_left_behind() {
    let mut command = Command::new(binary("plantctl").unwrap());
    let path = scenarios("broken/silent.toml");
    let mut plantctl = with_path(command.arg("test").arg(path)).spawn().unwrap();
    let servers = || -> Vec<u32> {
        let of = format!("/proc/{0}/task/{0}/children", plantctl.id());
        let children = std::fs::read_to_string(of).unwrap_or_default();
        children.split_whitespace().map(|id| id.parse().unwrap()).collect()
    };
    let is_server = |id: &u32| {
        std::fs::read_to_string(format!("/proc/{id}/comm")).is_ok_and(|name| name == "plantd\n")
    };
    let started = Instant::now();
    let server = loop {
        if let Some(server) = servers().into_iter().find(is_server) {
            break server;
        }
        assert!(started.elapsed() < PATIENCE, "no server");
        std::thread::sleep(Duration::from_millis(5));
    };
    plantctl.kill().unwrap();
    plantctl.wait().unwrap();
    while is_server(&server) {
        assert!(started.elapsed() < PATIENCE, "the server is left behind");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_controller_that_dies_or_falls_silent_is_told_of() {
    let (dead, _) = cases("broken/dies.toml", &[]);
    assert_eq!((&dead[0]["status"], &dead[0]["steps"]), (&"failed".into(), &20.into()));
    assert_eq!(dead[0]["ended"], "step 20 of 50: the controller ended: exit status: 7");
    assert_eq!(dead[0]["output"], "I am dying\n");
    for (file, ended, steps) in [
        ("broken/silent.toml", "step 20 of 50 when 3 s were over", 20),
        ("broken/absent.toml", "no step was taken in 0.5 s", 0),
        ("broken/absent-paced.toml", "no step was taken in 0.5 s", 0),
    ] {
        let (cases, code) = cases(file, &[]);
        assert_eq!((&cases[0]["ended"], code), (&ended.into(), 1), "{file}");
        assert_eq!(cases[0]["steps"], steps, "{file}");
    }
}

#[test]
fn a_failure_is_replayed_by_its_command() {
    let (first, code) = cases("broken/random.toml", &["--seed", "11"]);
    let failed: Vec<_> = first.iter().filter(|case| case["status"] == "failed").collect();
    assert!(code == 1 && !failed.is_empty() && failed.len() < 8, "{} of 8 failed", failed.len());
    let replay = failed[0]["replay"].as_str().unwrap();
    assert!(replay.contains("--seed 11 --case random-"), "{replay}");
    let again = format!("{replay} --json");
    let again = with_path(Command::new("sh").args(["-c", &again])).output().unwrap();
    let text = stdout(&again);
    let again: Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
    assert_eq!(again["expectations"], failed[0]["expectations"]);
    assert_eq!(text.lines().count(), 2);
    // Other seeds make other cases.
    let (other, _) = cases("broken/random.toml", &[]);
    assert_ne!(other[0]["expectations"], first[0]["expectations"]);
}

#[test]
fn what_cannot_be_run_is_no_failure_of_the_controller() {
    let (cases, code) = cases("unusable", &[]);
    assert_eq!((cases.len(), code), (4, 2));
    for (file, part) in [
        ("signal.toml", "expect[0].final: there is no signal `y`"),
        ("program.toml", "cannot start no-such-controller"),
        ("parameter.toml", "plant.parameters: INVALID_ARGUMENT"),
        ("scene.toml", "plant.scene: cannot read"),
    ] {
        let is_it = |case: &&Value| case["file"].as_str().unwrap().ends_with(file);
        let case = cases.iter().find(is_it).unwrap();
        assert_eq!(case["status"], "error", "{case}");
        assert!(case["error"].as_str().unwrap().contains(part), "{case}");
    }
    // Bound and dropped: a port that nobody listens on.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let nowhere = format!("http://127.0.0.1:{port}");
    for (path, arguments) in [
        ("no-such-file.toml", &[][..]),
        ("met", &["--case", "no-such-case"]),
        ("met", &["--address", &nowhere]),
        ("met", &["--plantd", "/no/such/server"]),
    ] {
        assert_eq!(test(path, arguments).status.code(), Some(2), "{path} {arguments:?}");
    }
}

#[test]
fn reports_say_what_the_console_says() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (xml, html) = (file("junit.xml"), file("report.html"));
    let output = test("broken/slider.toml", &["--junit", &xml, "--html", &html]);
    assert_eq!(output.status.code(), Some(1));
    let (text, xml) = (stdout(&output), std::fs::read_to_string(xml).unwrap());
    let html = std::fs::read_to_string(html).unwrap();
    assert!(text.starts_with("FAIL   slider  200 steps"), "{text}");
    assert!(text.ends_with("0 passed, 1 failed, 0 not run\n"), "{text}");
    let line = "x settles within 0.1 of 1 by 1 s: at 1.05 s it is 1.1025, above 1.1";
    for (what, place) in [("console", &text), ("JUnit", &xml), ("page", &html)] {
        assert!(place.contains(line), "{what}: {place}");
        assert!(place.contains("--seed 0"), "{what}");
    }
    assert!(xml.contains("tests=\"1\" failures=\"1\" errors=\"0\""), "{xml}");
    let plots = html.matches("role=\"img\"").count();
    assert_eq!(plots, 7, "a plot for each expectation with a signal");
    assert!(!html.contains("http://") && !html.contains("https://"), "it needs nothing else");
}

#[test]
fn a_server_that_is_there_is_left_without_plants() {
    let server = ServerProcess::start().unwrap();
    let (cases, code) = cases("met", &["--address", server.address(), "--jobs", "3"]);
    assert_eq!((cases.len(), code), (9, 0));
    let plants = plantctl(&["--address", server.address(), "list", "plants", "--json"]);
    let plants: Value = serde_json::from_str(&stdout(&plants)).unwrap();
    assert_eq!(plants["plants"], Value::Array(Vec::new()));
}

#[test]
fn cases_are_spread_over_servers() {
    let servers = [ServerProcess::start().unwrap(), ServerProcess::start().unwrap()];
    let over = servers.each_ref().map(ServerProcess::address).join(",");
    let (spread, code) = cases("met", &["--over", &over]);
    assert_eq!((spread.len(), code), (9, 0));
    // Which server it was makes no difference.
    let (alone, _) = cases("met", &[]);
    let told = |cases: &[Value]| -> Vec<String> {
        let mut told: Vec<_> = cases.iter().map(|case| case["expectations"].to_string()).collect();
        // How late a step was is the machine's business.
        told.retain(|told| !told.contains("deadline misses"));
        told.sort();
        told
    };
    assert_eq!(told(&spread), told(&alone));
    for server in &servers {
        assert!(steps_of(server) > 0.0);
        let plants = plantctl(&["--address", server.address(), "list", "plants", "--json"]);
        let plants: Value = serde_json::from_str(&stdout(&plants)).unwrap();
        assert_eq!(plants["plants"], Value::Array(Vec::new()));
    }
}

/// Steps that a server has taken, by its metrics.
fn steps_of(server: &ServerProcess) -> f64 {
    let metrics = server.addresses().metrics.clone().unwrap();
    let address = metrics.trim_start_matches("http://").trim_end_matches("/metrics");
    let mut stream = TcpStream::connect(address).unwrap();
    let request = format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let lines = text.lines().filter(|line| line.starts_with("plantd_steps_total"));
    lines.map(|line| line.rsplit(' ').next().unwrap().parse::<f64>().unwrap()).sum()
}
