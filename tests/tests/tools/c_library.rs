//! The C and C++ library, installed and compiled as a user would, against a real server over real shared
//! memory: the motion of the plant itself, and every refusal with its code.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use plantd_client::v1;
use plantd_models::Plant;
use plantd_tests::links::new_plant;
use plantd_tests::server::{ServerProcess, binary};

/// The library, installed, and a server with links.
struct Fixture {
    server: ServerProcess,
    directory: tempfile::TempDir,
    plants: u32,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../client/c")
}

#[track_caller]
fn run(command: &mut Command) -> String {
    let output = command.stdin(Stdio::null()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{command:?}: {errors}\n{text}");
    text
}

fn has(program: &str, argument: &str) -> bool {
    let status = Command::new(program).arg(argument).stdout(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

impl Fixture {
    fn new() -> Self {
        let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
        let libraries = binary("libplantd.so").unwrap();
        let mut install = Command::new(folder().join("install.sh"));
        install.arg(directory.path().join("usr")).arg(libraries.parent().unwrap());
        run(&mut install);
        let root = directory.path().join("link");
        let server = ServerProcess::start_with(|command| {
            command.arg("--link-root").arg(root);
        });
        Self { server: server.unwrap(), directory, plants: 0 }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// A new plant with an open link.
    fn plant(&mut self, model: &str) -> String {
        self.plants += 1;
        let id = format!("p{}", self.plants);
        let request = v1::CreatePlantRequest {
            id: id.clone(),
            model: model.to_owned(),
            open_link: true,
            ..Default::default()
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            self.server.client().await.create_plant(request).await.unwrap();
        });
        id
    }

    /// What pkg-config says, or what it would.
    fn flags(&self, arguments: &[&str]) -> Vec<String> {
        let packages = self.path("usr/lib/pkgconfig");
        if has("pkg-config", "--version") {
            let mut ask = Command::new("pkg-config");
            ask.args(arguments).arg("plantd").env("PKG_CONFIG_PATH", packages);
            return run(&mut ask).split_whitespace().map(str::to_owned).collect();
        }
        let at = |name| self.path(name).display().to_string();
        vec![
            format!("-I{}", at("usr/include")),
            format!("-L{}", at("usr/lib")),
            "-lplantd".to_owned(),
        ]
    }

    /// Compiles a program; returns its path.
    fn compile(&self, compiler: &[&str], source: &Path, flags: &[String]) -> PathBuf {
        let name = format!("{}-{}", compiler[0], source.file_name().unwrap().to_string_lossy());
        let program = self.path(&name);
        let mut compile = Command::new(compiler[0]);
        compile.args(&compiler[1..]).args(["-Wall", "-Wextra", "-Werror", "-pthread"]);
        compile.arg(source).arg("-o").arg(&program).args(flags);
        run(&mut compile);
        program
    }

    /// Runs a program with a new plant and the root path of its link.
    fn run(&mut self, program: &Path, model: &str, rest: &[&str]) -> String {
        let plant = self.plant(model);
        let mut command = Command::new(program);
        command.arg(plant).arg(self.path("link")).args(rest);
        run(command.env("LD_LIBRARY_PATH", self.path("usr/lib")))
    }
}

/// What the examples print.
fn expected(steps: usize) -> Vec<[u64; 3]> {
    let mut plant = new_plant("pendulum").unwrap();
    let line = |plant: &mut Plant| {
        let torque = -3.0 * plant.q()[0] - plant.p()[0];
        plant.step(&[torque]).unwrap();
        [plant.q()[0], plant.p()[0], plant.velocity()[0]].map(f64::to_bits)
    };
    (0..steps).map(|_| line(&mut plant)).collect()
}

fn printed(text: &str) -> Vec<[u64; 3]> {
    let numbers = |line: &str| -> Vec<u64> {
        line.split_whitespace().map(|word| word.parse::<f64>().unwrap().to_bits()).collect()
    };
    text.lines().map(|line| numbers(line).try_into().unwrap()).collect()
}

#[test]
fn programs_in_c_and_cpp_see_the_motion_of_the_plant_itself() {
    let mut fixture = Fixture::new();
    let (c, cpp) = (folder().join("examples/pendulum.c"), folder().join("examples/pendulum.cpp"));
    let shared = fixture.flags(&["--cflags", "--libs"]);
    let expected = expected(200);
    let mut programs = Vec::new();
    for (compiler, source) in [
        (&["cc", "-std=c11"][..], &c),
        (&["c++", "-std=c++20"], &cpp),
        (&["clang", "-std=c11"], &c),
        (&["clang++", "-std=c++20"], &cpp),
    ] {
        if has(compiler[0], "--version") {
            programs.push(fixture.compile(compiler, source, &shared));
        } else {
            println!("skipped: there is no {}", compiler[0]);
        }
    }
    assert!(programs.len() >= 2);
    for program in programs {
        let text = fixture.run(&program, "pendulum", &["200"]);
        assert_eq!(printed(&text), expected, "{}", program.display());
    }
    // With the library inside, where the shared one is not to be found.
    if has("pkg-config", "--version") {
        let mut flags = fixture.flags(&["--cflags", "--static", "--libs"]);
        flags.retain(|flag| flag != "-lplantd");
        flags.insert(0, fixture.path("usr/lib/libplantd.a").display().to_string());
        let program = fixture.compile(&["cc", "-std=c11"], &c, &flags);
        std::fs::remove_file(fixture.path("usr/lib/libplantd.so.0")).unwrap();
        let text = fixture.run(&program, "pendulum", &["200"]);
        assert_eq!(printed(&text), expected);
    }
}

#[test]
fn cmake_finds_the_library() {
    if !has("cmake", "--version") {
        println!("skipped: there is no cmake");
        return;
    }
    let mut fixture = Fixture::new();
    let build = fixture.path("build");
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(folder().join("examples")).arg("-B").arg(&build);
    run(configure.arg(format!("-DCMAKE_PREFIX_PATH={}", fixture.path("usr").display())));
    run(Command::new("cmake").arg("--build").arg(&build));
    for name in ["pendulum_c", "pendulum_cpp"] {
        let text = fixture.run(&build.join(name), "pendulum", &["50"]);
        assert_eq!(printed(&text), expected(50), "{name}");
    }
}

/// Programs that check themselves: every function, every field, every refusal that one process can cause.
#[test]
fn every_call_answers_as_the_headers_say() {
    let mut fixture = Fixture::new();
    let flags = fixture.flags(&["--cflags", "--libs"]);
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/c_library");
    for (compiler, name) in [(["cc", "-std=c11"], "calls.c"), (["c++", "-std=c++20"], "calls.cpp")]
    {
        let program = fixture.compile(&compiler, &here.join(name), &flags);
        let text = fixture.run(&program, "marionette", &[]);
        let mut plant = new_plant("marionette").unwrap();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        plant.hold_input(&mut u);
        let mut report = plant.step(&u).unwrap();
        for _ in 1..3 {
            report = plant.step(&u).unwrap();
        }
        let state = plant.state();
        let numbers = |name: &str, numbers: &[f64]| {
            let numbers = numbers.iter().map(|number| format!(" {:016x}", number.to_bits()));
            format!("{name}{}\n", numbers.collect::<String>())
        };
        let expected = [
            format!("step {}\n", state.step),
            numbers("time_s", &[plant.time_s()]),
            numbers("q", &state.q),
            numbers("p", &state.p),
            numbers("v", &state.v),
            numbers("velocity", &plant.velocity()),
            numbers("multipliers", &state.multipliers),
            numbers("x", &state.x()),
            numbers("outputs", &[]),
            numbers("lost", &[]),
            numbers("residual", &[report.residual]),
            numbers("constraint_residual", &[report.constraint_residual]),
            numbers("reciprocal_condition", &[report.reciprocal_condition]),
            numbers("constraint_reciprocal_condition", &[report.constraint_reciprocal_condition]),
            format!(
                "{} {} {} {} {}\n",
                report.iterations,
                report.factorizations,
                report.redundant_constraints,
                report.steps,
                report.halvings
            ),
        ];
        assert_eq!(text, expected.concat(), "{name}");
    }
}
