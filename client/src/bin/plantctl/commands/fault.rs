//! `fault`: what goes wrong on a plant.

use anyhow::Result;
use clap::{Args, Subcommand};
use plantd_client::v1;
use serde_json::json;

use crate::contract::json;
use crate::input::files::parse_message;
use crate::output::page::{Cell, Page, Table, table};
use crate::server::context::Context;

const FAULTS: &str = "\
Examples:
  plantctl fault inject p1 input=tau stuck=true
  plantctl fault inject p1 input=tau offset.value=0.3 start_s=2 duration_s=0.5
  plantctl fault inject p1 output=encoder noise.deviation=0.05 chance.window_s=1 chance.probability=0.2
  plantctl fault inject p1 output=encoder loss.probability=0.1
  plantctl fault inject p1 push.point.frame=rod 'push.force=[5, 0, 0]' start_step=100 duration_s=0.1
  plantctl fault inject p1 'parameters.parameters=[{path=\"gravity[1]\", value=-1.6}]' start_s=3
  plantctl fault list p1
  plantctl fault clear p1 3";

/// Lets something go wrong on a plant.
#[derive(Debug, Args)]
#[command(after_help = FAULTS)]
pub(crate) struct Fault {
    #[command(subcommand)]
    command: FaultCommand,
}

#[derive(Debug, Subcommand)]
enum FaultCommand {
    /// Injects a fault; it begins with the next step if no start is given.
    #[command(after_help = FAULTS)]
    Inject {
        /// Plant.
        id: String,
        /// Fields of the fault, in the names of the contract.
        #[arg(value_name = "FIELD=VALUE", value_parser = assignment, required = true)]
        fault: Vec<String>,
    },
    /// Lists the faults.
    List {
        /// Plant.
        id: String,
    },
    /// Ends a fault.
    Clear {
        /// Plant.
        id: String,
        /// Its number.
        #[arg(required_unless_present = "all")]
        fault: Option<u64>,
        /// All faults.
        #[arg(long, conflicts_with = "fault")]
        all: bool,
    },
}

impl Fault {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let output = &context.output;
        match self.command {
            FaultCommand::Inject { id, fault } => {
                let said = format!("the fault of plant `{id}` has the number");
                let fault = parse_message("FaultSpec", &fault.join("\n"))?;
                let fault = client.inject_fault(id, fault).await?;
                output.success(&format!("{said} {}", fault.id));
                let as_text = || faults(std::slice::from_ref(&fault));
                output.message("FaultInfo", &fault, as_text)
            }
            FaultCommand::List { id } => {
                let all = client.list_faults(id).await?;
                let as_text = || match all.as_slice() {
                    [] => Page::from("no faults\n".to_owned()),
                    all => faults(all).into(),
                };
                output.print(|| json::messages("FaultInfo", &all), as_text)
            }
            FaultCommand::Clear { id, fault, all: _ } => {
                let cleared = client.clear_fault(&id, fault.unwrap_or(0)).await?;
                if cleared == 0 {
                    output.nothing_to_do(&format!("plant `{id}` has no faults"));
                }
                let said = match cleared {
                    1 => format!("a fault of plant `{id}` has ended"),
                    count => format!("{count} faults of plant `{id}` have ended"),
                };
                let cleared_json = json!({ "cleared": { "plant": id, "faults": cleared } });
                output.confirm(cleared > 0, cleared_json, &said)
            }
        }
    }
}

/// A field of a fault on the command line as a line of TOML; text needs no quotes.
fn assignment(given: &str) -> Result<String, String> {
    let (name, value) = given.split_once('=').ok_or("a field and a value with `=` are needed")?;
    let (name, value) = (name.trim(), value.trim());
    let line = format!("{name} = {value}");
    if toml::from_str::<toml::Table>(&line).is_ok() {
        return Ok(line);
    }
    let quoted = format!("{name} = {}", toml::Value::String(value.to_owned()));
    toml::from_str::<toml::Table>(&quoted).map_err(|error| error.message().to_owned())?;
    Ok(quoted)
}

/// Faults, a row each.
fn faults(faults: &[v1::FaultInfo]) -> Table {
    let row = |info: &v1::FaultInfo| {
        let fault = info.fault.clone().unwrap_or_default();
        use v1::fault_spec::{Kind, Start, Target};
        let target = match &fault.target {
            Some(Target::Input(name) | Target::Output(name)) => name.as_str(),
            None => "",
        };
        let kind = match fault.kind {
            Some(Kind::Stuck(_)) => "stuck",
            Some(Kind::Off(_)) => "off",
            Some(Kind::WrongSign(_)) => "wrong sign",
            Some(Kind::Offset(_)) => "offset",
            Some(Kind::Noise(_)) => "noise",
            Some(Kind::Delay(_)) => "delay",
            Some(Kind::Loss(_)) => "loss",
            Some(Kind::Push(_)) => "push",
            Some(Kind::Parameters(_)) => "parameters",
            None => "",
        };
        let start = match fault.start {
            Some(Start::StartStep(step)) => step,
            _ => 0,
        };
        let length = match fault.duration_s {
            0.0 => "until cleared".to_owned(),
            time_s => format!("{time_s} s"),
        };
        let phase = match info.phase() {
            v1::FaultPhase::Unspecified => "",
            v1::FaultPhase::Waiting => "waiting",
            v1::FaultPhase::Active => "active",
            v1::FaultPhase::Paused => "paused",
            v1::FaultPhase::Over => "over",
        };
        let (id, start, length) = (info.id.to_string(), start.to_string(), length.as_str());
        [id.as_str(), phase, kind, target, start.as_str(), length].map(Cell::from).to_vec()
    };
    table(&["fault", "phase", "kind", "target", "from step", "for"], faults.iter().map(row))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(fields: &[&str]) -> Result<v1::FaultSpec> {
        let lines: Vec<String> = fields.iter().map(|field| assignment(field).unwrap()).collect();
        parse_message("FaultSpec", &lines.join("\n"))
    }

    #[test]
    fn a_fault_is_written_field_by_field() {
        use v1::fault_spec::{Kind, Target};
        let stuck = fault(&["input=tau", "stuck=true", "duration_s=0.5"]).unwrap();
        assert_eq!(stuck.target, Some(Target::Input("tau".to_owned())));
        assert_eq!((stuck.kind, stuck.duration_s), (Some(Kind::Stuck(true)), 0.5));
        let push =
            fault(&["push.point.frame=upper arm", "push.force=[1, 0, -2.5]", "start_s=2"]).unwrap();
        let Some(Kind::Push(push)) = push.kind else { panic!("{push:?}") };
        assert_eq!(push.point.unwrap().frame, "upper arm");
        assert_eq!(push.force, [1.0, 0.0, -2.5]);
        assert!(fault(&["colour=red"]).is_err());
        assert!(assignment("stuck").is_err());
    }
}
