//! Streams of answers, and pages of lists.

use std::pin::Pin;

use futures::{Stream, stream};
use tonic::Status;

use crate::wire::status::RpcError;

/// A stream of answers.
pub type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// What makes the messages of a stream, one after the other.
pub(crate) trait Messages: Sized + Send + 'static {
    type Message: Send + 'static;

    /// The next message, or the error that ends the stream.
    fn next(&mut self) -> impl Future<Output = Result<Self::Message, RpcError>> + Send;

    /// The stream.
    fn into_answers(self) -> Answers<Self::Message> {
        // After an error the state is gone, and with it the stream.
        Box::pin(stream::unfold(Some(self), |source| async {
            let mut source = source?;
            match source.next().await {
                Ok(message) => Some((Ok(message), Some(source))),
                Err(fault) => Some((Err(Status::from(fault)), None)),
            }
        }))
    }
}

/// Bytes of plants or models in one page of a list, at most: half of what clients take by default.
pub(crate) const PAGE_BYTES_MAX: usize = 2 << 20;

/// Cuts a page where it becomes too long for one message; true when something was cut off. At least
/// one entry stays.
pub(crate) fn cut_page<M: prost::Message>(entries: &mut Vec<M>) -> bool {
    let mut bytes = 0;
    let fits = entries
        .iter()
        .take_while(|entry| {
            bytes += entry.encoded_len();
            bytes <= PAGE_BYTES_MAX
        })
        .count();
    let is_cut = fits < entries.len();
    entries.truncate(fits.max(1));
    is_cut
}
