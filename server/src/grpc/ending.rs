//! Services of other crates, health and reflection, made to end with the server: their open streams
//! would hold up its end. Those of this crate end by themselves, with details.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use futures::FutureExt as _;
use futures::future::BoxFuture;
use http_body::{Body as HttpBody, Frame};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::server::NamedService;
use tower::Service;

/// A service whose streams end with UNAVAILABLE when the server does.
#[derive(Clone)]
pub struct Ending<S> {
    inner: S,
    ending: CancellationToken,
    was_asked: Arc<AtomicBool>,
}

impl<S> Ending<S> {
    /// The service, ending with `ending`.
    pub fn new(inner: S, ending: CancellationToken) -> Self {
        Self { inner, ending, was_asked: Arc::default() }
    }

    /// Set by the first call.
    pub fn was_asked(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.was_asked)
    }
}

impl<S: NamedService> NamedService for Ending<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<Request<Body>> for Ending<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = BoxFuture<'static, Result<Self::Response, Self::Error>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        self.was_asked.store(true, Ordering::Relaxed);
        let until = |ended: Pin<Box<WaitForCancellationFutureOwned>>, farewell| {
            move |body| Body::new(EndingBody { body, ended, has_ended: false, farewell })
        };
        let ended = || Box::pin(self.ending.clone().cancelled_owned());
        // Whoever still reads requests would keep the connection open.
        let (to_request, to_response) = (until(ended(), false), until(ended(), true));
        let response = self.inner.call(request.map(to_request));
        Box::pin(async move { Ok(response.await?.map(to_response)) })
    }
}

/// A body that ends with the server: what is ready comes first, then the end, of an answer with its status.
struct EndingBody {
    body: Body,
    ended: Pin<Box<WaitForCancellationFutureOwned>>,
    has_ended: bool,
    farewell: bool,
}

impl HttpBody for EndingBody {
    type Data = <Body as HttpBody>::Data;
    type Error = <Body as HttpBody>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        if self.has_ended {
            return Poll::Ready(None);
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        if frame.is_ready() || self.ended.poll_unpin(context).is_pending() {
            return frame;
        }
        self.has_ended = true;
        if !self.farewell {
            return Poll::Ready(None);
        }
        let mut trailers = HeaderMap::new();
        // A status without metadata always fits into headers.
        let _ = Status::unavailable("the server is shutting down").add_header(&mut trailers);
        Poll::Ready(Some(Ok(Frame::trailers(trailers))))
    }

    fn is_end_stream(&self) -> bool {
        self.has_ended || self.body.is_end_stream()
    }
}
