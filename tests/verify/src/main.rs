//! `cargo verify`: everything that must hold before a change lands, in stages.

mod python;
mod stage;
mod tools;
mod viewer;

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use stage::{Failure, Lane, Outcome, Stage, run, say};

const USAGE: &str = "\
Runs every check of the workspace.

Usage: cargo verify [--quick] [--long] [--only STAGE[,STAGE...]] [--list]

  --quick    formatting, lints and tests only
  --long     a minute for each target of the fuzzers; the server with traces, too
  --only     these stages only
  --list     print the stages
";

/// Every stage, in order: cheap ones first, so that a slip shows early; alone what measures times.
const STAGES: &[Stage] = &[
    Stage { name: "format", quick: true, lane: Lane::Main, run: format },
    Stage { name: "tools", quick: false, lane: Lane::Aside, run: tools::install_missing },
    Stage { name: "proto-lint", quick: false, lane: Lane::Aside, run: python::lint_proto },
    Stage { name: "deny", quick: false, lane: Lane::Aside, run: python::check_dependencies },
    Stage { name: "clippy", quick: true, lane: Lane::Main, run: clippy },
    Stage { name: "build", quick: true, lane: Lane::Main, run: build },
    Stage { name: "tests", quick: true, lane: Lane::Alone, run: tests },
    Stage { name: "wheel", quick: false, lane: Lane::Aside, run: python::try_wheel },
    Stage { name: "python", quick: false, lane: Lane::Aside, run: python::test_client },
    Stage { name: "book", quick: false, lane: Lane::Aside, run: python::make_book },
    Stage { name: "chart", quick: false, lane: Lane::Aside, run: python::check_chart },
    Stage { name: "robots", quick: false, lane: Lane::Aside, run: python::compare_robots },
    Stage { name: "gateway", quick: false, lane: Lane::Main, run: python::test_gateway },
    Stage { name: "store", quick: false, lane: Lane::Main, run: python::test_store },
    Stage { name: "several", quick: false, lane: Lane::Main, run: python::test_several },
    Stage { name: "viewer", quick: false, lane: Lane::Main, run: viewer::test_page },
    Stage { name: "docs", quick: false, lane: Lane::Main, run: docs },
    Stage { name: "doctests", quick: false, lane: Lane::Main, run: doctests },
    Stage { name: "stress", quick: false, lane: Lane::Main, run: stress },
    Stage { name: "traces", quick: false, lane: Lane::Main, run: traces },
    Stage { name: "fuzz", quick: false, lane: Lane::Main, run: fuzz },
    Stage { name: "demo", quick: false, lane: Lane::Main, run: demo },
    Stage { name: "windows", quick: false, lane: Lane::Alone, run: viewer::measure_page },
];

/// What the stages need to know.
#[derive(Clone)]
struct Context {
    /// Top folder of the workspace.
    root: PathBuf,
    /// Cargo's target folder.
    target: PathBuf,
    /// Whether what gets better with time gets more of it.
    is_long: bool,
    /// Whether an earlier stage found that the workspace does not build.
    broken: bool,
    /// Whether an earlier stage has built it.
    is_built: bool,
}

impl Context {
    fn cargo(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("cargo");
        command.args(arguments).current_dir(&self.root);
        command
    }

    /// A folder for what the checks themselves need.
    fn scratch(&self) -> PathBuf {
        self.target.join("verify")
    }
}

fn main() -> ExitCode {
    let (stages, is_long) = match selection(std::env::args().skip(1)) {
        Ok(Some(selected)) => selected,
        Ok(None) => return ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}\n\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let root = root.canonicalize().unwrap_or(root);
    let target = std::env::var_os("CARGO_TARGET_DIR")
        .map_or_else(|| root.join("target"), |dir| root.join(dir));
    let mut context = Context { root, target, is_long, broken: false, is_built: false };
    if stage::run_all(&stages, &mut context) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// The stages that the command line asks for, and whether for long ones; none if it only asks for help.
fn selection(
    mut arguments: impl Iterator<Item = String>,
) -> Result<Option<(Vec<&'static Stage>, bool)>, String> {
    let mut stages: Vec<&Stage> = STAGES.iter().collect();
    let mut is_long = false;
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--quick" => stages.retain(|stage| stage.quick),
            "--long" => is_long = true,
            "--only" => {
                let names = arguments.next().ok_or("--only needs a list of stages")?;
                let names: Vec<&str> = names.split(',').collect();
                if let Some(name) = names.iter().find(|n| STAGES.iter().all(|s| s.name != **n)) {
                    return Err(format!("there is no stage `{name}`"));
                }
                stages.retain(|stage| names.contains(&stage.name));
            }
            "--list" => {
                STAGES.iter().for_each(|stage| println!("{}", stage.name));
                return Ok(None);
            }
            "--help" | "-h" => {
                print!("{USAGE}");
                return Ok(None);
            }
            other => return Err(format!("unknown argument `{other}`")),
        }
    }
    Ok(Some((stages, is_long)))
}

fn format(context: &mut Context) -> Outcome {
    run(&mut context.cargo(&["fmt", "--all", "--check"]))
}

fn clippy(context: &mut Context) -> Outcome {
    let lint = ["clippy", "--workspace", "--all-targets", "--locked", "--", "-D", "warnings"];
    run(&mut context.cargo(&lint))
}

fn docs(context: &mut Context) -> Outcome {
    let mut command = context.cargo(&["doc", "--workspace", "--no-deps", "--locked"]);
    run(command.env("RUSTDOCFLAGS", "-D warnings"))
}

/// Builds all that runs at once: binaries, which the tests start, see the same features as the tests, so nothing is
/// compiled twice. That benchmarks compile is seen by the lints.
fn build(context: &mut Context) -> Outcome {
    let all = ["build", "--workspace", "--lib", "--bins", "--tests", "--examples", "--locked"];
    let built = run(&mut context.cargo(&all));
    (context.broken, context.is_built) = (built.is_err(), built.is_ok());
    built
}

fn tests(context: &mut Context) -> Outcome {
    context.must_build()?;
    let mut command = if tools::has("cargo", &["nextest", "--version"]) {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let mut command = context.cargo(&["nextest", "run", "--workspace", "--locked"]);
        command.args(["--profile", "verify", "--test-threads"]).arg((2 * processors).to_string());
        command
    } else {
        say("cargo-nextest is not installed: cargo test runs the tests");
        let mut command = context.cargo(&["test", "--workspace", "--locked", "--no-fail-fast"]);
        command.args(["--lib", "--bins", "--tests", "--examples"]);
        command
    };
    if let Some(promtool) = tools::promtool(context) {
        command.env("PROMTOOL", promtool);
    }
    run(command.env("PLANTD_BINARY_DIR", context.binaries()))
}

fn doctests(context: &mut Context) -> Outcome {
    context.must_build()?;
    run(&mut context.cargo(&["test", "--workspace", "--locked", "--doc"]))
}

/// The short form of the stress suite, about a minute.
fn stress(context: &mut Context) -> Outcome {
    context.must_build()?;
    run(Command::new(context.binaries().join("stress")).current_dir(&context.root))
}

/// The server with the feature `otlp`, which is built for nothing else.
fn traces(context: &mut Context) -> Outcome {
    context.must_build()?;
    if !context.is_long {
        return Err(Failure::Skipped("traces over OTLP: with --long".to_owned()));
    }
    let test = ["test", "--locked", "-p", "plantd-server", "--features", "otlp", "--test", "otlp"];
    run(&mut context.cargo(&test))
}

/// Feeds all that reads what comes from strangers with nonsense, for a few seconds each.
fn fuzz(context: &mut Context) -> Outcome {
    context.must_build()?;
    let seconds = if context.is_long { "60" } else { "3" };
    let mut command = Command::new(context.binaries().join("plantd-fuzz"));
    command.args(["--seconds", seconds]).arg("--failures").arg(context.target.join("fuzz"));
    run(command.current_dir(&context.root))
}

/// Shows the demo, which compares its numbers with the paper's.
fn demo(context: &mut Context) -> Outcome {
    context.must_build()?;
    let binaries = context.binaries();
    let mut command = Command::new(binaries.join("demo"));
    command.arg("--no-view").arg("--output").arg(context.scratch().join("demo-output"));
    run(command.current_dir(&context.root).env("PLANTD_BINARY_DIR", binaries))
}

impl Context {
    /// Where the build stage leaves the binaries, which the tests need not build again.
    fn binaries(&self) -> PathBuf {
        self.target.join("debug")
    }

    /// Refuses to go on after a failed build, whose errors say all there is to say.
    fn must_build(&self) -> Outcome {
        if self.broken { Err(Failure::Failed("the build failed".to_owned())) } else { Ok(()) }
    }
}
