//! `plantctl`: looks at, drives and asks a plantd server from a shell.

mod args;
mod channels;
mod commands;
mod feedback;
mod json;
mod optimize;
mod own_server;
mod replay;
mod run;
mod test;
mod text;

use std::process::ExitCode;

use clap::Parser as _;
use plantd_client::Error;

/// The server refused, a stream broke, or a file could not be read or written.
const FAILED: u8 = 1;
/// What was asked for makes no sense; clap's code for it.
const WRONG_USAGE: u8 = 2;
/// There is no server at the address.
const NO_SERVER: u8 = 3;
/// A search ended before it converged; what it found is there.
const STOPPED_EARLY: u8 = 4;

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    let args = args::Args::parse();
    let as_json = args.json;
    match commands::run(args).await {
        Ok(code) => code,
        // Whoever reads our output has seen enough (`plantctl watch ... | head`).
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            if as_json {
                eprintln!("{}", json::error(&error));
            } else {
                eprintln!("plantctl: {error:#}");
            }
            ExitCode::from(code(&error))
        }
    }
}

fn code(error: &anyhow::Error) -> u8 {
    match error.downcast_ref::<Error>() {
        Some(Error::Address { .. }) => WRONG_USAGE,
        Some(Error::Connect { .. }) => NO_SERVER,
        _ if error.is::<optimize::SearchStopped>() => STOPPED_EARLY,
        _ => FAILED,
    }
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error
        .downcast_ref::<std::io::Error>()
        .is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}
