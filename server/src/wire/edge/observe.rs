//! A layer around all services: counts calls by method and code, knows for which connection they are, keeps the places
//! of connections with open calls, bounds what unfinished messages take, and gives the one error that
//! tonic itself makes of a request, an oversized message, its documented code and details.

use std::collections::HashSet;
use std::pin::Pin;
use std::sync::{Arc, LazyLock};
use std::task::{Context, Poll};

use futures::future::BoxFuture;
use http_body::{Body as HttpBody, Frame, SizeHint};
use plantd_proto::{FILE_DESCRIPTOR_SET, code_name};
use prost::Message as _;
use prost_types::FileDescriptorSet;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::{Code, Status};
use tower::{Layer, Service};

use crate::core::connection::Connection;
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::metrics::registry::Metrics;
use crate::wire::edge::admission::{OpenCall, Place};
use crate::wire::edge::unfinished::Budget;
use crate::wire::status::RpcError;

/// Paths of all methods of `plantd.v1`: the only ones that become labels of metrics.
static METHODS: LazyLock<HashSet<String>> = LazyLock::new(|| {
    // The descriptors were encoded by this crate's own build.
    let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap_or_default();
    let mut methods = HashSet::new();
    for file in &set.file {
        for service in &file.service {
            for method in &service.method {
                methods.insert(format!("/{}.{}/{}", file.package(), service.name(), method.name()));
            }
        }
    }
    methods
});

fn method_label(path: &str) -> &'static str {
    METHODS.get(path).map_or("other", |path| path.as_str())
}

/// Name and value of the limit on messages to a method, by its path.
fn message_limit(limits: &Limits, path: &str) -> (&'static str, u64) {
    let is_small = path.starts_with("/plantd.v1.ChannelService/");
    if is_small && limits.channel_message_bytes < limits.message_bytes {
        ("channel_message_bytes", limits.channel_message_bytes)
    } else {
        ("message_bytes", limits.message_bytes)
    }
}

/// Turns tonic's refusal of an oversized message into the server's own.
pub(crate) fn with_limit_details(status: Status, path: &str, limits: &Limits) -> Status {
    // No service of this server answers OUT_OF_RANGE, so this is tonic's decoder.
    if status.code() != Code::OutOfRange {
        return status;
    }
    let (name, limit) = message_limit(limits, path);
    let actual = status
        .message()
        .split_once("found ")
        .and_then(|(_, rest)| rest.split(' ').next()?.parse().ok())
        .unwrap_or(limit.saturating_add(1));
    let what = "bytes in a message";
    RpcError::from(LimitExceeded { name, limit, what, actual }).into()
}

/// The layer.
#[derive(Clone)]
pub struct ObserveLayer {
    metrics: Arc<Metrics>,
    limits: Arc<Limits>,
    unfinished: Arc<Budget>,
}

impl ObserveLayer {
    /// A layer that counts into `metrics`.
    pub fn new(metrics: Arc<Metrics>, limits: Limits) -> Self {
        let unfinished = Arc::new(Budget::new(&limits));
        Self { metrics, limits: Arc::new(limits), unfinished }
    }
}

impl<S> Layer<S> for ObserveLayer {
    type Service = Observe<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Observe { inner, layer: self.clone() }
    }
}

/// The service that the layer makes.
#[derive(Clone)]
pub struct Observe<S> {
    inner: S,
    layer: ObserveLayer,
}

impl<S> Service<Request<Body>> for Observe<S>
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
        let mut call = Call {
            metrics: Arc::clone(&self.layer.metrics),
            method: method_label(request.uri().path()),
            code: None,
            _open: request.extensions().get::<Arc<Place>>().cloned().map(Place::call),
        };
        let limits = Arc::clone(&self.layer.limits);
        let place = request.extensions().get::<Arc<Place>>();
        let connection = Connection::numbered(place.map_or(0, |place| place.id() + 1));
        let unfinished = &self.layer.unfinished;
        let response = self.inner.call(request.map(|body| unfinished.follow(call.method, body)));
        Box::pin(async move {
            let mut response = connection.work(response).await?;
            if let Some(status) = Status::from_header_map(response.headers()) {
                if status.code() == Code::OutOfRange {
                    response = with_limit_details(status, call.method, &limits).into_http();
                }
                call.see(response.headers());
            }
            Ok(response.map(|body| Body::new(Observed { body, call, connection })))
        })
    }
}

/// A call on its way; counted when dropped.
struct Call {
    metrics: Arc<Metrics>,
    method: &'static str,
    code: Option<Code>,
    /// Keeps its connection's place.
    _open: Option<OpenCall>,
}

impl Call {
    fn see(&mut self, headers: &HeaderMap) {
        if let Some(code) = headers.get("grpc-status") {
            self.code = Some(Code::from_bytes(code.as_bytes()));
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        // Without a status the client went away first.
        let code = self.code.unwrap_or(Code::Cancelled);
        self.metrics.rpc_ended(self.method, code_name(code));
    }
}

/// A body that looks out for the status in the trailers.
struct Observed {
    body: Body,
    call: Call,
    connection: Connection,
}

impl HttpBody for Observed {
    type Data = <Body as HttpBody>::Data;
    type Error = <Body as HttpBody>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        let this = &mut *self;
        let frame = this.connection.scope(|| Pin::new(&mut this.body).poll_frame(context));
        if let Poll::Ready(Some(Ok(frame))) = &frame
            && let Some(trailers) = frame.trailers_ref()
        {
            this.call.see(trailers);
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_are_known_by_path() {
        let path = "/plantd.v1.PlantService/Drive";
        assert_eq!(method_label(path), path);
        assert_eq!(method_label("/plantd.v1.PlantService/Nonsense"), "other");
    }
}
