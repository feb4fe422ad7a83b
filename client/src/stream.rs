//! Server streams with the crate's error type.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::{Stream, StreamExt as _};

use crate::connection::within;
use crate::error::{Error, Result};

/// Messages that the server sends until it ends the stream; dropping it tells the server to stop.
#[derive(Debug)]
#[must_use = "a stream that is dropped is cancelled"]
pub struct Answers<T> {
    inner: tonic::Streaming<T>,
}

impl<T> Answers<T> {
    /// Waits until a stream is open, but not longer than `limit`.
    pub(crate) async fn open(
        limit: Duration,
        call: impl Future<Output = Result<tonic::Response<tonic::Streaming<T>>, tonic::Status>>,
    ) -> Result<Self> {
        Ok(Self { inner: within(limit, call).await?.into_inner() })
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
