//! Tenants: what is another's is not there, and who uses up what is theirs takes nothing from others.

use plantd_client::{Client, Code, Error, v1};
use plantd_tests::server::ServerProcess;
use tokio::task::JoinSet;

use crate::support::*;

const SCENE: &str = r#"
format = 1
name = "own"
gravity = [0.0, -9.8, 0.0]

[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 1.0, center_of_mass = [0.0, -1.0, 0.0] }
"#;

/// A server with folders for plants and recordings, and people of two tenants.
struct Two {
    lab: Lab,
    tokens: [String; 3],
    configuration: String,
}

impl Two {
    fn new(limits: &str) -> Self {
        let lab = Lab::new();
        let tokens = [
            lab.token("anna", "driver", "red"),
            lab.token("bert", "driver", "blue"),
            lab.token("root", "admin", "office"),
        ];
        let folder = |name: &str| lab.path(name).display().to_string();
        let configuration = format!(
            "state_directory = \"{}\"\nrecordings = \"{}\"\n{}{limits}",
            folder("plants"),
            folder("recordings"),
            lab.auth()
        );
        Self { lab, tokens, configuration }
    }

    async fn start(&self) -> (ServerProcess, [Client; 3]) {
        let server = self.lab.start(&self.configuration);
        let [red, blue, root] = &self.tokens;
        let red = somebody(&self.lab, &server, red).await;
        let blue = somebody(&self.lab, &server, blue).await;
        let root = somebody(&self.lab, &server, root).await;
        (server, [red, blue, root])
    }
}

async fn ids(client: &Client) -> Vec<String> {
    client.list_plants().await.unwrap().into_iter().map(|plant| plant.id).collect()
}

fn upload() -> v1::CreateModelRequest {
    v1::CreateModelRequest { scene: SCENE.to_owned(), replace: true, ..Default::default() }
}

async fn record(client: &Client, id: &str, name: &str) -> Result<v1::Recording, Error> {
    let (id, name) = (id.to_owned(), name.to_owned());
    client.start_recording(v1::StartRecordingRequest { id, name, ..Default::default() }).await
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_anothers_is_not_there() {
    let two = Two::new("");
    let (mut server, [red, blue, root]) = two.start().await;
    plant(&red, "red-1").await;
    plant(&blue, "blue-1").await;
    red.create_model_as(upload()).await.unwrap();
    record(&red, "red-1", "red-trial").await.unwrap();
    red.step(v1::StepRequest { id: "red-1".to_owned(), hold: 3, ..Default::default() })
        .await
        .unwrap();

    assert_eq!(ids(&red).await, ["red-1"]);
    assert_eq!(ids(&blue).await, ["blue-1"]);
    assert_eq!(ids(&root).await, ["blue-1", "red-1"]);
    // The same words as for what nobody has.
    let of = |id: &str| v1::StepRequest { id: id.to_owned(), hold: 1, ..Default::default() };
    let theirs = refusal(blue.step(of("red-1")).await);
    assert_eq!(theirs.replace("red-1", "xxx-1"), refusal(blue.step(of("xxx-1")).await));
    let theirs = refusal(blue.drive("red-1").await.map(drop));
    assert_eq!(theirs.replace("red-1", "xxx-1"), refusal(blue.drive("xxx-1").await.map(drop)));
    let theirs = refusal(blue.watch(watch_request("red-1")).await.map(drop));
    let nobodys = refusal(blue.watch(watch_request("xxx-1")).await.map(drop));
    assert_eq!(theirs.replace("red-1", "xxx-1"), nobodys);
    let theirs = refusal(blue.delete_plant("red-1").await);
    assert_eq!(theirs.replace("red-1", "xxx-1"), refusal(blue.delete_plant("xxx-1").await));
    let many = v1::StepManyRequest {
        ids: vec!["blue-1".to_owned(), "red-1".to_owned()],
        ..Default::default()
    };
    assert_refused(blue.step_many(many).await, Code::NotFound, "PLANT_NOT_FOUND");
    let theirs = v1::LinearizeRequest {
        point: Some(plantd_client::present_state("red-1")),
        ..Default::default()
    };
    assert_refused(blue.linearize(theirs).await, Code::NotFound, "PLANT_NOT_FOUND");
    assert_refused(record(&blue, "red-1", "mine").await, Code::NotFound, "PLANT_NOT_FOUND");

    let theirs = refusal(blue.delete_recording("red-trial").await);
    let nobodys = refusal(blue.delete_recording("xxx-trial").await);
    assert_eq!(theirs.replace("red-trial", "xxx-trial"), nobodys);
    assert_refused(blue.stop_recording("red-trial").await, Code::NotFound, "RECORDING_NOT_FOUND");
    assert!(blue.list_recordings().await.unwrap().is_empty());
    let names = async |client: &Client| {
        let recordings = client.list_recordings().await.unwrap();
        recordings.into_iter().map(|recording| recording.name).collect::<Vec<_>>()
    };
    assert_eq!(names(&red).await, ["red-trial"]);
    assert_eq!(names(&root).await, ["red-trial"]);

    // What is built in is everybody's; what is uploaded is not.
    blue.get_model("pendulum").await.unwrap();
    let theirs = refusal(blue.get_model("own").await);
    assert_eq!(theirs.replace("own", "xwn"), refusal(blue.get_model("xwn").await));
    assert_refused(blue.delete_model("own").await, Code::NotFound, "MODEL_NOT_FOUND");
    let has_own = async |client: &Client| {
        client.list_models().await.unwrap().iter().any(|model| model.name == "own")
    };
    assert!(has_own(&red).await && !has_own(&blue).await && has_own(&root).await);
    // Names are taken for all; whose one is nobody is told.
    assert_refused(blue.create_model_as(upload()).await, Code::AlreadyExists, "MODEL_EXISTS");
    let request = v1::CreatePlantRequest {
        id: "red-1".to_owned(),
        model: "pendulum".to_owned(),
        ..Default::default()
    };
    let taken = refusal(blue.create_plant(request).await);
    assert!(taken.contains("PLANT_EXISTS") && !taken.contains("red:"), "{taken}");
    assert_refused(
        record(&blue, "blue-1", "red-trial").await,
        Code::AlreadyExists,
        "RECORDING_EXISTS",
    );
    red.stop_recording("red-trial").await.unwrap();
    server.stop().unwrap();
    // The next server knows whose they are.
    let (_server, [red, blue, root]) = two.start().await;
    assert_eq!(ids(&red).await, ["red-1"]);
    assert_eq!(ids(&blue).await, ["blue-1"]);
    assert_eq!(ids(&root).await, ["blue-1", "red-1"]);
    assert_eq!(red.get_plant("red-1").await.unwrap().plant.unwrap().state.unwrap().step, 3);
    assert_eq!(red.list_recordings().await.unwrap().len(), 1);
    assert!(blue.list_recordings().await.unwrap().is_empty());
    assert_refused(blue.get_plant("red-1").await, Code::NotFound, "PLANT_NOT_FOUND");
    // Who administers the server may change what is anybody's.
    root.delete_plant("red-1").await.unwrap();
    root.delete_recording("red-trial").await.unwrap();
    assert!(ids(&red).await.is_empty());
}

#[track_caller]
fn assert_used_up<T: std::fmt::Debug>(result: Result<T, Error>, limit: &str) {
    let error = result.expect_err("a refusal");
    assert_eq!((error.code(), error.reason()), (Some(Code::ResourceExhausted), "LIMIT_EXCEEDED"));
    assert!(error.to_string().contains(&format!("`tenant.{limit}`")), "{error}");
}

fn run(id: &str) -> v1::RunRequest {
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    v1::RunRequest { id: id.to_owned(), settings: Some(settings), ..Default::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_used_up_is_said_by_name() {
    let limits = "[tenants.red.limits]\nplants = 2\nrunning_plants = 1\nmodels = 0\nwatchers = 1\n\
                  active_recordings = 1\nwatch_numbers = 100\n\
                  [tenants.\"*\".limits]\nplants = 3\n";
    let two = Two::new(limits);
    let (_server, [red, blue, _root]) = two.start().await;
    plant(&red, "red-1").await;
    plant(&red, "red-2").await;
    let another = || v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    assert_used_up(red.create_plant(another()).await, "plants");
    for _ in 0..3 {
        blue.create_plant(another()).await.unwrap();
    }
    assert_used_up(blue.create_plant(another()).await, "plants");
    assert_used_up(red.create_model_as(upload()).await, "models");
    blue.create_model_as(upload()).await.unwrap();

    red.run(run("red-1")).await.unwrap();
    assert_used_up(red.run(run("red-2")).await, "running_plants");
    // What is given back can be taken again.
    red.pause("red-1").await.unwrap();
    red.run(run("red-2")).await.unwrap();

    let mut states = red.watch(watch_request("red-1")).await.unwrap();
    soon(states.next()).await.unwrap().unwrap();
    assert_used_up(red.watch(watch_request("red-2")).await.map(drop), "watchers");
    drop(states);
    let again = async || {
        while let Err(error) = red.watch(watch_request("red-2")).await {
            assert!(error.to_string().contains("tenant.watchers"), "{error}");
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    };
    soon(again()).await;
    let queued = v1::WatchRequest { queue: 200, ..watch_request("red-1") };
    let queued = async || {
        loop {
            match red.watch(queued.clone()).await {
                Err(error) if error.to_string().contains("tenant.watchers") => {
                    tokio::time::sleep(std::time::Duration::from_millis(10)).await;
                }
                other => return other.map(drop),
            }
        }
    };
    assert_used_up(soon(queued()).await, "watch_numbers");

    record(&red, "red-1", "first").await.unwrap();
    assert_used_up(record(&red, "red-2", "second").await, "active_recordings");
    red.stop_recording("first").await.unwrap();
    record(&red, "red-2", "second").await.unwrap();
}

/// What the loop of a plant has missed in so many steps.
async fn missed(client: &Client, id: &str, steps: u64) -> (u64, u64) {
    client.timing(id, true).await.unwrap();
    loop {
        let timing = client.timing(id, false).await.unwrap();
        if timing.steps >= steps {
            return (timing.overruns, timing.slips);
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn one_tenants_excess_costs_another_nothing() {
    const STEPS: u64 = 2000;
    let two = Two::new("[tenants.blue.limits]\nplants = 4\nstreams = 40\nwatchers = 8\n");
    let (_server, [red, blue, _root]) = two.start().await;
    let settings = v1::PlantSettings { time_step_s: 1e-3, ..Default::default() };
    let request = v1::CreatePlantRequest {
        id: "red-1".to_owned(),
        model: "pendulum".to_owned(),
        settings: Some(settings),
        ..Default::default()
    };
    red.create_plant(request).await.unwrap();
    red.run(run("red-1")).await.unwrap();
    let alone = soon(missed(&red, "red-1", STEPS)).await;

    // The other tenant takes all that it may, and asks for more without end.
    for number in 0..4 {
        plant(&blue, &format!("blue-{number}")).await;
    }
    let mut excess = JoinSet::new();
    for number in 0..60_u32 {
        let blue = blue.clone();
        excess.spawn(async move {
            // Most of it is refused.
            loop {
                let model = "chain-16".to_owned();
                let plant = v1::CreatePlantRequest { model, ..Default::default() };
                let _ = blue.create_plant(plant).await;
                let id = format!("blue-{}", number % 4);
                let request = v1::StepRequest { id, hold: 10_000, ..Default::default() };
                let _ = blue.step(request).await;
            }
        });
    }
    let beside = soon(missed(&red, "red-1", STEPS)).await;
    println!(
        "missed in {STEPS} steps (overruns, slips): alone {alone:?}, beside an excess {beside:?}"
    );
    // Whoever keeps within bounds is served.
    let mut driver = soon(red.drive("red-1")).await.unwrap();
    soon(driver.offer(&[0.0])).await.unwrap();
    plant(&red, "red-2").await;
    let outcome = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let refused = soon(blue.create_plant(outcome)).await.unwrap_err();
    assert_eq!(refused.reason(), "LIMIT_EXCEEDED", "{refused}");
    let refused = refused.to_string();
    assert!(
        refused.contains("`tenant.plants`") || refused.contains("`tenant.streams`"),
        "{refused}"
    );
    excess.shutdown().await;
}

/// Of messages and of time of workers in a second.
#[tokio::test(flavor = "multi_thread")]
async fn what_comes_by_the_second_is_bounded_too() {
    let limits = "[tenants.red.limits]\nmessages_per_s = 30\n\
                  [tenants.blue.limits]\nworker_ms_per_s = 0\n\
                  [tenants.office.limits]\ntrajectory_numbers = 10\n";
    let two = Two::new(limits);
    let (_server, [red, blue, root]) = two.start().await;
    let excess = async |client: &Client| {
        loop {
            if let Err(error) = client.get_plant("red-1").await
                && error.code() != Some(Code::NotFound)
            {
                break error;
            }
        }
    };
    assert_used_up(Err::<(), _>(soon(excess(&red)).await), "messages_per_s");
    // The next second has its own.
    let created = async || {
        let request = || v1::CreatePlantRequest {
            id: "red-1".to_owned(),
            model: "pendulum".to_owned(),
            ..Default::default()
        };
        while red.create_plant(request()).await.is_err() {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    soon(created()).await;
    // A stream that sends too much ends.
    let driven = async || {
        let mut driver = loop {
            match red.drive("red-1").await {
                Ok(driver) => break driver,
                Err(_) => tokio::time::sleep(std::time::Duration::from_millis(50)).await,
            }
        };
        loop {
            if let Err(error) = driver.step(&[0.0]).await {
                break error;
            }
        }
    };
    assert_used_up(Err::<(), _>(soon(driven()).await), "messages_per_s");

    assert_used_up(blue.get_model("pendulum").await, "worker_ms_per_s");
    let u = v1::Matrix { rows: 5, cols: 1, data: vec![0.0; 5] };
    let trajectory = v1::Trajectory { u: Some(u), ..Default::default() };
    let request = v1::SolveTrajectoryLqrRequest {
        model: "pendulum".to_owned(),
        trajectory: Some(trajectory),
        ..Default::default()
    };
    let refused = root.solve_trajectory_lqr(request).await.map(drop);
    assert_used_up(refused, "trajectory_numbers");
}
