//! The page that shows plants: its bundle, and the page itself in a real browser.

use std::process::Command;

use crate::stage::{Failure, Outcome, run};
use crate::{Context, tools};

/// With this code the tests of the page say that there is no browser.
const SKIPPED: i32 = 77;

/// Builds the bundle anew and compares it with the one in the tree, then tests the page against the server.
pub(crate) fn test_page(context: &mut Context) -> Outcome {
    install(context)?;
    run(&mut at(context, "npm", &["run", "--silent", "generate"]))?;
    run(&mut at(context, "npm", &["run", "--silent", "check"]))?;
    run(&mut at(context, "node", &["build.mjs", "--check"]))?;
    test(context, "none")
}

/// Measures how fluent the page is, and whether many windows disturb a plant.
pub(crate) fn measure_page(context: &mut Context) -> Outcome {
    if !context.root.join("client/viewer/node_modules").is_dir() {
        install(context)?;
    }
    test(context, "only")
}

fn at(context: &Context, program: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(program);
    command.args(arguments).current_dir(context.root.join("client/viewer"));
    command
}

fn install(context: &Context) -> Outcome {
    context.must_build()?;
    if !tools::has("node", &["--version"]) || !tools::has("npm", &["--version"]) {
        return Err(Failure::Skipped("no node with npm: the page and its bundle".to_owned()));
    }
    run(&mut at(context, "npm", &["ci", "--no-progress", "--loglevel=error"]))
}

fn test(context: &Context, measures: &str) -> Outcome {
    context.must_build()?;
    let mut test = at(context, "node", &["test/run.mjs", "--measures", measures, "--server"]);
    match test.arg(context.binaries().join("plantd")).status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) if status.code() == Some(SKIPPED) => Err(Failure::Skipped(
            "no chromium (package chromium): the page in a browser".to_owned(),
        )),
        Ok(status) => Err(Failure::Failed(format!("the tests of the page: {status}"))),
        Err(error) => Err(Failure::Failed(format!("the tests of the page did not start: {error}"))),
    }
}
