//! `events`: what happens to a plant besides its steps.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::output::page::{Cell, Page, table};
use crate::server::context::Context;

/// Prints what happens to a plant besides its steps. Ends with Ctrl-C or after `--count`.
#[derive(Debug, Args)]
pub(crate) struct Events {
    /// Plant.
    id: String,
    /// Begin with the event of this number; a plant keeps 256 of them. From now on if not given.
    #[arg(long)]
    since: Option<u64>,
    /// End after this many events.
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

impl Events {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let mut events = client.watch_events(self.id, self.since).await?;
        let mut left = self.count.unwrap_or(u64::MAX);
        while left > 0
            && let Some(message) = events.next().await?
        {
            let as_text = || message.event.as_ref().map(text).unwrap_or_default();
            context.output.message("WatchEventsResponse", &message, as_text)?;
            left -= 1;
        }
        Ok(())
    }
}

/// An event: a line for people, a row for programs.
fn text(event: &v1::Event) -> Page {
    let kind = event.kind().as_str_name().trim_start_matches("EVENT_KIND_").to_lowercase();
    let kind = kind.replace('_', " ");
    let v1::Event { number, step, subject, value, .. } = event;
    let mut page = Page::from(format!("{number:6}  step {step:8}  {kind} {subject} {value}\n"));
    let row = vec![
        Cell::from(*number),
        (*step).into(),
        kind.into(),
        subject.as_str().into(),
        (*value).into(),
    ];
    page.data(table(&["event", "step", "kind", "subject", "value"], [row]));
    page
}
