//! `settle`: configurations in which a model rests.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::numbers::{Assignment, assignment, by_name, numbers};
use crate::output::page::{Cell, Page, table};
use crate::output::plant;
use crate::output::text::number;
use crate::server::context::Context;

/// Finds a configuration in which a model rests, from a guess.
#[derive(Debug, Args)]
pub(crate) struct Settle {
    /// Name of a model.
    model: String,
    /// Coordinates that keep their value of the guess, comma-separated.
    #[arg(long, value_delimiter = ',')]
    hold: Vec<String>,
    /// Values of coordinates of the guess; the scene's initial ones if not given.
    #[arg(long, num_args = 1.., value_name = "NAME=VALUE", value_parser = assignment)]
    guess: Vec<Assignment>,
    /// Input forces that act.
    #[arg(long, num_args = 1.., value_name = "NAME=VALUE", value_parser = assignment)]
    inputs: Vec<Assignment>,
    /// Where the origin of a frame shall be in the world, with its orientation w, x, y, z if that matters.
    #[arg(long, value_name = "FRAME=X,Y,Z[,W,X,Y,Z]", value_parser = target, allow_hyphen_values = true)]
    target: Vec<v1::SettleTarget>,
    /// Only satisfy the constraints, and reach the targets.
    #[arg(long)]
    constraints: bool,
    /// Print an operating point in the notation of a scene.
    #[arg(long)]
    toml: bool,
}

impl Settle {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let model = client.get_model(&self.model).await?;
        let goal = match self.constraints {
            true => v1::SettleGoal::Constraints,
            false => v1::SettleGoal::Equilibrium,
        };
        let request = v1::SettleRequest {
            model: self.model,
            hold: self.hold,
            guess: by_name(self.guess),
            inputs: by_name(self.inputs),
            goal: goal.into(),
            targets: self.target,
            ..Default::default()
        };
        let answer = client.settle(request).await?;
        context.output.message("SettleResponse", &answer, || match self.toml {
            true => operating_point(&answer, &model).into(),
            false => settled(&answer, &model),
        })
    }
}

/// A target of a frame.
fn target(text: &str) -> Result<v1::SettleTarget, String> {
    let (frame, values) = text.split_once('=').ok_or("a frame and numbers with `=` are needed")?;
    let values = numbers(values)?.0;
    if ![3, 7].contains(&values.len()) {
        return Err(format!("{} numbers; three or seven are needed", values.len()));
    }
    let (position, orientation) = values.split_at(3);
    Ok(v1::SettleTarget {
        point: Some(v1::FramePoint { frame: frame.to_owned(), at: Vec::new() }),
        position: position.to_vec(),
        orientation: orientation.to_vec(),
    })
}

/// A settled configuration.
fn settled(answer: &v1::SettleResponse, model: &v1::Model) -> Page {
    let coordinates = model.coordinates.iter().map(|c| (c.name.as_str(), names::unit(c)));
    let inputs = model.inputs.iter().map(|name| (name.as_str(), ""));
    let rows = coordinates
        .zip(&answer.q)
        .chain(inputs.zip(&answer.u))
        .map(|((name, unit), value)| vec![Cell::from(name), (*value).into(), unit.into()]);
    let mut text = Page::from(table(&["coordinate or input", "value", "unit"], rows));
    if let Some(equilibrium) = &answer.equilibrium {
        let kind = if equilibrium.stable { "stable" } else { "unstable" };
        let _ = write!(
            text,
            "\n{kind} equilibrium after {} iterations: {} J, smallest stiffness {}, residual {}\n",
            equilibrium.iterations,
            number(equilibrium.potential_j),
            number(equilibrium.smallest_stiffness),
            number(equilibrium.residual)
        );
        if !equilibrium.constraint_forces.is_empty() {
            text.next_table(plant::forces(&equilibrium.constraint_forces, model));
        }
    }
    text
}

/// A settled configuration as an operating point of a scene: what differs from the initial one, in
/// all digits.
fn operating_point(answer: &v1::SettleResponse, model: &v1::Model) -> String {
    let list = |entries: Vec<String>| format!("{{ {} }}", entries.join(", "));
    let coordinates: Vec<_> = model
        .coordinates
        .iter()
        .zip(&answer.q)
        .filter(|(coordinate, value)| coordinate.initial != **value)
        .map(|(coordinate, value)| format!("{} = {value:?}", key(&coordinate.name)))
        .collect();
    let mut text =
        format!("[[operating_points]]\nname = \"settled\"\ncoordinates = {}\n", list(coordinates));
    let inputs: Vec<_> = model
        .inputs
        .iter()
        .zip(&answer.u)
        .filter(|(_, value)| **value != 0.0)
        .map(|(name, value)| format!("{} = {value:?}", key(name)))
        .collect();
    if !inputs.is_empty() {
        let _ = writeln!(text, "inputs = {}", list(inputs));
    }
    text
}

/// A key of TOML, quoted where it must be.
fn key(name: &str) -> String {
    let is_bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !name.is_empty() && name.chars().all(is_bare) {
        return name.to_owned();
    }
    format!("{:?}", name)
}
