//! Services of other crates, health and reflection, made to end with the server: their open streams
//! would hold up its end. Those of this crate end by themselves, with details.

use std::pin::Pin;
use std::task::{Context, Poll};

use futures::FutureExt as _;
use http_body::{Body as HttpBody, Frame};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::server::NamedService;
use tonic::service::LayerExt as _;
use tower::Service;
use tower::util::{MapRequestLayer, MapResponseLayer};

/// The service, whose streams end with UNAVAILABLE when `ending` is cancelled.
pub fn ending_with<S>(
    service: S,
    ending: CancellationToken,
) -> impl Service<Request<Body>, Response = Response<Body>, Error = S::Error, Future: Send>
+ NamedService
+ Clone
+ Send
+ Sync
+ 'static
where
    S: Service<Request<Body>, Response = Response<Body>, Future: Send>,
    S: NamedService + Clone + Send + Sync + 'static,
{
    let wrap = move |farewell| {
        let ending = ending.clone();
        move |body| {
            let ended = Box::pin(ending.clone().cancelled_owned());
            Body::new(EndingBody { body, ended, has_ended: false, farewell })
        }
    };
    // Whoever still reads requests would keep the connection open.
    let (question, answer) = (wrap(false), wrap(true));
    let questions = MapRequestLayer::new(move |request: Request<Body>| request.map(&question));
    let answers = MapResponseLayer::new(move |response: Response<Body>| response.map(&answer));
    answers.named_layer(questions.named_layer(service))
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
