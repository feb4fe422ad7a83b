//! A host of one plant's shared-memory link in a process of its own, for tests and measurements.
//!
//! Prints `open` when drivers can attach. Ends when its standard input does.

use std::io::Read as _;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Parser;
use plantd_proto::link::Wait;
use plantd_server::wire::link::config::LinkConfig;
use plantd_server::wire::link::host::LinkHost;
use plantd_tests::links::new_session;

/// Hosts the shared-memory link of one plant.
#[derive(Parser)]
struct Arguments {
    /// Root path of the domain.
    #[arg(long)]
    root: PathBuf,
    /// Built-in model.
    #[arg(long, default_value = "pendulum")]
    model: String,
    /// Poll all the time.
    #[arg(long)]
    poll: bool,
    /// Poll for this long before sleeping, microseconds.
    #[arg(long, default_value_t = 50, conflicts_with = "poll")]
    poll_us: u64,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let sleep = Wait::PollThenSleep(Duration::from_micros(arguments.poll_us));
    let wait = if arguments.poll { Wait::Poll } else { sleep };
    let host = LinkHost::new(LinkConfig { root: arguments.root, wait, ..LinkConfig::default() })?;
    host.open(new_session(&arguments.model)?)?;
    println!("open");
    std::io::stdin().read_to_end(&mut Vec::new())?;
    host.shutdown();
    Ok(())
}
