//! The page that shows the plants in a browser, and the files of models that it reads: a layer around the gRPC
//! services, on their port, so that page and services have one origin.
//!
//! | request | answer |
//! | --- | --- |
//! | `GET /`, `/viewer.js`, `/viewer.css` | the page, compiled into the program |
//! | `GET /models/NAME/files/PATH` | a file of a model, as it was given to the server |
//! | `GET /metrics` | the metrics, where callers are asked who they are; of the own tenant alone, but for administrators |
//! | another `GET` | 404 |
//! | gRPC, gRPC-Web | the services' |
//! | any other method | 405 |
//!
//! Nothing is read from a disk, and no path is decoded: what is not the name of something is not found.

use std::pin::Pin;
use std::sync::{Arc, LazyLock};
use std::task::{Context, Poll};

use futures::future::{Either, Ready, ready};
use http_body::{Body as HttpBody, Frame, SizeHint};
use plantd_viewer::{HEADERS, PARTS, POLICY, Part};
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::codegen::http::header::{
    ACCEPT_ENCODING, ALLOW, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_LENGTH,
    CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, IF_NONE_MATCH, VARY,
};
use tonic::codegen::http::{HeaderMap, HeaderValue, Method, Request, Response, StatusCode};
use tower::{Layer, Service};

use crate::core::connection::Connection;
use crate::core::files::{File, tag};
use crate::core::metrics::registry::Metrics;
use crate::wire::edge::admission::{OpenCall, Place};
use crate::wire::edge::gate::is_grpc;
use crate::wire::edge::metrics_http::OPEN_METRICS;

/// Tags of [`PARTS`].
static TAGS: LazyLock<[u64; PARTS.len()]> = LazyLock::new(|| PARTS.map(|part| tag(part.bytes)));

/// A file of a model is never a page.
const FILE_POLICY: &str = "default-src 'none'; sandbox; frame-ancestors 'none'";

const TEXT: &str = "text/plain; charset=utf-8";
/// Asked for again each time, and sent again if it is another one.
const ASK_AGAIN: &str = "no-cache";
/// Never another one under this address.
const FOR_GOOD: &str = "public, max-age=31536000, immutable";

/// Finds a file by model and path.
pub type FindFile = Arc<dyn Fn(&str, &str) -> Option<Arc<File>> + Send + Sync>;

/// The layer.
#[derive(Clone)]
pub struct PageLayer {
    /// None where there is no page.
    files: Option<FindFile>,
    /// None where they are not shown here.
    metrics: Option<Arc<Metrics>>,
}

impl PageLayer {
    /// A layer with the page, or without one, and with metrics, or without.
    pub fn new(files: Option<FindFile>, metrics: Option<Arc<Metrics>>) -> Self {
        Self { files, metrics }
    }
}

impl<S> Layer<S> for PageLayer {
    type Service = Page<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Page { inner, files: self.files.clone(), metrics: self.metrics.clone() }
    }
}

/// The service that the layer makes.
#[derive(Clone)]
pub struct Page<S> {
    inner: S,
    files: Option<FindFile>,
    metrics: Option<Arc<Metrics>>,
}

impl<S> Service<Request<Body>> for Page<S>
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
        if is_grpc(&request) {
            return Either::Right(self.inner.call(request));
        }
        let open = request.extensions().get::<Arc<Place>>().cloned().map(Place::call);
        let answer = self.answer(&request);
        Either::Left(ready(Ok(answer.response(request.method(), open))))
    }
}

/// What is answered: headers but for those that all have, and the body.
struct Answer {
    status: StatusCode,
    kind: &'static str,
    policy: &'static str,
    cache: &'static str,
    tag: Option<u64>,
    encoding: Option<&'static str>,
    bytes: Bytes,
}

impl Answer {
    fn text(status: StatusCode, text: &'static str) -> Self {
        Self {
            status,
            kind: TEXT,
            policy: FILE_POLICY,
            cache: "no-store",
            tag: None,
            encoding: None,
            bytes: Bytes::from_static(text.as_bytes()),
        }
    }

    /// Not sent to somebody who has it.
    fn unless_known(mut self, headers: &HeaderMap) -> Self {
        let etag = self.tag.map(etag);
        let is_known = headers.get_all(IF_NONE_MATCH).iter().any(|known| {
            let mut known = known.to_str().unwrap_or_default().split(',').map(str::trim);
            known.any(|known| Some(known.trim_start_matches("W/")) == etag.as_deref())
        });
        if is_known {
            (self.status, self.bytes) = (StatusCode::NOT_MODIFIED, Bytes::new());
        }
        self
    }

    fn response(self, method: &Method, open: Option<OpenCall>) -> Response<Body> {
        let length = self.bytes.len();
        let bytes = Some(self.bytes).filter(|bytes| method != Method::HEAD && !bytes.is_empty());
        let mut response = Response::new(Body::new(Whole { bytes, _open: open }));
        *response.status_mut() = self.status;
        let headers = response.headers_mut();
        for (name, value) in [
            (CONTENT_TYPE, self.kind),
            (CONTENT_SECURITY_POLICY, self.policy),
            (CACHE_CONTROL, self.cache),
        ] {
            headers.insert(name, HeaderValue::from_static(value));
        }
        for (name, value) in HEADERS {
            headers.insert(name, HeaderValue::from_static(value));
        }
        if let Some(encoding) = self.encoding {
            headers.insert(CONTENT_ENCODING, HeaderValue::from_static(encoding));
            headers.insert(VARY, HeaderValue::from_static("accept-encoding"));
        }
        if let Some(Ok(etag)) = self.tag.map(|tag| HeaderValue::try_from(etag(tag))) {
            headers.insert(ETAG, etag);
        }
        if self.status == StatusCode::METHOD_NOT_ALLOWED {
            headers.insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        }
        if method == Method::HEAD && self.status != StatusCode::NOT_MODIFIED {
            headers.insert(CONTENT_LENGTH, HeaderValue::from(length));
        }
        response
    }
}

fn etag(tag: u64) -> String {
    format!("\"{tag:016x}\"")
}

impl<S> Page<S> {
    fn answer(&self, request: &Request<Body>) -> Answer {
        if !matches!(*request.method(), Method::GET | Method::HEAD) {
            return Answer::text(StatusCode::METHOD_NOT_ALLOWED, "only GET, and gRPC\n");
        }
        if let Some(metrics) = self.metrics.as_ref().filter(|_| request.uri().path() == "/metrics")
        {
            return metrics_text(metrics);
        }
        let Some(files) = &self.files else {
            return Answer::text(StatusCode::NOT_FOUND, "this server shows no page\n");
        };
        let path = request.uri().path();
        let (headers, query) = (request.headers(), request.uri().query());
        let part = PARTS.iter().position(|part| part.path == path).map(part);
        let found = part.or_else(|| {
            let (model, path) = path.strip_prefix("/models/")?.split_once("/files/")?;
            Some(file(files(model, path)?, query))
        });
        match found {
            Some(answer) if answer.encoding.is_some() && !takes_gzip(headers) => {
                Answer::text(StatusCode::NOT_ACCEPTABLE, "it is there compressed with gzip alone\n")
            }
            Some(answer) => answer.unless_known(headers),
            None => Answer::text(StatusCode::NOT_FOUND, "there is nothing here\n"),
        }
    }
}

/// All metrics for administrators, and for others those of their own tenant.
fn metrics_text(metrics: &Metrics) -> Answer {
    let text = Answer::text(StatusCode::OK, "");
    let caller = Connection::current();
    let shown =
        if caller.sees_all() { metrics.encode() } else { metrics.encode_of(caller.tenant()) };
    match shown {
        Ok(metrics) => Answer { kind: OPEN_METRICS, bytes: Bytes::from(metrics), ..text },
        Err(_) => Answer { status: StatusCode::INTERNAL_SERVER_ERROR, ..text },
    }
}

fn part(index: usize) -> Answer {
    let Part { kind, bytes, is_compressed, .. } = PARTS[index];
    Answer {
        status: StatusCode::OK,
        kind,
        policy: POLICY,
        cache: ASK_AGAIN,
        tag: Some(TAGS[index]),
        encoding: is_compressed.then_some("gzip"),
        bytes: Bytes::from_static(bytes),
    }
}

/// A file; with its tag in the query it stays as it is.
fn file(file: Arc<File>, query: Option<&str>) -> Answer {
    let is_this_one = query == Some(&format!("v={:016x}", file.tag));
    Answer {
        status: StatusCode::OK,
        // Text and XML would be shown by browsers; those who read a mesh do not ask what it is.
        kind: match file.extension {
            "png" => "image/png",
            "jpg" => "image/jpeg",
            "glb" => "model/gltf-binary",
            _ => "application/octet-stream",
        },
        policy: FILE_POLICY,
        cache: if is_this_one { FOR_GOOD } else { ASK_AGAIN },
        tag: Some(file.tag),
        encoding: None,
        bytes: Bytes::from_owner(Shared(file)),
    }
}

/// A file whose bytes are sent from where they are.
struct Shared(Arc<File>);

impl AsRef<[u8]> for Shared {
    fn as_ref(&self) -> &[u8] {
        &self.0.bytes
    }
}

fn takes_gzip(headers: &HeaderMap) -> bool {
    headers.get_all(ACCEPT_ENCODING).iter().any(|value| {
        value.to_str().unwrap_or_default().split(',').any(|coding| {
            let mut parts = coding.split(';').map(str::trim);
            let is_gzip = parts.next().is_some_and(|name| name.eq_ignore_ascii_case("gzip"));
            let is_refused =
                parts.any(|part| matches!(part, "q=0" | "q=0.0" | "q=0.00" | "q=0.000"));
            is_gzip && !is_refused
        })
    })
}

/// A body in one piece; while it is sent, its connection keeps its place.
struct Whole {
    bytes: Option<Bytes>,
    _open: Option<OpenCall>,
}

impl HttpBody for Whole {
    type Data = Bytes;
    type Error = std::convert::Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Self::Error>>> {
        Poll::Ready(self.bytes.take().map(|bytes| Ok(Frame::data(bytes))))
    }

    fn is_end_stream(&self) -> bool {
        self.bytes.is_none()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.bytes.as_ref().map_or(0, |bytes| bytes.len() as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn takes(coding: &str) -> bool {
        takes_gzip(&HeaderMap::from_iter([(ACCEPT_ENCODING, coding.parse().unwrap())]))
    }

    #[test]
    fn browsers_say_that_they_take_gzip() {
        assert!(takes("gzip, deflate, br, zstd") && takes("br;q=1.0, gzip;q=0.8") && takes("GZIP"));
        assert!(!takes("identity") && !takes("gzip;q=0, br") && !takes("x-gzip") && !takes(""));
        assert!(!takes_gzip(&HeaderMap::new()));
    }
}
