//! The shared-memory link: the same motion as in process, typed failures, and recovery from
//! processes that die.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use plantd_client::link::{LeaseHolder, LinkDriver, LinkError, LinkOptions, StepFailure, Wait};
use plantd_proto::link::{
    Code, Domain, DomainError, Endpoint, HEADER_FIELDS, Header, Holder, Kind, LAYOUT_VERSION,
    MAGIC, SCHEMA_HASH, monotonic_ns, random_instance,
};
use plantd_server::core::driver::DriverKind;
use plantd_server::core::plant::view::PlantSnapshot;
use plantd_server::wire::link::config::LinkConfig;
use plantd_server::wire::link::host::{LinkError as HostError, LinkHost};
use plantd_tests::links::{
    ChildProcess, LinkFixture, PATIENCE, PLANT, files_of_links, new_plant, new_session,
    new_session_of, wait_until, wiggle,
};

/// Never polls: each answer comes by a notification.
const SLEEP: Wait = Wait::PollThenSleep(Duration::ZERO);

fn start_driver(root: &Path, arguments: &[&str]) -> ChildProcess {
    let program = env!("CARGO_BIN_EXE_link_peer");
    ChildProcess::start(program, root, &[&["--plant", PLANT], arguments].concat()).unwrap()
}

fn start_host(root: &Path) -> ChildProcess {
    let mut host = ChildProcess::start(env!("CARGO_BIN_EXE_link_host"), root, &[]).unwrap();
    host.wait_for_line("open").unwrap();
    host
}

/// Bits of `x` and the multipliers.
fn bits(x: &[f64], multipliers: &[f64]) -> Vec<u64> {
    x.iter().chain(multipliers).map(|value| value.to_bits()).collect()
}

fn assert_same_motion(model: &str, wait: Wait, steps: u64) {
    let fixture = LinkFixture::new(model).unwrap();
    let mut plant = new_plant(model).unwrap();
    let mut driver = fixture.connect(wait).unwrap();
    assert_eq!(driver.model_digest(), plant.model().digest());
    assert_eq!(driver.time_step_s(), plant.settings().time_step_s);
    let mut u = vec![0.0; plant.model().dimensions().input()];
    for k in 0..steps {
        wiggle(&plant, k, &mut u);
        let report = plant.step(&u).unwrap();
        let state = plant.state();
        let view = driver.step(&u).unwrap();
        assert_eq!((view.step, view.time_s), (state.step, plant.time_s()));
        assert_eq!(
            bits(view.x, view.multipliers),
            bits(&state.x(), &state.multipliers),
            "step {k} of {model}"
        );
        assert_eq!((view.q, view.p, view.v), (&state.q[..], &state.p[..], &state.v[..]));
        assert_eq!(view.velocity, plant.velocity());
        assert_eq!(view.iterations, report.iterations);
        assert_eq!(view.residual.to_bits(), report.residual.to_bits());
    }
}

#[test]
fn a_sleeping_driver_sees_the_motion_of_the_plant_itself_bit_for_bit() {
    assert_same_motion("pendulum", SLEEP, 200);
    assert_same_motion("marionette", SLEEP, 50);
}

#[test]
fn a_polling_driver_sees_the_motion_of_the_plant_itself_bit_for_bit() {
    assert_same_motion("pendulum", Wait::Poll, 200);
    assert_same_motion("marionette", Wait::default(), 50);
}

#[test]
fn a_polling_host_serves_a_sleeping_driver() {
    let fixture = LinkFixture::with_config("pendulum", |config| config.wait = Wait::Poll).unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    for k in 1..=20 {
        assert_eq!(driver.step(&[0.0]).unwrap().step, k);
    }
}

#[test]
fn a_restored_plant_goes_on_bit_for_bit_over_the_link() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut first = Vec::new();
    let mut snapshot = None;
    let mut driver = fixture.connect(SLEEP).unwrap();
    for k in 0..40 {
        if k == 20 {
            let bytes = fixture.session.snapshot().to_bytes();
            snapshot = Some(PlantSnapshot::from_bytes(&bytes).unwrap());
        }
        let view = driver.step(&[0.1 * f64::from(k)]).unwrap();
        first.push(bits(view.x, view.multipliers));
    }
    drop(driver);
    wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    let mut lease = fixture.session.acquire(DriverKind::Step).unwrap();
    lease.restore(snapshot.unwrap()).unwrap();
    drop(lease);
    let mut driver = fixture.connect(SLEEP).unwrap();
    assert_eq!(driver.state().step, 20);
    for k in 20..40 {
        let view = driver.step(&[0.1 * f64::from(k)]).unwrap();
        assert_eq!(bits(view.x, view.multipliers), first[k as usize]);
    }
}

#[test]
fn a_second_driver_is_told_who_holds_the_lease() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    let own = LeaseHolder::Link { pid: std::process::id() };
    let refused = fixture.connect(SLEEP).unwrap_err();
    assert!(matches!(refused, LinkError::LeaseHeld { by } if by == own), "{refused}");
    // The refusal does not disturb the one who drives.
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);
    drop(driver);
    let mut next = fixture.connect(SLEEP).unwrap();
    assert_eq!(next.step(&[0.0]).unwrap().step, 2);
    drop(next);

    wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    for (kind, by) in
        [(DriverKind::Drive, LeaseHolder::Drive), (DriverKind::Step, LeaseHolder::Step)]
    {
        let _lease = fixture.session.acquire(kind).unwrap();
        let refused = fixture.connect(SLEEP).unwrap_err();
        assert!(matches!(refused, LinkError::LeaseHeld { by: holder } if holder == by));
    }
    assert!(fixture.connect(SLEEP).is_ok());
}

#[test]
fn a_failed_step_is_reported_in_band_and_leaves_the_plant_as_it_was() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    driver.step(&[0.3]).unwrap();
    let before = fixture.session.state();
    for value in [f64::NAN, f64::INFINITY] {
        let failure = driver.step(&[value]).unwrap_err();
        let LinkError::Step(StepFailure::InputNotFinite { index: 0, value: told }) = failure else {
            panic!("{failure}");
        };
        assert_eq!(told.to_bits(), value.to_bits());
        assert_eq!(fixture.session.state(), before);
    }
    let failure = driver.step(&[0.0, 0.0]).unwrap_err();
    assert!(matches!(failure, LinkError::Dimension { expected: 1, actual: 2 }), "{failure}");
    assert_eq!(fixture.session.state(), before);
    assert_eq!(driver.state().step, 1);
    assert_eq!(driver.step(&[0.0]).unwrap().step, 2);
}

/// A driver that speaks the layout but need not keep to the rules.
struct RawDriver {
    endpoint: Endpoint,
    header: Header,
}

impl RawDriver {
    fn connect(fixture: &LinkFixture) -> Self {
        let node = Domain::find(&fixture.root(), PLANT).unwrap().join("raw").unwrap();
        let services = node.open_services(PLANT).unwrap();
        let endpoint = Endpoint::driver(services, 8, SLEEP).unwrap();
        let header = Header { driver: random_instance(), ..Header::new(Kind::Attach) };
        let mut driver = Self { endpoint, header };
        let (attached, state) = driver.ask(header, &[]);
        assert_eq!(attached.kind, Kind::Attached as u32);
        assert_eq!(state.len(), attached.state_len());
        driver.header = Header { server: attached.server, ..header };
        driver
    }

    fn input(&self, sequence: u64) -> Header {
        Header { kind: Kind::Input as u32, sequence, ..self.header }
    }

    fn ask(&mut self, header: Header, payload: &[f64]) -> (Header, Vec<f64>) {
        self.endpoint.send(header, &[payload], 0).unwrap();
        let deadline_ns = monotonic_ns() + PATIENCE.as_nanos() as u64;
        loop {
            let message = self.endpoint.receive(deadline_ns).unwrap().expect("an answer");
            if message.user_header().driver == header.driver {
                return (*message.user_header(), message.payload().to_vec());
            }
        }
    }

    fn assert_refused(&mut self, header: Header, payload: &[f64], code: Code) -> Header {
        let (answer, state) = self.ask(header, payload);
        assert_eq!((answer.kind, answer.code), (Kind::Failure as u32, code as u32));
        assert!(state.is_empty());
        answer
    }
}

#[test]
fn a_driver_that_breaks_the_rules_is_told_which_one_and_moves_nothing() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut raw = RawDriver::connect(&fixture);
    let before = fixture.session.state();

    let wrong = raw.assert_refused(raw.input(1), &[0.0, 0.0], Code::Dimension);
    assert_eq!((wrong.detail_a, wrong.detail_b), (1, 2));
    let lost = raw.assert_refused(raw.input(5), &[0.0], Code::Sequence);
    assert_eq!(lost.detail_a, 2);
    raw.assert_refused(Header { layout_version: 1, ..raw.input(6) }, &[0.0], Code::Layout);
    raw.assert_refused(Header { kind: 99, ..raw.input(6) }, &[0.0], Code::Kind);
    raw.assert_refused(Header { kind: Kind::State as u32, ..raw.input(6) }, &[0.0], Code::Kind);
    raw.assert_refused(Header { server: 1, ..raw.input(6) }, &[0.0], Code::NotAttached);
    let stranger = Header { driver: random_instance(), ..raw.input(6) };
    raw.assert_refused(stranger, &[0.0], Code::NotAttached);
    assert_eq!(fixture.session.state(), before);

    // Inputs go on after the number received last.
    let (answer, _) = raw.ask(raw.input(6), &[0.0]);
    assert_eq!((answer.kind, answer.sequence, answer.step), (Kind::State as u32, 6, 1));
    raw.assert_refused(raw.input(6), &[0.0], Code::Sequence);
}

#[test]
fn the_lease_of_a_killed_driver_comes_back() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    for pause in ["0", "100000000"] {
        let mut victim = start_driver(&fixture.root(), &["--pause-us", pause]);
        victim.wait_for_line("attached").unwrap();
        victim.wait_for_line("stepped").unwrap();
        assert_eq!(fixture.session.driver(), Some(DriverKind::Link));
        let refused = fixture.connect(SLEEP).unwrap_err();
        let pid = victim.pid();
        assert!(
            matches!(refused, LinkError::LeaseHeld { by: LeaseHolder::Link { pid: p } } if p == pid),
            "{refused}"
        );
        victim.kill().unwrap();
        // The next driver need not wait for the housekeeping.
        let mut next = fixture.connect(SLEEP).unwrap();
        let step = next.state().step;
        assert_eq!(next.step(&[0.0]).unwrap().step, step + 1);
        drop(next);
        wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    }
}

/// What a killed driver has kept of a link that is closed is still there when another link opens, and goes
/// with the housekeeping.
#[test]
fn a_link_does_not_depend_on_what_is_left_of_another_one() {
    let fixture =
        LinkFixture::with_config("pendulum", |config| config.clean_up_period = PATIENCE / 10)
            .unwrap();
    let mut victim = start_driver(&fixture.root(), &[]);
    victim.wait_for_line("attached").unwrap();
    victim.wait_for_line("stepped").unwrap();
    victim.kill().unwrap();
    fixture.host.close(PLANT);
    let left = files_of_links(&fixture.root()).unwrap();
    fixture.host.open(new_session_of("other", "pendulum").unwrap()).unwrap();
    let services = |file: &&PathBuf| file.extension().is_some_and(|kind| kind == "dynamic");
    assert!(left.iter().any(|file| services(&file)), "a service of the link is left");
    let is_gone = || left.iter().filter(services).all(|file| !file.exists());
    wait_until("the housekeeping", is_gone).unwrap();
    let mut driver = LinkDriver::connect("other", fixture.options()).unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);
}

#[test]
fn many_killed_drivers_leave_no_files_behind() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let before = files_of_links(&fixture.root()).unwrap();
    for _ in 0..4 {
        let mut victim = start_driver(&fixture.root(), &[]);
        victim.wait_for_line("attached").unwrap();
        victim.wait_for_line("stepped").unwrap();
        victim.kill().unwrap();
        wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    }
    wait_until("the housekeeping", || files_of_links(&fixture.root()).unwrap() == before)
        .unwrap_or_else(|e| panic!("{e}: {:#?}", files_of_links(&fixture.root()).unwrap()));
}

#[test]
fn a_driver_that_ends_by_itself_gives_the_lease_back() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    for k in 1..=3 {
        let mut driver = start_driver(&fixture.root(), &["--steps", "10"]);
        assert!(driver.finish().unwrap());
        wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
        assert_eq!(fixture.session.state().step, 10 * k);
    }
}

#[test]
fn an_idle_driver_loses_the_lease_when_the_server_says_so() {
    let fixture = LinkFixture::with_config("pendulum", |config| {
        config.idle_timeout = Some(Duration::from_millis(100));
    })
    .unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    driver.step(&[0.0]).unwrap();
    wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    assert!(matches!(driver.step(&[0.0]).unwrap_err(), LinkError::LeaseLost));
    assert_eq!(fixture.session.state().step, 1);
    driver.reconnect().unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 2);
}

#[test]
fn a_driver_is_told_that_its_plant_was_deleted() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    driver.step(&[0.0]).unwrap();
    fixture.session.close();
    fixture.host.close(PLANT);
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::Closed { is_deleted: true }), "{error}");
    assert!(!fixture.session.link_open());
    assert!(fixture.host.open(fixture.session.clone()).is_err());
}

#[test]
fn a_driver_is_told_that_the_link_was_closed_and_can_connect_when_it_is_open_again() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    fixture.host.close(PLANT);
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::Closed { is_deleted: false }), "{error}");
    assert!(fixture.session.driver().is_none());

    let info = fixture.host.open(fixture.session.clone()).unwrap();
    assert_eq!(fixture.host.open(fixture.session.clone()).unwrap(), info);
    assert_eq!((info.service.as_str(), info.layout_version), ("plantd/5/plant", 5));
    // Without reconnecting it speaks to a link that is no more.
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::ServerRestarted), "{error}");
    driver.reconnect().unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);
}

#[test]
fn connecting_waits_for_the_link_but_not_for_ever() {
    let directory = tempfile::tempdir().unwrap();
    let options = LinkOptions {
        root: directory.path().join("link"),
        connect_timeout: Duration::from_millis(50),
        ..LinkOptions::default()
    };
    let error = LinkDriver::connect(PLANT, options.clone()).unwrap_err();
    assert!(matches!(error, LinkError::Domain(DomainError::Root { .. })), "{error}");

    let fixture = LinkFixture::new("pendulum").unwrap();
    let options = LinkOptions { root: fixture.root(), ..options };
    let error = LinkDriver::connect("another", options.clone()).unwrap_err();
    assert!(matches!(error, LinkError::Domain(DomainError::NotOpen { .. })), "{error}");

    fixture.host.close(PLANT);
    let patient = LinkOptions { connect_timeout: PATIENCE, ..options };
    let driver = std::thread::spawn(move || {
        LinkDriver::connect(PLANT, patient).map(|mut driver| driver.step(&[0.0]).unwrap().step)
    });
    std::thread::sleep(Duration::from_millis(100));
    fixture.host.open(fixture.session.clone()).unwrap();
    assert_eq!(driver.join().unwrap().unwrap(), 1);
}

#[test]
fn one_plant_id_under_one_root_path_belongs_to_one_server() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let root = fixture.root();
    let other = LinkHost::new(LinkConfig { root, ..LinkConfig::default() }).unwrap();
    let error = other.open(new_session("pendulum").unwrap()).unwrap_err();
    assert!(matches!(error, HostError::Domain(DomainError::ServedElsewhere)), "{error}");
    assert_eq!(fixture.connect(SLEEP).unwrap().step(&[0.0]).unwrap().step, 1);
}

#[test]
fn a_link_has_room_for_eight_drivers_that_are_connected() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let node = Domain::find(&fixture.root(), PLANT).unwrap().join("many").unwrap();
    let connect = || Endpoint::driver(node.open_services(PLANT)?, 1, SLEEP);
    let endpoints: Vec<Endpoint> = (0..8).map(|_| connect().unwrap()).collect();
    assert!(matches!(connect().unwrap_err(), DomainError::TooManyDrivers));
    drop(endpoints);
    assert!(connect().is_ok());
}

#[test]
fn nothing_is_left_behind_when_everybody_leaves() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = fixture.connect(SLEEP).unwrap();
    driver.step(&[0.0]).unwrap();
    let root = fixture.root();
    assert!(!files_of_links(&root).unwrap().is_empty());
    drop(driver);
    let LinkFixture { host, directory: _directory, .. } = fixture;
    drop(host);
    assert_eq!(files_of_links(&root).unwrap(), Vec::<PathBuf>::new());
}

#[test]
fn a_driver_survives_a_killed_server_and_connects_to_the_next() {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    let mut host = start_host(&root);
    let options = LinkOptions {
        root: root.clone(),
        timeout: PATIENCE,
        connect_timeout: PATIENCE,
        wait: SLEEP,
    };
    let mut driver = LinkDriver::connect(PLANT, options).unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);

    // Killed, and nobody in its place.
    host.kill().unwrap();
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::ServerGone { pid } if pid == host.pid()), "{error}");

    // In its place another one, over what the first has left behind.
    let mut host = start_host(&root);
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::ServerRestarted), "{error}");
    driver.reconnect().unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);

    // Killed and replaced before the driver looks.
    host.kill().unwrap();
    let mut host = start_host(&root);
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::ServerRestarted), "{error}");
    driver.reconnect().unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, 1);

    // A server that ends in order says so, and then nothing is left.
    assert!(host.finish().unwrap());
    let error = driver.step(&[0.0]).unwrap_err();
    assert!(matches!(error, LinkError::Closed { is_deleted: false }), "{error}");
    drop(driver);
    assert_eq!(files_of_links(&root).unwrap(), Vec::<PathBuf>::new());
}

#[test]
fn a_server_comes_up_clean_over_the_remains_of_killed_ones() {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    for _ in 0..3 {
        let mut host = start_host(&root);
        let mut driver = start_driver(&root, &[]);
        driver.wait_for_line("attached").unwrap();
        driver.wait_for_line("stepped").unwrap();
        host.kill().unwrap();
        driver.kill().unwrap();
        assert!(!files_of_links(&root).unwrap().is_empty());
    }
    let mut host = start_host(&root);
    assert!(start_driver(&root, &["--steps", "5"]).finish().unwrap());
    assert!(host.finish().unwrap());
    assert_eq!(files_of_links(&root).unwrap(), Vec::<PathBuf>::new());
}

/// Compiles a program that prints what the C header says, and compares it with the Rust side.
#[test]
fn the_c_header_describes_the_same_layout() {
    let directory = tempfile::tempdir().unwrap();
    let mut source = String::from(
        "#include <stddef.h>\n#include <stdio.h>\n#include \"plantd_link.h\"\nint main(void) {\n",
    );
    let mut expected = String::new();
    let mut print = |name: &str, expression: &str, value: u64| {
        source += &format!("printf(\"{name} %llu\\n\", (unsigned long long)({expression}));\n");
        expected += &format!("{name} {value}\n");
    };
    for field in HEADER_FIELDS {
        let member = format!("((struct plantd_link_header *)0)->{}", field.name);
        let size = if field.kind == "u32" { 4 } else { 8 };
        let offset = format!("offsetof(struct plantd_link_header, {})", field.name);
        print(field.name, &offset, field.offset as u64);
        print("size", &format!("sizeof({member})"), size);
        print(
            "is double",
            &format!("_Generic({member}, double: 1, default: 0)"),
            u64::from(field.kind == "f64"),
        );
    }
    print("header", "sizeof(struct plantd_link_header)", size_of::<Header>() as u64);
    print("version", "PLANTD_LINK_LAYOUT_VERSION", LAYOUT_VERSION.into());
    print("magic", "PLANTD_LINK_MAGIC", MAGIC.into());
    print("schema", "PLANTD_LINK_SCHEMA_HASH", SCHEMA_HASH);
    for &(name, kind) in Kind::ALL {
        print(name, &format!("PLANTD_LINK_{}", shout(name)), kind as u64);
    }
    for &(name, code) in Code::ALL {
        print(name, &format!("PLANTD_LINK_CODE_{}", shout(name)), code as u64);
    }
    for &(name, holder) in Holder::ALL {
        print(name, &format!("PLANTD_LINK_HOLDER_{}", shout(name)), holder as u64);
    }
    source += "return 0;\n}\n";

    let (file, program) = (directory.path().join("layout.c"), directory.path().join("layout"));
    std::fs::write(&file, source).unwrap();
    let include = Path::new(env!("CARGO_MANIFEST_DIR")).join("../client/c");
    let compiled = Command::new("cc")
        .args(["-std=c11", "-Wall", "-Werror", "-o"])
        .arg(&program)
        .arg("-I")
        .arg(include)
        .arg(&file)
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    let output = Command::new(&program).output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), expected);
}

/// `LeaseHeld` as `LEASE_HELD`.
fn shout(name: &str) -> String {
    let mut shouted = String::new();
    for (i, letter) in name.chars().enumerate() {
        if i > 0 && letter.is_uppercase() {
            shouted.push('_');
        }
        shouted.push(letter.to_ascii_uppercase());
    }
    shouted
}
