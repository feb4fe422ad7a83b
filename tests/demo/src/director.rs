//! The director: starts the server and the controllers, compares, plots, and clears the stage.

use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use indicatif::ProgressBar;
use plantd_process::{ServerProcess, binary};
use tokio::signal::unix::{SignalKind, signal};

use crate::controller::{Name, Process};
use crate::latency::RoundTrips;
use crate::report::Table;
use crate::{marionette, pendulum, plots, report, show};

/// How long the show lasts where nobody can press a key.
const SHOW: Duration = Duration::from_secs(30);

/// Shows everything, plants that move first if `with_view`; `false` if a number is off.
pub(crate) fn run(output: &Path, with_view: bool) -> Result<bool> {
    // Asked for first: building the server may put another file in this program's place.
    let program = std::env::current_exe()?;
    std::fs::create_dir_all(output)
        .with_context(|| format!("cannot make the folder {}", output.display()))?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let mut interruption = std::pin::pin!(interrupted()?);
        let (mut server, memory) = start_server().await?;
        let all = async {
            println!("plantd, process {}, at {}", server.pid(), server.address());
            if with_view {
                show(&program, &server).await?;
            }
            let start = Instant::now();
            Ok((compare(&program, &server, output).await?, start.elapsed()))
        };
        // Whatever happens in between, the server is asked to leave and leaves nothing.
        let shown = tokio::select! {
            shown = all => shown,
            () = &mut interruption => Err(anyhow::anyhow!("interrupted")),
        };
        let cleared = clear(&mut server, &memory);
        let (table, time) = shown?;
        cleared?;
        println!();
        println!(
            "{} in {:.1} s; the server has ended and left nothing behind",
            table.verdict(),
            time.as_secs_f64()
        );
        println!("plots and results: {}", output.display());
        Ok(table.is_good())
    })
}

/// Lets the plants of the show move until somebody has seen enough.
async fn show(program: &Path, server: &ServerProcess) -> Result<()> {
    let show = Process::start(program, Name::Show, server.address())?;
    let url = format!("{}/?plant={}", server.address(), show::MARIONETTE);
    println!();
    println!("   The marionette dances and the pendulum is pushed (by process {}):", show.pid());
    println!();
    println!("       {url}");
    println!();
    let is_person = std::io::stdin().is_terminal();
    if is_person {
        open_in_browser(&url);
        println!("   Press Enter for the numbers of the paper.");
    } else {
        println!("   The numbers of the paper follow in {} s.", SHOW.as_secs());
    }
    let enough =
        async { if is_person { key_pressed().await } else { tokio::time::sleep(SHOW).await } };
    tokio::select! {
        ended = show.end() => match ended {
            Ok(()) => bail!("the show has ended by itself"),
            Err(error) => Err(error),
        },
        () = enough => Ok(()),
    }
}

/// Opens an address where there is a display; whoever has none sees it printed.
fn open_in_browser(url: &str) {
    if ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some()) {
        let mut command = std::process::Command::new("xdg-open");
        command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let _ = command.spawn();
    }
}

/// Waits for a line on standard input, or for its end.
async fn key_pressed() {
    let (sender, pressed) = tokio::sync::oneshot::channel();
    // A thread of its own: the runtime would wait for one of its threads.
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_line(&mut String::new());
        let _ = sender.send(());
    });
    let _ = pressed.await;
}

/// Runs the controllers, and compares what they report with the paper.
async fn compare(program: &Path, server: &ServerProcess, output: &Path) -> Result<Table> {
    let mut table = Table::default();

    let (pid, pendulum) =
        perform::<pendulum::Report>(program, Name::Pendulum, server.address()).await?;
    report::pendulum(&mut table, pid, &pendulum);

    let (pid, marionette) =
        perform::<marionette::Report>(program, Name::Marionette, server.address()).await?;
    report::marionette(&mut table, pid, &marionette);

    let (tcp_pid, tcp) =
        perform::<RoundTrips>(program, Name::GrpcLatency, server.address()).await?;
    let (unix_pid, unix) =
        perform::<RoundTrips>(program, Name::GrpcLatency, server.unix_address()).await?;
    let (link_pid, link) =
        perform::<RoundTrips>(program, Name::LinkLatency, server.address()).await?;
    report::round_trips(
        [tcp_pid, unix_pid, link_pid],
        &[
            ("pendulum, gRPC over TCP", &tcp),
            ("pendulum, gRPC over a Unix socket", &unix),
            ("pendulum, shared memory", &link),
            ("pendulum with LQR, gRPC over TCP", &pendulum.round_trips),
            ("marionette, shared memory", &marionette.round_trips),
        ],
    );
    plots::draw(output, &pendulum, &marionette)?;
    let results = serde_json::json!({
        "pendulum": pendulum,
        "marionette": marionette,
        "round_trips": { "grpc_tcp": tcp, "grpc_unix": unix, "shared_memory": link },
    });
    std::fs::write(output.join("results.json"), serde_json::to_vec(&results)?)?;
    Ok(table)
}

/// Runs one controller to its end; returns its process id and what it found.
async fn perform<T: serde::de::DeserializeOwned>(
    program: &Path,
    name: Name,
    address: &str,
) -> Result<(u32, T)> {
    let process = Process::start(program, name, address)?;
    let pid = process.pid();
    Ok((pid, process.result().await?))
}

/// Builds and starts a server whose shared memory is its own.
async fn start_server() -> Result<(ServerProcess, SharedMemory)> {
    let spinner = ProgressBar::new_spinner().with_message("building and starting plantd");
    spinner.enable_steady_tick(Duration::from_millis(100));
    if !std::io::stderr().is_terminal() {
        eprintln!("building and starting plantd");
    }
    let started = tokio::task::spawn_blocking(|| {
        binary("plantd")?;
        let memory = SharedMemory::new()?;
        let server = ServerProcess::start_with(|command| {
            command.arg("--link-root").arg(memory.root());
        })?;
        Ok((server, memory))
    })
    .await?;
    spinner.finish_and_clear();
    started
}

/// The server's domain of shared memory.
struct SharedMemory {
    directory: tempfile::TempDir,
}

impl SharedMemory {
    fn new() -> Result<Self> {
        Ok(Self { directory: tempfile::Builder::new().prefix("plantd-demo-").tempdir()? })
    }

    /// Made by the server, closed to other users.
    fn root(&self) -> PathBuf {
        self.directory.path().join("link")
    }

    /// What is left under the root. The directory of a domain goes after its segments.
    fn residue(&self) -> Result<Vec<String>> {
        let entries = std::fs::read_dir(self.root())?;
        entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned())).collect()
    }
}

/// Ends the server and looks whether anything of it is left.
fn clear(server: &mut ServerProcess, memory: &SharedMemory) -> Result<()> {
    let status = server.stop()?;
    ensure!(status.success(), "the server ended with {status}:\n{}", server.log());
    let residue = memory.residue()?;
    if !residue.is_empty() {
        bail!("the server left in {}: {}", memory.root().display(), residue.join(", "));
    }
    Ok(())
}

/// Ends when somebody wants this process to end.
fn interrupted() -> Result<impl Future<Output = ()>> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut hangup = signal(SignalKind::hangup())?;
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            _ = hangup.recv() => {}
        }
    })
}
