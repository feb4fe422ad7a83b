//! `project-reference`: motions of a model that follow configurations from elsewhere.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::contract::names;
use crate::input::files::read_table;
use crate::input::settings::Settings;
use crate::input::weights::Weights;
use crate::output::page::{Page, table};
use crate::output::text::number;
use crate::server::context::Context;

/// Finds a motion of a model that follows configurations from elsewhere. The configurations come,
/// and the motion goes, as comma-separated values, one row per step; what the reference is like
/// goes to standard error.
#[derive(Debug, Args)]
pub(crate) struct ProjectReference {
    /// Name of a model.
    model: String,
    /// File of configurations, a column per coordinate, with or without a head; `-` reads
    /// standard input.
    reference: PathBuf,
    /// File of planned inputs, one row less; those that fit best if not given.
    #[arg(long, value_name = "FILE")]
    u: Option<PathBuf>,
    #[command(flatten)]
    settings: Settings,
    /// Weights of the regulator that pulls the plant along the reference.
    #[command(flatten)]
    weights: Weights,
    /// Error in an acceleration or a constraint up to which the reference is a motion.
    #[arg(long, value_name = "NUMBER", default_value_t = 0.0)]
    tolerance: f64,
    /// Refuse a reference that is not a motion.
    #[arg(long)]
    strict: bool,
}

impl ProjectReference {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        use v1::project_reference_response::Response;
        let client = context.connect().await?;
        let output = &context.output;
        let q = Some(read_table(&self.reference)?);
        let u = self.u.as_deref().map(read_table).transpose()?;
        let model = client.get_model(&self.model).await?;
        let request = v1::ProjectReferenceRequest {
            model: self.model,
            settings: Some(self.settings.into()),
            q,
            u,
            projection: Some(self.weights.for_model(&model)?),
            tolerance: self.tolerance,
            strict: self.strict,
            ..Default::default()
        };
        let mut messages = client.project_reference(request).await?;
        let (x, u) = (names::state(&model), names::input(&model));
        let head: Vec<_> = x.into_iter().chain(u.iter().map(|name| format!("u({name})"))).collect();
        let names: Vec<&str> = head.iter().map(String::as_str).collect();
        while let Some(message) = messages.next().await? {
            let text = match &message.response {
                Some(Response::Report(report)) => {
                    if output.is_for_people() {
                        eprint!("{}", text(report));
                    }
                    head.clone()
                }
                Some(Response::Step(step)) => {
                    // The last state has no input.
                    let entries = step.u_reference.iter().map(f64::to_string);
                    let entries = entries.chain(std::iter::repeat(String::new())).take(u.len());
                    step.x_reference.iter().map(f64::to_string).chain(entries).collect()
                }
                None => continue,
            };
            let is_row = matches!(message.response, Some(Response::Step(_)));
            let row = || {
                let mut page = Page::from(format!("{}\n", text.join(",")));
                page.data(table(&names, is_row.then_some(text)));
                page
            };
            output.message("ProjectReferenceResponse", &message, row)?;
        }
        Ok(())
    }
}

/// How a reference compares with motions of the plant.
fn text(report: &v1::ReferenceReport) -> String {
    let mut text = String::new();
    let verdict = if report.feasible { "is a motion" } else { "is not a motion" };
    let _ = writeln!(text, "the reference {verdict} of the plant");
    if !report.constraint.is_empty() {
        let _ = writeln!(
            text,
            "  constraints: off by {} at step {} ({})",
            number(report.constraint_violation),
            report.constraint_violation_step,
            report.constraint
        );
    }
    let _ = writeln!(
        text,
        "  forces: {} of {} at step {} cannot be exerted",
        number(report.unexplained_force),
        report.unexplained_force_coordinate,
        report.unexplained_force_step
    );
    let _ = writeln!(
        text,
        "  accelerations: {} of {} at step {} cannot be had",
        number(report.unexplained_acceleration),
        report.unexplained_coordinate,
        report.unexplained_step
    );
    let _ = writeln!(
        text,
        "  the motion found deviates by {} in {} at step {}",
        number(report.deviation),
        report.deviation_coordinate,
        report.deviation_step
    );
    text
}
