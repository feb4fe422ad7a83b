//! The page that shows plants: its bundle, and the page itself in a real browser.

use std::process::Command;

use crate::stage::{Failure, Outcome, run};
use crate::{Context, tools};

/// With this code the tests of the page say that there is no browser.
const SKIPPED: i32 = 77;

/// Builds the bundle anew and compares it with the one in the tree, then tests the page against the server.
pub(crate) fn test_page(context: &mut Context) -> Outcome {
    context.must_build()?;
    if !tools::has("node", &["--version"]) || !tools::has("npm", &["--version"]) {
        return Err(Failure::Skipped("no node with npm: the page and its bundle".to_owned()));
    }
    let folder = context.root.join("client/viewer");
    let at = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).current_dir(&folder);
        command
    };
    run(&mut at("npm", &["ci", "--no-progress", "--loglevel=error"]))?;
    run(&mut at("npm", &["run", "--silent", "generate"]))?;
    run(&mut at("npm", &["run", "--silent", "check"]))?;
    run(&mut at("node", &["build.mjs", "--check"]))?;
    let server = context.binaries().join("plantd");
    let mut test = at("node", &["test/run.mjs", "--server"]);
    match test.arg(server).status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) if status.code() == Some(SKIPPED) => Err(Failure::Skipped(
            "no chromium (package chromium): the page in a browser".to_owned(),
        )),
        Ok(status) => Err(Failure::Failed(format!("the tests of the page: {status}"))),
        Err(error) => Err(Failure::Failed(format!("the tests of the page did not start: {error}"))),
    }
}
