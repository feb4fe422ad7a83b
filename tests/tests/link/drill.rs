//! Drills of the shared-memory link: servers and drivers are killed at all times, segments are
//! overwritten, other users of the machine interfere. `PLANTD_DRILL_KILLS` is the number of kills of
//! each drill, 60 without it.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{Read as _, Write as _};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, chown, symlink};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use plantd_client::link::{LinkDriver, LinkError, LinkOptions};
use plantd_client::{Client, v1};
use plantd_proto::link::{DomainError, SHARED_MEMORY_DIRECTORY};
use plantd_server::wire::link::config::LinkConfig;
use plantd_server::wire::link::host::{LinkError as HostError, LinkHost};
use plantd_tests::links::{
    ChildProcess, LinkFixture, PATIENCE, PLANT, files_of_links, patient, wait_until,
};
use plantd_tests::server::ServerProcess;

const PLANTS: [&str; 3] = ["one", "two", "three"];

/// A user that is not the one who runs the tests.
const STRANGER: u32 = 65_534;

fn kills() -> u32 {
    std::env::var("PLANTD_DRILL_KILLS").map_or(60, |count| count.parse().unwrap())
}

/// Directories of links and of plants that outlive servers.
struct House {
    directory: tempfile::TempDir,
}

impl House {
    /// With plants whose links are open, saved by a server that has ended in good order.
    async fn new() -> Self {
        let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
        let house = Self { directory };
        let mut server = house.serve();
        let client = server.client().await;
        for id in PLANTS {
            let (id, model) = (id.to_owned(), "pendulum".to_owned());
            let request =
                v1::CreatePlantRequest { id, model, open_link: true, ..Default::default() };
            client.create_plant(request).await.unwrap();
        }
        assert!(server.stop().unwrap().success());
        house
    }

    fn root(&self) -> PathBuf {
        self.directory.path().join("link")
    }

    fn configure(&self, command: &mut Command) {
        let state = self.directory.path().join("state");
        command.arg("--link-root").arg(self.root()).arg("--state-directory").arg(state);
    }

    fn serve(&self) -> ServerProcess {
        ServerProcess::start_with(|command| self.configure(command)).unwrap()
    }

    fn files(&self) -> Vec<PathBuf> {
        files_of_links(&self.root()).unwrap()
    }

    fn connect(&self, plant: &str) -> Result<LinkDriver, LinkError> {
        connect(&self.root(), plant, PATIENCE)
    }
}

fn connect(root: &Path, plant: &str, connect_timeout: Duration) -> Result<LinkDriver, LinkError> {
    let options = LinkOptions { connect_timeout, ..patient(root) };
    tokio::task::block_in_place(|| LinkDriver::connect(plant, options))
}

fn peer(root: &Path, plant: &str) -> ChildProcess {
    ChildProcess::start(env!("CARGO_BIN_EXE_link_peer"), root, &["--plant", plant]).unwrap()
}

async fn assert_open(client: &Client) {
    for id in PLANTS {
        assert!(client.get_plant(id).await.unwrap().plant.unwrap().link_open, "link of {id}");
    }
}

/// All links open and useful, and as many files as with a server that nothing was before.
async fn assert_as_new(house: &House, files: usize) {
    let mut server = house.serve();
    assert_open(&server.client().await).await;
    wait_until("as many files as at first", || house.files().len() == files)
        .unwrap_or_else(|e| panic!("{e}: {files}, now {:#?}\n{}", house.files(), server.log()));
    for id in PLANTS {
        let mut driver = house.connect(id).unwrap();
        let step = driver.state().step;
        assert_eq!(driver.step(&[0.0]).unwrap().step, step + 1);
    }
    assert!(server.stop().unwrap().success());
    assert_eq!(house.files(), Vec::<PathBuf>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn links_open_again_however_their_server_was_killed() {
    let house = House::new().await;
    // Links that were open when a server ended in good order are open with the next.
    let started = Instant::now();
    let mut server = house.serve();
    let start = started.elapsed();
    assert_open(&server.client().await).await;
    let files = house.files().len();
    server.kill().unwrap();
    assert_open(&house.serve().client().await).await;

    let count = kills();
    for k in 0..count {
        let after = start * 5 / 4 * k / count;
        let mut server = ServerProcess::start_unready(|command| house.configure(command)).unwrap();
        // They wait for the link, and some attach.
        let mut drivers: Vec<_> = match k % 3 {
            0 => PLANTS.map(|plant| peer(&house.root(), plant)).into(),
            _ => Vec::new(),
        };
        std::thread::sleep(after);
        server.kill().unwrap();
        drivers.iter_mut().for_each(|driver| driver.kill().unwrap());
    }
    assert_as_new(&house, files).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn drivers_killed_while_they_attach_leave_nothing_and_keep_nobody_out() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let root = fixture.root();
    let before = files_of_links(&root).unwrap();
    let started = Instant::now();
    let mut first = peer(&root, PLANT);
    first.wait_for_line("attached").unwrap();
    let attach = started.elapsed();
    first.kill().unwrap();
    // One that dies while it makes a connection leaves an empty segment, which others wait for.
    let name = before.iter().find(|path| path.to_str().unwrap().ends_with(".data")).unwrap();
    let (kind, own) = name.to_str().unwrap().rsplit_once('_').unwrap();
    let own = own.trim_end_matches(".data");
    let dead = u128::from(first.pid()) << 64 | 1 << 96 | 12;
    File::create(format!("{kind}_{dead}_{own}.connection")).unwrap();
    let count = kills();
    for k in 0..count {
        let mut driver = peer(&root, PLANT);
        std::thread::sleep(attach * 5 / 4 * k / count);
        driver.kill().unwrap();
    }
    wait_until("the housekeeping", || files_of_links(&root).unwrap() == before)
        .unwrap_or_else(|e| panic!("{e}: {before:#?}, now {:#?}", files_of_links(&root).unwrap()));
    wait_until("the lease", || fixture.session.driver().is_none()).unwrap();
    let step = fixture.session.state().step;
    let mut driver = connect(&root, PLANT, PATIENCE).unwrap();
    assert_eq!(driver.step(&[0.0]).unwrap().step, step + 1);
}

/// Where this user may act as another one.
fn is_root() -> bool {
    fs::metadata("/proc/self").unwrap().uid() == 0
}

fn as_stranger(script: &str) -> bool {
    Command::new("sh").args(["-c", script]).uid(STRANGER).gid(STRANGER).status().unwrap().success()
}

#[tokio::test(flavor = "multi_thread")]
async fn segments_and_directories_are_closed_to_other_users() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let mut driver = connect(&fixture.root(), PLANT, PATIENCE).unwrap();
    driver.step(&[0.0]).unwrap();
    let files = files_of_links(&fixture.root()).unwrap();
    let is_segment = |path: &&PathBuf| path.starts_with(SHARED_MEMORY_DIRECTORY);
    assert!(files.iter().filter(is_segment).count() > 8, "{files:#?}");
    for path in &files {
        let mode = fs::symlink_metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode & 0o077, 0, "{} has mode {mode:o}", path.display());
    }
    if is_root() {
        for path in files.iter().filter(is_segment) {
            let path = path.display();
            assert!(!as_stranger(&format!("truncate -s 0 {path} 2>/dev/null")), "{path}");
        }
    }
    assert_eq!(driver.step(&[0.0]).unwrap().step, 2);
}

/// Names of the domain that others have taken are in nobody's way; a segment in use that has become
/// theirs, or is open to them, is refused by name.
#[tokio::test(flavor = "multi_thread")]
async fn segments_of_another_user_are_not_used() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let root = fixture.root();
    let files = files_of_links(&root).unwrap();
    let is_counter = |path: &&PathBuf| path.to_str().unwrap().ends_with(".global_mgmt");
    let counter = files.iter().find(is_counter).unwrap();
    let refused = |what: &str| {
        let error = connect(&root, PLANT, PATIENCE).unwrap_err();
        let domain = matches!(error, LinkError::Domain(DomainError::SegmentNotPrivate { .. }));
        assert!(domain && error.to_string().contains(counter.to_str().unwrap()), "{what}: {error}");
    };
    fs::set_permissions(counter, Permissions::from_mode(0o666)).unwrap();
    refused("open to others");
    fs::set_permissions(counter, Permissions::from_mode(0o600)).unwrap();
    if is_root() {
        chown(counter, Some(STRANGER), None).unwrap();
        refused("somebody else's");
        chown(counter, Some(0), None).unwrap();
        let planted = counter.with_extension("planted");
        assert!(as_stranger(&format!("umask 0; printf x > {}", planted.display())));
        assert_eq!(connect(&root, PLANT, PATIENCE).unwrap().step(&[0.0]).unwrap().step, 1);
        drop(fixture.host);
        let _ = fs::remove_file(planted);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_root_that_is_a_symbolic_link_is_refused() {
    let fixture = LinkFixture::new("pendulum").unwrap();
    let root = fixture.directory.path().join("elsewhere");
    symlink(fixture.root(), &root).unwrap();
    let config = LinkConfig { root: root.clone(), ..LinkConfig::default() };
    let Err(HostError::Domain(error)) = LinkHost::new(config) else { panic!("it was taken") };
    assert!(matches!(error, DomainError::RootIsSymbolicLink { .. }), "{error}");
    assert!(error.to_string().contains(root.to_str().unwrap()), "{error}");
    let error = connect(&root, PLANT, PATIENCE).unwrap_err();
    assert!(matches!(error, LinkError::Domain(DomainError::RootIsSymbolicLink { .. })), "{error}");
}

/// A segment that was cut off, to nothing or to a part, is found before it is mapped.
#[tokio::test(flavor = "multi_thread")]
async fn a_driver_names_a_segment_that_was_cut_off_and_does_not_hang() {
    let house = House::new().await;
    let mut server = house.serve();
    let segments = |suffix: &str| {
        let mut files = house.files();
        files.retain(|path| path.to_str().unwrap().ends_with(suffix));
        files
    };
    // Those of the segment cannot connect however long they try.
    let moment = Duration::from_millis(250);
    for path in [segments(".global_mgmt"), segments(".data")].concat() {
        let file = OpenOptions::new().write(true).open(&path).unwrap();
        let size = file.metadata().unwrap().len();
        for length in [0, size - 1] {
            file.set_len(length).unwrap();
            let started = Instant::now();
            let errors = PLANTS.map(|plant| connect(&house.root(), plant, moment).map(drop));
            assert!(started.elapsed() < PATIENCE);
            let named = |error: &LinkError| error.to_string().contains(path.to_str().unwrap());
            let errors: Vec<_> = errors.into_iter().filter_map(Result::err).collect();
            assert!(errors.iter().any(named), "{path:?} of {length} bytes: {errors:?}");
            file.set_len(size).unwrap();
        }
    }
    assert_open(&server.client().await).await;
    // The next one removes what is left of it.
    server.kill().unwrap();
    assert!(house.serve().stop().unwrap().success());
    assert_eq!(house.files(), Vec::<PathBuf>::new());
}

/// What a dead server has left, whatever became of it, is in nobody's way.
#[tokio::test(flavor = "multi_thread")]
async fn overwritten_remains_of_a_server_do_not_harm_the_next() {
    let house = House::new().await;
    let mut server = house.serve();
    let files = house.files().len();
    let mut random = File::open("/dev/urandom").unwrap();
    for round in 0..6 {
        server.kill().unwrap();
        for (i, path) in house.files().into_iter().enumerate() {
            let metadata = fs::symlink_metadata(&path).unwrap();
            if !metadata.is_file() {
                continue;
            }
            fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
            let mut file = OpenOptions::new().write(true).open(&path).unwrap();
            let mut bytes = vec![0; metadata.len() as usize];
            random.read_exact(&mut bytes).unwrap();
            match (round + i) % 4 {
                0 => file.write_all(&bytes).unwrap(),
                1 => file.set_len(0).unwrap(),
                2 => file.set_len(metadata.len() / 2).unwrap(),
                _ => {}
            }
        }
        server = house.serve();
        assert_open(&server.client().await).await;
    }
    server.kill().unwrap();
    assert_as_new(&house, files).await;
}
