//! `export`: the steps of a recording as a table.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use plantd_client::{RecordingEntry, RecordingReader, v1};
use serde_json::json;

use crate::contract::names;
use crate::server::context::Context;

/// Writes the steps of a recording as a table.
#[derive(Debug, Args)]
pub(crate) struct Export {
    /// Recording.
    file: PathBuf,
    /// Table with comma-separated values; `-` is standard output.
    #[arg(long, value_name = "FILE")]
    csv: PathBuf,
}

impl Export {
    /// One line per step, the first one with the names of its columns.
    pub(crate) fn run(self, context: &Context) -> Result<()> {
        let csv = self.csv;
        let mut recording = RecordingReader::open(self.file)?;
        let record = recording.plant().clone();
        let model = record.model.unwrap_or_default();
        let cannot_write = || format!("cannot write {}", csv.display());
        let sink: Box<dyn std::io::Write> = match csv.to_str() {
            Some("-") => Box::new(std::io::stdout().lock()),
            _ => Box::new(File::create(&csv).with_context(cannot_write)?),
        };
        let mut sink = BufWriter::new(sink);
        let (states, inputs) = (names::recorded(&model), names::input(&model));
        let inputs = inputs.iter().map(|name| format!("u({name})"));
        let outputs = record.outputs.iter().map(|name| format!("y({name})"));
        let names = ["step", "time_s"].into_iter().map(str::to_owned).chain(states.clone());
        let velocity = names::velocity(&model);
        let names = names.chain(inputs.clone()).chain(outputs.clone()).chain(velocity);
        let head: Vec<_> = names.map(|name| quoted(&name)).collect();
        writeln!(sink, "{}", head.join(",")).with_context(cannot_write)?;
        let mut line = |state: &v1::State, u: &[f64], y: &[f64]| {
            write!(sink, "{},{:?}", state.step, state.time_s)?;
            let (u, y) = (padded(u.to_vec(), inputs.len()), padded(y.to_vec(), outputs.len()));
            let x = padded(names::recorded_numbers(state), states.len());
            // Older recordings have none.
            let velocity = padded(state.velocity.clone(), model.coordinates.len());
            for cell in x.chain(u).chain(y).chain(velocity) {
                match cell {
                    // Rust prints as many digits as bring the number back.
                    Some(number) => write!(sink, ",{number:?}")?,
                    None => write!(sink, ",")?,
                }
            }
            writeln!(sink)
        };
        let mut steps = 0;
        if let Some(state) = record.plant.and_then(|plant| plant.state) {
            line(&state, &[], &[]).with_context(cannot_write)?;
        }
        while let Some(entry) = recording.next_entry()? {
            let RecordingEntry::Step(step) = entry else { continue };
            let y = step.outputs.as_ref().map_or(&[][..], |outputs| &outputs.y);
            line(&step.state.clone().unwrap_or_default(), &step.u, y).with_context(cannot_write)?;
            steps += 1;
        }
        sink.flush().with_context(cannot_write)?;
        drop(sink);
        if csv.to_str() != Some("-") {
            let done = json!({ "file": csv, "steps": steps, "cut_short": recording.is_cut() });
            context.output.done(done, &format!("{steps} steps are in {}", csv.display()))?;
        }
        Ok(())
    }
}

/// The numbers, and nothing where there are too few.
fn padded(numbers: Vec<f64>, count: usize) -> impl Iterator<Item = Option<f64>> {
    numbers.into_iter().map(Some).chain(std::iter::repeat(None)).take(count)
}

/// A cell of a table.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}
