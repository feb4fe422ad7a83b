//! `plantctl`: looks at, drives and asks a plantd server from a shell.

mod commands;
mod contract;
mod figure;
mod input;
mod output;
mod report;
mod scenario;
mod server;
mod trial;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::{CommandFactory as _, Parser, Subcommand};
use clap_complete::CompleteEnv;
use plantd_client::Credentials;

use crate::commands::{
    analyze, channels, create, diagnose, dynamics, events, export, fault, feedback, fmu, guard,
    health, import, inventory, kalman, linearize, lqr, mechanics, optimize, parameters, plot,
    record, reference, render, replay, run, scene, servers, settle, shell, state, step, test,
    timing, token, top, view, watch,
};
use crate::output::failure;
use crate::output::printer::{self, Format, Output};
use crate::server::context::Context;
use crate::server::known::{KnownServer, read_token};
use crate::server::names;

const EXAMPLES: &str = "\
Examples:
  plantctl list                                     models and plants of the server
  plantctl create pendulum --id p1 --at upright     a plant at a named operating point
  plantctl step p1 --u 0.1 --count 100              100 steps with the input 0.1
  plantctl watch p1 --fields state,energy --json    one JSON object per step
  plantctl linearize cart-pole --at upright         A and B of x[k+1] = f(x[k], u[k])
  plantctl kinematics cart-pole --q 0,0.3 --frames pole
  plantctl forces cart-pole --at upright --acceleration 1,0
  plantctl lqr cart-pole --at upright --q 100,1,1,1 --r 0.1
  plantctl analyze cart-pole --at hanging --outputs theta --frequencies 0.1,0.5,1
  plantctl optimize swing-up.toml --save best.json  one line per iteration, then the result
  plantctl kalman cart-pole --at upright --outputs x,theta --measurement 1e-4 --process 1e-6
  plantctl set-parameter p1 'frames[pole].body.mass=1.2'
  plantctl feedback set p1 --at upright --q 100,1 --r 1 --mode replace
  plantctl channels set p1 sensors.toml             sensors and actuators of a plant
  plantctl fault inject p1 input=tau stuck=true start_s=2 duration_s=0.5
  plantctl settle four-bar --guess crank=0.3 --toml  an operating point to paste into the scene
  plantctl validate arm.toml                        all errors of a scene, with their paths
  plantctl import arm.urdf > arm.toml               a robot as a scene, and what became of the file
  plantctl fmu arm.toml -o arm.fmu                  the plant for Simulink, Dymola, FMPy (FMI 3.0)
  plantctl record start p1 --name trial             then `record stop trial`, `record get trial`
  plantctl replay trial.mcap                        the same steps again, compared bit for bit
  plantctl export trial.mcap --csv trial.csv
  plantctl top                                      rates, drivers and lateness of all plants
  plantctl plot trial.mcap q.theta u.tau            in the terminal; --out plot.svg draws a picture
  plantctl view trial.mcap                          in the browser; `view p1` shows a plant
  plantctl render trial.mcap --out trial.gif        a film for documents; .png is a picture
  plantctl test scenarios --junit junit.xml         scenarios with their expectations
  plantctl move p1 --to http://plantd-2:50051       a plant to another server; it goes on bit for bit
  plantctl drain                                    the server takes nothing new, and ends
  plantctl token new anna --role driver --tenant lab --file tokens.toml
  plantctl --on lab list                            a server of ~/.config/plantd/servers.toml
  plantctl --address unix:/run/plantd/plantd.sock list plants";

const EXIT_CODES: &str = "\
Data goes to standard output, messages to standard error. Colours are for terminals; NO_COLOR=1 turns them off.
Vectors are numbers in the contract's order, or some of them by name: --q theta=0.1,x=0.

Exit codes:
  0  done; where things already were as asked for, a message says so
  1  refused by the server, or failed; `validate`: the scene has errors; `replay`: a step differs;
     `health`: it does not serve;
     `run --wait`: something else has stopped the plant
  2  wrong usage
  3  no server at the address
  4  `optimize`: the search stopped before it converged; what it found is printed, and saved if asked for";

/// Looks at, drives and asks a plantd server.
#[derive(Debug, Parser)]
#[command(name = "plantctl", version, before_help = EXAMPLES, after_help = EXIT_CODES, max_term_width = 100)]
struct Args {
    /// Server: http://host:port, https://host:port or unix:/path.
    /// http://127.0.0.1:50051 if not given; `test` then starts a server of its own.
    #[arg(long, global = true, env = "PLANTD_ADDRESS")]
    address: Option<String>,
    /// Server by its name in ~/.config/plantd/servers.toml, which has address, token, ca, cert and key.
    #[arg(long, global = true, value_name = "NAME", conflicts_with = "address")]
    on: Option<String>,
    /// Token with which the server knows you; the environment does not show it to others, a command line does.
    #[arg(long, global = true, env = "PLANTD_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// File with that token.
    #[arg(long, global = true, value_name = "FILE", env = "PLANTD_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// CA of the server's certificate, PEM; the system's CAs if not given.
    #[arg(long, global = true, value_name = "FILE", env = "PLANTD_CA")]
    ca: Option<PathBuf>,
    /// Certificate of your own, PEM.
    #[arg(long, global = true, value_name = "FILE", env = "PLANTD_CERT")]
    cert: Option<PathBuf>,
    /// Key of that certificate, PEM.
    #[arg(long, global = true, value_name = "FILE", env = "PLANTD_KEY")]
    key: Option<PathBuf>,
    /// How results are written.
    #[arg(
        long,
        global = true,
        value_enum,
        value_name = "FORMAT",
        default_value_t,
        env = "PLANTD_OUTPUT"
    )]
    output: Format,
    /// The same as `--output json`.
    #[arg(long, global = true, conflicts_with = "output")]
    json: bool,
    /// Do not say in a line what has been done.
    #[arg(long, short = 'q', global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    List(inventory::List),
    Show(inventory::Show),
    Upload(scene::Upload),
    Import(import::Import),
    Fmu(fmu::Fmu),
    Create(create::Create),
    Step(step::Step),
    Watch(watch::Watch),
    Linearize(linearize::Linearize),
    Lqr(lqr::Lqr),
    SecondOrder(linearize::SecondOrder),
    Dynamics(dynamics::Dynamics),
    Forces(mechanics::Forces),
    Kinematics(mechanics::Kinematics),
    Analyze(analyze::Analyze),
    Optimize(optimize::Optimize),
    ProjectReference(reference::ProjectReference),
    Kalman(kalman::Kalman),
    SetParameter(parameters::SetParameter),
    Feedback(feedback::Feedback),
    Channels(channels::Channels),
    Run(run::Run),
    Pause(run::Pause),
    Guard(guard::Guard),
    Timing(timing::Timing),
    Events(events::Events),
    Fault(fault::Fault),
    Gains(feedback::Gains),
    Settle(settle::Settle),
    Diagnose(diagnose::Diagnose),
    Validate(scene::Validate),
    Explain(scene::Explain),
    Record(record::Record),
    Replay(replay::Replay),
    Export(export::Export),
    Plot(plot::Plot),
    View(view::View),
    Render(render::Render),
    Reset(state::Reset),
    Snapshot(state::Snapshot),
    Restore(state::Restore),
    Test(test::Test),
    Delete(inventory::Delete),
    Top(top::Top),
    Health(health::Health),
    Server(servers::Server),
    Drain(servers::Drain),
    Move(servers::Move),
    Adopt(servers::Adopt),
    Token(token::Token),
    Completions(shell::Completions),
    Man(shell::Man),
}

fn main() -> ExitCode {
    // A shell that asks for completions gets them, and nothing else happens.
    let command_line = || names::completed(Args::command());
    CompleteEnv::with_factory(command_line).var(shell::ASKED_BY).complete();
    answer(Args::parse())
}

#[tokio::main(flavor = "current_thread")]
async fn answer(args: Args) -> ExitCode {
    let is_json = args.json || args.output == Format::Json;
    let outcome = async {
        let (command, mut context) = args.resolve()?;
        let follows = command.is_of_one_plant();
        match run(command, &context).await {
            Err(error) if follows && context.follow(&error).await? => {
                let (command, _) = Args::parse().resolve()?;
                run(command, &context).await
            }
            outcome => outcome,
        }
    };
    match outcome.await {
        Ok(code) => code,
        // Whoever reads our output has seen enough (`plantctl watch ... | head`).
        Err(error) if failure::is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            if is_json {
                eprintln!("{}", failure::as_json(&error));
            } else {
                printer::complain(&error);
            }
            ExitCode::from(failure::code(&error))
        }
    }
}

impl Command {
    /// What it does is of one plant, so that it has done nothing where that plant is not.
    fn is_of_one_plant(&self) -> bool {
        !matches!(self, Self::Delete(_) | Self::Test(_))
    }
}

impl Args {
    /// What is to be done, and where: flags and environment variables win over the file of servers.
    fn resolve(self) -> Result<(Command, Context)> {
        let Self { address, on, token, token_file, ca, cert, key, output, json, quiet, command } =
            self;
        let format = if json { Format::Json } else { output };
        let known = on.map(|name| KnownServer::named(&name)).transpose()?;
        let there = known.as_ref().map(KnownServer::credentials).transpose()?.unwrap_or_default();
        let token = match (token, token_file) {
            (None, Some(path)) => Some(read_token(&path)?),
            (token, _) => token,
        };
        let credentials = Credentials {
            token: token.or(there.token),
            ca: ca.or(there.ca),
            cert: cert.or(there.cert),
            key: key.or(there.key),
        };
        let address = address.or(known.map(|known| known.address));
        Ok((command, Context { address, credentials, output: Output::new(format, quiet) }))
    }
}

/// Runs a command; the code is that of a command which ran.
async fn run(command: Command, context: &Context) -> Result<ExitCode> {
    match command {
        Command::List(command) => command.run(context).await?,
        Command::Show(command) => command.run(context).await?,
        Command::Upload(command) => command.run(context).await?,
        Command::Import(command) => command.run(context)?,
        Command::Fmu(command) => command.run(context).await?,
        Command::Create(command) => command.run(context).await?,
        Command::Step(command) => command.run(context).await?,
        Command::Watch(command) => command.run(context).await?,
        Command::Linearize(command) => command.run(context).await?,
        Command::Lqr(command) => command.run(context).await?,
        Command::SecondOrder(command) => command.run(context).await?,
        Command::Dynamics(command) => command.run(context).await?,
        Command::Forces(command) => command.run(context).await?,
        Command::Kinematics(command) => command.run(context).await?,
        Command::Analyze(command) => command.run(context).await?,
        Command::Optimize(command) => command.run(context).await?,
        Command::ProjectReference(command) => command.run(context).await?,
        Command::Kalman(command) => command.run(context).await?,
        Command::SetParameter(command) => command.run(context).await?,
        Command::Feedback(command) => command.run(context).await?,
        Command::Channels(command) => command.run(context).await?,
        Command::Run(command) => command.run(context).await?,
        Command::Pause(command) => command.run(context).await?,
        Command::Guard(command) => command.run(context).await?,
        Command::Timing(command) => command.run(context).await?,
        Command::Events(command) => command.run(context).await?,
        Command::Fault(command) => command.run(context).await?,
        Command::Gains(command) => command.run(context).await?,
        Command::Settle(command) => command.run(context).await?,
        Command::Diagnose(command) => command.run(context).await?,
        Command::Validate(command) => return command.run(context).await,
        Command::Explain(command) => return command.run(context).await,
        Command::Record(command) => command.run(context).await?,
        Command::Replay(command) => return command.run(context).await,
        Command::Export(command) => command.run(context)?,
        Command::Plot(command) => command.run(context)?,
        Command::View(command) => command.run(context).await?,
        Command::Render(command) => command.run(context).await?,
        Command::Reset(command) => command.run(context).await?,
        Command::Snapshot(command) => command.run(context).await?,
        Command::Restore(command) => command.run(context).await?,
        Command::Test(command) => return command.run(context).await,
        Command::Delete(command) => command.run(context).await?,
        Command::Top(command) => command.run(context).await?,
        Command::Health(command) => return command.run(context).await,
        Command::Server(command) => command.run(context).await?,
        Command::Drain(command) => command.run(context).await?,
        Command::Move(command) => command.run(context).await?,
        Command::Adopt(command) => command.run(context).await?,
        Command::Token(command) => command.run(context)?,
        Command::Completions(command) => command.run()?,
        Command::Man(command) => command.run(Args::command(), &context.output)?,
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Args::command().debug_assert();
    }
}
