//! The `plantd` server binary.

use std::process::ExitCode;

use anyhow::Result;
use clap::Parser as _;
use plantd_server::cli::{Cli, Command, Settings};
use plantd_server::core::limits::Limits;
use plantd_server::daemon;

fn main() -> ExitCode {
    match run(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("plantd: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<()> {
    match command {
        Command::Serve(settings) => serve(*settings),
        Command::Limits(settings) => {
            print_limits(&settings.resolve()?.limits);
            Ok(())
        }
    }
}

fn serve(settings: Settings) -> Result<()> {
    let (print_config, until_stdin_ends) = (settings.print_config, settings.until_stdin_ends);
    let config = settings.resolve()?;
    if print_config {
        print!("{}", config.to_toml()?);
        return Ok(());
    }
    daemon::serve(config, until_stdin_ends)
}

fn print_limits(limits: &Limits) {
    println!("{:<24} {:>14}  MEANING", "LIMIT", "VALUE");
    for limit in limits.table() {
        println!("{:<24} {:>14}  {}", limit.name, limit.value, limit.meaning);
    }
}
