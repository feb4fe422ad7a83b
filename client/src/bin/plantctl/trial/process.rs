//! The process of a controller: started in a group of its own, its output kept, ended with all its
//! children.

use std::io::Read as _;
use std::path::Path;
use std::process::{ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context as _, Result};
use rustix::process::{Pid, Signal, kill_process_group};
use tokio::process::Child;

use crate::scenario::file::Command;

/// Output that is kept, bytes; of more, the end.
const OUTPUT_MAX_BYTES: usize = 64 << 10;
/// Time to end after SIGTERM, before SIGKILL.
const GRACE: Duration = Duration::from_secs(2);
/// Wait for what an ended controller has still in its pipe.
const OUTPUT_WAIT: Duration = Duration::from_millis(100);

/// A running controller; dropping it kills it.
pub(crate) struct Process {
    child: Child,
    group: Option<Pid>,
    output: Arc<Mutex<Output>>,
}

#[derive(Default)]
struct Output {
    bytes: Vec<u8>,
    is_cut: bool,
    is_complete: bool,
}

/// What a controller is told, as environment variables and in place of `{...}` in its arguments.
pub(crate) struct Assignment<'a> {
    pub(crate) address: &'a str,
    pub(crate) plant: &'a str,
    pub(crate) link_root: Option<&'a Path>,
    pub(crate) seed: u64,
    pub(crate) steps: u64,
    pub(crate) duration_s: f64,
}

impl Assignment<'_> {
    fn values(&self) -> [(&'static str, String); 6] {
        let link_root = self.link_root.unwrap_or(Path::new("")).to_string_lossy().into_owned();
        [
            ("address", self.address.to_owned()),
            ("plant", self.plant.to_owned()),
            ("link_root", link_root),
            ("seed", self.seed.to_string()),
            ("steps", self.steps.to_string()),
            ("duration_s", self.duration_s.to_string()),
        ]
    }
}

impl Process {
    /// Starts a controller in `folder`.
    pub(crate) fn start(command: &Command, folder: &Path, told: &Assignment<'_>) -> Result<Self> {
        let values = told.values();
        let filled = |text: &String| {
            values.iter().fold(text.clone(), |text, (name, value)| {
                text.replace(&format!("{{{name}}}"), value)
            })
        };
        let (program, arguments) = command.run.split_first().context("a program is needed")?;
        // A path is meant from the scenario's folder, a bare name from PATH.
        let program = filled(program);
        let program = if program.contains('/') { folder.join(&program) } else { program.into() };
        let (mut reader, writer) = std::io::pipe()?;
        let mut process = tokio::process::Command::new(&program);
        process
            .args(arguments.iter().map(filled))
            .current_dir(folder)
            .envs(
                values
                    .iter()
                    .map(|(name, value)| (format!("PLANTD_{}", name.to_uppercase()), value)),
            )
            .envs(command.env.iter().map(|(name, value)| (name, filled(value))))
            .stdin(Stdio::null())
            .stdout(writer.try_clone()?)
            .stderr(writer)
            .process_group(0)
            .kill_on_drop(true);
        let child =
            process.spawn().with_context(|| format!("cannot start {}", program.display()))?;
        let group = child.id().and_then(|id| Pid::from_raw(id as i32));
        let output = Arc::new(Mutex::new(Output::default()));
        let kept = Arc::clone(&output);
        // It ends with the last process that holds the other end of the pipe.
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(count @ 1..) = reader.read(&mut buffer) {
                kept.lock().unwrap_or_else(PoisonError::into_inner).push(&buffer[..count]);
            }
            kept.lock().unwrap_or_else(PoisonError::into_inner).is_complete = true;
        });
        Ok(Self { child, group, output })
    }

    /// Waits until it ends by itself.
    pub(crate) async fn wait(&mut self) -> Result<ExitStatus> {
        Ok(self.child.wait().await?)
    }

    /// Ends it with all its children, and returns what it has written.
    pub(crate) async fn stop(mut self) -> String {
        self.signal(Signal::TERM);
        let _ = tokio::time::timeout(GRACE, self.child.wait()).await;
        self.signal(Signal::KILL);
        let _ = self.child.wait().await;
        let deadline = tokio::time::Instant::now() + OUTPUT_WAIT;
        loop {
            let text = {
                let output = self.output.lock().unwrap_or_else(PoisonError::into_inner);
                let is_last = output.is_complete || tokio::time::Instant::now() >= deadline;
                is_last.then(|| output.text())
            };
            if let Some(text) = text {
                return text;
            }
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    /// To the whole group, which outlives its leader.
    fn signal(&self, signal: Signal) {
        if let Some(group) = self.group {
            // A group that is gone already needs no signal.
            let _ = kill_process_group(group, signal);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.signal(Signal::KILL);
    }
}

impl Output {
    fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
        // Rarely, so that keeping the end costs no more than reading it.
        if self.bytes.len() > 2 * OUTPUT_MAX_BYTES {
            self.bytes.drain(..self.bytes.len() - OUTPUT_MAX_BYTES);
            self.is_cut = true;
        }
    }

    fn text(&self) -> String {
        let start = self.bytes.len().saturating_sub(OUTPUT_MAX_BYTES);
        let cut = if self.is_cut || start > 0 { "[...]\n" } else { "" };
        format!("{cut}{}", String::from_utf8_lossy(&self.bytes[start..]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_much_output_the_end_is_kept() {
        let mut output = Output::default();
        for _ in 0..10_000 {
            output.push(b"0123456789abcdef\n");
        }
        output.push(b"the end\n");
        assert!(output.bytes.len() <= 2 * OUTPUT_MAX_BYTES + 4096);
        let text = output.text();
        assert!(text.starts_with("[...]\n") && text.ends_with("the end\n"));
        assert!(text.len() <= OUTPUT_MAX_BYTES + 6);
    }

    fn shell(script: &str) -> Process {
        let command = Command {
            run: ["/bin/sh", "-c", script].map(str::to_owned).to_vec(),
            link: false,
            env: Default::default(),
        };
        let told = Assignment {
            address: "unix:/a",
            plant: "p1",
            link_root: None,
            seed: 7,
            steps: 3,
            duration_s: 0.5,
        };
        Process::start(&command, Path::new("/"), &told).unwrap()
    }

    #[tokio::test]
    async fn a_controller_is_told_what_to_drive() {
        let mut controller = shell(
            "echo $PLANTD_ADDRESS {plant} $PLANTD_SEED >&2; echo {steps} {duration_s}; exit 3",
        );
        assert_eq!(controller.wait().await.unwrap().code(), Some(3));
        assert_eq!(controller.stop().await, "unix:/a p1 7\n3 0.5\n");
    }

    #[tokio::test]
    async fn the_children_of_a_controller_end_with_it() {
        let mut controller = shell("trap '' TERM; sleep 1000 & echo $!");
        controller.wait().await.unwrap();
        let child = loop {
            let text = controller.output.lock().unwrap().text();
            if let Ok(pid) = text.trim().parse::<i32>() {
                break Pid::from_raw(pid).unwrap();
            }
            tokio::time::sleep(Duration::from_millis(1)).await;
        };
        controller.stop().await;
        let is_alive = || {
            let stat = std::fs::read_to_string(format!("/proc/{}/stat", child.as_raw_nonzero()));
            stat.is_ok_and(|stat| !stat.contains(") Z "))
        };
        for _ in 0..1000 {
            if !is_alive() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        panic!("process {} outlives its group", child.as_raw_nonzero());
    }
}
