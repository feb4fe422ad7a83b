//! Server streams with the crate's error type.

use std::pin::Pin;
use std::task::{Context, Poll};

use futures::{Stream, StreamExt as _};

use crate::{Error, Result};

/// Messages that the server sends until it ends the stream; dropping it tells the server to stop.
#[derive(Debug)]
#[must_use = "a stream that is dropped is cancelled"]
pub struct Answers<T> {
    inner: tonic::Streaming<T>,
}

impl<T> Answers<T> {
    pub(crate) fn new(inner: tonic::Streaming<T>) -> Self {
        Self { inner }
    }

    /// The next message; `None` when the server is done.
    pub async fn next(&mut self) -> Result<Option<T>> {
        Ok(self.inner.message().await?)
    }

    /// All messages, in order.
    pub async fn collect(mut self) -> Result<Vec<T>> {
        let mut all = Vec::new();
        while let Some(message) = self.next().await? {
            all.push(message);
        }
        Ok(all)
    }
}

impl<T> Stream for Answers<T> {
    type Item = Result<T>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.inner.poll_next_unpin(context).map_err(Error::from)
    }
}
