//! Examples of gRPC clients in other languages, beside Python's, against a real server: the same bits as the
//! plant in process. Those whose tools are not there are skipped.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use plantd_models::Plant;
use plantd_tests::links::new_plant;
use plantd_tests::server::{ServerProcess, binary};

const STEPS: usize = 100;

fn has(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

#[track_caller]
fn run(command: &mut Command) -> String {
    let output = command.stdin(Stdio::null()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {errors}\n{text}");
    text
}

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name)
}

/// Runs an example, which takes the server's address and a number of steps.
fn assert_same_motion(program: &mut Command) {
    assert_same_motion_of(&ServerProcess::start().unwrap(), program);
}

fn assert_same_motion_of(server: &ServerProcess, program: &mut Command) {
    let (_, address) = server.address().split_once("://").unwrap();
    let text = run(program.arg(address).arg(STEPS.to_string()));
    let mut plant = new_plant("pendulum").unwrap();
    let step = |plant: &mut Plant| {
        let torque = -3.0 * plant.q()[0] - plant.p()[0];
        plant.step(&[torque]).unwrap();
        [plant.q()[0], plant.p()[0], plant.velocity()[0]].map(f64::to_bits).to_vec()
    };
    let expected: Vec<_> = (0..STEPS).map(|_| step(&mut plant)).collect();
    let numbers = |line: &str| -> Vec<u64> {
        line.split_whitespace().map(|word| word.parse::<f64>().unwrap().to_bits()).collect()
    };
    assert_eq!(text.lines().map(numbers).collect::<Vec<_>>(), expected);
}

#[test]
fn node() {
    if !has("node", &["--version"]) || !has("npm", &["--version"]) {
        println!("skipped: there is no node");
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    for name in ["package.json", "pendulum.js"] {
        std::fs::copy(folder("client/node").join(name), directory.path().join(name)).unwrap();
    }
    let mut install = Command::new("npm");
    install.args(["install", "--silent", "--no-audit", "--no-fund", "--no-package-lock"]);
    if !install.current_dir(directory.path()).status().is_ok_and(|status| status.success()) {
        println!("skipped: npm cannot install what the example needs");
        return;
    }
    let mut node = Command::new("node");
    node.arg(directory.path().join("pendulum.js")).env("PLANTD_PROTO", folder("proto"));
    assert_same_motion(&mut node);
}

/// With Go's packages where Debian puts them: others come over the network.
#[test]
fn go() {
    const PACKAGES: &str = "/usr/share/gocode";
    let tools = [
        ("go", &["version"][..]),
        ("protoc", &["--version"]),
        ("sh", &["-c", "command -v protoc-gen-go && command -v protoc-gen-go-grpc"]),
        ("test", &["-d", "/usr/share/gocode/src/google.golang.org/grpc"]),
    ];
    if let Some((tool, probe)) = tools.iter().find(|(tool, probe)| !has(tool, probe)) {
        println!("skipped: {tool} {} fails", probe.join(" "));
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let package = directory.path().join("src/plantd-example");
    std::fs::create_dir_all(&package).unwrap();
    let example = folder("client/go");
    std::fs::copy(example.join("pendulum.go"), package.join("pendulum.go")).unwrap();
    run(Command::new(example.join("generate.sh")).arg(&package));
    let program = directory.path().join("pendulum");
    let paths = format!("{}:{PACKAGES}", directory.path().display());
    let mut build = Command::new("go");
    build.args(["build", "-o"]).arg(&program).arg(".").current_dir(&package);
    run(build.env("GO111MODULE", "off").env("GOPATH", paths));
    assert_same_motion(&mut Command::new(program));
}

#[test]
fn cpp() {
    let tools = [
        ("cmake", &["--version"][..]),
        ("protoc", &["--version"]),
        ("sh", &["-c", "command -v grpc_cpp_plugin"]),
        ("pkg-config", &["--exists", "grpc++", "protobuf"]),
    ];
    if let Some((tool, probe)) = tools.iter().find(|(tool, probe)| !has(tool, probe)) {
        println!("skipped: {tool} {} fails", probe.join(" "));
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(folder("client/c/grpc")).arg("-B").arg(directory.path());
    run(&mut configure);
    run(Command::new("cmake").arg("--build").arg(directory.path()).args(["--parallel", "2"]));
    let program = directory.path().join("pendulum");
    assert_same_motion(&mut Command::new(&program));

    // The same with TLS and a token.
    let own = rcgen::generate_simple_self_signed(vec!["127.0.0.1".to_owned()]).unwrap();
    let path = |name: &str| directory.path().join(name);
    std::fs::write(path("own.pem"), own.cert.pem()).unwrap();
    std::fs::write(path("own.key"), own.signing_key.serialize_pem()).unwrap();
    let mut make = Command::new(binary("plantctl").unwrap());
    make.args(["token", "new", "anna", "--role", "driver", "--file"]).arg(path("tokens.toml"));
    let token = run(&mut make).trim().to_owned();
    let configuration = format!(
        "[tls]\ncertificate = \"{0}/own.pem\"\nkey = \"{0}/own.key\"\n[auth]\ntokens = \"{0}/tokens.toml\"\n",
        directory.path().display()
    );
    std::fs::write(path("plantd.toml"), configuration).unwrap();
    let server = ServerProcess::start_with(|command| {
        command.arg("--config").arg(path("plantd.toml"));
    });
    let mut program = Command::new(program);
    program.env("PLANTD_CA", path("own.pem")).env("PLANTD_TOKEN", token);
    assert_same_motion_of(&server.unwrap(), &mut program);
}
