//! What the tests of plantd share: servers, links, reference data.

pub mod links;
pub mod reference;
pub use plantd_process as server;

use std::path::PathBuf;
use std::sync::OnceLock;

/// An example of the workspace, built in the profile of the running test, with the binaries: so Cargo sees the same
/// dependencies as for these and builds none of them a second time.
/// The environment variable `PLANTD_BINARY_DIR` names the directory above ready ones instead.
///
/// # Panics
/// If they do not build.
pub fn example(name: &str) -> PathBuf {
    if let Some(directory) = std::env::var_os("PLANTD_BINARY_DIR") {
        return PathBuf::from(directory).join("examples").join(name);
    }
    static DIRECTORY: OnceLock<PathBuf> = OnceLock::new();
    let directory = DIRECTORY.get_or_init(|| {
        let program = std::env::current_exe().unwrap();
        let directory = program.ancestors().nth(2).unwrap();
        let profile = match directory.file_name().and_then(|name| name.to_str()) {
            Some("debug") => "dev",
            other => other.unwrap(),
        };
        let status = plantd_launch::cargo()
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["build", "--quiet", "--workspace", "--bins", "--examples"])
            .args(["--profile", profile, "--target-dir"])
            .arg(directory.parent().unwrap())
            .status()
            .unwrap();
        assert!(status.success(), "cannot build the examples");
        directory.join("examples")
    });
    directory.join(name)
}
