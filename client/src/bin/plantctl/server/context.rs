//! What every command is given: the server's address, and where results go.

use anyhow::{Context as _, Result};
use plantd_client::{Answers, Client, ConnectOptions, Credentials, DEFAULT_ADDRESS, Error, v1};

use crate::output::printer::Output;

/// What every command is given.
pub(crate) struct Context {
    /// The server's address, if one was given.
    pub(crate) address: Option<String>,
    /// How the user shows there who they are.
    pub(crate) credentials: Credentials,
    /// Where results go.
    pub(crate) output: Output,
}

impl Context {
    /// Connects to the server.
    pub(crate) async fn connect(&self) -> Result<Client> {
        self.connect_to(self.address.as_deref().unwrap_or(DEFAULT_ADDRESS)).await
    }

    /// The model of a plant, whose names people see beside its numbers; programs know them.
    pub(crate) async fn names_of(&self, client: &Client, id: &str) -> Result<v1::Model> {
        match self.output.is_json() {
            true => Ok(v1::Model::default()),
            false => model_of(client, id).await,
        }
    }

    /// Goes where a plant has gone, if that is why a command was refused: whether there is another address now.
    pub(crate) async fn follow(&mut self, error: &anyhow::Error) -> Result<bool> {
        let refused = error.downcast_ref::<Error>();
        let Some(address) = refused.and_then(Error::elsewhere) else { return Ok(false) };
        // Not everywhere: a token is for networks that keep it.
        self.connect().await?.at(address).await?;
        self.address = Some(address.to_owned());
        Ok(true)
    }

    /// Connects to a server at an address, as the same user.
    pub(crate) async fn connect_to(&self, address: &str) -> Result<Client> {
        self.connect_as(address, self.credentials.clone()).await
    }

    /// Connects to a server at an address, as somebody.
    pub(crate) async fn connect_as(
        &self,
        address: &str,
        credentials: Credentials,
    ) -> Result<Client> {
        let options = ConnectOptions { credentials, ..ConnectOptions::default() };
        Ok(Client::connect_with(address, options).await?)
    }
}

/// A plant as it is now.
pub(crate) async fn plant(client: &Client, id: &str) -> Result<v1::PlantInfo> {
    client.get_plant(id).await?.plant.context("no plant in the answer")
}

/// The model of a plant.
pub(crate) async fn model_of(client: &Client, id: &str) -> Result<v1::Model> {
    Ok(client.get_model(plant(client, id).await?.model).await?)
}

/// The input under which nothing happens to a plant: no forces, prescribed coordinates where they are.
pub(crate) fn resting(plant: &v1::PlantInfo, model: &v1::Model) -> Vec<f64> {
    let q = plant.state.as_ref().map_or(&[][..], |state| &state.q);
    let here = model.coordinates.iter().zip(q).filter(|(c, _)| c.prescribed).map(|(_, q)| *q);
    model.inputs.iter().map(|_| 0.0).chain(here).collect()
}

/// Hands over the messages of a stream until it ends, Ctrl-C is pressed, or there were `count`.
pub(crate) async fn for_each<T>(
    mut messages: Answers<T>,
    count: Option<u64>,
    mut print: impl FnMut(T) -> Result<()>,
) -> Result<()> {
    let mut seen = 0;
    while count.is_none_or(|count| seen < count) {
        let next = tokio::select! {
            next = messages.next() => next?,
            _ = tokio::signal::ctrl_c() => None,
        };
        let Some(message) = next else { break };
        print(message)?;
        seen += 1;
    }
    Ok(())
}
