//! Servers that share an object store: plants, scenes and recordings are of all of them, and none writes over another's.
//!
//! By the store in a process, with servers in it; by a real S3 server with servers of their own, one of which hangs,
//! in the tests that `cargo verify --only store` runs.

use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use futures::{StreamExt as _, TryStreamExt as _};
use plantd_client::{
    Client, Code, ConnectOptions, Error, Reconnecting, RecordingEntry, RecordingReader, v1,
};
use plantd_server::config::{Config, Listen};
use plantd_server::serve::RunningServer;
use plantd_tests::server::ServerProcess;

/// The program `moto_server`, set by `cargo verify --only store`, which installs it.
const MOTO: &str = "PLANTD_MOTO";
const PATIENCE: Duration = Duration::from_secs(20);

/// A server in this process, on a store in it.
struct Inside {
    server: Option<RunningServer>,
    folder: tempfile::TempDir,
}

impl Inside {
    async fn start(store: &str, name: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut config = Config {
            name: Some(name.to_owned()),
            grpc: Listen::At("127.0.0.1:0".parse().unwrap()),
            metrics: Listen::Off,
            state_directory: Some(format!("memory://{store}").into()),
            state_interval_s: 0.05,
            recordings: Some(folder.path().join("recordings")),
            shutdown_grace_s: 1.0,
            ..Config::default()
        };
        config.link.enabled = false;
        Self { server: Some(RunningServer::start(config).await.unwrap()), folder }
    }

    fn address(&self) -> String {
        self.server.as_ref().unwrap().addresses().grpc.clone().unwrap()
    }

    async fn client(&self) -> Client {
        Client::connect(&self.address()).await.unwrap()
    }

    async fn end(mut self) {
        self.server.take().unwrap().stop().await;
    }
}

async fn create(client: &Client, id: &str, model: &str) -> Result<v1::PlantInfo, Error> {
    let (id, model) = (id.to_owned(), model.to_owned());
    client.create_plant(v1::CreatePlantRequest { id, model, ..Default::default() }).await
}

async fn start_recording(client: &Client, id: &str) -> Result<v1::Recording, Error> {
    let (id, name) = (id.to_owned(), "trial".to_owned());
    client.start_recording(v1::StartRecordingRequest { id, name, ..Default::default() }).await
}

/// The input of a step: of nothing but its index.
fn force(k: u64) -> f64 {
    0.3 * (0.17 * k as f64).sin()
}

async fn step(client: &Client, id: &str, k: u64) -> Result<v1::State, Error> {
    let u = Some(v1::Matrix { rows: 1, cols: 1, data: vec![force(k)] });
    let request = v1::StepRequest { id: id.to_owned(), u, ..Default::default() };
    Ok(client.step(request).await?.states.remove(0))
}

/// The state after so many steps, of a plant that nobody has disturbed.
async fn undisturbed(client: &Client, model: &str, steps: u64) -> v1::State {
    let id = create(client, "", model).await.unwrap().id;
    let mut state = None;
    for k in 0..steps {
        state = Some(step(client, &id, k).await.unwrap());
    }
    client.delete_plant(&id).await.unwrap();
    state.unwrap()
}

/// Until something is so.
async fn until(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so().await {
        assert!(Instant::now() < deadline, "{what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn is_elsewhere(error: &Error, address: &str) -> bool {
    error.reason() == "PLANT_ELSEWHERE" && error.elsewhere() == Some(address)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_plant_has_one_server_and_every_server_says_which() {
    let (a, b) = (Inside::start("one", "a").await, Inside::start("one", "b").await);
    let (to_a, to_b) = (a.client().await, b.client().await);
    assert_eq!(create(&to_a, "p", "pendulum").await.unwrap().server, "a");
    // Its address is in the store once it has been saved after the start, at the latest.
    until("b knows where it is", async || {
        to_b.get_plant("p").await.is_err_and(|error| is_elsewhere(&error, &a.address()))
    })
    .await;
    // Its id is taken on all servers.
    let refused = create(&to_b, "p", "pendulum").await.unwrap_err();
    assert!(is_elsewhere(&refused, &a.address()), "{refused}");
    assert!(to_b.list_plants().await.unwrap().is_empty());
    // Whoever asks b for it ends at a.
    let open = v1::DriveOpen { id: "p".to_owned(), ..Default::default() };
    let mut driver = Reconnecting::open(to_b.clone(), open, PATIENCE).await.unwrap();
    assert_eq!(driver.step(&[0.1]).await.unwrap().state.unwrap().step, 1);
    driver.close().await.unwrap();
    // A plant that is nowhere is no plant, and one that was deleted is gone for all.
    assert_eq!(to_b.get_plant("q").await.unwrap_err().reason(), "PLANT_NOT_FOUND");
    to_a.delete_plant("p").await.unwrap();
    assert_eq!(to_b.get_plant("p").await.unwrap_err().reason(), "PLANT_NOT_FOUND");
    assert_eq!(create(&to_b, "p", "pendulum").await.unwrap().server, "b");
    a.end().await;
    b.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn plants_of_a_server_that_ended_come_to_whoever_is_asked_for_them() {
    let a = Inside::start("two", "a").await;
    let to_a = a.client().await;
    for id in ["p", "q", "r"] {
        create(&to_a, id, "cart-pole").await.unwrap();
        for k in 0..10 {
            step(&to_a, id, k).await.unwrap();
        }
    }
    to_a.delete_plant("r").await.unwrap();
    a.end().await;
    let b = Inside::start("two", "b").await;
    let to_b = b.client().await;
    assert!(to_b.list_plants().await.unwrap().is_empty(), "nobody has asked for one yet");
    // Two at once find the same plant.
    let (one, other) = tokio::join!(to_b.get_plant("p"), to_b.get_plant("p"));
    assert_eq!(one.unwrap().plant, other.unwrap().plant);
    assert_eq!(to_b.get_plant("r").await.unwrap_err().reason(), "PLANT_NOT_FOUND");
    let state = step(&to_b, "p", 10).await.unwrap();
    assert_eq!(state, undisturbed(&to_b, "cart-pole", 11).await);
    // What nobody has taken is there when the server comes back, and nothing else.
    let a = Inside::start("two", "a").await;
    let to_a = a.client().await;
    let here: Vec<_> =
        to_a.list_plants().await.unwrap().into_iter().map(|plant| plant.id).collect();
    assert_eq!(here, ["q"]);
    assert_eq!(to_a.get_plant("q").await.unwrap().plant.unwrap().state.unwrap().step, 10);
    until("a knows where the other one is", async || {
        to_a.get_plant("p").await.is_err_and(|error| is_elsewhere(&error, &b.address()))
    })
    .await;
    a.end().await;
    b.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_whose_plants_were_taken_lets_them_go() {
    let (a, b) = (Inside::start("three", "a").await, Inside::start("three", "b").await);
    let (to_a, to_b) = (a.client().await, b.client().await);
    create(&to_a, "p", "pendulum").await.unwrap();
    let mut driver = to_a.drive("p").await.unwrap();
    for k in 0..20 {
        driver.step(&[force(k)]).await.unwrap();
    }
    let refused = to_b.adopt_plants("b").await.unwrap_err();
    assert_eq!(refused.violations()[0].field, "from");
    assert_eq!(to_b.adopt_plants("nobody").await.unwrap(), v1::AdoptPlantsResponse::default());
    let saved =
        async || to_b.get_plant("p").await.is_err_and(|error| is_elsewhere(&error, &a.address()));
    until("it is saved", saved).await;
    let adopted = to_b.adopt_plants("a").await.unwrap();
    assert_eq!((adopted.plants, adopted.lost), (vec!["p".to_owned()], vec![]));
    let from = to_b.get_plant("p").await.unwrap().plant.unwrap().state.unwrap().step;
    assert!(from <= 20);
    // The driver of the old one steps on until that wants to save it.
    let mut k = 20;
    let ended = loop {
        match driver.step(&[force(k)]).await {
            Ok(_) => k += 1,
            Err(error) => break error,
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    };
    assert!(is_elsewhere(&ended, &b.address()), "{ended}");
    // Nothing of that has reached the store.
    for k in from..30 {
        step(&to_b, "p", k).await.unwrap();
    }
    let state = to_b.get_plant("p").await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(state, undisturbed(&to_b, "pendulum", 30).await);
    b.end().await;
    let c = Inside::start("three", "c").await;
    let to_c = c.client().await;
    assert_eq!(to_c.get_plant("p").await.unwrap().plant.unwrap().state, Some(state));
    c.end().await;
    a.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_plant_that_is_moved_is_the_others_in_the_store_too() {
    let (a, b) = (Inside::start("four", "a").await, Inside::start("four", "b").await);
    let (to_a, to_b) = (a.client().await, b.client().await);
    create(&to_a, "p", "pendulum").await.unwrap();
    step(&to_a, "p", 0).await.unwrap();
    assert_eq!(to_a.move_plant("p", &to_b, false).await.unwrap().server, "b");
    assert!(is_elsewhere(&to_a.get_plant("p").await.unwrap_err(), &b.address()));
    step(&to_b, "p", 1).await.unwrap();
    a.end().await;
    b.end().await;
    let a = Inside::start("four", "a").await;
    let to_a = a.client().await;
    assert_eq!(to_a.get_plant("p").await.unwrap().plant.unwrap().state.unwrap().step, 2);
    a.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn scenes_and_recordings_are_there_for_all_servers() {
    let (a, b) = (Inside::start("five", "a").await, Inside::start("five", "b").await);
    let (to_a, to_b) = (a.client().await, b.client().await);
    let scene = to_a.get_model("pendulum").await.unwrap().scene_toml;
    let upload = |name: &str| v1::CreateModelRequest {
        scene: scene.clone(),
        name: name.to_owned(),
        ..Default::default()
    };
    to_a.create_model_as(upload("mine")).await.unwrap();
    assert_eq!(create(&to_b, "p", "mine").await.unwrap().model, "mine");

    let recording = start_recording(&to_b, "p").await.unwrap();
    assert_eq!(recording.name, "trial");
    for k in 0..20 {
        step(&to_b, "p", k).await.unwrap();
    }
    let done = to_b.stop_recording("trial").await.unwrap();
    let local = b.folder.path().join("recordings/trial.mcap");
    until("it is in the store", async || !local.exists()).await;
    for client in [&to_a, &to_b] {
        let listed = client.list_recordings().await.unwrap();
        let [recording] = &listed[..] else { panic!("{listed:?}") };
        assert_eq!((&recording.name[..], recording.bytes), ("trial", done.bytes));
        let pieces = client.get_recording("trial").await.unwrap();
        let pieces: Vec<_> = pieces.map_ok(|piece| piece.data).try_collect().await.unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trial.mcap");
        std::fs::write(&path, pieces.concat()).unwrap();
        let mut read = RecordingReader::open(&path).unwrap();
        let mut steps = 0;
        while let Some(entry) = read.next_entry().unwrap() {
            steps += u64::from(matches!(entry, RecordingEntry::Step(_)));
        }
        assert_eq!(steps, 20);
    }
    create(&to_a, "q", "pendulum").await.unwrap();
    let refused = start_recording(&to_a, "q").await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::AlreadyExists), "{refused}");
    to_a.delete_recording("trial").await.unwrap();
    assert!(to_b.list_recordings().await.unwrap().is_empty());

    to_b.delete_model("mine").await.unwrap();
    let c = Inside::start("five", "c").await;
    let refused = create(&c.client().await, "r", "mine").await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::NotFound), "{refused}");
    for server in [a, b, c] {
        server.end().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_is_refused_where_it_is_none() {
    let mut config =
        Config { grpc: Listen::At("127.0.0.1:0".parse().unwrap()), ..Config::default() };
    config.link.enabled = false;
    config.state_directory = Some("ftp://lab/plants".into());
    let Err(refused) = RunningServer::start(config).await else { panic!("a store of files") };
    let refused = format!("{refused:#}");
    assert!(refused.contains("ftp://lab/plants") && refused.contains("s3://"), "{refused}");

    let directory = tempfile::tempdir().unwrap();
    let server = ServerProcess::start_with(|command| {
        command.arg("--state-directory").arg(directory.path());
    });
    let server = server.unwrap();
    let refused = server.client().await.adopt_plants("other").await.unwrap_err();
    assert_eq!(refused.reason(), "NO_OBJECT_STORE");
}

/// A real S3 server.
struct Moto {
    child: Child,
    port: u16,
}

impl Moto {
    async fn start() -> Self {
        let program = std::env::var_os(MOTO).expect("`cargo verify --only store` sets it");
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let child = Command::new(program)
            .args(["-H", "127.0.0.1", "-p", &port.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let moto = Self { child, port };
        // A bucket, by the plainest of requests.
        until("the store answers", async || put_bucket(port).is_ok_and(|answer| answer)).await;
        moto
    }

    fn server(&self, name: &str, recordings: &Path) -> ServerProcess {
        let server = ServerProcess::start_with(|command| {
            command
                .args(["--name", name, "--state-directory", "s3://lab/plants"])
                .args(["--state-interval-s", "0.2", "--recordings"])
                .arg(recordings)
                .env("AWS_ENDPOINT", format!("http://127.0.0.1:{}", self.port))
                .envs([("AWS_ALLOW_HTTP", "true"), ("AWS_REGION", "us-east-1")])
                .envs([("AWS_ACCESS_KEY_ID", "key"), ("AWS_SECRET_ACCESS_KEY", "secret")]);
        });
        server.unwrap()
    }
}

impl Drop for Moto {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn put_bucket(port: u16) -> std::io::Result<bool> {
    use std::io::{Read as _, Write as _};
    let mut stream = std::net::TcpStream::connect(("127.0.0.1", port))?;
    let head =
        "PUT /lab HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    stream.write_all(head.as_bytes())?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer.starts_with("HTTP/1.1 200"))
}

fn signal(server: &ServerProcess, name: &str) {
    let pid = server.pid().to_string();
    assert!(Command::new("kill").args([name, &pid]).status().unwrap().success());
}

/// 100 plants of a server that hangs are taken; it wakes up, steps on and saves: nothing of it is written.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an S3 server: cargo verify --only store"]
async fn a_hung_server_that_wakes_up_writes_nothing() {
    const PLANTS: usize = 100;
    let folder = tempfile::tempdir().unwrap();
    let moto = Moto::start().await;
    let (a, b) = (moto.server("a", folder.path()), moto.server("b", folder.path()));
    let (to_a, to_b) = (a.client().await, b.client().await);
    let ids: Vec<String> = (0..PLANTS).map(|k| format!("p{k}")).collect();
    for id in &ids {
        create(&to_a, id, "pendulum").await.unwrap();
        step(&to_a, id, 0).await.unwrap();
    }
    for id in &ids {
        until("all are saved", async || {
            let found = to_b.get_plant(id).await;
            found.is_err_and(|error| is_elsewhere(&error, a.address()))
        })
        .await;
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    // A call that is on its way when the server hangs ends after it woke up.
    signal(&a, "-STOP");
    let adopted = to_b.adopt_plants("a").await.unwrap();
    assert_eq!((adopted.plants.len(), adopted.lost), (PLANTS, vec![]));
    for id in &ids {
        assert_eq!(step(&to_b, id, 1).await.unwrap().step, 2);
    }
    signal(&a, "-CONT");
    let fresh = Client::connect_with(a.address(), ConnectOptions::default()).await.unwrap();
    let mut stepped = 0;
    for id in &ids {
        // Until it wants to save the plant it does not know better.
        stepped += usize::from(step(&fresh, id, 7).await.is_ok());
    }
    for id in &ids {
        until("it lets the plants go", async || {
            let found = fresh.get_plant(id).await;
            found.is_err_and(|error| is_elsewhere(&error, b.address()))
        })
        .await;
    }
    println!(
        "the server stepped {stepped} of {PLANTS} plants that were taken from it; none was written"
    );
    let (mut a, mut b) = (a, b);
    a.stop().unwrap();
    b.kill().unwrap();
    let b = moto.server("b", folder.path());
    let to_b = b.client().await;
    for id in &ids {
        let state = to_b.get_plant(id).await.unwrap().plant.unwrap().state.unwrap();
        assert!([1, 2].contains(&state.step), "{id} at {}", state.step);
        // What there is followed from b's steps, or from before them.
        assert_eq!(state, undisturbed(&to_b, "pendulum", state.step).await);
    }
}

/// What a server leaves behind that was killed, one that was ended, and a store that is slow.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an S3 server: cargo verify --only store"]
async fn servers_come_and_go_with_their_plants_in_a_real_store() {
    let folder = tempfile::tempdir().unwrap();
    let moto = Moto::start().await;
    let mut a = moto.server("a", folder.path());
    let to_a = a.client().await;
    create(&to_a, "p", "pendulum").await.unwrap();
    for k in 0..50 {
        step(&to_a, "p", k).await.unwrap();
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    a.kill().unwrap();
    // Under its name it is there again; by another one only when somebody says so.
    let b = moto.server("b", folder.path());
    let to_b = b.client().await;
    assert_eq!(to_b.get_plant("p").await.unwrap_err().reason(), "PLANT_ELSEWHERE");
    let mut a = moto.server("a", folder.path());
    let to_a = a.client().await;
    assert_eq!(to_a.get_plant("p").await.unwrap().plant.unwrap().state.unwrap().step, 50);
    assert!(a.stop().unwrap().success());
    let state = step(&to_b, "p", 50).await.unwrap();
    assert_eq!(state, undisturbed(&to_b, "pendulum", 51).await);

    let recorded = folder.path().join("trial.mcap");
    start_recording(&to_b, "p").await.unwrap();
    for k in 0..50 {
        step(&to_b, "p", k).await.unwrap();
    }
    to_b.stop_recording("trial").await.unwrap();
    until("it is in the store", async || !recorded.exists()).await;
    let a = moto.server("a", folder.path());
    let pieces = a.client().await.get_recording("trial").await.unwrap();
    let pieces: Vec<_> = pieces.map_ok(|piece| piece.data.len()).try_collect().await.unwrap();
    assert!(pieces.iter().sum::<usize>() > 1000);
}

/// The store is slow for so many at once; the server waits for it, and nobody is lost.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an S3 server: cargo verify --only store"]
async fn a_thousand_plants_outlive_their_server_in_a_slow_store() {
    const PLANTS: usize = 1000;
    let folder = tempfile::tempdir().unwrap();
    let moto = Moto::start().await;
    let mut a = moto.server("a", folder.path());
    let to_a = a.client().await;
    let ids: Vec<String> = (0..PLANTS).map(|k| format!("p{k}")).collect();
    let created = futures::stream::iter(&ids).map(async |id| create(&to_a, id, "pendulum").await);
    let created: Vec<_> = created.buffer_unordered(16).try_collect().await.unwrap();
    assert_eq!(created.len(), PLANTS);
    for id in &ids {
        step(&to_a, id, 0).await.unwrap();
    }
    let began = Instant::now();
    assert!(a.stop().unwrap().success());
    println!("{PLANTS} plants were given up in {:.1} s", began.elapsed().as_secs_f64());
    let b = moto.server("b", folder.path());
    let to_b = b.client().await;
    for id in &ids {
        let state = to_b.get_plant(id).await.unwrap().plant.unwrap().state.unwrap();
        assert_eq!(state.step, 1, "{id}");
    }
}
