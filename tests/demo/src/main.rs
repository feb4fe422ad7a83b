//! `cargo demo`: a real server, controllers in processes of their own, a page that shows them, and the
//! numbers of the paper.
//!
//! The director (this process without a subcommand) starts `plantd`, starts one controller after
//! the other (this program again, with the subcommand `controller`), and compares what they report
//! with the paper and its reference implementation. Controllers know the server's address alone.

mod controller;
mod director;
mod latency;
mod marionette;
mod pendulum;
mod plots;
mod report;
mod show;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Stabilises the paper's pendulum and the 40-coordinate marionette from outside a running plantd
/// server, over gRPC and over shared memory, and compares with the paper.
#[derive(Parser)]
#[command(
    name = "cargo demo",
    max_term_width = 100,
    after_help = "Ends with code 0 if every number is as it should be."
)]
struct Arguments {
    /// Folder for plots and results.
    #[arg(long, value_name = "FOLDER", default_value = "demo-output")]
    output: PathBuf,
    /// Show nothing in a browser: run, print the numbers, and end.
    #[arg(long)]
    no_view: bool,
    #[command(subcommand)]
    role: Option<Role>,
}

#[derive(Subcommand)]
enum Role {
    /// Runs one controller against a running server; prints events as lines of JSON.
    Controller {
        /// Which one.
        controller: controller::Name,
        /// Address of the server, `http://host:port` or `unix:/path`.
        #[arg(long)]
        address: String,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let outcome = match arguments.role {
        None => director::run(&arguments.output, !arguments.no_view),
        Some(Role::Controller { controller, address }) => {
            controller::run(controller, &address).map(|()| true)
        }
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
