//! `step`: steps of a plant.

use anyhow::{Result, ensure};
use clap::Args;
use plantd_client::{Client, MatrixExt as _, v1};

use crate::contract::names;
use crate::input::numbers::{Vector, vector};
use crate::output::page::Page;
use crate::output::plant;
use crate::server::context::{Context, model_of, plant as plant_now, resting};

/// Takes steps.
#[derive(Debug, Args)]
pub(crate) struct Step {
    /// Plant.
    id: String,
    /// Input of a step, comma-separated: input forces, then next prescribed positions; or some of them by name,
    /// `tau=0.1`. Repeat it for several steps. Without it, and where nothing is named, there are no forces and
    /// prescribed coordinates stay.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    u: Vec<Vector>,
    /// Number of steps; those after the last `--u` repeat it.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u32).range(1..))]
    count: Option<u32>,
    /// Print every state, not only the last.
    #[arg(long)]
    all: bool,
}

impl Step {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let model = match self.u.iter().any(Vector::is_named) {
            true => model_of(&client, &self.id).await?,
            false => context.names_of(&client, &self.id).await?,
        };
        let rows = self.rows(&client, &model).await?;
        let cols = rows.first().map_or(0, Vec::len);
        ensure!(rows.iter().all(|row| row.len() == cols), "the inputs differ in length");
        let given = rows.len() as u32;
        let count = self.count.unwrap_or(given.max(1));
        ensure!(count >= given, "{given} inputs for {count} steps");
        let request = v1::StepRequest {
            id: self.id,
            u: Some(v1::Matrix::from_rows(&rows)),
            hold: count - given,
            all_states: self.all,
            ..Default::default()
        };
        let answer = client.step(request).await?;
        context.output.message("StepResponse", &answer, || {
            let states = answer.states.iter().map(|state| plant::state(state, &model));
            states.chain(answer.report.as_ref().map(|r| plant::report(r).into())).collect::<Page>()
        })
    }

    /// The inputs. Forces that are not named are zero, prescribed coordinates that are not named stay.
    async fn rows(&self, client: &Client, model: &v1::Model) -> Result<Vec<Vec<f64>>> {
        let rest = match self.u.iter().any(Vector::is_named) {
            true => resting(&plant_now(client, &self.id).await?, model),
            false => Vec::new(),
        };
        let names = names::input(model);
        self.u.iter().map(|row| row.over("u", &names, &rest)).collect()
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[test]
    fn inputs_may_be_negative() {
        #[derive(clap::Parser)]
        struct CommandLine {
            #[command(flatten)]
            step: Step,
        }
        let line = ["step", "p", "--u", "-1,2e-3", "--u", "0,0"];
        let CommandLine { step: Step { u, .. } } = CommandLine::parse_from(line);
        assert_eq!(u[0].over("u", &["a", "b"], &[]).unwrap(), [-1.0, 2e-3]);
        assert_eq!(u.len(), 2);
    }
}
