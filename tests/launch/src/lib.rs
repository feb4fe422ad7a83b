//! Cargo, started by programs that cargo has started itself.

use std::process::Command;

/// The cargo of the program that runs, with an environment as a person has it.
pub fn cargo() -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    leave_package(&mut command);
    command
}

/// Takes from a command what cargo tells the programs that it runs of their package. Build scripts look at the
/// same variables (that of `ring` does): with those of another package, all that stands on them is built again.
pub fn leave_package(command: &mut Command) {
    let of_package =
        |name: &str| name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_");
    for (name, _) in std::env::vars_os() {
        if name.to_str().is_some_and(of_package) {
            command.env_remove(name);
        }
    }
}
