//! Tools beyond Rust that some checks use.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use crate::Context;
use crate::stage::{Failure, Outcome, run, say};

/// A tool, how to see that it is there, and the Debian package that brings it.
struct Tool {
    purpose: &'static str,
    probe: (&'static str, &'static [&'static str]),
    package: &'static str,
}

const TOOLS: &[Tool] = &[
    Tool {
        purpose: "instruction counts",
        probe: ("valgrind", &["--version"]),
        package: "valgrind",
    },
    Tool { purpose: "system calls of paced plants", probe: ("strace", &["-V"]), package: "strace" },
    Tool {
        purpose: "checks of the systemd unit",
        probe: ("systemd-analyze", &["--version"]),
        package: "systemd",
    },
    Tool { purpose: "the C library in CMake", probe: ("cmake", &["--version"]), package: "cmake" },
    Tool {
        purpose: "the C library as users find it",
        probe: ("pkg-config", &["--version"]),
        package: "pkg-config",
    },
    Tool {
        purpose: "the Python client's environment",
        probe: ("python3", &["-c", "import venv, ensurepip"]),
        package: "python3-venv",
    },
    Tool {
        purpose: "the page in a browser",
        probe: ("chromium", &["--version"]),
        package: "chromium",
    },
];

/// Whether the command runs and succeeds.
pub(crate) fn has(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Installs what is missing if it may; what stays missing is told, and its tests skip themselves.
pub(crate) fn install_missing(context: &mut Context) -> Outcome {
    let missing = || TOOLS.iter().filter(|tool| !has(tool.probe.0, tool.probe.1));
    if missing().next().is_some() && rustix::process::getuid().is_root() && has("apt-get", &["-v"])
    {
        let packages: Vec<&str> = missing().map(|tool| tool.package).collect();
        // Old package lists are the usual reason for a failure; a fresh list is the cure.
        let installed = apt_get(&["install"], &packages).or_else(|_| {
            apt_get(&["update"], &[])?;
            apt_get(&["install"], &packages)
        });
        if installed.is_err() {
            say(&format!("apt-get could not install {}", packages.join(", ")));
        }
    }
    let mut absent: Vec<String> = missing()
        .map(|tool| format!("no {} (package {}): {}", tool.probe.0, tool.package, tool.purpose))
        .collect();
    if promtool(context).is_none() && unpack_promtool(context).is_err() {
        absent.push("no promtool (package prometheus): dashboard and alert rules".to_owned());
    }
    if absent.is_empty() { Ok(()) } else { Err(Failure::Skipped(absent.join("; "))) }
}

/// Where the checker of alert rules is, if it is there.
pub(crate) fn promtool(context: &Context) -> Option<PathBuf> {
    let works = |path: &PathBuf| path.to_str().is_some_and(|path| has(path, &["--version"]));
    let unpacked = context.scratch().join("prometheus/usr/bin/promtool");
    [PathBuf::from("promtool"), unpacked].into_iter().find(works)
}

/// Unpacks it from Debian's package: to install that would start a Prometheus.
fn unpack_promtool(context: &Context) -> Outcome {
    let folder = context.scratch().join("prometheus");
    let script =
        "mkdir -p $0 && cd $0 && rm -f *.deb && apt-get -qq download prometheus && dpkg -x *.deb .";
    run(Command::new("sh").args(["-c", script]).arg(folder))
}

fn apt_get(verb: &[&str], packages: &[&str]) -> Outcome {
    let mut command = Command::new("apt-get");
    command.args(["-qq", "-y", "-o", "Acquire::Retries=1", "-o", "Acquire::http::Timeout=30"]);
    command.args(verb).args(packages).env("DEBIAN_FRONTEND", "noninteractive");
    run(command.stdin(Stdio::null()))
}
