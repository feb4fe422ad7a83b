//! What goes wrong around a server: controllers and watchers that are killed, stopped, slow, that flood
//! or send nonsense; connections that come and go. Nothing leaks, nothing hangs, and no other plant
//! notices. `PLANTD_LONG_FAULTS=1` takes each as far as a day of use.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use plantd_client::link::{LinkDriver, LinkOptions};
use plantd_client::{Client, v1};
use plantd_tests::server::{ServerProcess, binary};
use rustix::process::{Pid, Signal, kill_process};

/// Longest wait for anything.
const PATIENCE: Duration = Duration::from_secs(60);
/// Growth of the server that is no leak, KiB: buffers of connections, and what the allocator keeps.
const GROWTH_MAX_KIB: u64 = 48 << 10;

/// A controller in a process of its own, which ends with this value.
struct Controller(Child);

impl Controller {
    fn start(server: &ServerProcess, plant: &str, manner: &str) -> Self {
        let mut child = Command::new(binary("controller").unwrap())
            .args([server.address(), plant, manner])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        Self(child)
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }
}

impl Drop for Controller {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A cart-pole that runs by itself, ten times as fast as the wall clock, with a safe input after 50 ms.
async fn running(client: &Client, id: &str) {
    let request = v1::CreatePlantRequest {
        id: id.to_owned(),
        model: "cart-pole".to_owned(),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
    let policy = v1::InputPolicy {
        timeout_s: 0.5,
        action: v1::InputAction::Safe.into(),
        ..Default::default()
    };
    let settings =
        v1::RunSettings { pace: v1::Pace::Paced.into(), speed: 10.0, input: Some(policy) };
    let request =
        v1::RunRequest { id: id.to_owned(), settings: Some(settings), steps: 0, wait: false };
    client.run(request).await.unwrap();
}

async fn step_of(client: &Client, id: &str) -> u64 {
    client.get_plant(id).await.unwrap().plant.unwrap().state.unwrap().step
}

/// Waits until the plant has taken so many more steps.
async fn goes_on(client: &Client, id: &str, steps: u64) {
    let (first, deadline) = (step_of(client, id).await, Instant::now() + PATIENCE);
    while step_of(client, id).await < first + steps {
        assert!(Instant::now() < deadline, "plant `{id}` stands still");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

/// Waits for an event after the number `since`; its number.
async fn event(client: &Client, id: &str, kind: v1::EventKind, since: u64) -> u64 {
    let mut events = client.watch_events(id, Some(since)).await.unwrap();
    let find = async {
        loop {
            let event = events.next().await.unwrap().unwrap().event.unwrap();
            if event.kind() == kind {
                return event.number;
            }
        }
    };
    tokio::time::timeout(PATIENCE, find).await.expect("the event comes")
}

async fn driver_of(client: &Client, id: &str) -> String {
    client.get_plant(id).await.unwrap().plant.unwrap().driver
}

/// So many, or so many times as many for a long run.
fn rounds(short: u32, long: u32) -> u32 {
    if std::env::var_os("PLANTD_LONG_FAULTS").is_some() { long } else { short }
}

#[tokio::test]
async fn a_controller_that_is_stopped_is_replaced_by_the_safe_input_and_may_come_back() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    running(&client, "a").await;
    running(&client, "b").await;
    let mut stopped = Controller::start(&server, "a", "drive");
    let _other = Controller::start(&server, "b", "drive");
    let back = event(&client, "a", v1::EventKind::InputBack, 0).await;

    stopped.signal(Signal::STOP);
    let lost = event(&client, "a", v1::EventKind::InputLost, back).await;
    // It holds its lease: it may come back. Neither plant stands still.
    goes_on(&client, "a", 100).await;
    goes_on(&client, "b", 100).await;
    assert_eq!(driver_of(&client, "a").await, "drive");
    stopped.signal(Signal::CONT);
    let back = event(&client, "a", v1::EventKind::InputBack, lost).await;

    stopped.signal(Signal::KILL);
    stopped.0.wait().unwrap();
    let left = event(&client, "a", v1::EventKind::DriverLeft, back).await;
    event(&client, "a", v1::EventKind::InputLost, left.saturating_sub(2)).await;
    goes_on(&client, "a", 100).await;
    stopped = Controller::start(&server, "a", "drive");
    event(&client, "a", v1::EventKind::DriverAttached, left).await;
    drop(stopped);
    // Nobody else has noticed.
    let timing = client.timing("b", false).await.unwrap();
    assert_eq!(driver_of(&client, "b").await, "drive");
    assert!(timing.steps > 200, "{timing:?}");
}

#[tokio::test]
async fn floods_nonsense_and_slowness_stay_with_whoever_causes_them() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    for id in ["quiet", "flooded", "nonsense", "slow"] {
        running(&client, id).await;
    }
    let _quiet = Controller::start(&server, "quiet", "drive");
    let _flood = Controller::start(&server, "flooded", "flood");
    let _nan = Controller::start(&server, "nonsense", "nan");
    let _slow = Controller::start(&server, "slow", "slow");
    goes_on(&client, "quiet", 200).await;
    let before_kib = server.resident_kib();
    for _ in 0..rounds(3, 300) {
        for id in ["quiet", "flooded", "nonsense", "slow"] {
            goes_on(&client, id, 200).await;
        }
    }
    let flooded = client.timing("flooded", false).await.unwrap();
    assert!(flooded.unused_inputs > 100, "{flooded:?}");
    let slow = client.timing("slow", false).await.unwrap();
    assert!(slow.late_inputs > 0 && slow.safe_inputs > 0, "{slow:?}");
    let state = client.get_plant("nonsense").await.unwrap().plant.unwrap().state.unwrap();
    assert!(state.q.iter().chain(&state.p).all(|number| number.is_finite()), "{state:?}");
    let grown_kib = server.resident_kib().saturating_sub(before_kib);
    assert!(grown_kib < GROWTH_MAX_KIB, "the server has grown by {grown_kib} KiB");
}

#[tokio::test]
async fn a_watcher_that_is_stopped_loses_states_and_holds_nobody_up() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    running(&client, "a").await;
    let watchers: Vec<Controller> =
        (0..4).map(|_| Controller::start(&server, "a", "watch")).collect();
    goes_on(&client, "a", 200).await;
    let before_kib = server.resident_kib();
    watchers[0].signal(Signal::STOP);
    watchers[1].signal(Signal::STOP);
    drop(Controller::start(&server, "a", "watch"));
    for _ in 0..rounds(5, 1000) {
        goes_on(&client, "a", 400).await;
    }
    let grown_kib = server.resident_kib().saturating_sub(before_kib);
    assert!(grown_kib < GROWTH_MAX_KIB, "the server has grown by {grown_kib} KiB");
    watchers[0].signal(Signal::CONT);
    goes_on(&client, "a", 100).await;
}

#[tokio::test]
async fn drivers_that_come_and_go_leave_nothing_behind() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    running(&client, "a").await;
    let mut before_kib = 0;
    let rounds = rounds(300, 10_000);
    for k in 0..rounds {
        let other = Client::connect(server.address()).await.unwrap();
        let mut driver = other.drive("a").await;
        while driver.is_err() {
            // The one before has not been noticed to be gone.
            tokio::time::sleep(Duration::from_millis(1)).await;
            driver = other.drive("a").await;
        }
        let mut driver = driver.unwrap();
        driver.step(&[f64::from(k % 3)]).await.unwrap();
        if k == rounds / 3 {
            before_kib = server.resident_kib();
        }
    }
    let deadline = Instant::now() + PATIENCE;
    while !driver_of(&client, "a").await.is_empty() {
        assert!(Instant::now() < deadline, "the last lease is never given up");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    let grown_kib = server.resident_kib().saturating_sub(before_kib);
    assert!(grown_kib < GROWTH_MAX_KIB / 4, "the server has grown by {grown_kib} KiB");
    goes_on(&client, "a", 100).await;
}

#[tokio::test]
async fn long_lockstep_does_not_grow() {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    let id = client.create_plant(request).await.unwrap().id;
    let many = v1::StepRequest { id: id.clone(), hold: 100_000, ..Default::default() };
    client.step(many.clone()).await.unwrap();
    let before_kib = server.resident_kib();
    // Long: a day at 100 Hz.
    for _ in 0..rounds(2, 86) {
        client.step(many.clone()).await.unwrap();
    }
    let mut driver = client.drive(&id).await.unwrap();
    for k in 0..rounds(2_000, 1_000_000) {
        driver.step(&[f64::from(k).sin()]).await.unwrap();
    }
    let grown_kib = server.resident_kib().saturating_sub(before_kib);
    assert!(grown_kib < GROWTH_MAX_KIB / 4, "the server has grown by {grown_kib} KiB");
}

/// Stops a process for a while, now and then, as a debugger does; until it is dropped.
struct Debugger {
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<u32>>,
}

impl Debugger {
    fn of(pid: u32) -> Self {
        let pid = Pid::from_raw(pid.cast_signed()).unwrap();
        let is_over = Arc::new(AtomicBool::new(false));
        let thread = {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                let mut stops = 0;
                while !is_over.load(Ordering::Acquire) {
                    // Some stops are longer than a plant catches up with.
                    let pause = Duration::from_millis(if stops % 4 == 0 { 120 } else { 20 });
                    kill_process(pid, Signal::STOP).unwrap();
                    std::thread::sleep(pause);
                    kill_process(pid, Signal::CONT).unwrap();
                    stops += 1;
                    std::thread::sleep(Duration::from_millis(10));
                }
                stops
            })
        };
        Self { is_over, thread: Some(thread) }
    }

    /// Lets the process go; how often it was stopped.
    fn detach(mut self) -> u32 {
        self.is_over.store(true, Ordering::Release);
        self.thread.take().unwrap().join().unwrap()
    }
}

impl Drop for Debugger {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

async fn create(client: &Client, model: &str, open_link: bool) -> String {
    let model = model.to_owned();
    let request = v1::CreatePlantRequest { model, open_link, ..Default::default() };
    client.create_plant(request).await.unwrap().id
}

/// The `k`-th force on the cart of the tests with debuggers; that of the controller `sway`.
fn sway(k: u32) -> f64 {
    f64::from(k % 17) - 8.0
}

/// Where a plant is, bit for bit.
async fn bits_of(client: &Client, id: &str) -> (u64, Vec<u64>) {
    let state = client.get_plant(id).await.unwrap().plant.unwrap().state.unwrap();
    (state.step, state.q.iter().chain(&state.p).map(|number| number.to_bits()).collect())
}

/// A server or a controller that stands in a debugger now and then does not change the motion: in
/// lockstep over gRPC and over shared memory, and paced.
#[tokio::test(flavor = "multi_thread")]
async fn a_debugger_on_either_side_does_not_change_a_bit_of_the_motion() {
    const STEPS: u32 = 1000;
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    let expected = create(&client, "cart-pole", false).await;
    let mut driver = client.drive(&expected).await.unwrap();
    for k in 0..STEPS {
        driver.step(&[sway(k)]).await.unwrap();
    }
    let expected = bits_of(&client, &expected).await;
    let free = create(&client, "double-pendulum", false).await;
    let hold = v1::StepRequest { id: free.clone(), hold: STEPS, ..Default::default() };
    client.step(hold).await.unwrap();
    let expected_free = bits_of(&client, &free).await;

    // The server, in lockstep over gRPC.
    let id = create(&client, "cart-pole", false).await;
    let mut driver = client.drive(&id).await.unwrap();
    let debugger = Debugger::of(server.pid());
    for k in 0..STEPS {
        driver.step(&[sway(k)]).await.unwrap();
        if k % 100 == 0 {
            // Long enough to be stopped in between.
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
    assert!(debugger.detach() > 0);
    assert_eq!(bits_of(&client, &id).await, expected);

    // The server, in lockstep over shared memory.
    let id = create(&client, "cart-pole", true).await;
    let root = client.open_link(&id).await.unwrap().root_path.into();
    let options =
        LinkOptions { root, timeout: PATIENCE, connect_timeout: PATIENCE, ..Default::default() };
    let mut driver = LinkDriver::connect(&id, options).unwrap();
    let debugger = Debugger::of(server.pid());
    for k in 0..STEPS {
        driver.step(&[sway(k)]).unwrap();
        if k % 100 == 0 {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
    assert!(debugger.detach() > 0);
    assert_eq!(bits_of(&client, &id).await, expected);

    // The server, of a plant that follows the clock.
    let id = create(&client, "double-pendulum", false).await;
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), speed: 10.0, input: None };
    let steps = u64::from(STEPS);
    let request = v1::RunRequest { id: id.clone(), settings: Some(settings), steps, wait: true };
    let debugger = Debugger::of(server.pid());
    let run = client.run(request).await.unwrap();
    assert!(debugger.detach() > 0);
    assert_eq!((run.running, run.steps_left), (false, 0));
    assert_eq!(bits_of(&client, &id).await, expected_free);
    let timing = client.timing(&id, false).await.unwrap();
    assert!(timing.overruns > 0, "it was stopped: {timing:?}");

    // The controller, in lockstep.
    let id = create(&client, "cart-pole", false).await;
    let run = v1::RunRequest { id: id.clone(), settings: None, steps, wait: true };
    let waiting = client.run(run);
    let controller = async {
        while client.get_plant(&id).await.unwrap().plant.unwrap().run.unwrap().steps_left == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let controller = Controller::start(&server, &id, "sway");
        (Debugger::of(controller.0.id()), controller)
    };
    let (run, (debugger, controller)) = tokio::join!(waiting, controller);
    assert!(!run.unwrap().running);
    assert!(debugger.detach() > 0);
    assert_eq!(bits_of(&client, &id).await, expected);
    drop(controller);
}
