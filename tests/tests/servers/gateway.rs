//! Several servers behind a real Envoy, by the configuration that `deploy/envoy.py` writes: names, placement, drain,
//! and a gateway that is lost.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use plantd_client::{Client, ConnectOptions, Error, Reconnecting, v1};
use plantd_tests::server::ServerProcess;

/// Name of the program, set by `cargo verify --only gateway`, which installs it.
const ENVOY: &str = "PLANTD_ENVOY";
const NEW: &str = "new.plantd.test";
const PATIENCE: Duration = Duration::from_secs(20);

/// Envoy in front of servers, called by their names.
struct Gateway {
    child: Child,
    port: u16,
    configuration: PathBuf,
    _folder: tempfile::TempDir,
}

impl Gateway {
    fn start(servers: &[(String, &ServerProcess)]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let port = free_port();
        let of = |(name, server): &(String, &ServerProcess)| {
            format!("{name}={}", server.address().trim_start_matches("http://"))
        };
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/envoy.py");
        let written = Command::new("python3")
            .arg(script)
            .args(servers.iter().map(of))
            .args(["--listen", &format!("127.0.0.1:{port}"), "--new", NEW])
            .output()
            .unwrap();
        assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
        let configuration = folder.path().join("envoy.json");
        std::fs::write(&configuration, written.stdout).unwrap();
        let child = envoy(&configuration);
        Self { child, port, configuration, _folder: folder }
    }

    /// A client that calls a server, or the placement, by its name.
    async fn client(&self, name: &str) -> Client {
        let address = format!("http://127.0.0.1:{}", self.port);
        let options = ConnectOptions { authority: Some(name.to_owned()), ..Default::default() };
        let deadline = Instant::now() + PATIENCE;
        loop {
            match Client::connect_with(&address, options.clone()).await {
                Ok(client) => return client,
                Err(error) => assert!(Instant::now() < deadline, "{error}"),
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Ends it as a crash does, and starts it again.
    fn restart(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.child = envoy(&self.configuration);
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn envoy(configuration: &Path) -> Child {
    let program = std::env::var_os(ENVOY).expect("`cargo verify --only gateway` sets it");
    Command::new(program)
        .args(["--base-id", &std::process::id().to_string(), "--use-dynamic-base-id"])
        .args(["--log-level", "error", "-c"])
        .arg(configuration)
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn servers() -> Vec<(String, ServerProcess)> {
    let start = |k| {
        let name = format!("plantd-{k}.plantd.test");
        let server = ServerProcess::start_with(|command| {
            command.args(["--name", &name, "--drain-s", "5"]);
        });
        (name, server.unwrap())
    };
    (0..3).map(start).collect()
}

fn borrowed(servers: &[(String, ServerProcess)]) -> Vec<(String, &ServerProcess)> {
    servers.iter().map(|(name, server)| (name.clone(), server)).collect()
}

async fn create(client: &Client) -> Result<v1::PlantInfo, Error> {
    let model = "cart-pole".to_owned();
    client.create_plant(v1::CreatePlantRequest { model, ..Default::default() }).await
}

/// Until as many servers as there should be get new plants.
async fn all_are_ready(new: &Client, count: usize) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut seen = BTreeMap::new();
        for _ in 0..3 * count {
            if let Ok(plant) = create(new).await {
                *seen.entry(plant.server).or_insert(0) += 1;
            }
        }
        if seen.len() == count {
            return;
        }
        assert!(Instant::now() < deadline, "{seen:?}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
#[ignore = "takes Envoy: cargo verify --only gateway"]
async fn plants_are_placed_in_turn_and_found_by_name() {
    let servers = servers();
    let gateway = Gateway::start(&borrowed(&servers));
    let new = gateway.client(NEW).await;
    all_are_ready(&new, 3).await;
    let mut placed: BTreeMap<String, Vec<v1::PlantInfo>> = BTreeMap::new();
    for _ in 0..30 {
        let plant = create(&new).await.unwrap();
        placed.entry(plant.server.clone()).or_default().push(plant);
    }
    let counts: Vec<usize> = placed.values().map(Vec::len).collect();
    assert_eq!(counts, [10, 10, 10]);
    for (server, plants) in &placed {
        let by_name = gateway.client(server).await;
        let direct = Client::connect(&plants[0].address).await.unwrap();
        assert_eq!(by_name.server_info().await.unwrap().name, *server);
        for plant in plants {
            for client in [&by_name, &direct] {
                for _ in 0..5 {
                    let found = client.get_plant(&*plant.id).await.unwrap().plant.unwrap();
                    assert_eq!((&found.id, &found.server), (&plant.id, server));
                }
            }
        }
    }
    // A name that nobody has is refused.
    let address = format!("http://127.0.0.1:{}", gateway.port);
    let authority = Some("stranger.plantd.test".to_owned());
    let options = ConnectOptions { authority, ..Default::default() };
    let stranger = Client::connect_with(address, options).await;
    let refused = match stranger {
        Ok(client) => client.server_info().await.map(|_| ()),
        Err(error) => Err(error),
    };
    assert!(refused.is_err());
}

#[tokio::test]
#[ignore = "takes Envoy: cargo verify --only gateway"]
async fn a_server_drains_under_load_and_no_new_plant_is_refused() {
    let mut servers = servers();
    let gateway = Gateway::start(&borrowed(&servers));
    let new = gateway.client(NEW).await;
    all_are_ready(&new, 3).await;
    let ending = servers[1].0.clone();
    let client = gateway.client(&ending).await;
    let plant = create(&client).await.unwrap();
    let mut driver = client.drive(&*plant.id).await.unwrap();
    let mut step = async |k: u64| {
        let state = driver.step(&[(k as f64).sin()]).await.unwrap().state.unwrap();
        assert_eq!(state.step, k + 1);
    };
    step(0).await;
    servers[1].1.terminate().unwrap();
    // The signal has been heard.
    while !client.server_info().await.unwrap().draining {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    for k in 1..=20 {
        let made = create(&new).await.unwrap();
        assert_ne!(made.server, ending);
        step(k).await;
    }
    driver.close().await.unwrap();
    assert!(servers[1].1.end().unwrap().success());
}

#[tokio::test]
#[ignore = "takes Envoy: cargo verify --only gateway"]
async fn a_driver_outlives_its_gateway() {
    let servers = servers();
    let mut gateway = Gateway::start(&borrowed(&servers));
    let (name, server) = &servers[0];
    let client = gateway.client(name).await;
    let plant = create(&client).await.unwrap();
    let open = v1::DriveOpen { id: plant.id.clone(), grace_s: 20.0, ..Default::default() };
    let mut driver = Reconnecting::open(client, open, PATIENCE).await.unwrap();
    let steps = 10_000;
    for k in 0..steps {
        if k == steps / 2 {
            gateway.restart();
        }
        let state = driver.step(&[(k as f64).sin()]).await.unwrap().state.unwrap();
        assert_eq!(state.step, k + 1);
    }
    assert!(driver.reconnections() >= 1);
    driver.close().await.unwrap();
    let direct = server.client().await.get_plant(&*plant.id).await.unwrap().plant.unwrap();
    assert_eq!(direct.state.unwrap().step, steps);
}
