//! The layer through which every request passes where people are asked who they are: page, files, metrics and services
//! lie behind it.

use std::sync::Arc;
use std::task::{Context, Poll};

use futures::future::{Either, Ready, ready};
use plantd_viewer::PARTS;
use tonic::body::Body;
use tonic::codegen::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use tonic::codegen::http::{HeaderValue, Request, Response, StatusCode};
use tonic::{Code, Status};
use tower::{Layer, Service};

use crate::core::metrics::registry::Metrics;
use crate::wire::edge::admission::Place;
use crate::wire::edge::auth::door::{Door, Refused};
use crate::wire::edge::auth::{gateway, role};
use crate::wire::edge::gate::{answer, is_grpc};
use crate::wire::edge::methods::method_label;

/// The layer.
#[derive(Clone)]
pub struct GuardLayer {
    /// None where nobody is asked.
    door: Option<Arc<Door>>,
    metrics: Arc<Metrics>,
}

impl GuardLayer {
    /// A layer that asks at a door, or nobody.
    pub fn new(door: Option<Arc<Door>>, metrics: Arc<Metrics>) -> Self {
        Self { door, metrics }
    }
}

impl<S> Layer<S> for GuardLayer {
    type Service = Guard<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Guard { inner, layer: self.clone() }
    }
}

/// The service that the layer makes.
#[derive(Clone)]
pub struct Guard<S> {
    inner: S,
    layer: GuardLayer,
}

impl<S> Service<Request<Body>> for Guard<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Either<Ready<Result<Self::Response, Self::Error>>, S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        let Some(door) = &self.layer.door else {
            return Either::Right(self.inner.call(request));
        };
        let (path, is_call) = (request.uri().path(), is_grpc(&request));
        if !is_call && PARTS.iter().any(|part| part.path == path) {
            // The page itself shows nothing of anybody.
            return Either::Right(self.inner.call(request));
        }
        let place = request.extensions().get::<Arc<Place>>();
        match door.admit(path, is_call, request.headers(), place) {
            Ok(None) => Either::Right(self.inner.call(request)),
            Ok(Some(pass)) => {
                // It has done its work, and nobody behind here is to know it.
                request.headers_mut().remove(AUTHORIZATION);
                gateway::strip(request.headers_mut());
                request.extensions_mut().insert(Arc::clone(&pass));
                Either::Right(pass.caller().scope(|| self.inner.call(request)))
            }
            Err(Refused { tenant, error: fault }) => {
                let status = Status::from(fault.clone());
                let peer = place.map(|place| place.peer());
                let (reason, code) = (fault.reason(), plantd_proto::code_name(status.code()));
                tracing::debug!(path, ?peer, reason, "refused");
                if is_call {
                    self.layer.metrics.rpc_ended(method_label(path), code, tenant);
                }
                if status.code() == Code::PermissionDenied && role::changes(path) {
                    let why = status.message();
                    tracing::info!(target: "audit", method = path, ?peer, why, result = reason);
                }
                Either::Left(ready(Ok(refusal(&request, status))))
            }
        }
    }
}

/// The status for gRPC; 401, 403 or 429 and a text for others.
fn refusal(request: &Request<Body>, status: Status) -> Response<Body> {
    let code = status.code();
    let mut response = answer(request, status);
    if is_grpc(request) {
        return response;
    }
    *response.status_mut() = match code {
        Code::Unauthenticated => StatusCode::UNAUTHORIZED,
        Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
        _ => StatusCode::FORBIDDEN,
    };
    if code == Code::Unauthenticated {
        response.headers_mut().insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    response
}
