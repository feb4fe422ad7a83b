//! A real `plantd` process for tests and the demo: built if need be, on free ports, gone when
//! dropped.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use plantd_client::Client;

/// Longest wait for a server to come up or to go down.
const PATIENCE: Duration = Duration::from_secs(30);

/// A running server. Dropping it ends the process, by force if need be, and removes its files.
#[derive(Debug)]
pub struct ServerProcess {
    child: Child,
    addresses: Addresses,
    directory: tempfile::TempDir,
}

/// What a server writes into its `--ready-file` once it serves.
#[derive(Clone, Debug, serde::Deserialize)]
pub struct Addresses {
    /// gRPC over TCP, `http://host:port`.
    pub grpc: String,
    /// gRPC over a Unix-domain socket, `unix:/path`.
    pub unix: String,
    /// The page that shows the plants, `http://host:port/`.
    pub view: Option<String>,
    /// Prometheus metrics, `http://host:port/metrics`.
    pub metrics: Option<String>,
}

impl ServerProcess {
    /// Starts a server with default settings on free ports.
    pub fn start() -> Result<Self> {
        Self::start_with(|_| {})
    }

    /// Starts a server after `configure` has added flags or environment variables to
    /// `plantd serve`.
    pub fn start_with(configure: impl FnOnce(&mut Command)) -> Result<Self> {
        let mut server = Self::start_unready(configure)?;
        let ready = server.directory.path().join("ready.json");
        server.addresses = server.wait_until_ready(&ready)?;
        Ok(server)
    }

    /// The same, without waiting for it to serve: its addresses are empty.
    pub fn start_unready(configure: impl FnOnce(&mut Command)) -> Result<Self> {
        let directory = tempfile::Builder::new().prefix("plantd-test-").tempdir()?;
        let ready = directory.path().join("ready.json");
        let log = File::create(directory.path().join("log"))?;
        let mut command = Command::new(binary("plantd")?);
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("PLANTD_") {
                command.env_remove(name);
            }
        }
        command
            .arg("serve")
            .args(["--grpc", "127.0.0.1:0", "--metrics", "127.0.0.1:0"])
            // A test that ends does not answer the server's farewell on its idle connections.
            .args(["--shutdown-grace-s", "0.2"])
            // Nor does it wait for drivers of its own; flags win over it.
            .env("PLANTD_DRAIN_S", "0")
            .arg("--unix")
            .arg(directory.path().join("plantd.sock"))
            .arg("--ready-file")
            .arg(&ready)
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log);
        configure(&mut command);
        let child = command.spawn().with_context(|| format!("cannot start {command:?}"))?;
        // From here on the process is this value's to kill.
        let nowhere =
            Addresses { grpc: String::new(), unix: String::new(), view: None, metrics: None };
        Ok(Self { child, addresses: nowhere, directory })
    }

    /// Address over TCP, `http://127.0.0.1:port`.
    pub fn address(&self) -> &str {
        &self.addresses.grpc
    }

    /// Address of the Unix-domain socket, `unix:/path`.
    pub fn unix_address(&self) -> &str {
        &self.addresses.unix
    }

    /// All addresses.
    pub fn addresses(&self) -> &Addresses {
        &self.addresses
    }

    /// A directory that lives as long as the server.
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// Process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// A client over TCP.
    pub async fn client(&self) -> Client {
        Client::connect(self.address()).await.expect("the server is ready")
    }

    /// Memory of the process that is in use or kept, KiB.
    pub fn resident_kib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid()));
        let status = status.expect("the server runs");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.strip_suffix("kB"));
        line.and_then(|kib| kib.trim().parse().ok()).expect("Linux tells what is resident")
    }

    /// What the server has logged so far.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.directory.path().join("log")).unwrap_or_default()
    }

    /// Ends the process without a chance to clean up, as `kill -9` does.
    pub fn kill(&mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }

    /// Asks the server to shut down (SIGTERM).
    pub fn terminate(&self) -> Result<()> {
        let pid = rustix::process::Pid::from_child(&self.child);
        Ok(rustix::process::kill_process(pid, rustix::process::Signal::TERM)?)
    }

    /// Asks the server to shut down (SIGTERM) and waits until it has.
    pub fn stop(&mut self) -> Result<ExitStatus> {
        self.terminate()?;
        self.wait(PATIENCE)
    }

    /// Waits until the server has ended, as somebody else has asked it to.
    pub fn end(&mut self) -> Result<ExitStatus> {
        self.wait(PATIENCE)
    }

    fn wait(&mut self, patience: Duration) -> Result<ExitStatus> {
        let deadline = Instant::now() + patience;
        loop {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status);
            }
            ensure!(Instant::now() < deadline, "the server does not end:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn wait_until_ready(&mut self, ready: &Path) -> Result<Addresses> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            // The server renames the finished file into place, so what is there is complete.
            if let Ok(text) = std::fs::read_to_string(ready) {
                return serde_json::from_str(&text).with_context(|| format!("ready file: {text}"));
            }
            if let Some(status) = self.child.try_wait()? {
                bail!("the server ended with {status}:\n{}", self.log());
            }
            ensure!(Instant::now() < deadline, "the server does not get ready:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // A server that may say goodbye leaves no shared memory behind; one that hangs may not.
        if !matches!(self.child.try_wait(), Ok(Some(_))) && self.stop().is_err() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
        if std::thread::panicking() {
            eprintln!("---- log of the server ----\n{}", self.log());
        }
    }
}

/// A binary of the workspace (`plantd`, `plantctl`) or a library for other languages (`libplantd.so`,
/// `libplantd.a`, `libplantd_fmi.so`), built in the profile of the running program.
/// The environment variable `PLANTD_BINARY_DIR` names a directory with ready ones instead.
pub fn binary(name: &str) -> Result<PathBuf> {
    if let Some(directory) = std::env::var_os("PLANTD_BINARY_DIR") {
        return Ok(PathBuf::from(directory).join(name));
    }
    static DIRECTORY: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    match DIRECTORY.get_or_init(|| build().map_err(|error| format!("{error:#}"))) {
        Ok(directory) => Ok(directory.join(name)),
        Err(error) => bail!("{error}"),
    }
}

/// Builds the binaries and returns where they are. Cargo does not build the binaries of other
/// packages for a test, and locks its target directory against builds at the same time.
fn build() -> Result<PathBuf> {
    let program = std::env::current_exe()?;
    let directory = program
        .ancestors()
        .skip(1)
        .find(|directory| !directory.ends_with("deps") && !directory.ends_with("examples"))
        .context("the running program has no directory")?;
    let profile = match directory.file_name().and_then(|name| name.to_str()) {
        Some("debug") => "dev",
        Some(other) => other,
        None => bail!("{} is not a target directory", directory.display()),
    };
    let target = directory.parent().context("the target directory has no parent")?;
    // With the binaries of the packages that ask, so that Cargo sees the same dependencies as for the
    // running program and builds none of them a second time.
    let output = plantd_launch::cargo()
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["build", "--quiet", "--bins", "--lib"])
        .args(["-p", "plantd-server", "-p", "plantd-client", "-p", "plantd-tests"])
        .args(["-p", "plantd-demo", "-p", "plantd-fmi", "-p", "plantd-link-c"])
        .args(["--profile", profile, "--target-dir"])
        .arg(target)
        .output()
        .context("cannot run cargo")?;
    ensure!(
        output.status.success(),
        "cannot build the binaries:\n{}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(directory.to_owned())
}
