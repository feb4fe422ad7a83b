//! A layer around all services: counts calls by method and code, knows for whom they are, writes down what changes
//! something, ends calls whose credential is over, keeps the places of connections with open calls, bounds what unfinished messages take, and gives the one error that
//! tonic itself makes of a request, an oversized message, its documented code and details.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use futures::future::BoxFuture;
use http_body::{Body as HttpBody, Frame, SizeHint};
use plantd_proto::code_name;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::{Code, Status};
use tower::{Layer, Service};
use tracing::{Instrument as _, Span};

use crate::core::connection::{Caller, Connection};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::metrics::registry::Metrics;
use crate::core::tenant::Tenant;
use crate::wire::edge::admission::{OpenCall, Peer, Place};
use crate::wire::edge::auth::credential::{Over, Pass};
use crate::wire::edge::auth::role;
use crate::wire::edge::methods::method_label;
use crate::wire::edge::trace;
use crate::wire::edge::unfinished::Budget;
use crate::wire::status::RpcError;

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
        let pass = request.extensions().get::<Arc<Pass>>().cloned();
        let method = method_label(request.uri().path());
        let span = trace::of_call(method, request.headers());
        let mut call = Call {
            span: span.clone(),
            metrics: Arc::clone(&self.layer.metrics),
            method,
            code: None,
            pass: pass.clone(),
            peer: request.extensions().get::<Arc<Place>>().map(|place| place.peer()),
            _open: request.extensions().get::<Arc<Place>>().cloned().map(Place::call),
        };
        let limits = Arc::clone(&self.layer.limits);
        let place = request.extensions().get::<Arc<Place>>();
        let caller = match &pass {
            Some(pass) => pass.caller(),
            None => Connection::numbered(place.map_or(0, |place| place.id() + 1)).into(),
        };
        let unfinished = &self.layer.unfinished;
        let rate = pass.as_ref().map(|pass| pass.messages());
        let follow = |body| unfinished.follow(call.method, body, rate);
        let response = self.inner.call(request.map(follow));
        let answer = async move {
            let mut watch = pass.map(Watch::new);
            let answered = caller.clone().work(response);
            let mut response = match &mut watch {
                None => answered.await?,
                Some(watch) => tokio::select! {
                    biased;
                    response = answered => response?,
                    () = &mut watch.ended => watch.farewell().into_http(),
                },
            };
            if let Some(status) = Status::from_header_map(response.headers()) {
                if status.code() == Code::OutOfRange {
                    response = with_limit_details(status, call.method, &limits).into_http();
                }
                call.see(response.headers());
            }
            Ok(response
                .map(|body| Body::new(Observed { body, call, caller, watch, has_ended: false })))
        };
        Box::pin(answer.instrument(span))
    }
}

/// A call on its way; counted when dropped.
struct Call {
    /// Lasts as long as the call.
    span: Span,
    metrics: Arc<Metrics>,
    method: &'static str,
    code: Option<Code>,
    /// Of whom, and from where.
    pass: Option<Arc<Pass>>,
    peer: Option<Peer>,
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
        self.span.record("rpc.code", code_name(code));
        let tenant = self.pass.as_ref().map_or(Tenant::NONE, |pass| pass.principal().tenant);
        self.metrics.rpc_ended(self.method, code_name(code), tenant);
        if let Some(pass) = &self.pass
            && role::changes(self.method)
        {
            let (who, peer) = (pass.principal(), self.peer);
            tracing::info!(
                target: "audit",
                who = who.name,
                tenant = who.tenant_name,
                role = who.role.as_str(),
                ?peer,
                method = self.method,
                what = pass.subject(),
                result = code_name(code),
            );
        }
    }
}

/// A body that looks out for the status in the trailers.
struct Observed {
    body: Body,
    call: Call,
    caller: Caller,
    watch: Option<Watch>,
    has_ended: bool,
}

/// Looks whether the credential of a call is over.
struct Watch {
    pass: Arc<Pass>,
    ended: Pin<Box<dyn Future<Output = ()> + Send>>,
}

impl Watch {
    fn new(pass: Arc<Pass>) -> Self {
        let ended = Box::pin(pass.ended());
        Self { pass, ended }
    }

    /// The status of a call that has ended so.
    fn farewell(&self) -> Status {
        RpcError::from(self.pass.over().unwrap_or(Over::Revoked)).into()
    }
}

impl HttpBody for Observed {
    type Data = <Body as HttpBody>::Data;
    type Error = <Body as HttpBody>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        let this = &mut *self;
        if this.has_ended {
            return Poll::Ready(None);
        }
        let is_over = this.watch.as_ref().is_some_and(|watch| watch.pass.over().is_some());
        let caller = &this.caller;
        let frame = match is_over {
            true => Poll::Pending,
            false => this
                .call
                .span
                .in_scope(|| caller.clone().scope(|| Pin::new(&mut this.body).poll_frame(context))),
        };
        if frame.is_pending()
            && let Some(watch) = &mut this.watch
            && (is_over || watch.ended.as_mut().poll(context).is_ready())
        {
            let mut trailers = HeaderMap::new();
            // A status with few details always fits into headers.
            let _ = watch.farewell().add_header(&mut trailers);
            this.call.see(&trailers);
            // What was under way ends with its body, and a lease with that.
            (this.body, this.has_ended) = (Body::empty(), true);
            return Poll::Ready(Some(Ok(Frame::trailers(trailers))));
        }
        if let Poll::Ready(Some(Ok(frame))) = &frame
            && let Some(trailers) = frame.trailers_ref()
        {
            this.call.see(trailers);
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.has_ended || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
