//! Plants with an open shared-memory link, in this process and in others.

use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, ensure};
use plantd_client::link::{LinkDriver, LinkError, LinkOptions, Wait};
use plantd_models::{Model, Plant, Settings, builtin};
use plantd_proto::link::SHARED_MEMORY_DIRECTORY;
use plantd_server::core::metrics::registry::Metrics;
use plantd_server::core::realtime::loops::RealTime;
use plantd_server::core::realtime::settings::RealTimeSettings;
use plantd_server::core::session::creation::Origin;
use plantd_server::core::session::shared::Session;
use plantd_server::wire::link::config::LinkConfig;
use plantd_server::wire::link::host::LinkHost;

/// Longest wait for something that takes a fraction of a second.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// Name of the plant of a [`LinkFixture`].
pub const PLANT: &str = "plant";

/// A plant of a built-in model, its session, and the host of its link.
pub struct LinkFixture {
    /// The session.
    pub session: Arc<Session>,
    /// Hosts the link; dropped before the directory.
    pub host: LinkHost,
    /// Holds the root path.
    pub directory: tempfile::TempDir,
}

impl LinkFixture {
    /// Opens the link of a new plant under a root path of its own.
    pub fn new(model: &str) -> Result<Self> {
        Self::with_config(model, |_| {})
    }

    /// The same, with another configuration.
    pub fn with_config(model: &str, configure: impl FnOnce(&mut LinkConfig)) -> Result<Self> {
        let directory = tempfile::Builder::new().prefix("plantd-").tempdir()?;
        let mut config =
            LinkConfig { root: directory.path().join("link"), ..LinkConfig::default() };
        configure(&mut config);
        let host = LinkHost::new(config)?;
        let session = new_session(model)?;
        host.open(Arc::clone(&session))?;
        Ok(Self { session, host, directory })
    }

    /// Root path of the domain.
    pub fn root(&self) -> PathBuf {
        self.directory.path().join("link")
    }

    /// Options to connect.
    pub fn options(&self) -> LinkOptions {
        patient(self.root())
    }

    /// A connected driver.
    pub fn connect(&self, wait: Wait) -> Result<LinkDriver, LinkError> {
        LinkDriver::connect(PLANT, LinkOptions { wait, ..self.options() })
    }
}

/// Options of a driver that waits as long as tests do: a machine with many of them at once may stand still for longer
/// than a controller would wait.
pub fn patient(root: impl Into<PathBuf>) -> LinkOptions {
    LinkOptions {
        root: root.into(),
        timeout: PATIENCE,
        connect_timeout: PATIENCE,
        ..LinkOptions::default()
    }
}

/// A session of a plant of a built-in model.
pub fn new_session(model: &str) -> Result<Arc<Session>> {
    new_session_of(PLANT, model)
}

/// The same, of a plant with another id.
pub fn new_session_of(id: &str, model: &str) -> Result<Arc<Session>> {
    let plant = new_plant(model)?;
    let metrics = Arc::new(Metrics::default());
    let realtime = RealTime::new(RealTimeSettings::default(), &metrics);
    Ok(Session::new(Origin::new(id, model), plant, metrics, realtime))
}

/// A plant of a built-in model.
pub fn new_plant(model: &str) -> Result<Plant> {
    new_plant_of_order(model, 2)
}

/// The same, stepped by a method of this order.
pub fn new_plant_of_order(model: &str, order: u32) -> Result<Plant> {
    let scene = builtin::scene(model).context("no such model")?;
    let model = Arc::new(Model::compile(&scene)?);
    let settings = Settings { order, ..Settings::new(&model) };
    Ok(Plant::new(model, settings)?)
}

/// The `k`-th input of a deterministic sequence that moves every input and every prescribed
/// coordinate about its position at the start.
pub fn wiggle(plant: &Plant, k: u64, u: &mut [f64]) {
    let inputs = plant.model().dimensions().inputs;
    plant.hold_input(u);
    for (i, value) in u.iter_mut().enumerate() {
        let size = if i < inputs { 0.1 } else { 1e-3 };
        *value += size * (0.7 * k as f64 + i as f64).sin();
    }
}

/// The files of links: under their root path, and in shared memory those of the domains that are there
/// or were when this was last asked.
pub fn files_of_links(root: &Path) -> Result<Vec<PathBuf>> {
    static SEEN: Mutex<BTreeSet<(PathBuf, String)>> = Mutex::new(BTreeSet::new());
    let mut seen = SEEN.lock().map_err(|_| anyhow!("another test has failed"))?;
    let mut files = Vec::new();
    let mut directories = vec![root.to_owned()];
    while let Some(directory) = directories.pop() {
        // Members may come and go meanwhile.
        for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() && path.parent() == Some(root) {
                seen.insert((root.to_owned(), entry.file_name().to_string_lossy().into_owned()));
            }
            if path.is_dir() { &mut directories } else { &mut files }.push(path);
        }
    }
    let own = seen.iter().filter(|(under, _)| under == root);
    let prefixes: Vec<_> = own.map(|(_, domain)| format!("plantd5_{domain}_")).collect();
    for entry in std::fs::read_dir(SHARED_MEMORY_DIRECTORY)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if prefixes.iter().any(|prefix| name.starts_with(prefix)) {
            files.push(entry.path());
        }
    }
    files.sort();
    Ok(files)
}

/// Waits until `is_so`, at most [`PATIENCE`].
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        ensure!(Instant::now() < deadline, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// A driver or a host in a process of its own; killed when dropped.
pub struct ChildProcess {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl ChildProcess {
    /// Starts a program with these arguments besides the root path.
    pub fn start(program: impl AsRef<Path>, root: &Path, arguments: &[&str]) -> Result<Self> {
        let program = program.as_ref();
        let mut child = Command::new(program)
            .arg("--root")
            .arg(root)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        let output = BufReader::new(child.stdout.take().context("no output")?);
        Ok(Self { child, output })
    }

    /// Waits until the process prints this line.
    pub fn wait_for_line(&mut self, expected: &str) -> Result<()> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        ensure!(line.trim_end() == expected, "the process printed `{}`", line.trim_end());
        Ok(())
    }

    /// Process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Kills the process as `kill -9` does.
    pub fn kill(&mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }

    /// Closes the standard input and waits until the process ends; whether it succeeded.
    pub fn finish(&mut self) -> Result<bool> {
        drop(self.child.stdin.take());
        let mut status = None;
        wait_until("the end of a process", || {
            status = self.child.try_wait().ok().flatten();
            status.is_some()
        })?;
        Ok(status.is_some_and(|status| status.success()))
    }
}

impl Drop for ChildProcess {
    fn drop(&mut self) {
        // Fails only if the process has ended already.
        let _ = self.kill();
    }
}
