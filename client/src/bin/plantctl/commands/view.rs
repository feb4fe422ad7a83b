//! `view`: plants and recordings in a browser.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Result, bail};
use clap::Args;
use plantd_client::{DEFAULT_ADDRESS, RecordingReader};
use serde_json::json;

use crate::server::context::{Context, plant};
use crate::server::page::PageServer;

/// Shows plants, or a recording, in a browser: prints the page's address, and opens it where there is a display.
///
/// The page of plants is the server's (`plantd serve --view`). That of a recording is served from here, to this
/// machine alone, until Ctrl-C; it needs no other server.
#[derive(Debug, Args)]
pub(crate) struct View {
    /// Plant, or the file of a recording; all plants if not given.
    #[arg(value_name = "PLANT|FILE")]
    what: Option<String>,
    /// Do not open a browser.
    #[arg(long)]
    no_open: bool,
}

/// What was named is the file of a recording, and no plant.
pub(crate) fn is_recording(what: &str) -> bool {
    what.ends_with(".mcap") || Path::new(what).is_file()
}

/// Address of the server's page, without a slash at the end.
pub(crate) fn page_of(context: &Context) -> Result<&str> {
    let address = context.address.as_deref().unwrap_or(DEFAULT_ADDRESS);
    if !address.starts_with("http://") {
        bail!(
            "browsers do not reach {address}: give the server's address over TCP, http://host:port"
        );
    }
    Ok(address.trim_end_matches('/'))
}

impl View {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        if let Some(file) = self.what.as_ref().filter(|what| is_recording(what)) {
            // What is no recording is better told here than by the page.
            RecordingReader::open(file)?;
            let server = PageServer::bind(Path::new(file)).await?;
            self.show(&server.url(), context)?;
            return tokio::select! {
                served = server.serve() => served,
                _ = tokio::signal::ctrl_c() => Ok(()),
            };
        }
        let client = context.connect().await?;
        if let Some(id) = &self.what {
            plant(&client, id).await?;
        }
        let address = page_of(context)?;
        let query = self.what.as_ref().map(|id| format!("?plant={id}")).unwrap_or_default();
        self.show(&format!("{address}/{query}"), context)
    }

    fn show(&self, url: &str, context: &Context) -> Result<()> {
        context.output.print(|| json!({ "url": url }), || format!("{url}\n"))?;
        let has_display =
            ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some());
        if has_display && !self.no_open {
            let mut open = Command::new("xdg-open");
            open.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            // Whoever has no such program has the address.
            let _ = open.spawn();
        }
        Ok(())
    }
}
