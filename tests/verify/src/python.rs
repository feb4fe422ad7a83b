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
