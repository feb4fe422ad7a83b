//! What `deploy/` says fits the server, and the systemd unit is sound and closed.

use std::path::{Path, PathBuf};
use std::process::Command;

use plantd_server::config::{Config, Listen, LogFormat};
use plantd_server::core::limits::Limits;
use plantd_server::core::metrics::registry::Metrics;
use plantd_server::core::tenant::Tenant;
use plantd_server::tls::ClientCertificates;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    let path = root().join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The annotated configuration with the keys that are commented out.
fn full_configuration() -> String {
    let text = read("deploy/plantd.toml");
    // What is commented out has no space after the mark; what is said has one.
    let lines = text.lines().map(|line| match line.strip_prefix('#') {
        Some(key) if key.starts_with(|c: char| c == '[' || c.is_ascii_lowercase()) => key,
        _ => line,
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// Dotted names of all keys of a table.
fn keys(table: &toml::Table, prefix: &str) -> Vec<String> {
    let names = |(key, value): (&String, &toml::Value)| match value {
        toml::Value::Table(inner) => keys(inner, &format!("{prefix}{key}.")),
        _ => vec![format!("{prefix}{key}")],
    };
    let mut names: Vec<String> = table.iter().flat_map(names).collect();
    names.sort();
    names
}

#[test]
fn the_annotated_configuration_is_valid() {
    let config: Config = toml::from_str(&read("deploy/plantd.toml")).expect("it is read");
    config.check().expect("it is in range");
}

#[test]
fn the_annotated_configuration_has_every_key() {
    let text = full_configuration();
    // Read and written again, a configuration shows every key that is set: all of them must be.
    let config: Config = toml::from_str(&text).expect("it is read");
    assert!(config.unix.is_some() && config.scenes.is_some() && config.ready_file.is_some());
    assert!(config.link.root.is_some());
    assert!(config.state_directory.is_some() && config.recordings.is_some());
    assert!(config.telemetry.otlp.is_some());
    let tls = config.tls.as_ref().expect("it has TLS");
    assert!(tls.client_ca.is_some() && tls.client != ClientCertificates::default());
    let auth = config.auth.as_ref().expect("it asks who calls");
    assert!(
        auth.tokens.is_some()
            && auth.rules.is_some()
            && !auth.certificates.is_empty()
            && auth.peers[0].name.is_some()
    );
    config.check().expect("it is in range");
    let known: toml::Table = config.to_toml().expect("it is written").parse().expect("as TOML");
    let annotated: toml::Table = text.parse().expect("it is TOML");
    assert_eq!(keys(&annotated, ""), keys(&known, ""));
}

#[test]
fn the_annotated_configuration_differs_from_the_defaults_only_where_it_says_so() {
    let mut config: Config = toml::from_str(&read("deploy/plantd.toml")).expect("it is read");
    assert_eq!(config.limits, Limits::default());
    assert_ne!(config.metrics, Listen::Off);
    config.metrics = Listen::Off;
    config.unix = None;
    config.link.root = None;
    config.log.format = LogFormat::Text;
    assert_eq!(config, Config::default());
}

#[test]
fn the_annotated_configuration_has_every_limit_of_tenants() {
    let config: Config = toml::from_str(&full_configuration()).expect("it is read");
    let limits = toml::Table::try_from(config.tenants["lab"].limits).expect("as a table");
    let document = read("docs/security.md");
    let all = plantd_server::core::tenant::TenantLimits::NAMES;
    assert_eq!(limits.len(), all.len());
    for name in all {
        assert!(limits.contains_key(*name), "deploy/plantd.toml lacks {name}");
        assert!(document.contains(&format!("`{name}`")), "docs/security.md lacks {name}");
    }
}

#[test]
fn the_document_states_the_limits_in_force() {
    let document = read("docs/limits.md");
    for limit in Limits::default().table() {
        let row = format!("| `{}` | {} | {} |", limit.name, limit.value, limit.meaning);
        assert!(document.contains(&row), "docs/limits.md lacks the row\n{row}");
    }
}

#[test]
fn the_list_of_metrics_is_complete() {
    let metrics = Metrics::default();
    // A family without members is not written.
    metrics.step_failed("NOT_CONVERGED");
    metrics.rpc_ended("GetPlant", "OK", Tenant::NONE);
    let metrics = metrics.encode().expect("metrics are text");
    let list = read("deploy/prometheus.yml");
    let mut described: Vec<&str> =
        list.lines().filter_map(|line| line.strip_prefix("# | `")?.split('`').next()).collect();
    let mut registered: Vec<String> = metrics
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '))
        // Counters are exposed with the suffix `_total`, what does not change with `_info`.
        .map(|(name, kind)| match kind {
            "counter" => format!("{name}_total"),
            "info" => format!("{name}_info"),
            _ => name.to_owned(),
        })
        .collect();
    described.sort_unstable();
    registered.sort();
    assert_eq!(described, registered);
}

/// Whether a program goes well, and what it says; none, and a message, if it is not installed.
fn told_by(command: &mut Command) -> Option<(bool, String)> {
    match command.output() {
        Ok(output) => {
            let text = [output.stdout, output.stderr].concat();
            Some((output.status.success(), String::from_utf8_lossy(&text).into_owned()))
        }
        Err(error) => {
            eprintln!("skipped: {} does not run: {error}", command.get_program().display());
            None
        }
    }
}

fn promtool(arguments: &[&str]) -> Option<(bool, String)> {
    let program = std::env::var_os("PROMTOOL").unwrap_or_else(|| "promtool".into());
    told_by(Command::new(program).args(arguments).current_dir(root().join("deploy")))
}

#[test]
fn alerts_are_raised_when_they_should_be() {
    for arguments in [
        ["check", "config", "--syntax-only", "prometheus.yml"].as_slice(),
        &["check", "rules", "alerts.yml"],
        &["test", "rules", "alerts.test.yml"],
    ] {
        let Some((correct, messages)) = promtool(arguments) else { return };
        assert!(correct, "{messages}");
    }
    // No alert is without a test.
    let tests = read("deploy/alerts.test.yml");
    let alerts = read("deploy/alerts.yml");
    let mut alerts = alerts.lines().filter_map(|line| line.trim().strip_prefix("- alert: "));
    assert!(alerts.all(|alert| tests.contains(&format!("alertname: {alert}\n"))));
}

/// Queries of the dashboard's panels.
fn queries(value: &serde_json::Value, found: &mut Vec<String>) {
    match value {
        serde_json::Value::Object(fields) => {
            if let Some(query) = fields.get("expr").and_then(|query| query.as_str()) {
                found.push(query.to_owned());
            }
            fields.values().for_each(|value| queries(value, found));
        }
        serde_json::Value::Array(values) => values.iter().for_each(|value| queries(value, found)),
        _ => {}
    }
}

#[test]
fn the_queries_of_the_dashboard_are_correct() {
    let dashboard = serde_json::from_str(&read("deploy/grafana.json")).expect("it is JSON");
    let mut found = Vec::new();
    queries(&dashboard, &mut found);
    assert!(found.len() > 20, "{found:?}");
    // What Grafana fills in.
    let filled = found.iter().map(|query| query.replace("$__rate_interval", "1m"));
    let rules: Vec<_> = filled
        .map(|query| serde_json::json!({ "record": "a", "expr": query.replace("$instance", ".*") }))
        .collect();
    let rules = serde_json::json!({ "groups": [{ "name": "dashboard", "rules": rules }] });
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("rules.yml");
    // JSON is YAML, too.
    std::fs::write(&path, rules.to_string()).expect("it is written");
    let path = path.to_str().expect("a path of text");
    let Some((correct, messages)) = promtool(&["check", "rules", "--lint=none", path]) else {
        return;
    };
    assert!(correct, "{messages}");
}

/// Priorities that the documents recommend, and those that the unit grants.
#[test]
fn recommended_priorities_are_granted() {
    let unit = read("deploy/plantd.service");
    let granted = unit.lines().find_map(|line| line.strip_prefix("LimitRTPRIO=")).expect("a limit");
    let granted: u8 = granted.parse().expect("a number");
    let mut recommended = 0;
    for document in ["server/REALTIME.md", "README.md", "deploy/plantd.toml"] {
        let text = read(document);
        for rest in text.split("fifo = ").skip(1) {
            let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
            let Ok(priority) = digits.parse::<u8>() else { continue };
            assert!(
                priority <= granted,
                "{document} recommends {priority}, the unit grants {granted}"
            );
            recommended += 1;
        }
    }
    assert!(recommended > 0);
    assert!(read("deploy/plantd.toml").contains(&format!("grants up to {granted}\n")));
}

#[test]
fn ports_and_paths_agree() {
    let config: Config = toml::from_str(&read("deploy/plantd.toml")).expect("it is read");
    let port = |listen: Listen| match listen {
        Listen::At(address) => address.port(),
        Listen::Off => panic!("it listens"),
    };
    let container = read("deploy/Containerfile");
    let (grpc, metrics) = (port(config.grpc), port(config.metrics));
    assert!(container.contains(&format!("EXPOSE {grpc} {metrics}")));
    assert!(read("deploy/prometheus.yml").contains(&format!("\"127.0.0.1:{metrics}\"")));
    let unit = read("deploy/plantd.service");
    let folder = unit.lines().find_map(|line| line.strip_prefix("RuntimeDirectory="));
    // Of the unit that is no instance.
    let folder = folder.map(|folder| folder.replace("%N", "plantd"));
    let folder = Path::new("/run").join(folder.expect("the unit has a runtime folder"));
    for path in [config.unix, config.link.root] {
        assert!(path.expect("it is set").starts_with(&folder));
    }
    // What is cut off last must not be cut off by the service manager first.
    let stop =
        unit.lines().find_map(|line| line.strip_prefix("TimeoutStopSec=")?.strip_suffix('s'));
    let stop: f64 = stop.expect("the unit bounds the stop").parse().expect("a number");
    assert!(stop > config.drain_s + config.shutdown_grace_s + 10.0);
}

#[test]
fn the_container_is_built_from_what_is_here_and_not_run_by_root() {
    let container = read("deploy/Containerfile");
    let manifest: toml::Table = read("Cargo.toml").parse().expect("it is TOML");
    let rust = manifest["workspace"]["package"]["rust-version"].as_str().expect("a version");
    assert!(container.contains(&format!("rust:{rust}-")), "the container builds with {rust}");
    assert!(container.lines().any(|line| line == "USER nonroot"));
    assert!(container.contains("--shm-size"));
    for line in container.lines().filter(|line| line.starts_with("COPY deploy/")) {
        let source = line.split(' ').nth(1).expect("COPY has a source");
        assert!(root().join(source).is_file(), "{source} is missing");
    }
}

/// Versions agree, the changelog has the section, `cargo binstall` finds what is packed, and the parts can be listed.
#[test]
fn a_release_can_be_made() {
    let mut check = Command::new("python3");
    check.arg("deploy/release.py").arg("--check").current_dir(root());
    let output = check.output().expect("python3 runs");
    let told = String::from_utf8_lossy(&output.stderr);
    if told.contains("No module named 'tomllib'") {
        println!("skipped: releases are made with Python 3.11 or later");
        return;
    }
    assert!(output.status.success(), "{told}");
    assert!(read("deploy/Containerfile").contains("[\"/usr/local/bin/plantctl\", \"health\"]"));
}

fn systemd_analyze(arguments: &[&str]) -> Option<(bool, String)> {
    told_by(Command::new("systemd-analyze").args(arguments))
}

#[test]
fn the_systemd_unit_is_correct() {
    // The command must exist for the check; any other one does.
    let command = "ExecStart=/usr/local/bin/plantd serve ";
    let unit = read("deploy/plantd.service");
    assert!(unit.contains(command));
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("plantd.service");
    std::fs::write(&path, unit.replace(command, "ExecStart=/bin/true ")).expect("it is written");
    let path = path.to_str().expect("a path of text");
    let Some((correct, messages)) = systemd_analyze(&["verify", path]) else { return };
    assert!(correct, "{messages}");
    assert!(!messages.contains("plantd.service:"), "{messages}");
}

#[test]
fn the_systemd_unit_is_closed() {
    // Of 100; a unit without any protection has 96.
    const EXPOSURE_MAX: &str = "--threshold=20";
    let path = root().join("deploy/plantd.service");
    let path = path.to_str().expect("a path of text");
    let arguments = ["security", "--offline=yes", "--no-pager", EXPOSURE_MAX, path];
    let Some((closed, messages)) = systemd_analyze(&arguments) else { return };
    assert!(closed, "{messages}");
}
