//! What makes a server a well-behaved process: signals, log, ready file, service manager.

use std::io::{IsTerminal as _, Write as _};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result};
use sd_notify::NotifyState;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::oneshot;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{fmt, registry};

use crate::config::{Config, LogConfig, LogFormat};
use crate::core::modes::Mode;
use crate::serve::{Addresses, Shutdown, run};

/// Time for computations that nobody waits for any more to notice that the server has ended.
const LEFTOVERS_MAX: Duration = Duration::from_secs(1);

/// Sets up logging to standard error.
pub fn start_log(config: &LogConfig) -> Result<()> {
    let filter: Targets =
        config.filter.parse().with_context(|| format!("log filter `{}`", config.filter))?;
    let lines =
        fmt::layer().with_writer(std::io::stderr).with_ansi(std::io::stderr().is_terminal());
    let log = registry().with(filter);
    match config.format {
        LogFormat::Text => log.with(lines).init(),
        LogFormat::Json => log.with(lines.json()).init(),
    }
    Ok(())
}

/// Serves, on threads of its own, until SIGTERM or SIGINT, or until standard input ends where that is asked
/// for. A second signal cuts short what open calls and balancers are given to end.
///
/// No `async fn`: what a program waits for is compiled with the program, and the server would be twice.
pub fn serve(config: Config, until_stdin_ends: bool) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(config.thread_count())
        .enable_all()
        .build()
        .context("threads")?;
    let outcome = runtime.block_on(serve_until_told(config, until_stdin_ends));
    runtime.shutdown_timeout(LEFTOVERS_MAX);
    outcome
}

async fn serve_until_told(config: Config, until_stdin_ends: bool) -> Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let shutdown = async {
        let shutdown = tokio::select! {
            _ = terminate.recv() => Shutdown::Drained,
            _ = interrupt.recv() => Shutdown::Prompt,
            () = stdin_ended(), if until_stdin_ends => Shutdown::Prompt,
        };
        tracing::info!("shutting down");
        notify(&[NotifyState::Stopping]);
        shutdown
    };
    let hurry = second_signal()?;
    let ready_file = config.ready_file.clone();
    let on_ready = |addresses: &Addresses| {
        tracing::info!(
            grpc = addresses.grpc,
            unix = addresses.unix,
            metrics = addresses.metrics,
            "serving"
        );
        if let Some(path) = &ready_file
            && let Err(error) = write_ready_file(path, addresses)
        {
            tracing::error!(path = %path.display(), %error, "ready file not written");
        }
        if let Some(view) = &addresses.view {
            // For people; nothing is lost where nobody reads it.
            let _ = writeln!(std::io::stdout(), "See the plants: {view}");
        }
        notify(&[NotifyState::Ready]);
    };
    let watchdog = tokio::spawn(feed_watchdog());
    let outcome = run(config, shutdown, hurry, on_ready).await;
    watchdog.abort();
    if let Some(path) = &ready_file {
        // It says where a server is that is no longer there; nothing is lost if it stays.
        let _ = std::fs::remove_file(path);
    }
    outcome
}

/// Completes with the second SIGTERM or SIGINT.
fn second_signal() -> Result<impl Future<Output = ()>> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    Ok(async move {
        for _ in 0..2 {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
        }
        tracing::warn!("a second signal: ending at once");
    })
}

/// Completes when nobody can write to standard input any more.
async fn stdin_ended() {
    let (ends, ended) = oneshot::channel::<()>();
    // A thread of its own: the runtime would wait at its end for one that reads.
    std::thread::spawn(move || {
        let _ends = ends;
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
    });
    let _ = ended.await;
}

/// Writes the addresses beside the file and renames them into place, so that readers see all or
/// nothing.
fn write_ready_file(path: &Path, addresses: &Addresses) -> Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    // Clients trust it: others may read it, and not write to it.
    let mut file = Mode::PUBLIC.create(Path::new(&partial))?;
    serde_json::to_writer(&mut file, addresses)?;
    file.write_all(b"\n")?;
    drop(file);
    Ok(std::fs::rename(partial, path)?)
}

/// Tells the service manager, if there is one.
fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "the service manager was not told");
    }
}

/// Tells the service manager's watchdog that the runtime turns, twice in its period.
async fn feed_watchdog() {
    let Some(period) = sd_notify::watchdog_enabled() else { return };
    let mut ticks = tokio::time::interval(period / 2);
    loop {
        ticks.tick().await;
        notify(&[NotifyState::Watchdog]);
    }
}
