//! What plants, models and streams took comes back when they are gone.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use plantd_client::{Client, v1};
use plantd_tests::server::ServerProcess;

/// What may stay with the process, KiB: what it keeps on purpose, and pages that are used in part.
const KEPT_KIB: u64 = 64 << 10;
/// Longest wait for memory to come back.
const PATIENCE: Duration = Duration::from_secs(60);
/// Links of a chain that takes megabytes to compile and to step.
const LINKS: usize = 512;

fn chain(name: &str) -> String {
    let mut scene = format!("format = 1\nname = \"{name}\"\ngravity = [0.0, -9.8, 0.0]\n");
    for i in 0..LINKS {
        let parent = if i > 0 { format!("parent = \"f{}\"\n", i - 1) } else { String::new() };
        let _ = write!(
            scene,
            "[[frames]]\nname = \"f{i}\"\n{parent}\
             joint = {{ type = \"revolute\", axis = [0.0, 0.0, 1.0] }}\n\
             body = {{ mass = 1.0, center_of_mass = [0.1, 0.0, 0.0] }}\n"
        );
    }
    scene
}

/// Models with a plant each, stepped and deleted by as many clients at a time.
async fn models_come_and_go(server: &ServerProcess, round: usize) {
    let tasks = (0..4).map(|task| {
        let address = server.address().to_owned();
        tokio::spawn(async move {
            let client = Client::connect(&address).await.unwrap();
            for k in 0..4 {
                let name = format!("chain-of-{round}-{task}-{k}");
                client.create_model(chain(&name)).await.unwrap();
                let request = v1::CreatePlantRequest { model: name, ..Default::default() };
                let plant = client.create_plant(request).await.unwrap();
                let mut driver = client.drive(&plant.id).await.unwrap();
                for _ in 0..3 {
                    driver.step(&[]).await.unwrap();
                }
                drop(driver);
                client.delete_plant(&plant.id).await.unwrap();
                client.delete_model(&plant.model).await.unwrap();
            }
        })
    });
    for task in tasks.collect::<Vec<_>>() {
        task.await.unwrap();
    }
}

/// Many plants with an open stream each, over a few connections.
async fn streams_come_and_go(server: &ServerProcess) {
    let mut drivers = Vec::new();
    for _ in 0..8 {
        let client = server.client().await;
        for _ in 0..30 {
            let request =
                v1::CreatePlantRequest { model: "cart-pole".to_owned(), ..Default::default() };
            let id = client.create_plant(request).await.unwrap().id;
            let mut driver = client.drive(&id).await.unwrap();
            driver.step(&[0.0]).await.unwrap();
            drivers.push((client.clone(), id, driver));
        }
    }
    for (client, id, driver) in drivers {
        drop(driver);
        client.delete_plant(&id).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_comes_back_round_after_round() {
    let server = ServerProcess::start().unwrap();
    let start = server.resident_kib();
    for round in 0..4 {
        models_come_and_go(&server, round).await;
        streams_come_and_go(&server).await;
        let deadline = Instant::now() + PATIENCE;
        while server.resident_kib() > start + KEPT_KIB {
            assert!(
                Instant::now() < deadline,
                "{} MiB at first, {} MiB after round {round}",
                start >> 10,
                server.resident_kib() >> 10
            );
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
}
