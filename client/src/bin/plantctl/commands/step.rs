//! `step`: steps of a plant.

use anyhow::{Result, ensure};
use clap::Args;
use plantd_client::{MatrixExt as _, v1};

use crate::input::numbers::{Numbers, numbers};
use crate::output::plant;
use crate::server::context::Context;

/// Takes steps.
#[derive(Debug, Args)]
pub(crate) struct Step {
    /// Plant.
    id: String,
    /// Input of a step, comma-separated: input forces, then next prescribed positions. Repeat
    /// it for several steps. Without it there are no forces and prescribed coordinates stay.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    u: Vec<Numbers>,
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
        let rows: Vec<_> = self.u.into_iter().map(|row| row.0).collect();
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
            let states = answer.states.iter().map(plant::state);
            states.chain(answer.report.as_ref().map(plant::report)).collect()
        })
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
        assert_eq!((u[0].0.as_slice(), u.len()), ([-1.0, 2e-3].as_slice(), 2));
    }
}
