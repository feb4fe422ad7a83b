//! Metrics: a tenant sees its own alone; dashboard and alerts name nothing that a server does not export.

use std::collections::BTreeSet;
use std::path::Path;

use plantd_client::{Code, v1};
use plantd_tests::server::ServerProcess;

use crate::support::*;

/// What a server counts, seen by the holder of a token.
fn seen_by(server: &ServerProcess, token: &str) -> String {
    let answer = get(server, "/metrics", &format!("Authorization: Bearer {token}\r\n"));
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tenant_sees_its_own_metrics_alone() {
    let lab = Lab::new();
    let [anna, bert, root] =
        [("anna", "driver", "red"), ("bert", "viewer", "blue"), ("root", "admin", "office")]
            .map(|(name, role, tenant)| lab.token(name, role, tenant));
    let limits = "[tenants.red.limits]\nplants = 1\n";
    let server = lab.start(&format!("{}{limits}", lab.auth()));
    let red = somebody(&lab, &server, &anna).await;
    let blue = somebody(&lab, &server, &bert).await;
    plant(&red, "red-1").await;
    let another = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    assert_refused(
        red.create_plant(another.clone()).await,
        Code::ResourceExhausted,
        "LIMIT_EXCEEDED",
    );
    assert_refused(blue.create_plant(another).await, Code::PermissionDenied, "ROLE");
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    let run =
        v1::RunRequest { id: "red-1".to_owned(), settings: Some(settings), ..Default::default() };
    red.run(run).await.unwrap();

    let (of_red, of_blue, all) =
        (seen_by(&server, &anna), seen_by(&server, &bert), seen_by(&server, &root));
    for line in [
        "plantd_tenant_plants{tenant=\"red\"} 1",
        "plantd_tenant_running_plants{tenant=\"red\"} 1",
        "plantd_tenant_overruns_total{tenant=\"red\"} ",
        "plantd_tenant_rpcs_total{tenant=\"red\",code=\"RESOURCE_EXHAUSTED\"} 1",
    ] {
        assert!(of_red.contains(line), "{line} is missing in\n{of_red}");
        assert!(!of_blue.contains(line) && all.contains(line), "{line}");
    }
    let denied = "plantd_tenant_rpcs_total{tenant=\"blue\",code=\"PERMISSION_DENIED\"} 1";
    assert!(of_blue.contains(denied) && !of_red.contains(denied) && all.contains(denied));
    for own in [&of_red, &of_blue] {
        assert!(own.contains("plantd_build_info{version="), "{own}");
        // What is counted of all together says something of others.
        for name in ["plantd_plants ", "plantd_rpcs_total", "process_", "office"] {
            assert!(!own.contains(name), "{name} in\n{own}");
        }
    }
    for name in ["plantd_plants 1", "process_cpu_seconds_total ", "process_open_fds "] {
        assert!(all.contains(name), "{name} is missing in\n{all}");
    }
}

/// Names of the series that a server exports.
fn exported(metrics: &str) -> BTreeSet<String> {
    let types = metrics.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '));
    let names = types.flat_map(|(name, kind)| {
        let ends: &[&str] = match kind {
            "counter" => &["_total"],
            "info" => &["_info"],
            "histogram" => &["_bucket", "_sum", "_count"],
            _ => &[""],
        };
        ends.iter().map(move |end| format!("{name}{end}"))
    });
    names.collect()
}

/// Names of our metrics in a text.
fn named(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    let ours = words.filter(|word| word.starts_with("plantd_") || word.starts_with("process_"));
    ours.map(str::to_owned).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn dashboard_and_alerts_name_what_a_server_exports() {
    let lab = Lab::new();
    let root = lab.token("root", "admin", "office");
    let server = lab.start(&lab.auth());
    // What is counted by reasons and codes is not there before the first of them.
    let client = somebody(&lab, &server, &root).await;
    let settings = v1::PlantSettings { time_step_s: 0.5, max_iterations: 1, ..Default::default() };
    let (id, model) = ("p".to_owned(), "double-pendulum".to_owned());
    let request =
        v1::CreatePlantRequest { id, model, settings: Some(settings), ..Default::default() };
    client.create_plant(request).await.unwrap();
    let step = v1::StepRequest { id: "p".to_owned(), hold: 1000, ..Default::default() };
    client.step(step).await.expect_err("one iteration is not enough");
    let exported = exported(&seen_by(&server, &root));
    let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
    for (file, count) in [("grafana.json", 25), ("alerts.yml", 8), ("alerts.test.yml", 8)] {
        let named = named(&std::fs::read_to_string(deploy.join(file)).unwrap());
        assert!(named.len() >= count, "{file} names {named:?}");
        let unknown: Vec<_> = named.difference(&exported).collect();
        assert!(unknown.is_empty(), "{file} names {unknown:?}, which no server exports");
    }
}
