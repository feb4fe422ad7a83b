//! `timing`: what a plant's loop has counted.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

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

fn text(timing: &v1::GetTimingResponse) -> String {
    let mut text = format!(
        "{:12} {:>10} {:>10} {:>10} {:>10} {:>10}\n",
        "us", "mean", "p50", "p99", "p99.9", "max"
    );
    for (name, times) in [
        ("lateness", &timing.lateness),
        ("step", &timing.step),
        ("input age", &timing.input_age),
        ("round trip", &timing.round_trip),
    ] {
        let Some(times) = times.as_ref().filter(|times| times.count > 0) else { continue };
        let us = |time_ns: u64| time_ns as f64 * 1e-3;
        let _ = writeln!(
            text,
            "{name:12} {:10.1} {:10.1} {:10.1} {:10.1} {:10.1}",
            us(times.mean_ns),
            us(times.p50_ns),
            us(times.p99_ns),
            us(times.p999_ns),
            us(times.max_ns)
        );
    }
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
