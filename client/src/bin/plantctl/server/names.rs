//! Names that the server knows, for shells that complete them.

use std::time::Duration;

use clap::{Arg, Command};
use clap_complete::{ArgValueCandidates, CompletionCandidate};
use plantd_client::{Client, ConnectOptions, Credentials, DEFAULT_ADDRESS, Error};

/// Longest that somebody who has pressed a key waits for names.
const PATIENCE: Duration = Duration::from_millis(500);

/// The command line with names of the server as candidates: ids are those of plants, what is called `model` is a
/// model, and names of `record` are recordings.
pub(crate) fn completed(command: Command) -> Command {
    let is_record = command.get_name() == "record";
    let known = |arg: Arg| match arg.get_id().as_str() {
        "id" => arg.add(ArgValueCandidates::new(plants)),
        "model" => arg.add(ArgValueCandidates::new(models)),
        _ => arg,
    };
    command.mut_args(known).mut_subcommands(move |command| {
        let command = completed(command);
        match is_record {
            true => command.mut_args(|arg| match arg.get_id().as_str() {
                "name" => arg.add(ArgValueCandidates::new(recordings)),
                _ => arg,
            }),
            false => command,
        }
    })
}

fn plants() -> Vec<CompletionCandidate> {
    ask(async |client| {
        let plants = client.list_plants().await?;
        Ok(plants.into_iter().map(|p| candidate(p.id, p.model)).collect())
    })
}

fn models() -> Vec<CompletionCandidate> {
    ask(async |client| {
        let models = client.list_models().await?;
        Ok(models.into_iter().map(|m| candidate(m.name, m.description)).collect())
    })
}

fn recordings() -> Vec<CompletionCandidate> {
    ask(async |client| {
        let recordings = client.list_recordings().await?;
        Ok(recordings.into_iter().map(|r| candidate(r.name, r.plant)).collect())
    })
}

fn candidate(name: String, help: String) -> CompletionCandidate {
    CompletionCandidate::new(name).help((!help.is_empty()).then(|| help.into()))
}

/// What the server answers in time; without one there are no names.
fn ask(
    question: impl AsyncFnOnce(Client) -> Result<Vec<CompletionCandidate>, Error>,
) -> Vec<CompletionCandidate> {
    let address = std::env::var("PLANTD_ADDRESS").unwrap_or_else(|_| DEFAULT_ADDRESS.to_owned());
    let answer = async {
        question({
            let options =
                ConnectOptions { credentials: Credentials::from_env(), ..Default::default() };
            Client::connect_with(&address, options).await?
        })
        .await
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let Ok(runtime) = runtime else { return Vec::new() };
    match runtime.block_on(async { tokio::time::timeout(PATIENCE, answer).await }) {
        Ok(Ok(names)) => names,
        _ => Vec::new(),
    }
}
