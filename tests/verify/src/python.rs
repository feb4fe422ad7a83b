//! Checks that run in a Python environment of their own, under cargo's target folder.

use std::path::PathBuf;
use std::process::Command;

use crate::stage::{Failure, Outcome, run};
use crate::{Context, tools};

/// The linter of the contract, a binary that PyPI delivers.
const BUF: &str = "buf-bin==1.75.0";

/// Checks `proto/` against buf's STANDARD rules.
pub(crate) fn lint_proto(context: &mut Context) -> Outcome {
    let environment = environment(context)?;
    run(Command::new(environment.join("bin/pip")).args(["install", "--quiet", BUF]))?;
    let mut lint = Command::new(environment.join("bin/buf"));
    run(lint.args(["lint", "proto"]).current_dir(&context.root))
}

/// Installs the Python client, runs its tests against a real server, and checks its types.
pub(crate) fn test_client(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment(context)?;
    let mut install = Command::new(environment.join("bin/pip"));
    install.args(["install", "--quiet", "client/python[test]"]).current_dir(&context.root);
    run(&mut install)?;
    let mut test = Command::new(environment.join("bin/python"));
    test.args(["-m", "pytest", "client/python/tests"]).current_dir(&context.root);
    run(test.env("PLANTD_SERVER", context.binaries().join("plantd")))?;
    let mut types = Command::new(environment.join("bin/mypy"));
    types.args(["--config-file", "client/python/pyproject.toml", "--package", "plantd"]);
    run(types.current_dir(&context.root))
}

/// Robots and the engines that they are compared with; what cannot be had is told.
const PEERS: [(&str, &[&str], &[&str]); 3] = [
    ("robots.py", &["pin==4.1.0", "example-robot-data==6.0.0"], &["--few"]),
    ("models.py", &["mujoco==4.0.0", "dm_control", "gymnasium"], &["--few"]),
    ("units.py", &["mujoco==4.0.0"], &[]),
];

/// Imports a choice of published robots and compares them with the engines for which they were made.
pub(crate) fn compare_robots(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment(context)?;
    let pip = |packages: &[&str]| {
        let mut install = Command::new(environment.join("bin/pip"));
        run(install.args(["install", "--quiet"]).args(packages).current_dir(&context.root))
    };
    pip(&["client/python"])?;
    let mut absent = Vec::new();
    for (script, packages, flags) in PEERS {
        if pip(packages).is_err() {
            absent.push(format!("no {}: {script}", packages.join(", ")));
            continue;
        }
        let mut compare = Command::new(environment.join("bin/python"));
        compare.arg(context.root.join("tests/peers").join(script)).args(flags);
        run(compare.arg("--binaries").arg(context.binaries()).current_dir(context.scratch()))?;
    }
    if absent.is_empty() { Ok(()) } else { Err(Failure::Skipped(absent.join("; "))) }
}

/// The environment's folder; creates the environment if it is not there.
fn environment(context: &Context) -> Result<PathBuf, Failure> {
    let path = context.scratch().join("venv");
    let python = path.join("bin/python");
    let pip = ["-c", "import pip"];
    if !python.to_str().is_some_and(|python| tools::has(python, &pip)) {
        if !tools::has("python3", &["-c", "import venv, ensurepip"]) {
            let reason =
                "python3 has no venv or ensurepip; on Debian: apt-get install python3-venv";
            return Err(Failure::Failed(reason.to_owned()));
        }
        run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&path))?;
    }
    Ok(path)
}
