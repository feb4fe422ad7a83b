//! `cargo demo`: builds the server and the demo, shows how far it is, and becomes the demo.

mod bar;
mod cargo;

use std::io::{BufRead as _, BufReader};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread;
use std::time::{Duration, Instant};

use crate::bar::{Bar, clock};
use crate::cargo::{Artifact, count_packages};

/// What is built: the server and the demo.
const BUILD: [&str; 8] =
    ["--profile", PROFILE, "--locked", "--bins", "-p", "plantd-server", "-p", "plantd-demo"];
/// Ready soon, and nearly as fast as a release.
const PROFILE: &str = "demo";
/// What a first build has taken elsewhere, without the time to fetch crates.
const BUILD_TIME: &str = "five to twenty minutes on two cores";
/// How often the bar is drawn anew.
const REFRESH: Duration = Duration::from_millis(200);

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    match build() {
        Ok(demo) => {
            let directory = demo.parent().unwrap_or(Path::new("."));
            let mut command = Command::new(&demo);
            // Only a failure comes back.
            let error = command.args(arguments).env("PLANTD_BINARY_DIR", directory).exec();
            eprintln!("error: {} does not start: {error}", demo.display());
        }
        Err(problem) => eprintln!("error: {problem}"),
    }
    ExitCode::FAILURE
}

/// Builds everything; where the demo is.
fn build() -> Result<PathBuf, String> {
    println!("cargo demo: builds the server and its demo, the first time {BUILD_TIME}");
    let total = packages()?;
    let mut child = cargo(&["build", "--quiet", "--message-format", "json-render-diagnostics"])
        .args(BUILD)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| format!("cargo does not start: {error}"))?;
    let (lines, happenings) = mpsc::channel();
    let readers = [
        read_lines(child.stdout.take(), lines.clone(), Happening::Message),
        read_lines(child.stderr.take(), lines, Happening::Complaint),
    ];
    let start = Instant::now();
    let mut bar = Bar::new(total);
    let mut demo = None;
    loop {
        match happenings.recv_timeout(REFRESH) {
            Ok(Happening::Message(line)) => {
                let Some(artifact) = Artifact::read(&line) else { continue };
                if artifact.executable.as_deref().is_some_and(|path| path.ends_with("demo")) {
                    demo.clone_from(&artifact.executable);
                }
                bar.done(artifact.package);
            }
            Ok(Happening::Complaint(line)) => bar.say(&line),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        bar.draw(start.elapsed());
    }
    bar.clear();
    for reader in readers {
        let _ = reader.join();
    }
    let status: ExitStatus = child.wait().map_err(|error| error.to_string())?;
    match demo {
        Some(demo) if status.success() => {
            println!("built in {}", clock(start.elapsed()));
            Ok(demo)
        }
        _ => Err(format!("the build ended with {status}")),
    }
}

/// How many packages are compiled. Fetches those that are not there, which cargo shows.
fn packages() -> Result<usize, String> {
    let output = cargo(&["tree", "--locked", "--prefix", "none", "--edges", "normal,build"])
        .args(["-p", "plantd-server", "-p", "plantd-demo"])
        .stderr(Stdio::inherit())
        .output()
        .map_err(|error| format!("cargo does not start: {error}"))?;
    if !output.status.success() {
        return Err(format!("cargo tree ended with {}", output.status));
    }
    Ok(count_packages(&String::from_utf8_lossy(&output.stdout)))
}

fn cargo(arguments: &[&str]) -> Command {
    let mut command = plantd_launch::cargo();
    command.args(arguments).stdin(Stdio::null());
    command
}

/// What cargo says.
enum Happening {
    /// On standard output, for programs.
    Message(String),
    /// On standard error, for people.
    Complaint(String),
}

fn read_lines(
    from: Option<impl std::io::Read + Send + 'static>,
    to: Sender<Happening>,
    happening: fn(String) -> Happening,
) -> thread::JoinHandle<()> {
    thread::spawn(move || {
        let lines = from.into_iter().flat_map(|from| BufReader::new(from).lines());
        for line in lines.map_while(Result::ok) {
            if to.send(happening(line)).is_err() {
                break;
            }
        }
    })
}
