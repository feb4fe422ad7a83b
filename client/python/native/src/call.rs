//! Calls with a stream of answers.

use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};
use tokio_stream::wrappers::UnboundedReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Request, Status, Streaming};

use crate::codec::AsBytes;
use crate::server::{Inner, refused};

/// A call under way.
#[pyclass(frozen, module = "plantd._native")]
pub(crate) struct Call {
    inner: Arc<Inner>,
    /// None when there are no more.
    requests: Mutex<Option<UnboundedSender<Bytes>>>,
    answers: tokio::sync::Mutex<Answers>,
    cancelled: CancellationToken,
}

enum Answers {
    Open(Box<Streaming<Bytes>>),
    /// It ended, in good order or not.
    Ended(Result<(), Status>),
}

impl Call {
    /// Begins it with its one request, or with none so far.
    pub(crate) fn begin(
        py: Python<'_>,
        inner: Arc<Inner>,
        path: PathAndQuery,
        request: Option<Bytes>,
    ) -> PyResult<Self> {
        let (sender, receiver) = unbounded_channel();
        let requests = match request {
            Some(request) => {
                // The other end is here.
                let _ = sender.send(request);
                // It is the only one: the server waits for their end.
                drop(sender);
                None
            }
            None => Some(sender),
        };
        let mut grpc = inner.grpc();
        let begun = inner.wait(py, async move {
            let Ok(()) = grpc.ready().await;
            let requests = UnboundedReceiverStream::new(receiver);
            grpc.streaming(Request::new(requests), path, AsBytes).await
        })?;
        // A refusal is the first answer, as over a connection.
        let answers = match begun {
            Ok(answers) => Answers::Open(Box::new(answers.into_inner())),
            Err(status) => Answers::Ended(Err(status)),
        };
        Ok(Self {
            inner,
            requests: Mutex::new(requests),
            answers: tokio::sync::Mutex::new(answers),
            cancelled: CancellationToken::new(),
        })
    }
}

#[pymethods]
impl Call {
    /// Sends a request; one after the end of the call is lost.
    fn send(&self, request: &[u8]) {
        let requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(requests) = &*requests {
            let _ = requests.send(Bytes::copy_from_slice(request));
        }
    }

    /// There are no more requests.
    fn finish(&self) {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// The next answer; None after the last.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyBytes>>> {
        self.inner.check()?;
        let answer = self.inner.wait(py, async {
            let mut answers = self.answers.lock().await;
            let answer = match &mut *answers {
                Answers::Open(answers) => tokio::select! {
                    biased;
                    () = self.cancelled.cancelled() => {
                        Err(Status::cancelled("the call was cancelled here"))
                    }
                    answer = answers.message() => answer,
                },
                Answers::Ended(end) => end.clone().map(|()| None),
            };
            if !matches!(answer, Ok(Some(_))) {
                *answers = Answers::Ended(answer.clone().map(|_| ()));
            }
            answer
        })?;
        let answer = answer.map_err(|status| refused(&status, false))?;
        Ok(answer.map(|answer| PyBytes::new(py, &answer)))
    }

    /// Ends it; who waits for an answer learns that.
    fn cancel(&self) {
        self.cancelled.cancel();
        self.finish();
        self.end();
    }
}

impl Call {
    fn end(&self) {
        // Whoever waits for an answer has it, and ends the call.
        let Ok(mut answers) = self.answers.try_lock() else { return };
        if let Answers::Open(_) = &*answers {
            let ended = Answers::Ended(Err(Status::cancelled("the call was cancelled here")));
            self.inner.inside(|| *answers = ended);
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        self.end();
    }
}
