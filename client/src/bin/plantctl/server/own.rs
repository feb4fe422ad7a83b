//! A plantd of one's own: started on a private Unix-domain socket, ended with this process.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use serde::Deserialize;
use tempfile::TempDir;
use tokio::process::{Child, Command};

/// Longest wait for a server to serve, and for it to end.
const PATIENCE: Duration = Duration::from_secs(30);
const LOOK_PERIOD: Duration = Duration::from_millis(5);

/// A server process; dropping it ends it.
pub(crate) struct OwnServer {
    child: Child,
    directory: TempDir,
    addresses: Addresses,
}

/// What the server writes when it is ready.
#[derive(Debug, Deserialize)]
struct Addresses {
    unix: String,
    link_root: Option<PathBuf>,
}

impl OwnServer {
    /// Starts `program`, or the `plantd` beside this program, or the one in `PATH`.
    pub(crate) async fn start(program: Option<&Path>) -> Result<Self> {
        let program = program.map_or_else(find, Path::to_owned);
        let directory = tempfile::Builder::new().prefix("plantctl-").tempdir()?;
        let path = |name: &str| directory.path().join(name);
        let log = File::create(path("log"))?;
        let mut command = Command::new(&program);
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("PLANTD_") {
                command.env_remove(name);
            }
        }
        command
            .args(["serve", "--grpc", "off", "--metrics", "off", "--worker-priority", "normal"])
            .args(["--shutdown-grace-s", "0.2", "--until-stdin-ends"])
            .arg("--unix")
            .arg(path("plantd.sock"))
            .arg("--link-root")
            .arg(path("link"))
            .arg("--ready-file")
            .arg(path("ready.json"))
            // It ends with this process, however that ends.
            .stdin(Stdio::piped())
            .stdout(log.try_clone()?)
            .stderr(log)
            // Ctrl-C is for this process, which then ends the server.
            .process_group(0)
            .kill_on_drop(true);
        let child =
            command.spawn().with_context(|| format!("cannot start {}", program.display()))?;
        let addresses = Addresses { unix: String::new(), link_root: None };
        let mut server = Self { child, directory, addresses };
        server.addresses = server.wait_until_ready().await?;
        Ok(server)
    }

    /// Address of its Unix-domain socket.
    pub(crate) fn address(&self) -> &str {
        &self.addresses.unix
    }

    /// Root path of its shared-memory links.
    pub(crate) fn link_root(&self) -> Option<&Path> {
        self.addresses.link_root.as_deref()
    }

    /// The end of what it has logged.
    pub(crate) fn log(&self) -> String {
        const SHOWN_BYTES: usize = 4096;
        let log = std::fs::read(self.directory.path().join("log")).unwrap_or_default();
        String::from_utf8_lossy(&log[log.len().saturating_sub(SHOWN_BYTES)..]).into_owned()
    }

    /// Asks it to end, so that it leaves no shared memory behind.
    pub(crate) async fn stop(mut self) {
        if let Some(pid) = self.child.id().and_then(|id| Pid::from_raw(id as i32)) {
            // A server that is gone already needs no signal.
            let _ = kill_process(pid, Signal::TERM);
        }
        let _ = tokio::time::timeout(PATIENCE, self.child.wait()).await;
    }

    async fn wait_until_ready(&mut self) -> Result<Addresses> {
        let ready = self.directory.path().join("ready.json");
        let deadline = tokio::time::Instant::now() + PATIENCE;
        loop {
            // The server renames the finished file into place, so what is there is complete.
            if let Ok(text) = std::fs::read_to_string(&ready) {
                return Ok(serde_json::from_str(&text)?);
            }
            if let Some(status) = self.child.try_wait()? {
                bail!("plantd ended with {status}:\n{}", self.log());
            }
            if tokio::time::Instant::now() > deadline {
                bail!("plantd does not get ready:\n{}", self.log());
            }
            tokio::time::sleep(LOOK_PERIOD).await;
        }
    }
}

/// The `plantd` beside this program, or the one in `PATH`.
fn find() -> PathBuf {
    let beside = std::env::current_exe().ok().map(|program| program.with_file_name("plantd"));
    beside.filter(|path| path.is_file()).unwrap_or_else(|| PathBuf::from("plantd"))
}
