//! `list`, `show` and `delete`: the models and plants of the server.

use std::fmt::Write as _;

use anyhow::Result;
use clap::{Args, ValueEnum};
use plantd_client::{Client, Code, v1};
use serde_json::{Map, Value, json};

use crate::contract::json;
use crate::output::page::Page;
use crate::output::printer::Output;
use crate::output::text::number;
use crate::output::{model, plant};
use crate::server::context::Context;

/// Lists models, plants, or both.
#[derive(Debug, Args)]
pub(crate) struct List {
    /// What to list; both if not given.
    what: Option<Plural>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Plural {
    Models,
    Plants,
}

/// Shows one model or plant.
#[derive(Debug, Args)]
pub(crate) struct Show {
    /// What it is.
    what: Singular,
    /// Name of the model or id of the plant.
    name: String,
}

/// Deletes a plant or an uploaded model, or all of them.
#[derive(Debug, Args)]
pub(crate) struct Delete {
    /// What it is.
    what: Singular,
    /// Name of the model or id of the plant.
    #[arg(required_unless_present = "all", conflicts_with = "all")]
    name: Option<String>,
    /// All plants, or all uploaded models.
    #[arg(long)]
    all: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Singular {
    Model,
    Plant,
}

impl List {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let models = match self.what {
            Some(Plural::Plants) => None,
            _ => Some(client.list_models().await?),
        };
        let plants = match self.what {
            Some(Plural::Models) => None,
            _ => Some(client.list_plants().await?),
        };
        let as_json = || {
            let mut object = Map::new();
            if let Some(models) = &models {
                object.insert("models".to_owned(), json::messages("Model", models));
            }
            if let Some(plants) = &plants {
                object.insert("plants".to_owned(), json::messages("PlantInfo", plants));
            }
            Value::Object(object)
        };
        let as_text = || {
            let mut page = Page::default();
            models.iter().for_each(|models| page.next_table(model::list(models)));
            plants.iter().for_each(|plants| page.next_table(plant::list(plants)));
            page
        };
        context.output.print(as_json, as_text)
    }
}

impl Show {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        match self.what {
            Singular::Model => {
                let model = client.get_model(self.name).await?;
                context.output.message("Model", &model, || model::known(&model))
            }
            Singular::Plant => show_plant(&client, context, self.name).await,
        }
    }
}

impl Delete {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Some(name) = self.name else {
            return self.what.delete_all(&client, &context.output).await;
        };
        let kind = match self.what {
            Singular::Model => {
                client.delete_model(&name).await?;
                "model"
            }
            Singular::Plant => {
                client.delete_plant(&name).await?;
                "plant"
            }
        };
        context
            .output
            .done(json!({ "deleted": { kind: name } }), &format!("{kind} `{name}` is deleted"))
    }
}

impl Singular {
    /// Deletes all that there are; what somebody else deletes meanwhile is gone as well.
    async fn delete_all(self, client: &Client, output: &Output) -> Result<()> {
        let (kind, names) = match self {
            Self::Model => {
                let models = client.list_models().await?.into_iter();
                let names = models.filter(|model| !model.builtin).map(|model| model.name);
                ("models", names.collect::<Vec<_>>())
            }
            Self::Plant => {
                let plants = client.list_plants().await?.into_iter();
                ("plants", plants.map(|plant| plant.id).collect())
            }
        };
        for name in &names {
            let deleted = match self {
                Self::Model => client.delete_model(name).await,
                Self::Plant => client.delete_plant(name).await,
            };
            match deleted {
                Err(error) if error.code() == Some(Code::NotFound) => {}
                deleted => deleted?,
            }
        }
        let said = format!("{} {kind} are deleted", names.len());
        output.done(json!({ "deleted": { kind: names } }), &said)
    }
}

async fn show_plant(client: &Client, context: &Context, id: String) -> Result<()> {
    let model = context.names_of(client, &id).await?;
    let answer = client.get_plant(id).await?;
    let as_text = || {
        let info = answer.plant.as_ref();
        let state = info.and_then(|p| p.state.as_ref());
        [
            info.map(|p| plant::list(std::slice::from_ref(p)).into()),
            info.map(|p| plant::stepping(p).into()),
            state.map(|s| plant::state(s, &model)),
            answer.energy.as_ref().map(|e| plant::energy(e).into()),
            info.map(|p| plant::parameters(p).into()),
            info.and_then(|p| p.feedback.as_ref()).map(|f| plant::feedback(f).into()),
            info.and_then(|p| p.safety.as_ref()).map(|s| safety(s).into()),
        ]
        .into_iter()
        .flatten()
        .collect::<Page>()
    };
    context.output.message("GetPlantResponse", &answer, as_text)
}

/// The bounds that protect a plant, and which of them holds it.
fn safety(safety: &v1::SafetyInfo) -> String {
    let name = |action: v1::WatchdogAction| {
        action.as_str_name().trim_start_matches("WATCHDOG_ACTION_").to_lowercase()
    };
    let mut text = String::new();
    for dog in &safety.watchdogs {
        let end = |end: Option<f64>| end.map_or_else(String::new, number);
        let (min, max) = (end(dog.min), end(dog.max));
        let _ =
            writeln!(text, "  guard {} in [{min}, {max}]: {}", dog.quantity, name(dog.action()));
    }
    if safety.on_step_failure != 0 {
        let _ = writeln!(text, "  guard failed steps: {}", name(safety.on_step_failure()));
    }
    if let Some(trip) = &safety.frozen {
        let (quantity, step) = (trip.watchdog as usize, trip.step);
        let quantity = safety.watchdogs.get(quantity).map_or("", |dog| dog.quantity.as_str());
        let value = number(trip.value);
        let _ = writeln!(text, "  stopped by a watchdog at step {step}: {quantity} = {value}");
    }
    text
}
