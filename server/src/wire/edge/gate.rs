//! A layer around page and services: refuses pages of strangers, see [`crate::wire::names`].

use std::sync::Arc;
use std::task::{Context, Poll};

use futures::future::{Either, Ready, ready};
use tonic::body::Body;
use tonic::codegen::http::header::{CONTENT_TYPE, HOST, ORIGIN};
use tonic::codegen::http::{HeaderName, HeaderValue, Request, Response, StatusCode};
use tonic::{Code, Status};
use tower::{Layer, Service};

use crate::wire::edge::admission::{Peer, Place};
use crate::wire::names::{Foreign, Names};
use crate::wire::status::RpcError;

/// The layer.
#[derive(Clone)]
pub struct GateLayer {
    names: Arc<Names>,
    /// For what a page could ask for without saying where it comes from.
    strict: Arc<Names>,
}

impl GateLayer {
    /// A layer that lets through what these names allow.
    pub fn new(names: Names) -> Self {
        Self { strict: Arc::new(names.strict()), names: Arc::new(names) }
    }
}

impl<S> Layer<S> for GateLayer {
    type Service = Gate<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Gate { inner, layer: self.clone() }
    }
}

/// The service that the layer makes.
#[derive(Clone)]
pub struct Gate<S> {
    inner: S,
    layer: GateLayer,
}

impl<S> Service<Request<Body>> for Gate<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Either<Ready<Result<Self::Response, Self::Error>>, S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let GateLayer { names, strict } = &self.layer;
        match check(if is_grpc(&request) { names } else { strict }, &request) {
            Ok(()) => Either::Right(self.inner.call(request)),
            Err(foreign) => Either::Left(ready(Ok(refusal(&request, foreign)))),
        }
    }
}

/// Whether it is for a service, and not for the page.
pub(super) fn is_grpc(request: &Request<Body>) -> bool {
    let kind = request.headers().get(CONTENT_TYPE);
    kind.is_some_and(|kind| kind.as_bytes().starts_with(b"application/grpc"))
}

fn check(names: &Names, request: &Request<Body>) -> Result<(), Foreign> {
    // What is no text is no name.
    let of = |name: HeaderName| {
        request.headers().get_all(name).into_iter().map(|value| value.to_str().unwrap_or("?"))
    };
    let place = request.extensions().get::<Arc<Place>>();
    let over_unix = place.is_some_and(|place| place.peer() == Peer::Unix);
    let authority = request.uri().authority().map(|authority| authority.as_str());
    let hosts = || authority.into_iter().chain(of(HOST)).filter(|_| !over_unix);
    names.check(hosts, || of(ORIGIN))
}

/// 403; with PERMISSION_DENIED for gRPC, and as text for others.
fn refusal(request: &Request<Body>, foreign: Foreign) -> Response<Body> {
    tracing::debug!(path = request.uri().path(), %foreign, "refused");
    let mut response = answer(request, Status::from(RpcError::from(foreign)));
    *response.status_mut() = StatusCode::FORBIDDEN;
    response
}

/// A status as gRPC has it, and as text for others.
pub(super) fn answer(request: &Request<Body>, status: Status) -> Response<Body> {
    let kind = request.headers().get(CONTENT_TYPE).filter(|_| is_grpc(request));
    let (mut response, kind) = match kind {
        Some(kind) => (status.into_http(), kind.clone()),
        None => {
            let text = Body::new(format!("{}\n", status.message()));
            (Response::new(text), HeaderValue::from_static("text/plain; charset=utf-8"))
        }
    };
    response.headers_mut().insert(CONTENT_TYPE, kind);
    response
}

impl From<Foreign> for RpcError {
    fn from(foreign: Foreign) -> Self {
        let reason = match foreign {
            Foreign::Host(_) => "FOREIGN_HOST",
            Foreign::Origin(_) => "FOREIGN_ORIGIN",
        };
        Self::new(Code::PermissionDenied, reason, foreign.to_string())
    }
}
