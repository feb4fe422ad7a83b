//! What commands print and for whom: tables, JSON, comma-separated values, colours, names, and a line of success.

use plantd_tests::server::ServerProcess;

use super::{json, plantctl, run, stderr, text};

#[test]
fn what_changes_something_says_so_in_a_line_unless_quiet() {
    let server = ServerProcess::start().unwrap();
    let said = |arguments: &[&str]| stderr(&run(&server, arguments));
    assert_eq!(said(&["create", "pendulum", "--id", "p"]), "plantctl: there is a plant `p` now\n");
    assert_eq!(said(&["reset", "p"]), "plantctl: plant `p` is at step 0 again\n");
    assert_eq!(said(&["guard", "p", "theta<2"]), "plantctl: a bound protects plant `p`\n");
    assert!(said(&["guard", "p"]).contains("nothing protects plant `p` any more"));
    assert!(said(&["guard", "p"]).contains("nothing to do"));
    assert_eq!(said(&["create", "pendulum", "--id", "q", "--quiet"]), "");
    assert_eq!(said(&["delete", "plant", "q", "--json"]), "");
    assert_eq!(said(&["delete", "plant", "p"]), "plantctl: plant `p` is deleted\n");
    let version = run(&server, &["--version"]);
    assert!(String::from_utf8(version.stdout).unwrap().starts_with("plantctl "));
}

#[test]
fn tables_are_comma_separated_values_with_all_digits() {
    let server = ServerProcess::start().unwrap();
    let csv = |arguments: &[&str]| text(&server, &[arguments, &["--output", "csv"]].concat());
    json(&server, &["create", "pendulum", "--id", "p", "--q", "0.1"]);
    let steps = csv(&["step", "p", "--count", "2", "--all"]);
    let lines: Vec<&str> = steps.lines().collect();
    assert_eq!(lines[0], "step,time_s,theta,p(theta),velocity(theta)");
    assert_eq!(lines.len(), 3);
    let state = json(&server, &["show", "plant", "p"])["plant"]["state"].clone();
    let last: Vec<&str> = lines[2].split(',').collect();
    assert_eq!(last[2].parse::<f64>().unwrap(), state["q"][0].as_f64().unwrap());
    let listed = csv(&["list", "plants"]);
    assert_eq!(listed, "plant,model,dt/s,step,time/s,driver,link\np,pendulum,0.1,2,0.2,,\n");
    let both = csv(&["list"]);
    assert!(both.starts_with("model,") && both.contains("\n\nplant,"), "{both}");
    assert!(csv(&["lqr", "cart-pole", "--at", "upright"]).starts_with("K,x,theta,p(x),p(theta)\n"));
    assert!(csv(&["top", "--count", "1"]).starts_with("plant,model,run,"));
    let same = text(&server, &["list", "plants", "--output", "json"]);
    assert_eq!(same, text(&server, &["list", "plants", "--json"]));
    let no_table = run(&server, &["explain", "pendulum", "--output", "csv"]);
    assert_eq!(no_table.status.code(), Some(2));
    assert!(stderr(&no_table).contains("there is no table"), "{}", stderr(&no_table));
}

/// The lines of the README, in their order; the server is there already.
#[test]
fn the_readme_s_commands_run() {
    let server = ServerProcess::start().unwrap();
    let readme = include_str!("../../../../README.md");
    let section = readme.split("## On the command line").nth(1).unwrap();
    let lines = section.split("```sh\n").nth(1).unwrap().split("```").next().unwrap().lines();
    let commands: Vec<&str> = lines.filter(|line| line.starts_with("plantctl ")).collect();
    assert!(commands.len() >= 8);
    let program = plantctl(server.address(), &[]).get_program().to_owned();
    let folder = std::path::Path::new(&program).parent().unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    for command in commands {
        let mut shell = std::process::Command::new("sh");
        shell.args(["-c", command]).current_dir(server.directory());
        let output = shell.env("PATH", &path).env("PLANTD_ADDRESS", server.address()).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{command}: {}", stderr(&output));
    }
    let push = std::fs::read_to_string(server.directory().join("push.csv")).unwrap();
    assert_eq!(push.lines().count(), 201);
}

#[test]
fn a_server_that_serves_is_healthy() {
    let server = ServerProcess::start().unwrap();
    assert_eq!(json(&server, &["health"])["serving"], true);
    assert!(text(&server, &["health"]).ends_with("serving\n"));
    let nobody = plantctl("http://127.0.0.1:1", &["health"]).output().unwrap();
    assert_eq!(nobody.status.code(), Some(3));
}

#[test]
fn colours_are_for_terminals() {
    let server = ServerProcess::start().unwrap();
    let listed = |variables: &[(&str, &str)]| {
        let mut command = plantctl(server.address(), &["list", "models"]);
        command.env_remove("NO_COLOR").env_remove("CLICOLOR_FORCE");
        let output = command.envs(variables.iter().copied()).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let plain = listed(&[]);
    assert!(plain.contains("cart-pole") && !plain.contains('\x1b'), "{plain}");
    assert!(listed(&[("CLICOLOR_FORCE", "1")]).starts_with("\x1b["));
    assert_eq!(listed(&[("NO_COLOR", "1"), ("TERM", "xterm")]), plain);
}

#[test]
fn entries_of_vectors_have_names() {
    let server = ServerProcess::start().unwrap();
    let named = json(&server, &["create", "cart-pole", "--id", "named", "--q", "theta=0.1"]);
    // What is not named is as the scene has it.
    assert_eq!(named["state"]["q"], serde_json::json!([0.0, 0.1]));
    json(&server, &["create", "cart-pole", "--id", "listed", "--q", "0,0.1"]);
    let by_name = json(&server, &["step", "named", "--u", "u.force=1.5"]);
    assert_eq!(by_name["states"], json(&server, &["step", "listed", "--u", "1.5"])["states"]);
    let shown = text(&server, &["show", "plant", "named"]);
    for part in ["theta = ", " rad", " m, ", " N m s", "rad/s"] {
        assert!(shown.contains(part), "no `{part}` in\n{shown}");
    }
    let lqr = |q: &str| json(&server, &["lqr", "cart-pole", "--at", "upright", "--q", q]);
    assert_eq!(lqr("theta=100,p(theta)=5"), lqr("1,100,1,5"));
    let dynamics = |q: &str| json(&server, &["dynamics", "cart-pole", "--at", "upright", "--q", q]);
    assert_eq!(dynamics("x=0.3"), dynamics(&format!("0.3,{:?}", std::f64::consts::PI)));
    let wrong = run(&server, &["step", "named", "--u", "forse=1"]);
    assert!(stderr(&wrong).contains("no `forse`; did you mean `force`?"), "{}", stderr(&wrong));
}

#[test]
fn one_thing_has_one_name_and_what_is_over_is_refused() {
    let server = ServerProcess::start().unwrap();
    // By the name of the machine, without a scheme.
    let address = server.address().replace("http://127.0.0.1", "localhost");
    let create = ["create", "pendulum", "--id", "p", "--time-step", "0.02", "--json"];
    let created = plantctl(&address, &create).output().unwrap();
    assert!(created.status.success(), "{}", stderr(&created));
    let plant = json(&server, &["set-parameter", "p", "--dt", "0.05"]);
    assert_eq!(plant["settings"]["time_step_s"], 0.05);
    json(&server, &["step", "p", "--count", "3"]);
    let late = run(&server, &["fault", "inject", "p", "input=tau", "stuck=true", "start_s=0.05"]);
    assert_eq!(late.status.code(), Some(1));
    assert!(stderr(&late).contains("START_PASSED"), "{}", stderr(&late));
    let wrong = run(&server, &["fault", "inject", "p", "input=tau", "stuk=true"]);
    assert!(stderr(&wrong).contains("no key `stuk`; did you mean `stuck`?"), "{}", stderr(&wrong));
}
