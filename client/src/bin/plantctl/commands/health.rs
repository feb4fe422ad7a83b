//! `health`: whether a server serves.

use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use plantd_client::{Client, ConnectOptions, DEFAULT_ADDRESS};
use serde_json::json;

use crate::output::failure::FAILED;
use crate::output::page::table;
use crate::server::context::Context;

/// Says whether the server serves, by gRPC's health service: for what watches over servers. Needs no token.
#[derive(Debug, Args)]
pub(crate) struct Health {
    /// Whether it takes new plants: it does not when it is about to end.
    #[arg(long)]
    ready: bool,
}

/// The service whose health says so.
const PLANTS: &str = "plantd.v1.PlantService";

impl Health {
    pub(crate) async fn run(self, context: &Context) -> Result<ExitCode> {
        let credentials = context.credentials.clone();
        let options = ConnectOptions { credentials, ..ConnectOptions::default() };
        let service = if self.ready { PLANTS } else { "" };
        let address = context.address.as_deref().unwrap_or(DEFAULT_ADDRESS);
        let is_serving = Client::is_serving(address, service, &options).await?;
        let word = if is_serving { "serving" } else { "not serving" };
        let row = || table(&["server", "health"], [vec![address, word]]);
        context.output.print(|| json!({ "address": address, "serving": is_serving }), row)?;
        Ok(if is_serving { ExitCode::SUCCESS } else { ExitCode::from(FAILED) })
    }
}
