//! Heavy calls of one connection keep no other one waiting.

use std::time::{Duration, Instant};

use plantd_client::{Client, operating_point, v1};
use tokio::task::JoinSet;

use crate::support::*;

/// Endless calls, and streams of heavy steps.
const HEAVY_PLANTS: usize = 16;
const HEAVY_ROLLOUTS: usize = 300;
/// Of a step of each of them: half a second or more.
const SUBSTEPS: u32 = 24;

fn heavy_settings() -> v1::PlantSettings {
    v1::PlantSettings { order: 12, substeps: SUBSTEPS, ..Default::default() }
}

async fn heavy_plant(client: &Client) -> String {
    let request = v1::CreatePlantRequest {
        model: "chain-64".to_owned(),
        settings: Some(heavy_settings()),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap().id
}

/// Calls that take as long as they may.
async fn steps(client: Client, id: String) {
    loop {
        let request = v1::StepRequest { id: id.clone(), hold: 100_000, ..Default::default() };
        let _ = client.step(request).await;
    }
}

async fn drive(client: Client, id: String) {
    let mut driver = client.drive(id).await.unwrap();
    loop {
        driver.step(&[0.0]).await.unwrap();
    }
}

async fn rollouts(client: Client) {
    loop {
        let case = v1::RolloutCase { hold: 100_000, ..Default::default() };
        let request = v1::RolloutRequest {
            model: "chain-64".to_owned(),
            settings: Some(heavy_settings()),
            cases: vec![case; 4],
            ..Default::default()
        };
        if let Ok(answers) = client.rollout(request).await {
            let _ = answers.collect().await;
        }
    }
}

/// Waits for an answer, and says how long that took.
async fn timed<T>(what: &str, call: impl Future<Output = plantd_client::Result<T>>) -> T {
    let began = Instant::now();
    let answer = soon(call).await.unwrap();
    println!("{what}: {:?}", began.elapsed());
    answer
}

/// What another connection asks for meanwhile.
async fn light_calls(client: &Client) {
    let model = "cart-pole".to_owned();
    let request = v1::CreatePlantRequest { model: model.clone(), ..Default::default() };
    let id = timed("CreatePlant", client.create_plant(request)).await.id;
    timed("GetPlant", client.get_plant(&id)).await;
    timed("Snapshot", client.snapshot(&id)).await;
    let mut driver = timed("Drive", client.drive(&id)).await;
    for _ in 0..20 {
        timed("a step", driver.step(&[0.0])).await;
    }
    timed("its end", driver.close()).await;
    let request = v1::StepRequest { id, hold: 2_000, ..Default::default() };
    timed("Step", client.step(request)).await;
    let point = Some(operating_point("upright"));
    let request =
        v1::LinearizeRequest { model: model.clone(), point: point.clone(), ..Default::default() };
    timed("Linearize", client.linearize(request)).await;
    let weights = Some(unit_weights(4, 1));
    let request = v1::SolveLqrRequest { model, point, weights, ..Default::default() };
    timed("SolveLqr", client.solve_lqr(request)).await;
    timed("ValidateScene", client.validate_scene(TWO_PENDULUMS)).await;
}

/// Processor time of a process so far, in ticks.
fn ticks(pid: u32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let (_, fields) = stat.rsplit_once(')').unwrap();
    fields.split_whitespace().skip(11).take(2).map(|field| field.parse::<u64>().unwrap()).sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn heavy_calls_of_one_connection_shut_nobody_out() {
    let flags = ["--threads", "2", "--workers", "2", "--limit", "streams_per_connection=1000"];
    let (server, heavy) = server_with(&flags).await;
    let light = server.client().await;
    let mut work = JoinSet::new();
    for _ in 0..HEAVY_PLANTS {
        let (stepped, driven) = (heavy_plant(&heavy).await, heavy_plant(&heavy).await);
        work.spawn(steps(heavy.clone(), stepped));
        work.spawn(drive(heavy.clone(), driven));
    }
    for _ in 0..HEAVY_ROLLOUTS {
        work.spawn(rollouts(heavy.clone()));
    }
    for _ in 0..2 {
        tokio::time::sleep(Duration::from_secs(1)).await;
        light_calls(&light).await;
    }
    // What nobody waits for ends.
    work.shutdown().await;
    drop(heavy);
    let is_idle = async || {
        let before = ticks(server.pid());
        tokio::time::sleep(Duration::from_millis(300)).await;
        ticks(server.pid()) - before <= 2
    };
    soon(async { while !is_idle().await {} }).await;
    let plants = light.list_plants().await.unwrap();
    assert!(plants.iter().all(|plant| plant.driver.is_empty()), "a lease was kept");
}

/// Largest resident memory of a process so far, bytes.
fn peak_bytes(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    peak.trim_end_matches("kB").trim().parse::<u64>().unwrap() * 1024
}

/// Small parts take a hundred times their bytes: messages of many are refused before they are read.
#[tokio::test]
async fn what_becomes_of_many_empty_channels_is_bounded() {
    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let before = peak_bytes(server.pid());
    let outputs = vec![v1::OutputChannel::default(); 400_000];
    let channels = v1::Channels { outputs, ..Default::default() };
    let error = soon(client.set_channels(&id, channels)).await.unwrap_err();
    assert_eq!(error.reason(), "LIMIT_EXCEEDED");
    assert!(error.to_string().contains("channel_message_bytes"), "{error}");
    let grown = peak_bytes(server.pid()) - before;
    assert!(grown < 24 << 20, "{grown} bytes more");
}
