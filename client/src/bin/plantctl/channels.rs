//! Sensors, actuators and faults of plants.

use std::fmt::Write as _;

use anyhow::{Context as _, Result};
use plantd_client::{Client, v1};
use serde_json::json;

use crate::args::{ChannelsCommand, FaultCommand};
use crate::commands::{Output, read_text};
use crate::{json, text};

/// `channels set`, `show` and `clear`.
pub(crate) async fn run(client: &Client, output: Output, command: ChannelsCommand) -> Result<()> {
    match command {
        ChannelsCommand::Set { id, file } => {
            let channels: v1::Channels = read("Channels", &read_text(&file)?)?;
            let answer = client.set_channels(id, channels).await?;
            let outputs = v1::Outputs { y: answer.y.clone(), lost: Vec::new() };
            let as_text = || declared(answer.info.as_ref(), &outputs);
            Ok(output.print(|| json::message("SetChannelsResponse", &answer), as_text)?)
        }
        ChannelsCommand::Show { id } => {
            let answer = client.get_channels(id).await?;
            let outputs = v1::Outputs { y: answer.y.clone(), lost: answer.lost.clone() };
            let as_text = || declared(answer.info.as_ref(), &outputs);
            Ok(output.print(|| json::message("GetChannelsResponse", &answer), as_text)?)
        }
        ChannelsCommand::Clear { id } => {
            let had = client.get_channels(&id).await?.info.and_then(|info| info.channels);
            client.set_channels(&id, v1::Channels::default()).await?;
            if had.is_none_or(|had| had.outputs.is_empty() && had.inputs.is_empty()) {
                output.nothing_to_do(&format!("plant `{id}` has no channels"));
            }
            Ok(output.done(json!({ "cleared": { "plant": id } }))?)
        }
    }
}

/// `fault inject`, `list` and `clear`.
pub(crate) async fn fault(client: &Client, output: Output, command: FaultCommand) -> Result<()> {
    match command {
        FaultCommand::Inject { id, fault } => {
            let fault = client.inject_fault(id, read("FaultSpec", &fault.join("\n"))?).await?;
            let as_text = || faults(std::slice::from_ref(&fault));
            Ok(output.print(|| json::message("FaultInfo", &fault), as_text)?)
        }
        FaultCommand::List { id } => {
            let all = client.list_faults(id).await?;
            let as_text = || match all.as_slice() {
                [] => "no faults\n".to_owned(),
                all => faults(all),
            };
            Ok(output.print(|| json::messages("FaultInfo", &all), as_text)?)
        }
        FaultCommand::Clear { id, fault, all: _ } => {
            let cleared = client.clear_fault(&id, fault.unwrap_or(0)).await?;
            if cleared == 0 {
                output.nothing_to_do(&format!("plant `{id}` has no faults"));
            }
            Ok(output.done(json!({ "cleared": { "plant": id, "faults": cleared } }))?)
        }
    }
}

/// Reads a message from TOML or JSON in the field names of the contract.
fn read<M: prost::Message + Default>(name: &str, text: &str) -> Result<M> {
    if text.trim_start().starts_with('{') {
        return json::read(name, text);
    }
    let table: toml::Table = toml::from_str(text)?;
    let text = serde_json::to_string(&table)?;
    json::read(name, &text).with_context(|| format!("not a {name} of the contract"))
}

/// A field of a fault on the command line as a line of TOML; text needs no quotes.
pub(crate) fn assignment(given: &str) -> Result<String, String> {
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

/// The outputs with their numbers, and the inputs, a line each.
fn declared(info: Option<&v1::ChannelsInfo>, outputs: &v1::Outputs) -> String {
    let mut text = String::new();
    let Some(v1::ChannelsInfo { channels: Some(channels), names }) = info else {
        return "no channels\n".to_owned();
    };
    let _ = writeln!(text, "seed {}", channels.seed);
    for (name, y) in names.iter().zip(&outputs.y) {
        let _ = writeln!(text, "output  {name:<24} {}", text::numbers(&[*y]));
    }
    for index in &outputs.lost {
        let name = channels.outputs.get(*index as usize).map_or("", |output| &output.name);
        let _ = writeln!(text, "lost    {name}");
    }
    for input in &channels.inputs {
        let _ = writeln!(text, "input   {:<24} {} s late", input.input, input.delay_s);
    }
    text
}

/// What a watcher sees of the outputs.
pub(crate) fn outputs(outputs: &v1::Outputs) -> String {
    let mut text = format!("  y: {}\n", text::numbers(&outputs.y));
    if !outputs.lost.is_empty() {
        let _ = writeln!(text, "  lost: {:?}", outputs.lost);
    }
    text
}

/// Faults, a line each.
fn faults(faults: &[v1::FaultInfo]) -> String {
    let mut text = String::new();
    for info in faults {
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
            time_s => format!("for {time_s} s"),
        };
        let phase = match info.phase() {
            v1::FaultPhase::Unspecified => "",
            v1::FaultPhase::Waiting => "waiting",
            v1::FaultPhase::Active => "active",
            v1::FaultPhase::Paused => "paused",
            v1::FaultPhase::Over => "over",
        };
        let _ = writeln!(
            text,
            "{:>4}  {phase:<8} {kind:<11} {target:<16} from step {start} {length}",
            info.id
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(fields: &[&str]) -> Result<v1::FaultSpec> {
        let lines: Vec<String> = fields.iter().map(|field| assignment(field).unwrap()).collect();
        read("FaultSpec", &lines.join("\n"))
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

    #[test]
    fn channels_are_read_from_toml_and_json() {
        let toml = "seed = 7\n[[outputs]]\nname = \"angle\"\ncoordinate = \"theta\"\nnoise = 0.1\n\
                    [[inputs]]\ninput = \"tau\"\ndelay_s = 0.02\nhold = \"HOLD_FIRST_ORDER\"";
        let channels: v1::Channels = read("Channels", toml).unwrap();
        assert_eq!((channels.seed, channels.outputs[0].noise), (7, 0.1));
        assert_eq!(channels.inputs[0].hold(), v1::Hold::FirstOrder);
        let text = json::message("Channels", &channels).to_string();
        assert_eq!(read::<v1::Channels>("Channels", &text).unwrap(), channels);
    }
}
