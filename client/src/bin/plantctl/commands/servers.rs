//! `server`, `drain`, `move` and `adopt`: servers among others.

use anyhow::{Result, ensure};
use clap::Args;
use plantd_client::v1;
use serde_json::json;

use crate::output::page::table;
use crate::server::context::Context;
use crate::server::known::KnownServer;

/// Says which server this is: its name, where clients reach it, its build.
#[derive(Debug, Args)]
pub(crate) struct Server {}

/// Lets the server end: it takes nothing new, plants that are driven go on for a while, and all are saved where it has
/// a state directory. Answers at once; a second signal to the server's process would end it at once.
#[derive(Debug, Args)]
pub(crate) struct Drain {
    /// Longest time for which plants may still be driven; the server's own `drain_s` if not given.
    #[arg(long, value_name = "SECONDS")]
    drain_s: Option<f64>,
}

const MOVE: &str = "\
Examples:
  plantctl move p1 --to https://plantd-2.lab:50051
  plantctl move p1 --to lab-2                       a server of ~/.config/plantd/servers.toml

The plant goes with its model, numbers, state, channels, faults, feedback and watchdogs, and with how it is run; bit
for bit on a server of the same build. Its lease, watchers, events, counts of timing and recordings stay behind.
Whoever asks the old server for it is told where it is.";

/// Moves a plant to another server, where it goes on as it was.
#[derive(Debug, Args)]
#[command(after_help = MOVE)]
pub(crate) struct Move {
    /// Plant.
    id: String,
    /// The other server: its address, or its name in ~/.config/plantd/servers.toml.
    #[arg(long, value_name = "SERVER")]
    to: String,
    /// Also to a server of another build, where its motion has other round-off.
    #[arg(long)]
    any_build: bool,
}

const ADOPT: &str = "\
Example:
  plantctl --address https://plantd-1.lab:50051 adopt --from plantd-3

For servers that keep their plants in an object store (`state_directory = \"s3://...\"`). Plants of a server that ended
in good order need no such call: they come to whoever is asked for them. Should the lost server live after all, it
closes these plants as soon as it wants to save them.";

/// Takes the plants of a server over that is lost, onto the server that is asked.
#[derive(Debug, Args)]
#[command(after_help = ADOPT)]
pub(crate) struct Adopt {
    /// Name of the lost server.
    #[arg(long, value_name = "NAME")]
    from: String,
}

impl Server {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let server = context.connect().await?.server_info().await?;
        let as_json = || {
            json!({
                "name": server.name,
                "address": server.address,
                "version": server.version,
                "build": server.build,
                "draining": server.draining,
                "plants": server.plants,
            })
        };
        let rows = || {
            let draining = if server.draining { "yes" } else { "no" };
            let plants = server.plants.to_string();
            let row = vec![&server.name[..], &server.address, &plants, draining, &server.build];
            table(&["name", "address", "plants", "draining", "build"], [row])
        };
        context.output.print(as_json, rows)
    }
}

impl Drain {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let name = client.server_info().await?.name;
        let driven = client.drain(self.drain_s).await?;
        let waits = match driven {
            0 => "takes nothing new, and ends: nobody drives a plant".to_owned(),
            1 => "takes nothing new; one plant is driven".to_owned(),
            _ => format!("takes nothing new; {driven} plants are driven"),
        };
        let as_json = json!({ "server": name, "driven": driven });
        context.output.done(as_json, &format!("server `{name}` {waits}"))
    }
}

impl Move {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let here = context.connect().await?;
        let there = match self.to.contains(':') {
            true => here.at(&self.to).await?,
            false => {
                let known = KnownServer::named(&self.to)?;
                context.connect_as(&known.address, known.credentials()?).await?
            }
        };
        let plant = here.move_plant(&self.id, &there, self.any_build).await?;
        let step = plant.state.as_ref().map_or(0, |state| state.step);
        let as_json = json!({
            "id": plant.id, "step": step, "server": plant.server, "address": plant.address,
        });
        let sentence = format!(
            "plant `{}` is on server `{}` now, {}, at step {step}",
            plant.id, plant.server, plant.address
        );
        context.output.done(as_json, &sentence)
    }
}

impl Adopt {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let adopted = client.adopt_plants(&self.from).await?;
        let lost = |lost: &v1::LostPlant| json!({ "id": lost.id, "problem": lost.problem });
        let as_json = json!({
            "plants": adopted.plants,
            "lost": adopted.lost.iter().map(lost).collect::<Vec<_>>(),
        });
        let sentence = match &adopted.plants[..] {
            [] => format!("server `{}` has left no plants to take", self.from),
            plants => format!("{} here now: {}", counted(plants.len()), plants.join(", ")),
        };
        context.output.done(as_json, &sentence)?;
        let problem = |lost: &v1::LostPlant| format!("\n  {}: {}", lost.id, lost.problem);
        let problems: String = adopted.lost.iter().map(problem).collect();
        let count = counted(adopted.lost.len());
        ensure!(problems.is_empty(), "{count} not taken, and left as they were:{problems}");
        Ok(())
    }
}

fn counted(plants: usize) -> String {
    if plants == 1 { "one plant is".to_owned() } else { format!("{plants} plants are") }
}
