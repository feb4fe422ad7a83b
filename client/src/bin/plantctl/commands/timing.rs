//! `timing`: what a plant's loop has counted.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::output::page::{Cell, Page, table};
use crate::server::context::Context;

/// Prints what the loop of a plant that runs by itself has counted.
#[derive(Debug, Args)]
pub(crate) struct Timing {
    /// Plant.
    id: String,
    /// Begin to count anew.
    #[arg(long)]
    clear: bool,
}

impl Timing {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let timing = client.timing(self.id, self.clear).await?;
        context.output.message("GetTimingResponse", &timing, || text(&timing))
    }
}

fn text(timing: &v1::GetTimingResponse) -> Page {
    let times = [
        ("lateness", &timing.lateness),
        ("step", &timing.step),
        ("input age", &timing.input_age),
        ("round trip", &timing.round_trip),
    ];
    let row = |(name, times): (&str, &Option<v1::TimeSummary>)| {
        let times = times.as_ref().filter(|times| times.count > 0)?;
        let us = |time_ns: u64| Cell::from(format!("{:.1}", time_ns as f64 * 1e-3));
        let spread = [times.p50_ns, times.p99_ns, times.p999_ns, times.max_ns].map(us);
        Some([name.into(), us(times.mean_ns)].into_iter().chain(spread).collect())
    };
    let head = ["us", "mean", "p50", "p99", "p99.9", "max"];
    let mut text = Page::from(table(&head, times.into_iter().filter_map(row)));
    let _ = writeln!(
        text,
        "{} steps, {} overruns, {} slips, {} late inputs, {} safe inputs, {} unused inputs",
        timing.steps,
        timing.overruns,
        timing.slips,
        timing.late_inputs,
        timing.safe_inputs,
        timing.unused_inputs
    );
    text
}
